"""Several machines around one set of generators: the fast kernel against the reference, and both against machines that run alone.

session ──┬── ReferenceReplicas ── reasons, cycles, counts, states ──┐
          ├── FastReplicas ─────── reasons, cycles, counts, states ──┼── equal
          └── R machines alone ─── reasons, cycles, counts ──────────┘
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from machines import fast, fast_code
from machines.bm1 import BM1Machine, Start, StopReason, joint_reason
from machines.errors import MachineError, StartError
from machines.fast import FastBM1, FastReplicas
from machines.kernel import make_kernel
from machines.parameters import BM1Parameters, RngKind, RngReset, SensorMode
from machines.reference import ReferenceBM1, ReferenceReplicas
from tests.machines.random_machines import LFSRS, codes, play, seen, sessions

SEVERAL = st.sampled_from([2, 3, 5, 16])


@settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck))
@given(sessions(replicas=SEVERAL), st.sampled_from([0, 1 << 14, 1 << 18, 1 << 22, 1 << 26]))
def test_equals_the_reference(session, kept):
    quick = FastReplicas(session.machine, kept_bytes=kept)
    slow = ReferenceReplicas(session.machine)
    for shown, expected in zip(play(quick, session.frames), play(slow, session.frames), strict=True):
        assert shown == expected
        event(" ".join(sorted({reason.name for reason in expected[4]})))
        event("words of the frame" if quick._of_frame else "words of the banks")


@settings(max_examples=80, deadline=None, suppress_health_check=list(HealthCheck))
@given(sessions(kinds=tuple(RngKind), shared=(True, False), replicas=SEVERAL))
def test_equals_machines_that_run_alone(session):
    """Each replica is a machine of its own: whatever the generators, and whether or not each cell has its own."""
    machine = session.machine
    parameters = machine.parameters
    alone = replace(machine, parameters=replace(parameters, replicas=1))
    together = make_kernel(machine)
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


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(sessions())
def test_a_reference_of_one_replica_is_the_machine(session):
    shown = play(ReferenceReplicas(session.machine), session.frames)
    assert list(shown) == list(play(ReferenceBM1(session.machine), session.frames))


def machine_of(replicas=3, mode=SensorMode.COLUMN, *, lines=12, sensors=2, zeros=0.0, **parameters):
    bits = 8 if mode is SensorMode.THRESHOLD else 2
    parameters = BM1Parameters(
        **{
            "lines": lines,
            "sensor_bits": (bits,) * sensors,
            "sensor_mode": mode,
            "replicas": replicas,
            **parameters,
        }
    )
    random = np.random.default_rng(5)
    prior = codes(random, parameters, parameters.prior_addresses, zeros, 0.8, top=False)
    tables = tuple(codes(random, parameters, 4, zeros, 0.8) for _ in range(sensors))
    return BM1Machine(parameters, prior, tables if parameters.has_tables else ())


@pytest.mark.parametrize("kernel", [FastReplicas, ReferenceReplicas])
def test_a_halted_replica_stays_where_it_is_and_the_generators_go_on(kernel):
    running = kernel(machine_of(rng_reset=RngReset.FREE))
    start = Start(addresses=np.zeros((3, 2), int), target_count=255, max_cycles=2**17, run_until=64)
    assert running.start(start) is StopReason.SLICE
    before = running.counts[1].tolist()
    running.resume(128, {1})
    assert running.replica_cycles == (128, 64, 128)
    assert running.replica_reasons[1] is StopReason.SLICE
    assert running.counts[1].tolist() == before
    with pytest.raises(StartError, match="no replica is left that could go on"):
        running.resume(256, {0, 2})
    assert running.resume(0) is StopReason.OVERFLOW
    assert running.replica_cycles[1] == 64
    with pytest.raises(StartError, match="There is no slice to resume"):
        running.resume(0)
    states = running.rng_state
    alone = ReferenceBM1(machine_of(1, rng_reset=RngReset.FREE, counter_bits=32))
    alone.start(Start(addresses=(0, 0), target_count=2**32 - 1, max_cycles=running.cycles))
    assert alone.rng_state.tolist() == states.tolist()


def test_the_joint_reason():
    slice_, over = StopReason.SLICE, StopReason.OVERFLOW
    assert joint_reason([slice_, over]) is slice_
    assert joint_reason([slice_, over], {0}) is over
    assert joint_reason([slice_, StopReason.IMPOSSIBLE], {1}) is slice_
    assert joint_reason([StopReason.MAX_CYCLES, StopReason.IMPOSSIBLE]) is StopReason.MAX_CYCLES
    assert joint_reason([StopReason.IMPOSSIBLE] * 2) is StopReason.IMPOSSIBLE
    assert joint_reason([slice_, slice_], {0, 1}) is StopReason.NONE
    assert joint_reason([StopReason.NONE] * 2) is StopReason.NONE


def test_words_are_shared_by_the_replicas_and_kept_from_frame_to_frame():
    quick = FastReplicas(machine_of(16))
    start = Start(addresses=np.zeros((16, 2), int), target_count=200, max_cycles=5000)
    first = seen(quick, quick.start(start))
    filled = int(quick._store.filled.sum())
    blocks = -(-quick.cycles // 512)
    assert 0 < filled <= blocks * 3 * 12  # as much as one replica's lines need
    assert seen(quick, quick.start(start)) == first
    assert int(quick._store.filled.sum()) == filled


@pytest.mark.parametrize("reset", RngReset)
def test_what_is_prepared_changes_nothing(reset):
    prepared, fresh = (FastReplicas(machine_of(rng_reset=reset)) for _ in range(2))
    prepared.start(Start(addresses=np.ones((3, 2), int), target_count=9, max_cycles=600))
    prepared.prepare()
    assert (prepared.kept_cycles > 0) is (reset is RngReset.BANK)
    for bank in (0, 2, 2):
        start = Start(addresses=np.ones((3, 2), int), target_count=99, max_cycles=4000, bank=bank)
        assert seen(prepared, prepared.start(start)) == seen(fresh, fresh.start(start))


def test_nothing_is_compiled_twice():
    for machine, kept in (
        (machine_of(2), fast.KEPT_BYTES),
        (machine_of(5, SensorMode.CELL, rng_reset=RngReset.FREE), 0),
        (machine_of(3, SensorMode.THRESHOLD, sensors=1, rng=RngKind.LFSR16), 1 << 20),
    ):
        kernel = FastReplicas(machine, kept_bytes=kept)
        shape = machine.parameters.input_shape
        kernel.start(Start(addresses=np.ones(shape, int), target_count=90, max_cycles=2000, run_until=10))
        if kernel.reason is StopReason.SLICE:
            kernel.resume(0)
    for function in (fast_code.begin_replicas, fast_code.resume_replicas, fast_code.copy_counts):
        assert len(function.signatures) == 1
    for function in (
        fast_code._run_replica,
        fast_code.run,
    ):  # none where it was loaded as a part of the others
        assert len(function.signatures) <= 1


@pytest.mark.parametrize("kernel", [FastBM1, ReferenceBM1])
def test_a_kernel_of_one_machine_refuses_replicas(kernel):
    with pytest.raises(MachineError, match=r"runs one machine; there are 3 replicas: use make_kernel\."):
        kernel(machine_of(3))


def test_other_generators_are_refused_by_the_fast_kernel():
    with pytest.raises(MachineError, match="runs shared LFSRs only"):
        FastReplicas(machine_of(rng=RngKind.IDEAL))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"addresses": (0, 0)}, r"The inputs have the shape (2,); this machine takes (3, 2)."),
        (
            {"addresses": np.full((3, 2), 4)},
            "The address of column 1 of replica 0 is 4; it must be from 0 to 3.",
        ),
        ({"addresses": np.zeros((3, 2))}, "The inputs are float64; they must be integers."),
        (
            {"prior_address": (0, 0)},
            "There are 2 prior addresses; this machine takes one, or one for each of its 3 replicas.",
        ),
        ({"prior_address": (0, 1, 0)}, "prior_address of replica 1 is 1; it must be from 0 to 0."),
    ],
)
@pytest.mark.parametrize("kernel", [FastReplicas, ReferenceReplicas])
def test_what_a_start_must_be(kernel, change, message):
    running = kernel(machine_of(3))
    with pytest.raises(StartError) as caught:
        running.start(
            Start(**{"addresses": np.zeros((3, 2), int), "target_count": 9, "max_cycles": 9} | change)
        )
    assert str(caught.value) == message


def test_what_a_resume_must_be():
    running = FastReplicas(machine_of(3))
    running.start(Start(addresses=np.zeros((3, 2), int), target_count=255, max_cycles=2**17, run_until=9))
    with pytest.raises(StartError, match=r"Replicas 3 are to be halted; this machine's are 0 to 2\."):
        running.resume(0, {3})
    alone = FastBM1(machine_of(1))
    alone.start(Start(addresses=(0, 0), target_count=255, max_cycles=2**17, run_until=9))
    with pytest.raises(StartError, match="this machine has only one"):
        alone.resume(0, {0})


@pytest.mark.parametrize("kind", LFSRS)
def test_cells_of_their_own_address_are_rows_of_the_same_tables(kind):
    """A cell machine whose cells all have one address is the column machine."""
    columns = machine_of(1, rng=kind, prob_bits=6)
    cells = replace(columns, parameters=replace(columns.parameters, sensor_mode=SensorMode.CELL))
    thresholds = BM1Machine(
        replace(columns.parameters, sensor_mode=SensorMode.THRESHOLD, sensor_bits=(6, 6)),
        columns.prior,
        (),
    )
    kernels = [make_kernel(machine) for machine in (columns, cells, thresholds)]
    for one, two in ((0, 1), (3, 2), (2, 3)):
        given = (
            (one, two),
            np.repeat([[one], [two]], 12, axis=1),
            np.stack([columns.tables[0][one], columns.tables[1][two]]),
        )
        shown = [
            seen(kernel, kernel.start(Start(addresses=own, target_count=60, max_cycles=9000)))
            for kernel, own in zip(kernels, given, strict=True)
        ]
        assert shown[0] == shown[1] == shown[2]
