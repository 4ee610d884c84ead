"""The reference kernel with generators of every kind: slices and frames do not change the counts."""

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from machines.bm1 import Start, StopReason, addressed_codes
from machines.parameters import RngKind
from machines.reference import ReferenceBM1
from machines.rng import random_numbers
from tests.machines.random_machines import sessions


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
