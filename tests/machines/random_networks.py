"""Random networks and their frames, for properties that hold for every BM2."""

from dataclasses import dataclass, field

import numpy as np
from hypothesis import strategies as st

from machines.bm2 import BM2Machine, BM2Parameters, BM2Start, BM2StopReason, start_state, unpack
from machines.bm2_kernel import BM2Kernel
from machines.parameters import RngKind, RngReset, SampleEvery, Sequencer

KINDS = (RngKind.LFSR24, RngKind.LFSR32, RngKind.TABLE, RngKind.IDEAL)
LFSRS = (RngKind.LFSR24, RngKind.LFSR32)
FACTOR_BITS = 9


@dataclass(frozen=True)
class Course:
    """A start, the cycles after which it pauses, and the totals of samples of its resumes.

    Attributes:
        pauses: Cycles; those that are not later than the last cycle are skipped.
        every_cycle: Pause after every cycle.
    """

    start: BM2Start
    pauses: tuple[int, ...]
    every_cycle: bool
    totals: tuple[int, ...]


@dataclass(frozen=True)
class Run:
    """A machine, the factors that it was made of, and its frames one after another."""

    machine: BM2Machine
    factors: tuple[np.ndarray, ...] = field(repr=False)
    courses: tuple[Course, ...]


@st.composite
def runs(draw, kinds=KINDS, cycles=400, variables=12):
    """Runs with every feature: 1 to 12 variables and factors, evidence on any subset, zeros, several boards."""
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    cardinalities = draw(st.lists(st.integers(1, 9), min_size=1, max_size=variables))
    if max(cardinalities) == 1:
        cardinalities[0] = 2
    bits = [(cardinality - 1).bit_length() for cardinality in cardinalities]
    factors = scopes(random, bits, draw(st.integers(1, 12)))
    literal = draw(st.sampled_from([False, False, True]))
    orders = [order for order in Sequencer if not (literal and order is Sequencer.COLOURED)]
    shuffled = random.permutation(len(cardinalities)).tolist()
    searched = draw(st.integers(0, min(4, len(shuffled))))
    parameters = BM2Parameters(
        cardinalities=tuple(cardinalities),
        factors=factors,
        searched=tuple(shuffled[:searched]),
        known=tuple(shuffled[searched:]),
        prob_bits=draw(st.integers(2, 16)),
        sequencer=draw(st.sampled_from(orders)),
        literal=literal,
        sample_every=draw(st.sampled_from(SampleEvery)),
        rng=draw(st.sampled_from(kinds)),
        steps_per_clock=draw(st.sampled_from([0, 0, 0, 1, 2, 8, 32, 64])),
        rng_banks=draw(st.sampled_from([1, 2, 16])),
        rng_reset=draw(st.sampled_from(RngReset)),
        ideal_seed=draw(st.integers(0, 2**64 - 1)),
        chains=(chains := draw(st.sampled_from([1, 1, 2, 3, 17]))),
        chain=draw(st.integers(0, chains - 1)),
        stream=draw(st.sampled_from([0, 0, 1, 2, 5, 40])),
    )
    # from smooth factors, which agree soon, to factors with zeros that disagree for long
    zeros, spread = draw(st.sampled_from([(0, 1), (0, 1), (0, 4), (0.1, 1), (0.4, 2)]))
    tables = tuple(factor_of(random, [cardinalities[at] for at in scope], zeros, spread) for scope in factors)
    rng_table = None
    if parameters.rng is RngKind.TABLE:
        rng_table = random.integers(0, 2**32, draw(st.integers(1, 3000)), dtype=np.uint32)
    machine = BM2Machine.from_factors(parameters, tables, rng_table)
    courses = tuple(draw(st.lists(courses_of(machine, random, orders, cycles), min_size=1, max_size=3)))
    return Run(machine, tables, courses)


def scopes(random, bits, count):
    """Factors' variables, of few enough bits; every variable is in one of them."""
    every = []
    left = set(range(len(bits)))
    while len(every) < count or left:
        scope, width = [], 0
        # often narrow, and first of all variables that no factor has yet
        most = random.integers(1, FACTOR_BITS + 1)
        for variable in sorted(random.permutation(len(bits)).tolist(), key=lambda at: at not in left):
            if not scope or (width + bits[variable] <= most and random.random() < 0.8):
                scope.append(variable)
                width += bits[variable]
        every.append(tuple(sorted(scope)))
        left -= set(scope)
    return tuple(every)


def factor_of(random, shape, zeros, spread):
    """A factor with a share of zeros, but not of zeros alone."""
    factor = np.exp(random.normal(0, spread, shape))
    factor[random.random(shape) < zeros] = 0
    if not factor.any():
        factor.flat[0] = 1
    return factor


@st.composite
def courses_of(draw, machine, random, orders, cycles):
    """A frame with evidence on any subset: a start state of the host's, or any with legal evidence."""
    parameters = machine.parameters
    variables = [at for at, bits in enumerate(parameters.bits) if bits]
    share = draw(st.sampled_from([0.0, 0.3, 0.7, 1.0]))
    known = [at for at in random.permutation(variables).tolist()[1:] if random.random() < share]
    evidence = {at: int(random.integers(parameters.cardinalities[at])) for at in known}
    state = start_state(machine, evidence, largest=bool(parameters.chain % 2))
    samples = draw(st.one_of(st.integers(1, 60), st.just(2**32 - 1)))
    mask = sum(parameters.masks[at] for at in known)
    if state is None or draw(st.booleans()):
        own = sum(value << parameters.offsets[at] for at, value in evidence.items())
        unknown = ((1 << parameters.state_bits) - 1) & ~mask
        legal = state is not None
        state = own | int.from_bytes(random.bytes(8 * len(parameters.bits)), "little") & unknown
        # a frame without a state is not started; from time to time it is, and mostly times out
        samples = samples if legal or draw(st.booleans()) else 0
    start = BM2Start(
        state=state,
        known=mask,
        samples=samples,
        burn_in=draw(st.sampled_from([0, 0, 1, 3, 20])),
        ops_timeout=draw(st.sampled_from([1, 5, 30, 200, 2**20, 2**32 - 1])),
        max_cycles=draw(st.one_of(st.integers(1, 50), st.integers(cycles // 2, cycles))),
        bank=draw(st.integers(0, parameters.rng_banks - 1)),
        sequencer=draw(st.sampled_from(orders)),
    )
    every_cycle = draw(st.booleans())
    pauses = () if every_cycle else tuple(sorted(draw(st.sets(st.integers(1, cycles), max_size=4))))
    more = draw(st.lists(st.one_of(st.integers(1, 5), st.integers(20, 100)), max_size=4))
    return Course(start, pauses, every_cycle, tuple(more))


def play(kernel, courses: tuple[Course, ...], look=None):
    """Run the frames, and yield all that can be seen of the kernel after every stop; `look` sees other kernels."""
    look = look or seen
    for course in courses:

        def pause(course=course):
            if course.every_cycle:
                return kernel.cycles + 1
            return next((at for at in course.pauses if at > kernel.cycles), 0)

        first = 1 if course.every_cycle else (*course.pauses, 0)[0]
        yield look(kernel, kernel.start(course.start, first))
        more = iter(course.totals)
        while True:
            if kernel.reason is BM2StopReason.PAUSED:
                yield look(kernel, kernel.step(pause()))
            elif kernel.reason is BM2StopReason.FULL and kernel.samples < course.start.samples:
                yield look(kernel, kernel.resume(course.start.samples, pause()))
            elif kernel.reason in {BM2StopReason.SAMPLES, BM2StopReason.FULL}:
                total = min(kernel.samples + next(more, 0), 2**32 - 1)
                if total == kernel.samples:
                    break
                yield look(kernel, kernel.resume(total, pause()))
            else:
                break


def seen(kernel: BM2Kernel, returned: BM2StopReason):
    """Return all that a kernel shows."""
    assert kernel.reason is returned
    assert kernel.results.dtype == kernel.stream.dtype == np.uint32
    assert kernel.stream.ndim == 2
    assert kernel.rng_state.dtype == np.uint64
    return {
        "reason": returned,
        "state": unpack(kernel.machine.parameters, kernel.state),
        "cycles": kernel.cycles,
        "samples": kernel.samples,
        "unused": kernel.unused,
        "timed out": kernel.timed_out_bit,
        "results": kernel.results.tolist(),
        "RNGs": kernel.rng_state.tolist(),
        "sequencer": kernel.sequencer_state,
        "stream": kernel.stream.tolist(),
    }
