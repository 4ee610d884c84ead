"""Parameters, tables, the start of a frame and the resumption of a slice; and which kernel a machine gets."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from machines import make_kernel
from machines.bm1 import BM1Machine, Start, StopReason, addressed_codes
from machines.errors import ParameterError, StartError
from machines.fast import FastBM1
from machines.parameters import CYCLES_MAX, BM1Parameters, PriorMode, RngKind, RngReset
from machines.reference import ReferenceBM1
from machines.rng import random_numbers
from tests.machines.random_machines import sessions
from tests.patience import PROCESS_PATIENCE


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
    "arguments",
    [
        {"prior": np.full((2, 3), 1)},
        {"prior": np.full((1, 3), 256)},
        {"prior": np.full((1, 3), 0.5)},
        {"tables": (np.full((2, 3), 255),)},
        {"tables": (np.full((2, 3), 255), np.full((4, 3), 254))},
        {"sensor_mode": "threshold", "sensor_bits": (8, 8)},
        {"rng": RngKind.TABLE},
        {"rng": RngKind.TABLE, "rng_table": np.zeros((2, 2), int)},
        {"rng": RngKind.TABLE, "rng_table": np.zeros(0, int)},
        {"rng": RngKind.TABLE, "rng_table": np.array([2**32])},
    ],
)
def test_arrays_that_do_not_fit_the_parameters_are_refused(arguments):
    with pytest.raises(ParameterError):
        build(**arguments)


FINE = {"addresses": (0, 3), "target_count": 15, "max_cycles": 20}


@pytest.mark.parametrize(
    "changes",
    [
        {"addresses": (0,)},
        {"addresses": (0, 4)},
        {"addresses": (-1, 0)},
        {"addresses": (0.0, 0)},
        {"prior_address": 1},
        {"prior_address": (0,)},
        {"target_count": 0},
        {"target_count": 16},
        {"max_cycles": 0},
        {"max_cycles": True},
        {"max_cycles": CYCLES_MAX + 1},
        {"bank": 2},
        {"run_until": -1},
        {"prior_codes": np.full(3, 9)},
    ],
)
def test_a_start_that_does_not_fit_changes_nothing(make, changes):
    kernel = make(build())
    kernel.start(Start(**FINE))
    before = kernel.reason, kernel.cycles, kernel.counts.tolist(), kernel.rng_state.tolist()
    with pytest.raises(StartError):
        kernel.start(Start(**FINE | changes))
    assert (kernel.reason, kernel.cycles, kernel.counts.tolist(), kernel.rng_state.tolist()) == before


@pytest.mark.parametrize("codes", [np.full(2, 9), np.full(3, 256)])
def test_a_written_prior_has_one_code_a_line(make, codes):
    with pytest.raises(StartError):
        make(build(prior_mode=PriorMode.WRITTEN)).start(Start(**FINE, prior_codes=codes))


def test_numbers_may_be_numpys(make):
    kernel = make(build())
    kernel.start(
        Start(addresses=(np.int64(0), np.uint8(3)), target_count=np.int32(3), max_cycles=np.int64(9))
    )
    assert kernel.cycles in range(1, 10)
    assert isinstance(kernel.cycles, int)


@pytest.mark.parametrize(
    ("prior", "last", "reason"),
    [
        (128, None, StopReason.NONE),
        (128, 15, StopReason.OVERFLOW),
        (128, 255, StopReason.MAX_CYCLES),
        (0, 15, StopReason.IMPOSSIBLE),
    ],
)
def test_a_frame_that_is_over_can_not_be_resumed(make, prior, last, reason):
    kernel = make(build(np.full((1, 3), prior), counter_bits=8))
    if last is not None:
        kernel.start(Start(addresses=(0, 3), target_count=last, max_cycles=50))
    assert kernel.reason is reason
    with pytest.raises(StartError):
        kernel.resume(1000)


@pytest.mark.parametrize("until", [10, 1, -1, CYCLES_MAX + 1])
def test_a_slice_must_end_later(make, until):
    kernel = make(build(np.array([[1] * 3])))
    start = Start(addresses=(0, 3), target_count=15, max_cycles=50, run_until=10)
    assert kernel.start(start) is StopReason.SLICE
    with pytest.raises(StartError):
        kernel.resume(until)
    assert (kernel.reason, kernel.cycles) == (StopReason.SLICE, 10)
    assert kernel.resume(11) is StopReason.SLICE


def test_counts_and_states_are_copies(make):
    kernel = make(build())
    kernel.start(Start(**FINE))
    counts, states = kernel.counts, kernel.rng_state
    kernel.counts[:] = 0
    kernel.rng_state[:] = 0
    assert kernel.counts.tolist() == counts.tolist()
    assert kernel.rng_state.tolist() == states.tolist()


@pytest.mark.parametrize("kind", RngKind)
@pytest.mark.parametrize("shared", [True, False])
def test_the_fast_one_where_it_can(kind, shared):
    parameters = BM1Parameters(lines=2, sensor_bits=(1,), prob_bits=7, rng=kind, shared=shared)
    rng_table = np.random.default_rng(1).integers(0, 2**32, 1000, dtype=np.uint32)
    machine = BM1Machine(
        parameters,
        np.full((1, 2), 100),
        (np.full((2, 2), 127),),
        rng_table if kind is RngKind.TABLE else None,
    )
    kernel = make_kernel(machine)
    assert type(kernel) is (FastBM1 if shared and kind in (*RngKind,)[:4] else ReferenceBM1)
    assert kernel.start(Start(addresses=(0,), target_count=20, max_cycles=1000)) is StopReason.OVERFLOW
    assert kernel.counts.max() == 20


def test_a_machine_with_too_many_codes_for_the_fast_kernel_gets_the_reference():
    parameters = BM1Parameters(lines=1, sensor_bits=(16,) * 256, prob_bits=16, sensor_mode="threshold")
    assert type(make_kernel(BM1Machine(parameters, np.full((1, 1), 100), ()))) is ReferenceBM1


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("module", "late"), [("posterior", "numba"), ("reference", "numba"), ("parameters", "numpy")]
)
def test_a_library_is_not_loaded_before_it_is_needed(module, late):
    code = f"import sys, machines.{module}; sys.exit('{late}' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=PROCESS_PATIENCE).returncode == 0


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(sessions(kinds=tuple(RngKind), shared=(True, False)), st.lists(st.integers(1, 300), max_size=6))
def test_slices_are_the_frame_in_one(session, lengths):
    machine = session.machine
    whole, sliced = ReferenceBM1(machine), ReferenceBM1(machine)
    for frame in session.frames:
        start = {name: getattr(frame.start, name) for name in Start.__dataclass_fields__}
        start["max_cycles"] = min(start["max_cycles"], 300)
        whole.start(Start(**{**start, "run_until": 0}))
        sliced.start(Start(**{**start, "run_until": lengths[0] if lengths else 0}))
        for length in lengths[1:]:
            if sliced.reason is StopReason.SLICE:
                sliced.resume(sliced.cycles + length)
        if sliced.reason is StopReason.SLICE:
            sliced.resume(0)
        assert sliced.reason is whole.reason
        assert sliced.cycles == whole.cycles
        assert (sliced.counts == whole.counts).all()
        assert (sliced.rng_state == whole.rng_state).all()


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(sessions(kinds=tuple(RngKind), shared=(True, False)))
def test_counts_are_the_ands_of_every_cell(session):
    """Whole streams at once, from the generators alone: another way to the same counts."""
    machine, start = session.machine, session.frames[0].start
    cycles = min(start.max_cycles, 60)
    kernel = ReferenceBM1(machine)
    kernel.start(Start(addresses=start.addresses, target_count=start.target_count, max_cycles=cycles))
    codes = addressed_codes(machine, Start(addresses=start.addresses, target_count=1, max_cycles=1)).T
    if (codes == 0).any(axis=1).all():
        assert kernel.reason is StopReason.IMPOSSIBLE
        return
    generators = random_numbers(machine)
    states = [generators.restart(0)]
    for _ in range(cycles):
        states.append(generators.clock(states[-1]))
    shown = np.stack([np.broadcast_to(generators.show(state), codes.shape) for state in states[:-1]])
    bits = np.where(codes == machine.parameters.ones_code, True, shown < codes)
    counts = bits.all(axis=2).cumsum(axis=0)
    stops = np.flatnonzero((counts >= start.target_count).any(axis=1))
    last = int(stops[0]) if stops.size else cycles - 1
    assert kernel.reason is (StopReason.OVERFLOW if stops.size else StopReason.MAX_CYCLES)
    assert kernel.cycles == last + 1
    assert (kernel.counts == counts[last]).all()
    assert (kernel.rng_state == states[last + 1]).all()
