"""Parameters: their defaults, their ranges, and the combinations that are refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.errors import ParameterError
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


@pytest.mark.parametrize(("prob_bits", "steps"), [(1, 1), (3, 4), (4, 4), (5, 8), (9, 16), (16, 16)])
def test_an_lfsr_makes_as_many_steps_a_clock_as_give_fresh_bits(prob_bits, steps):
    assert BM1Parameters(lines=1, sensor_bits=(), prob_bits=prob_bits).steps_per_clock == steps


@pytest.mark.parametrize("rng", [RngKind.TABLE, RngKind.IDEAL])
def test_other_generators_make_one(rng):
    assert BM1Parameters(lines=1, sensor_bits=(), rng=rng).steps_per_clock == 1


@given(st.sampled_from(RngKind), st.integers(1, 16))
def test_an_lfsr_must_be_wider_than_a_code(kind, prob_bits):
    def build():
        return BM1Parameters(lines=1, sensor_bits=(), prob_bits=prob_bits, rng=kind)

    if kind.lfsr_bits is None or prob_bits < kind.lfsr_bits:
        assert build().prob_bits == prob_bits
    else:
        with pytest.raises(ParameterError):
            build()


@pytest.mark.parametrize(
    "changes",
    [
        {"lines": 0},
        {"lines": 2.0},
        {"sensor_bits": (3, 0)},
        {"sensor_bits": (17,)},
        {"prob_bits": 17},
        {"prior_bits": -1},
        {"prior_bits": 1, "prior_mode": "written"},
        {"sensor_mode": "threshold", "sensor_bits": (8, 7)},
        {"replicas": 257},
        {"counter_bits": 0},
        {"steps_per_clock": -1},
        {"rng_banks": 0},
        {"rng": "lfsr12"},
        {"rng_reset": ""},
        {"ideal_seed": 2**64},
    ],
)
def test_parameters_of_no_machine_are_refused(changes):
    with pytest.raises(ParameterError) as refusal:
        BM1Parameters(**{"lines": 4, "sensor_bits": (1,), **changes})
    assert refusal.value.exit_code == 2


def test_names_from_a_file_become_members():
    parameters = BM1Parameters(lines=1, sensor_bits=[2], rng="lfsr16", rng_reset="free")
    assert parameters.rng is RngKind.LFSR16
    assert parameters.rng_reset is RngReset.FREE
    assert parameters.sensor_bits == (2,)


@pytest.mark.parametrize("column", [0, 2])
def test_only_sensor_columns_can_miss_a_reading(column):
    with pytest.raises(ParameterError):
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
