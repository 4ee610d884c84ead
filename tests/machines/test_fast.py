"""The fast kernel against the reference, to the bit, over random machines.

session ──┬── ReferenceBM1 ── reason, cycles, counts, states ──┐
          └── FastBM1 ─────── reason, cycles, counts, states ──┴── equal after every start and resume
"""

import multiprocessing

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from machines import fast, fast_code
from machines.bm1 import Start, StopReason
from machines.errors import MachineError
from machines.fast import FastBM1
from machines.parameters import RngKind, RngReset, SensorMode
from machines.reference import ReferenceBM1
from tests.machines.random_machines import machine_of, play, seen, sessions
from tests.patience import PATIENCE


@pytest.mark.parametrize("examples", [50, pytest.param(200, marks=pytest.mark.thorough)])
def test_equals_the_reference(examples):
    search = given(sessions(replicas=st.sampled_from([1, 1, 1, 2, 3, 5, 16])))(equals_the_reference)
    settings(max_examples=examples, suppress_health_check=list(HealthCheck))(search)()


def equals_the_reference(session):
    """With kept words of every size: the reference, which is the slow one, runs once for all of them."""
    expected = list(play(ReferenceBM1(session.machine), session.frames))
    for kept_bytes in (0, *(1 << kept for kept in (14, 16, 18, 20, 22, 26))):
        quick = FastBM1(session.machine, kept_bytes=kept_bytes)
        assert list(play(quick, session.frames)) == expected


def start_of(machine, address=1, **changes):
    """A start with one address in every cell; a replica's and a line's own where the machine takes them."""
    shape = machine.parameters.input_shape
    addresses = (address,) * shape[0] if len(shape) == 1 else np.full(shape, address)
    return Start(**{"addresses": addresses, "target_count": 200, "max_cycles": 5000, **changes})


def both(machine, start, **options):
    """Start both kernels, see that they agree, and return what they show."""
    quick, slow = FastBM1(machine, **options), ReferenceBM1(machine)
    shown = seen(quick, quick.start(start))
    assert shown == seen(slow, slow.start(start))
    return shown


def test_every_cycle_can_be_the_last():
    """Targets one by one move the stop over words and blocks, through every place of a word."""
    machine = machine_of(lines=5, sensors=1)
    quick = FastBM1(machine)
    # The reference, once, as far as the farthest stop, looking at the counters after every cycle.
    slow = ReferenceBM1(machine)
    slow.start(Start(addresses=(1,), target_count=2**32 - 1, max_cycles=5000, run_until=1))
    expected = {}
    while slow.counts.max() < 700:
        expected.setdefault(
            int(slow.counts.max()), (slow.cycles, slow.counts.tolist(), slow.rng_state.tolist())
        )
        slow.resume(slow.cycles + 1)
    assert {cycles % 64 for cycles, *_ in expected.values()} == set(range(64))
    assert len({cycles // 512 for cycles, *_ in expected.values()}) > 1
    for target_count in range(1, 700):
        reason = quick.start(Start(addresses=(1,), target_count=target_count, max_cycles=5000))
        assert seen(quick, reason)[:4] == (StopReason.OVERFLOW, *expected[target_count])


@pytest.mark.parametrize("kind", [RngKind.LFSR8, RngKind.LFSR16])
@pytest.mark.parametrize("reset", RngReset)
def test_streams_wrap_at_the_period(kind, reset):
    machine = machine_of(lines=3, sensors=2, prob_bits=5, rng=kind, steps_per_clock=15, rng_reset=reset)
    cycles = 3 * 255 + 7 if kind is RngKind.LFSR8 else 65535 // 15 + 700
    reason, *_ = both(machine, Start(addresses=(0, 1), target_count=2**32 - 1, max_cycles=cycles))
    assert reason is StopReason.MAX_CYCLES


@pytest.mark.parametrize("replicas", [1, 16])
def test_kept_words_are_shared_and_the_same_the_second_time(replicas):
    machine = machine_of(lines=30, rng_banks=3, replicas=replicas)
    quick = FastBM1(machine)

    def frames_of_all_banks():
        return [
            seen(quick, quick.start(start_of(machine, address, bank=bank)))
            for bank in range(3)
            for address in range(4)
        ]

    first = frames_of_all_banks()
    filled = int(quick._store.filled.sum())
    assert frames_of_all_banks() == first
    assert int(quick._store.filled.sum()) == filled
    alone = FastBM1(machine_of(lines=30, rng_banks=3))
    for bank in range(3):
        for address in range(4):
            alone.start(start_of(alone.machine, address, bank=bank))
    assert filled == int(alone._store.filled.sum()) > 0


@pytest.mark.parametrize("kept_bytes", [0, 1, 10**5, 10**6, fast.KEPT_BYTES])
def test_kept_words_stay_within_their_memory(kept_bytes):
    quick = FastBM1(machine_of(lines=200, sensors=6), kept_bytes=kept_bytes)
    assert quick._store.words[:-1].nbytes + quick._store.filled[:-1].nbytes <= kept_bytes
    assert quick.kept_cycles <= fast.KEPT_CYCLES


@pytest.mark.parametrize("replicas", [1, 3])
@pytest.mark.parametrize("reset", RngReset)
def test_prepare_changes_nothing(reset, replicas):
    machine = machine_of(zeros=0.1, rng_reset=reset, rng_banks=3, replicas=replicas)
    prepared, fresh = FastBM1(machine), FastBM1(machine)
    prepared.start(start_of(machine, target_count=9, max_cycles=600))
    prepared.prepare()
    for bank in (0, 2, 1, 2):
        start = start_of(machine, target_count=900, max_cycles=4000, bank=bank)
        assert seen(prepared, prepared.start(start)) == seen(fresh, fresh.start(start))
    blocks = fast.PREPARED_CYCLES // fast_code.BLOCK_CYCLES if reset is RngReset.BANK else 0
    assert (prepared.kept_cycles > 0) is (blocks > 0)
    for bank in range(3):
        first = bank * prepared._kept_blocks
        assert prepared._store.filled[first : first + blocks].all()


def test_words_begin_at_a_cache_line():
    assert FastBM1(machine_of())._store.words.ctypes.data % 64 == 0


@pytest.mark.parametrize("parameters", [{"rng": RngKind.IDEAL}, {"shared": False}])
def test_other_generators_are_refused(parameters):
    with pytest.raises(MachineError):
        FastBM1(machine_of(**parameters))


def test_nothing_is_compiled_twice():
    """Any machine, of any size, has the same types."""
    for machine, kept in (
        (machine_of(lines=1, sensors=0), fast.KEPT_BYTES),
        (machine_of(rng=RngKind.LFSR24, prob_bits=13, zeros=0.1, rng_reset=RngReset.FREE), 0),
        (machine_of(replicas=5, sensor_mode=SensorMode.CELL, rng_reset=RngReset.FREE), 0),
        (machine_of(replicas=3, sensor_mode=SensorMode.THRESHOLD, sensors=1, rng=RngKind.LFSR16), 1 << 20),
    ):
        quick = FastBM1(machine, kept_bytes=kept)
        if quick.start(start_of(machine, run_until=3)) is StopReason.SLICE:
            quick.resume(0)
        _ = quick.rng_state
    for function in (fast_code.begin, fast_code.resume, fast_code.jump):
        assert len(function.signatures) == 1
    assert len(fast_code._run.signatures) <= 1  # none where it was loaded as a part of the others


def _in_a_child(machine, start, answers):
    kernel = FastBM1(machine)
    kernel.start(start)
    compiled = sum(fast_code.begin.stats.cache_misses.values())
    answers.put((compiled, kernel.cycles, kernel.counts.tolist()))


@pytest.mark.process
def test_a_forked_process_has_the_kernel_loaded():
    fast.warm_up()
    compiled = sum(fast_code.begin.stats.cache_misses.values())
    machine, start = machine_of(), Start(addresses=(0, 1, 2), target_count=99, max_cycles=900)
    kernel = FastBM1(machine)
    kernel.start(start)
    context = multiprocessing.get_context("fork")
    answers = context.Queue()
    child = context.Process(target=_in_a_child, args=(machine, start, answers))
    child.start()
    assert answers.get(timeout=PATIENCE) == (compiled, kernel.cycles, kernel.counts.tolist())
    child.join(PATIENCE)


def test_code_is_compiled_without_a_cache_where_none_can_be_written(monkeypatch):
    def njit(*, cache=False, nogil=False):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: (function, nogil)

    monkeypatch.setattr(fast_code, "njit", njit)
    assert fast_code.jit(abs) == (abs, True)
