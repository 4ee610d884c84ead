"""The fast kernel against the reference, to the bit, over random machines.

session ──┬── ReferenceBM1 ── reason, cycles, counts, states ──┐
          └── FastBM1 ─────── reason, cycles, counts, states ──┴── equal after every start and resume
"""

import multiprocessing

import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from machines import fast, fast_code
from machines.bm1 import BM1Machine, Start, StopReason
from machines.errors import MachineError
from machines.fast import FastBM1
from machines.parameters import BM1Parameters, RngKind, RngReset
from machines.reference import ReferenceBM1
from tests.machines.random_machines import codes, play, seen, sessions


@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
@given(sessions(), st.integers(14, 26))
def test_equals_the_reference(session, kept):
    quick = FastBM1(session.machine, kept_bytes=1 << kept)
    for shown, expected in zip(
        play(quick, session.frames), play(ReferenceBM1(session.machine), session.frames), strict=True
    ):
        assert shown == expected
        reason, cycles, *_ = expected
        event(f"{reason.name} after {'no' if not cycles else 1 << (cycles.bit_length() - 1)} cycles")
        event(f"kept: {min(quick.kept_cycles, 2048)}")


def machine_of(lines=20, sensors=3, typical=0.8, zeros=0.0, **parameters):
    parameters = BM1Parameters(
        **{"lines": lines, "sensor_bits": (2,) * sensors, "counter_bits": 32, **parameters}
    )
    random = np.random.default_rng(11)
    prior = codes(random, parameters, parameters.prior_addresses, zeros, typical, top=False)
    return BM1Machine(
        parameters, prior, tuple(codes(random, parameters, 4, zeros, typical) for _ in range(sensors))
    )


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
        assert seen(quick, reason) == (StopReason.OVERFLOW, *expected[target_count])


@pytest.mark.parametrize("kind", [RngKind.LFSR8, RngKind.LFSR16])
@pytest.mark.parametrize("reset", RngReset)
def test_streams_wrap_at_the_period(kind, reset):
    machine = machine_of(lines=3, sensors=2, prob_bits=5, rng=kind, steps_per_clock=15, rng_reset=reset)
    cycles = 3 * 255 + 7 if kind is RngKind.LFSR8 else 65535 // 15 + 700
    reason, *_ = both(machine, Start(addresses=(0, 1), target_count=2**32 - 1, max_cycles=cycles))
    assert reason is StopReason.MAX_CYCLES


def test_cycles_may_pass_the_periods_number_of_bits():
    """The generators' state after far more cycles than an LFSR has states."""
    machine = machine_of(lines=1, sensors=0, rng=RngKind.LFSR16, steps_per_clock=1)
    quick = FastBM1(machine)
    start = {"addresses": (), "target_count": 2**32 - 1}
    quick.start(Start(**start, max_cycles=65535))
    once, seeds = quick.counts, quick.rng_state
    quick.reset()
    assert (quick.rng_state == seeds).all()
    quick.start(Start(**start, max_cycles=65535 * 100 + 1))
    assert 0 <= int(quick.counts[0]) - 100 * int(once[0]) <= 1
    reference = ReferenceBM1(machine)
    reference.start(Start(**start, max_cycles=1))
    assert (quick.rng_state == reference.rng_state).all()


def test_kept_words_are_the_same_the_second_time():
    quick = FastBM1(machine_of(lines=30, rng_banks=3))

    def round_of_frames():
        for bank in range(3):
            for address in range(4):
                start = Start(addresses=(address,) * 3, target_count=200, max_cycles=5000, bank=bank)
                yield seen(quick, quick.start(start))

    first = list(round_of_frames())
    filled = int(quick._store.filled.sum())
    assert list(round_of_frames()) == first
    assert int(quick._store.filled.sum()) == filled > 0


@pytest.mark.parametrize("kept_bytes", [0, 1, 10**5, 10**6, fast.KEPT_BYTES])
def test_kept_words_stay_within_their_memory(kept_bytes):
    quick = FastBM1(machine_of(lines=200, sensors=6), kept_bytes=kept_bytes)
    assert quick._store.words[:-1].nbytes + quick._store.filled[:-1].nbytes <= kept_bytes
    assert quick.kept_cycles <= fast.KEPT_CYCLES


def test_free_generators_keep_nothing():
    assert FastBM1(machine_of(rng_reset=RngReset.FREE)).kept_cycles == 0


@pytest.mark.parametrize("reset", [RngReset.BANK, RngReset.FREE])
def test_what_is_prepared_changes_nothing(reset):
    machine = machine_of(zeros=0.1, rng_reset=reset, rng_banks=3)
    prepared, fresh = FastBM1(machine), FastBM1(machine)
    prepared.start(Start(addresses=(1, 2, 3), target_count=9, max_cycles=600))
    prepared.prepare()
    for bank in (0, 2, 1, 2):
        start = Start(addresses=(bank, 2, 3), target_count=900, max_cycles=4000, bank=bank)
        assert seen(prepared, prepared.start(start)) == seen(fresh, fresh.start(start))
    if reset is RngReset.BANK:
        blocks = fast.PREPARED_CYCLES // fast_code.BLOCK_CYCLES
        for bank in range(3):
            first = bank * prepared._kept_blocks
            assert prepared._store.filled[first : first + blocks].all()


def test_words_begin_at_a_cache_line():
    assert FastBM1(machine_of())._store.words.ctypes.data % 64 == 0


@pytest.mark.parametrize(
    "parameters", [{"rng": RngKind.IDEAL}, {"shared": False}, {"rng": RngKind.IDEAL, "shared": False}]
)
def test_other_generators_are_refused(parameters):
    with pytest.raises(MachineError, match="The fast kernel runs shared LFSRs only"):
        FastBM1(machine_of(**parameters))


def test_nothing_is_compiled_twice():
    """Any machine, of any size, has the same types."""
    both(machine_of(lines=1, sensors=0), Start(addresses=(), target_count=1, max_cycles=9))
    both(
        machine_of(rng=RngKind.LFSR24, prob_bits=13, zeros=0.1, rng_reset=RngReset.FREE),
        Start(addresses=(1, 2, 3), target_count=70, max_cycles=900, run_until=3),
        kept_bytes=0,
    )
    for function in (fast_code.begin, fast_code.run, fast_code.jump):
        assert len(function.signatures) == 1


def _in_a_child(machine, start, answers):
    kernel = FastBM1(machine)
    kernel.start(start)
    compiled = sum(fast_code.run.stats.cache_misses.values())
    answers.put((compiled, kernel.cycles, kernel.counts.tolist()))


def test_a_forked_process_has_the_kernel_loaded():
    fast.warm_up()
    compiled = sum(fast_code.run.stats.cache_misses.values())
    machine, start = machine_of(), Start(addresses=(0, 1, 2), target_count=99, max_cycles=900)
    kernel = FastBM1(machine)
    kernel.start(start)
    context = multiprocessing.get_context("fork")
    answers = context.Queue()
    child = context.Process(target=_in_a_child, args=(machine, start, answers))
    child.start()
    assert answers.get(timeout=30) == (compiled, kernel.cycles, kernel.counts.tolist())
    child.join(10)


def test_where_nothing_can_be_cached_it_is_compiled_all_the_same(monkeypatch):
    def njit(*, cache=False, nogil=False):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: (function, nogil)

    monkeypatch.setattr(fast_code, "njit", njit)
    assert fast_code._jit(abs) == (abs, True)
