"""Replicas that share generators: each equals a machine that runs alone.

session ──┬── R replicas together ── reasons, cycles, counts, states ──┐
          └── R machines alone ───── reasons, cycles, counts ──────────┴── equal
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from machines import make_kernel
from machines.bm1 import Start, StopReason, joint_reason
from machines.errors import StartError
from machines.parameters import RngKind, RngReset
from machines.reference import ReferenceBM1
from tests.machines.random_machines import machine_of, sessions


@pytest.mark.parametrize("examples", [20, pytest.param(50, marks=pytest.mark.thorough)])
def test_equals_machines_that_run_alone(examples):
    machines = sessions(kinds=tuple(RngKind), shared=(True, False), replicas=st.sampled_from([2, 3, 5, 16]))
    search = given(machines, st.booleans())(equals_machines_that_run_alone)
    settings(max_examples=examples, suppress_health_check=list(HealthCheck))(search)()


def equals_machines_that_run_alone(session, reference):
    """With every kind of generators, in either kernel, and whether or not each cell has a generator."""
    machine = session.machine
    parameters = machine.parameters
    alone = replace(machine, parameters=replace(parameters, replicas=1))
    together = ReferenceBM1(machine) if reference else make_kernel(machine)
    for frame in session.frames:
        if parameters.rng_reset is RngReset.FREE:
            together.reset()
        start = replace(frame.start, run_until=0)
        together.start(start)
        inputs = np.asarray(start.addresses).reshape(parameters.replicas, -1)
        longest = None
        for replica in range(parameters.replicas):
            kernel = make_kernel(alone)
            own = inputs[replica].reshape(alone.parameters.input_shape)
            priors = start.prior_address
            written = start.prior_codes
            kernel.start(
                replace(
                    start,
                    addresses=tuple(own.tolist()) if own.ndim == 1 else own,
                    prior_address=priors[replica] if isinstance(priors, tuple) else priors,
                    prior_codes=written[replica] if written is not None and written.ndim > 1 else written,
                )
            )
            assert together.counts[replica].tolist() == kernel.counts.tolist()
            assert together.replica_cycles[replica] == kernel.cycles
            assert together.replica_reasons[replica] is kernel.reason
            if longest is None or kernel.cycles > longest.cycles:
                longest = kernel
        assert together.rng_state.tolist() == longest.rng_state.tolist()


def replicas_of(count, **parameters):
    return machine_of(lines=12, sensors=2, **{"replicas": count, "counter_bits": 8, **parameters})


def test_a_halted_replica_stays_where_it_is_and_the_generators_go_on(make):
    running = make(replicas_of(3, rng_reset=RngReset.FREE))
    start = Start(addresses=np.zeros((3, 2), int), target_count=255, max_cycles=2**17, run_until=64)
    assert running.start(start) is StopReason.SLICE
    before = running.counts[1].tolist()
    running.resume(128, {1})
    assert running.replica_cycles == (128, 64, 128)
    assert running.replica_reasons[1] is StopReason.SLICE
    assert running.counts[1].tolist() == before
    for halted in ({0, 2}, {3}):
        with pytest.raises(StartError):
            running.resume(256, halted)
    assert running.resume(0) is StopReason.OVERFLOW
    assert running.replica_cycles[1] == 64
    with pytest.raises(StartError):
        running.resume(0)
    states = running.rng_state
    alone = ReferenceBM1(replicas_of(1, rng_reset=RngReset.FREE, counter_bits=32))
    alone.start(Start(addresses=(0, 0), target_count=2**32 - 1, max_cycles=running.cycles))
    assert alone.rng_state.tolist() == states.tolist()
    # the next frame halts nobody
    running.start(start)
    running.resume(128)
    assert running.replica_cycles == (128, 128, 128)


@pytest.mark.parametrize(
    ("reasons", "halted", "joint"),
    [
        ("SLICE OVERFLOW", (), "SLICE"),
        ("SLICE OVERFLOW", (0,), "OVERFLOW"),
        ("SLICE IMPOSSIBLE", (1,), "SLICE"),
        ("MAX_CYCLES OVERFLOW", (), "OVERFLOW"),
        ("IMPOSSIBLE MAX_CYCLES", (), "MAX_CYCLES"),
        ("IMPOSSIBLE IMPOSSIBLE", (), "IMPOSSIBLE"),
        ("SLICE SLICE", (0, 1), "NONE"),
        ("NONE NONE", (), "NONE"),
    ],
)
def test_the_joint_reason(reasons, halted, joint):
    assert joint_reason([StopReason[name] for name in reasons.split()], halted) is StopReason[joint]


@pytest.mark.parametrize(
    "change",
    [
        {"addresses": (0, 0)},
        {"addresses": np.full((3, 2), 4)},
        {"addresses": np.zeros((3, 2))},
        {"prior_address": (0, 0)},
        {"prior_address": (0, 1, 0)},
    ],
)
def test_a_start_must_fit_the_replicas(make, change):
    running = make(replicas_of(3))
    start = {"addresses": np.zeros((3, 2), int), "target_count": 9, "max_cycles": 9}
    with pytest.raises(StartError):
        running.start(Start(**start | change))


def test_the_only_replica_cannot_be_halted(make):
    alone = make(replicas_of(1))
    alone.start(Start(addresses=(0, 0), target_count=255, max_cycles=2**17, run_until=9))
    with pytest.raises(StartError):
        alone.resume(0, {0})
