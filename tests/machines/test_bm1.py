"""A machine's tables and a frame's start: what is taken, and what is refused with which sentence."""

import numpy as np
import pytest

from machines.bm1 import BM1Machine, Start, StopReason
from machines.errors import ParameterError, StartError
from machines.parameters import CYCLES_MAX, BM1Parameters, PriorMode, RngKind


def build(prior=None, tables=None, rng_table=None, **parameters):
    parameters = BM1Parameters(
        **{"lines": 3, "sensor_bits": (1, 2), "counter_bits": 4, "rng_banks": 2, **parameters}
    )
    if prior is None:
        prior = np.full((parameters.prior_addresses, 3), 100)
    if tables is None:
        tables = tuple(np.full((1 << bits, 3), 255) for bits in parameters.sensor_bits)
    return BM1Machine(parameters, prior, tables, rng_table)


def test_arrays_become_read_only_copies():
    prior = np.full((1, 3), 100, dtype=np.uint16)
    machine = build(prior)
    prior[0, 0] = 7
    assert machine.prior.tolist() == [[100, 100, 100]]
    assert machine.prior.dtype == machine.tables[0].dtype == np.uint16
    with pytest.raises(ValueError, match="read-only"):
        machine.tables[1][0, 0] = 1


def test_machines_are_equal_by_what_they_hold():
    assert build() == build()
    assert hash(build()) == hash(build())
    assert build() != build(np.array([[100, 100, 101]]))
    assert build() != build(counter_bits=5)
    assert build() != build(tables=(np.full((2, 3), 255), np.array([[1, 2, 3]] * 3 + [[255] * 3])))
    table = {"rng": RngKind.TABLE}
    assert build(rng_table=np.arange(5), **table) == build(rng_table=np.arange(5), **table)
    assert build(rng_table=np.arange(5), **table) != build(rng_table=np.arange(6), **table)
    assert build() != "a machine"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"prior": np.full((2, 3), 1)}, "The prior's table has the shape (2, 3); it must be (1, 3)"),
        ({"prior": np.full((1, 3), 256)}, "The prior's table holds codes from 256 to 256"),
        ({"prior": np.full((1, 3), -1)}, "The prior's table holds codes from -1 to -1"),
        ({"prior": np.full((1, 3), 0.5)}, "The prior's table holds float64; codes are integers"),
        ({"tables": (np.full((2, 3), 255),)}, "There are 1 sensor tables"),
        (
            {"tables": (np.full((2, 3), 255), np.full((4, 3), 254))},
            "The table of column 2 has other codes than all-ones (255) at its top address 3",
        ),
        (
            {"sensor_mode": "threshold", "sensor_bits": (8, 8)},
            "There are 2 sensor tables; with sensor_mode = threshold cells are given codes, so there must be none.",
        ),
        ({"rng_table": np.arange(5)}, "rng = lfsr32 plays none"),
        ({"rng": RngKind.TABLE}, "needs a table of random numbers"),
        ({"rng": RngKind.TABLE, "rng_table": np.zeros((2, 2), int)}, "has the shape (2, 2)"),
        ({"rng": RngKind.TABLE, "rng_table": np.zeros(0, int)}, "has the shape (0,)"),
        ({"rng": RngKind.TABLE, "rng_table": np.array([2**32])}, "something else than integers"),
        ({"rng": RngKind.TABLE, "rng_table": np.array([0.5])}, "something else than integers"),
    ],
)
def test_arrays_of_no_such_machine_are_refused(arguments, sentence):
    with pytest.raises(ParameterError) as refusal:
        build(**arguments)
    assert sentence in str(refusal.value)


FINE = {"addresses": (0, 3), "target_count": 15, "max_cycles": 20}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"addresses": (0,)}, "There are 1 addresses; this machine has 2 sensor columns"),
        ({"addresses": (0, 4)}, "The address of column 2 is 4; it must be from 0 to 3"),
        ({"addresses": (-1, 0)}, "The address of column 1 is -1"),
        ({"addresses": (0.0, 0)}, "The address of column 1 is 0.0; it must be an integer"),
        ({"addresses": (None, 0)}, "The address of column 1 is None; it must be an integer"),
        ({"prior_address": 1}, "prior_address is 1; it must be from 0 to 0"),
        ({"target_count": 0}, "target_count is 0; it must be from 1 to 15"),
        ({"target_count": 16}, "target_count is 16; it must be from 1 to 15"),
        ({"max_cycles": 0}, "max_cycles is 0"),
        ({"max_cycles": CYCLES_MAX + 1}, "max_cycles is"),
        ({"bank": 2}, "bank is 2; it must be from 0 to 1"),
        ({"run_until": -1}, "run_until is -1"),
        ({"prior_codes": np.full(3, 9)}, "this machine's prior is a table"),
    ],
)
def test_a_start_that_the_machine_can_not_take_changes_nothing(make, changes, sentence):
    kernel = make(build())
    kernel.start(Start(**FINE))
    before = kernel.reason, kernel.cycles, kernel.counts.tolist(), kernel.rng_state.tolist()
    with pytest.raises(StartError) as refusal:
        kernel.start(Start(**{**FINE, **changes}))
    assert sentence in str(refusal.value)
    assert (kernel.reason, kernel.cycles, kernel.counts.tolist(), kernel.rng_state.tolist()) == before


@pytest.mark.parametrize(
    ("codes", "sentence"),
    [
        (np.full(2, 9), "The written prior has the shape (2,)"),
        (np.full(3, 256), "The written prior holds codes from 256 to 256"),
    ],
)
def test_a_written_prior_has_one_code_a_line(make, codes, sentence):
    with pytest.raises(StartError) as refusal:
        make(build(prior_mode=PriorMode.WRITTEN)).start(Start(**FINE, prior_codes=codes))
    assert sentence in str(refusal.value)


def test_a_written_prior_holds_for_its_frame(make):
    kernel = make(build(np.array([[0, 255, 0]]), prior_mode=PriorMode.WRITTEN))
    kernel.start(Start(**FINE, prior_codes=np.array([255, 0, 0], dtype=np.uint16)))
    assert kernel.counts.tolist() == [15, 0, 0]
    kernel.start(Start(**FINE))
    assert kernel.counts.tolist() == [0, 15, 0]


def test_prior_addresses_select_a_row(make):
    kernel = make(build(np.array([[255, 0, 0], [0, 0, 255]]), prior_bits=1))
    kernel.start(Start(**FINE, prior_address=1))
    assert kernel.counts.tolist() == [0, 0, 15]


def test_numbers_may_be_numpys(make):
    kernel = make(build())
    kernel.start(
        Start(addresses=(np.int64(0), np.uint8(3)), target_count=np.int32(3), max_cycles=np.int64(9))
    )
    assert kernel.cycles in range(1, 10)
    assert isinstance(kernel.cycles, int)


@pytest.mark.parametrize(
    ("until", "last", "reason"),
    [
        (None, 0, "none"),
        (0, 15, "overflow"),
        (0, 255, "max_cycles"),
    ],
)
def test_a_frame_that_is_over_can_not_be_resumed(make, until, last, reason):
    kernel = make(build(np.array([[128] * 3]), counter_bits=8))
    if until is not None:
        kernel.start(Start(addresses=(0, 3), target_count=last, max_cycles=50, run_until=until))
    with pytest.raises(StartError, match=f"There is no slice to resume: .* reason {reason}"):
        kernel.resume(1000)


def test_an_impossible_frame_can_not_be_resumed(make):
    kernel = make(build(np.zeros((1, 3), int)))
    kernel.start(Start(**FINE, run_until=3))
    with pytest.raises(StartError, match="reason impossible"):
        kernel.resume(5)


@pytest.mark.parametrize("until", [10, 1, -1, CYCLES_MAX + 1])
def test_a_slice_must_end_later(make, until):
    kernel = make(build(np.array([[1] * 3])))
    assert (
        kernel.start(Start(addresses=(0, 3), target_count=15, max_cycles=50, run_until=10))
        is StopReason.SLICE
    )
    with pytest.raises(StartError, match=r"run_until is .*; it must be from 11 to"):
        kernel.resume(until)
    assert (kernel.reason, kernel.cycles) == (StopReason.SLICE, 10)
    assert kernel.resume(11) is StopReason.SLICE


def test_what_a_kernel_shows_is_the_readers_own(make):
    kernel = make(build())
    kernel.start(Start(**FINE))
    counts, states = kernel.counts, kernel.rng_state
    kernel.counts[:] = 0
    kernel.rng_state[:] = 0
    assert kernel.counts.tolist() == counts.tolist()
    assert kernel.rng_state.tolist() == states.tolist()
