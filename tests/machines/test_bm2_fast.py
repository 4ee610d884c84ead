"""The fast BM2 against the reference, to the bit, over random networks.

run ──┬── ReferenceBM2 ── reason, state, samples, results, generators, stream ──┐
      └── FastBM2 ─────── reason, state, samples, results, generators, stream ──┴── equal after every stop
"""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from machines import make_bm2_kernel
from machines.bm2 import BM2Machine, BM2Parameters, BM2Start, BM2StopReason, Sequencer
from machines.bm2_fast import STREAM_ROOM, FastBM2, wiring_of
from machines.bm2_reference import ReferenceBM2
from machines.errors import MachineError
from machines.parameters import RngKind
from machines.rng import LFSR, random_numbers
from tests.machines.random_networks import LFSRS, play, runs, seen


@pytest.mark.parametrize("examples", [60, pytest.param(1000, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("cycles", [400, 4000])
def test_equals_the_reference(examples, cycles):
    """Most short runs end in the first block of cycles, and long ones in a later one."""
    search = given(runs(LFSRS, cycles))(equals_the_reference)
    settings(max_examples=400 * examples // cycles, suppress_health_check=list(HealthCheck))(search)()


def equals_the_reference(run):
    expected = play(ReferenceBM2(run.machine), run.courses)
    for at, (shown, due) in enumerate(zip(play(FastBM2(run.machine), run.courses), expected, strict=True)):
        assert shown == due, f"after stop {at}"


def network(**changes):
    """Three variables in a chain, of 3, 2 and 4 values."""
    random = np.random.default_rng(5)
    parameters = BM2Parameters(
        **{"cardinalities": (3, 2, 4), "factors": ((0,), (0, 1), (1, 2)), "searched": (0,), **changes}
    )
    shapes = ([parameters.cardinalities[at] for at in scope] for scope in parameters.factors)
    return BM2Machine.from_factors(parameters, [random.uniform(0.1, 1, shape) for shape in shapes])


def start_of(**changes):
    settings = {"state": 0, "known": 0, "samples": 100, "burn_in": 0, "ops_timeout": 10**6}
    return BM2Start(**{**settings, "max_cycles": 2**40, **changes})


@pytest.mark.parametrize("kind", LFSRS)
@pytest.mark.parametrize("steps_per_clock", [1 << k for k in range(9)])
def test_numbers_are_those_of_the_generators(kind, steps_per_clock):
    """One CDE always agrees with itself, so each of its numbers writes the bit, over more than three blocks."""
    machine = network(
        cardinalities=(2,),
        factors=((0,),),
        rng=kind,
        steps_per_clock=steps_per_clock,
        prob_bits=8,
        sample_every="move",
        stream=5000,
    )
    kernel = FastBM2(machine)
    kernel.start(start_of(samples=5000))
    seed, code = random_numbers(machine).restart(0), int(machine.tables[0][0])
    times = np.arange(5001, dtype=np.uint64)
    states = LFSR(kind).jump(np.repeat(seed, 5001), times * np.uint64(steps_per_clock))
    assert (kernel.stream[:, 0] == (states[:-1] & np.uint64(255) < code)).all()
    assert kernel.rng_state[0] == states[-1]


def contradiction():
    """A variable of which each factor excludes a value: they agree in one of 2**15 cycles."""
    parameters = BM2Parameters(cardinalities=(2,), factors=((0,), (0,)))
    return BM2Machine.from_factors(parameters, [[1, 0], [0, 1]])


@pytest.mark.parametrize("limits", [{"ops_timeout": 5000}, {"max_cycles": 5000}])
def test_a_move_may_take_many_blocks(limits):
    kernel = FastBM2(contradiction())
    slow = ReferenceBM2(contradiction())
    start = start_of(**limits)
    assert seen(kernel, kernel.start(start)) == seen(slow, slow.start(start))
    assert kernel.cycles == 5000


def test_a_stream_grows_up_to_its_size():
    kernel = FastBM2(network(stream=3 * STREAM_ROOM))
    assert kernel.start(start_of(samples=4 * STREAM_ROOM)) is BM2StopReason.FULL
    whole = FastBM2(network())
    whole.start(start_of(samples=3 * STREAM_ROOM))
    assert kernel.stream.shape == (3 * STREAM_ROOM, 1)
    assert np.bincount(kernel.stream[:, 0] & 3, minlength=4).tolist() == kernel.results[:4].tolist()
    assert (kernel.results == whole.results).all()
    assert kernel.rng_state.tolist() == whole.rng_state.tolist()


def test_a_state_may_have_many_words():
    """A ring of 100 variables of 9 values, which cross the words of the packed state."""
    count = 100
    factors = tuple(tuple(sorted((at, (at + 1) % count))) for at in range(count))
    machine = network(cardinalities=(9,) * count, factors=factors, searched=(), stream=20)
    slow, quick = ReferenceBM2(machine), FastBM2(machine)
    start = start_of(samples=3, sequencer=Sequencer.COLOURED)
    assert seen(quick, quick.start(start)) == seen(slow, slow.start(start))
    assert quick.stream.shape == (3, 13)


def test_a_variable_without_bits_is_in_no_word_of_its_own():
    """The last one would begin behind the last word of a full state."""
    parameters = BM2Parameters(cardinalities=(2,) * 32 + (1,), factors=tuple((at,) for at in range(33)))
    machine = BM2Machine.from_factors(parameters, [[1.0] * size for size in parameters.cardinalities])
    assert wiring_of(machine).places[:, 0].max() == parameters.state_words - 1 == 0


def test_other_generators_are_refused():
    with pytest.raises(MachineError, match="rng = ideal"):
        FastBM2(network(rng=RngKind.IDEAL))


@pytest.mark.parametrize(("kind", "made"), [(RngKind.LFSR24, FastBM2), (RngKind.IDEAL, ReferenceBM2)])
def test_the_fastest_kernel_is_made(kind, made):
    assert type(make_bm2_kernel(network(rng=kind))) is made
