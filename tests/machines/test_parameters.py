"""Parameters: what can be built, what can't, and what stands where nothing is said."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.errors import MachineError, ParameterError
from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset


def test_defaults():
    parameters = BM1Parameters(lines=256, sensor_bits=(7, 7, 7, 9, 9, 9))
    assert (parameters.sensors, parameters.columns) == (6, 7)
    assert (parameters.prob_bits, parameters.counter_bits, parameters.rng_banks) == (8, 8, 16)
    assert (parameters.rng, parameters.rng_reset, parameters.shared) == (RngKind.LFSR32, RngReset.BANK, True)
    assert (parameters.prior_mode, parameters.prior_addresses) == (PriorMode.TABLE, 1)
    assert parameters.ones_code == 255
    assert parameters.target_count_max == 255
    assert [parameters.missing_address(column) for column in range(1, 7)] == [127, 127, 127, 511, 511, 511]


@pytest.mark.parametrize(
    ("prob_bits", "steps"), [(1, 1), (2, 2), (3, 4), (4, 4), (5, 8), (8, 8), (9, 16), (16, 16)]
)
def test_an_lfsr_makes_as_many_steps_a_clock_as_give_fresh_bits(prob_bits, steps):
    assert BM1Parameters(lines=1, sensor_bits=(), prob_bits=prob_bits).steps_per_clock == steps


@pytest.mark.parametrize("rng", [RngKind.TABLE, RngKind.IDEAL])
def test_other_generators_make_one(rng):
    assert BM1Parameters(lines=1, sensor_bits=(), rng=rng).steps_per_clock == 1


def test_a_number_of_steps_stands_as_it_is():
    assert BM1Parameters(lines=1, sensor_bits=(), steps_per_clock=1).steps_per_clock == 1


def test_the_default_and_its_number_are_the_same_machine():
    assert BM1Parameters(lines=1, sensor_bits=()) == BM1Parameters(lines=1, sensor_bits=(), steps_per_clock=8)


@given(st.sampled_from(RngKind), st.integers(1, 16))
def test_an_lfsr_must_be_wider_than_a_code(kind, prob_bits):
    def build():
        return BM1Parameters(lines=1, sensor_bits=(), prob_bits=prob_bits, rng=kind)

    if kind.lfsr_bits is None or prob_bits < kind.lfsr_bits:
        assert build().prob_bits == prob_bits
    else:
        with pytest.raises(ParameterError, match=f"{kind} is too narrow for prob_bits = {prob_bits}"):
            build()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"lines": 0}, "lines is 0; it must be from 1"),
        ({"lines": 2.0}, "lines is 2.0; it must be an integer"),
        ({"lines": True}, "lines is True; it must be an integer"),
        ({"sensor_bits": (3, 0)}, "sensor_bits of column 2 is 0; it must be from 1 to 16"),
        ({"sensor_bits": (17,)}, "sensor_bits of column 1 is 17"),
        ({"prob_bits": 0}, "prob_bits is 0; it must be from 1 to 16"),
        ({"prob_bits": 17}, "prob_bits is 17"),
        ({"prior_bits": -1}, "prior_bits is -1"),
        ({"prior_bits": 1, "prior_mode": "written"}, "a written prior has no address"),
        ({"prior_mode": "guessed"}, "prior_mode is 'guessed'; it must be one of table, written"),
        ({"sensor_mode": "pixel"}, "sensor_mode is 'pixel'; it must be one of column, cell, threshold"),
        (
            {"sensor_mode": "threshold", "sensor_bits": (8, 7)},
            "is 7 with sensor_mode = threshold; a cell's input is its code then, so it must be prob_bits = 8.",
        ),
        ({"replicas": 0}, "replicas is 0; it must be from 1 to 256"),
        ({"replicas": 257}, "replicas is 257"),
        ({"counter_bits": 33}, "counter_bits is 33; it must be from 1 to 32"),
        ({"steps_per_clock": -1}, "steps_per_clock is -1"),
        ({"steps_per_clock": 257}, "steps_per_clock is 257"),
        ({"rng_banks": 0}, "rng_banks is 0"),
        ({"rng": "lfsr12"}, "rng is 'lfsr12'; it must be one of lfsr8, lfsr16"),
        ({"rng_reset": ""}, "rng_reset is ''"),
        ({"ideal_seed": 2**64}, "ideal_seed is"),
    ],
)
def test_what_can_not_be_built_is_refused(changes, sentence):
    with pytest.raises(ParameterError) as refusal:
        BM1Parameters(**{"lines": 4, "sensor_bits": (1,), **changes})
    assert sentence in str(refusal.value)
    assert isinstance(refusal.value, MachineError)
    assert refusal.value.exit_code == 2


def test_names_from_a_file_become_members():
    parameters = BM1Parameters(lines=1, sensor_bits=[2], rng="lfsr16", rng_reset="free")
    assert parameters.rng is RngKind.LFSR16
    assert parameters.rng_reset is RngReset.FREE
    assert parameters.sensor_bits == (2,)


@pytest.mark.parametrize("column", [0, 2])
def test_only_sensor_columns_can_miss_a_reading(column):
    with pytest.raises(ParameterError, match=f"There is no sensor column {column}"):
        BM1Parameters(lines=1, sensor_bits=(2,)).missing_address(column)


@pytest.mark.parametrize(
    ("changes", "inputs", "counts"),
    [
        ({}, (2,), (5,)),
        ({"replicas": 3}, (3, 2), (3, 5)),
        ({"sensor_mode": "cell"}, (2, 5), (5,)),
        ({"sensor_mode": "threshold", "prob_bits": 4, "replicas": 3}, (3, 2, 5), (3, 5)),
    ],
)
def test_shapes_of_inputs_and_counts(changes, inputs, counts):
    parameters = BM1Parameters(lines=5, sensor_bits=(4, 4), **changes)
    assert (parameters.input_shape, parameters.count_shape) == (inputs, counts)
