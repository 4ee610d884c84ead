"""Which kernel a machine gets, what is loaded for it, and the reference with generators of every kind."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from machines import make_kernel
from machines.bm1 import BM1Machine, Start, StopReason, addressed_codes
from machines.fast import FastBM1
from machines.parameters import BM1Parameters, RngKind
from machines.reference import ReferenceBM1
from machines.rng import random_numbers
from tests.machines.random_machines import sessions
from tests.patience import PROCESS_PATIENCE


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
