"""The BM2: its tables, starts and stops, and its reference against the description.

run ──┬── ReferenceBM2 ── state, samples, histograms, RNGs, reason ──┐
      └── PageBM2 ─────── state, samples, histograms, RNGs, reason ──┴── equal after every stop or cycle
"""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from machines.bm2 import (
    CDES_MAX,
    BM2Machine,
    BM2Parameters,
    BM2Start,
    BM2StopReason,
    cde_table,
    pack,
    start_state,
    unpack,
)
from machines.bm2_estimate import BoardSamples, estimate, searched_values
from machines.bm2_fast import FastBM2
from machines.bm2_reference import ReferenceBM2
from machines.errors import ParameterError, StartError
from machines.parameters import Sequencer
from machines.rng import random_numbers
from tests.machines.bm2_of_the_page import PageBM2
from tests.machines.random_networks import play, runs, seen

RAIN, SPRINKLER, GRASS = range(3)
WET = 1 << GRASS
EXACT = 0.16038 / 0.44838
"""P(rain | wet grass)."""


def sprinkler(**changes):
    """Rain, sprinkler and wet grass (thesis 2.1.3.1)."""
    parameters = BM2Parameters(
        **{
            "cardinalities": (2, 2, 2),
            "factors": ((RAIN,), (RAIN, SPRINKLER), (RAIN, SPRINKLER, GRASS)),
            "searched": (RAIN,),
            "known": (GRASS,),
            **changes,
        }
    )
    wet = np.array([[0, 0.9], [0.8, 0.99]])
    return BM2Machine.from_factors(
        parameters, [[0.8, 0.2], [[0.6, 0.4], [0.99, 0.01]], np.stack([1 - wet, wet], axis=-1)]
    )


def uniform(cardinalities, factors=None, **changes):
    """A machine of constant factors: one for each variable, or these scopes."""
    scopes = factors or tuple((at,) for at in range(len(cardinalities)))
    parameters = BM2Parameters(**{"cardinalities": cardinalities, "factors": scopes, **changes})
    return BM2Machine.from_factors(
        parameters, [np.ones([cardinalities[variable] for variable in scope]) for scope in scopes]
    )


def start_of(**changes):
    """A start of the sprinkler with wet grass."""
    due = {"known": WET, "samples": 300, "burn_in": 10, "ops_timeout": 2**20, "max_cycles": 2**40}
    return BM2Start(**{"state": pack(sprinkler().parameters, (0, 1, 1)), **due, **changes})


# ---- the machine of the page ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("examples", "cycles"), [(60, 60), pytest.param(400, 400, marks=pytest.mark.thorough)]
)
def test_equals_the_page(examples, cycles):
    search = given(runs(cycles=cycles))(equals_the_page)
    settings(max_examples=examples, suppress_health_check=list(HealthCheck), deadline=None)(search)()


def equals_the_page(run):
    page = PageBM2(run.machine.parameters, run.factors, run.machine.rng_table)
    due = play(page, run.courses, lambda page, reason: page.shown(reason))
    for shown, expected in zip(play(ReferenceBM2(run.machine), run.courses), due, strict=True):
        assert shown == expected


def chances(machine, state, bit):
    """The chances that the concerned CDEs all make a one, and all a zero, for a pointed bit."""
    ones = zeros = 1.0
    for cde, table in enumerate(machine.tables):
        bits = machine.parameters.factor_bits(cde)
        if bit in bits:
            others = [state >> other & 1 for other in bits if other != bit]
            address = bits.index(bit) << len(others) | sum(value << at for at, value in enumerate(others))
            p = table[address] / 2**machine.parameters.prob_bits
            ones, zeros = ones * p, zeros * (1 - p)
    return ones, zeros


@pytest.mark.parametrize(("prob_bits", "error"), [(16, 0.00015), (12, 0.0016), (8, 0.018)])
def test_the_codes_have_the_sprinklers_posterior(prob_bits, error):
    """Exactly, from the transition matrix of a sweep; and so have the cycles that a sweep takes."""
    machine = sprinkler(prob_bits=prob_bits)
    states = [WET | rest for rest in range(4)]
    sweep = np.eye(4)
    waits = {}
    for bit in (RAIN, SPRINKLER):
        move = np.zeros((4, 4))
        for at, state in enumerate(states):
            ones, zeros = chances(machine, state, bit)
            waits[bit, at] = 1 / (ones + zeros)
            move[at, states.index(state | 1 << bit)] += ones / (ones + zeros)
            move[at, states.index(state & ~(1 << bit))] += zeros / (ones + zeros)
        sweep = sweep @ move
        if bit == RAIN:
            after_rain = move
    stationary = np.linalg.matrix_power(sweep, 2**14)[0]
    exact = np.array([0, 0.2 * 0.99 * 0.8, 0.8 * 0.4 * 0.9, 0.2 * 0.01 * 0.99]) / 0.44838
    assert np.abs(stationary - exact).sum() / 2 == pytest.approx(error, rel=0.05)
    if prob_bits == 16:
        in_between = stationary @ after_rain
        cycles = [
            sum(stationary[at] * waits[RAIN, at] for at in range(4)),
            sum(in_between[at] * waits[SPRINKLER, at] for at in range(4)),
        ]
        assert sum(cycles) == pytest.approx(7.0, abs=0.05)
        # in literal machines, the one CDE without the sprinkler has to agree, too
        assert cycles[0] + 2 * cycles[1] == pytest.approx(9.4, abs=0.05)


@pytest.mark.parametrize(
    ("changes", "order", "cycles"),
    [
        ({}, Sequencer.LINEAR, 7.0),
        ({}, Sequencer.RANDOM, 7.0),
        ({}, Sequencer.COLOURED, 7.0),
        ({"literal": True}, Sequencer.LINEAR, 9.4),
    ],
)
def test_samples_of_the_sprinkler(changes, order, cycles):
    """By the fast kernel, which equals the reference."""
    kernel = FastBM2(sprinkler(stream=2**20, **changes))
    assert kernel.start(start_of(samples=400_000, burn_in=1000, sequencer=order)) is BM2StopReason.SAMPLES
    assert kernel.cycles / 401_000 == pytest.approx(cycles, abs=0.12)
    values = searched_values(kernel.machine.parameters, kernel.stream)
    result = estimate([BoardSamples(kernel.reason, kernel.results[np.newaxis, :2], values)])
    assert result.posterior[1] == pytest.approx(EXACT, abs=3 * result.error[1])
    assert 0 < result.error[1] < 0.02


# ---- tables ---------------------------------------------------------------------------------------


def test_a_table_of_odds():
    """Two bits: the pointed bit first, then the other one."""
    factor = np.array([[3.0, 0.0], [1.0, 0.0]])  # [variable 0 = a, variable 1 = b]
    # a points: b = 0: 1 / 4; b = 1: 0 / 0. b points: a = 0, a = 1: clipped
    assert cde_table(factor, 4).tolist() == [4, 8, 1, 1]
    # ties are rounded up, and the all-ones code is an ordinary one
    assert cde_table(np.array([29.0, 3.0]), 4).tolist() == [2]
    assert cde_table(np.array([0.0, 1.0]), 4).tolist() == [15]
    assert cde_table(np.ones(1), 4).tolist() == []


def test_codes_of_unused_values():
    """Three values in two bits: the bit that would make the unused value 3 is clipped; the rest is even."""
    #  low bit: 0 or 1, 2 or (3); high bit: 0 or 2, 1 or (3)
    assert cde_table(np.array([1.0, 3.0, 4.0]), 4).tolist() == [12, 1, 13, 1]
    # five values: 5, 6 and 7 are unused; low bit of 2 and 3, both used, and of 6 and 7, both unused
    five = cde_table(np.array([1.0, 1.0, 1.0, 3.0, 1.0]), 4).reshape(3, 4)
    assert five[0].tolist() == [8, 12, 1, 8]
    # the other variable at an unused value: all odds are 1, also those of a used value against an unused one
    pair = cde_table(np.ones((3, 3)), 4).reshape(4, 8)
    assert [pair[0, 6:].tolist(), pair[1, 6:].tolist()] == [[8, 8], [8, 8]]
    assert pair[0, :2].tolist() == [8, 1]


def test_colours():
    """A star of 2 with 0, 1 and 3, and a variable alone: the star's middle comes first."""
    parameters = uniform((2, 4, 3, 2, 8), ((0, 2), (1, 2), (2, 3), (4,))).parameters
    assert parameters.colours == (1, 1, 0, 1, 0)
    # colour 0: bits of 2 (3, 4) and of 4 (6, 7, 8); colour 1: 0 (0), 1 (1, 2) and 3 (5)
    assert parameters.moves(0, Sequencer.COLOURED) == ((3, 6), (4, 7), (8,), (0, 1, 5), (2,))
    # a move without an unknown bit is left out; colours do not depend on the evidence
    assert parameters.moves(parameters.masks[1], Sequencer.COLOURED) == ((3, 6), (4, 7), (8,), (0, 5))
    assert parameters.moves(0b110, Sequencer.LINEAR) == ((0,), (3,), (4,), (5,), (6,), (7,), (8,))


def test_no_two_boards_or_banks_share_a_seed():
    starts = set()
    for chain in range(3):
        machine = sprinkler(chain=chain, chains=3, rng_banks=4)
        kernel = ReferenceBM2(machine)
        for bank in range(4):
            kernel.start(start_of(samples=0, bank=bank))
            starts |= {*kernel.rng_state.tolist(), ("order", kernel.sequencer_state)}
            assert kernel.rng_state.tolist() == random_numbers(machine).restart(bank).tolist()
    assert len(starts) == 3 * 4 * (3 + 1)


# ---- starts and stops -----------------------------------------------------------------------------


@pytest.mark.parametrize("order", Sequencer)
@pytest.mark.parametrize("stream", [0, 7])
def test_a_resumed_run_is_one_run(order, stream):
    once, often = (ReferenceBM2(sprinkler(stream=size, sample_every="move")) for size in (2**20, stream))
    once.start(start_of(samples=60, sequencer=order))
    reason = often.start(start_of(samples=10, sequencer=order), pause_at=5)
    streamed = []
    while often.samples < 60 or reason is BM2StopReason.PAUSED:
        if reason is BM2StopReason.PAUSED:
            reason = often.step(often.cycles + 50)
            continue
        streamed += often.stream.tolist()
        assert reason is (BM2StopReason.SAMPLES if often.samples % 10 == 0 else BM2StopReason.FULL)
        reason = often.resume(min(60, often.samples // 10 * 10 + 10), pause_at=often.cycles + 3)
    streamed += often.stream.tolist()
    assert seen(often, reason) | {"stream": streamed} == seen(once, once.reason) | {
        "stream": once.stream.tolist() if stream else []
    }


def test_a_bank_restarts_the_random_numbers_and_free_ones_go_on():
    start = start_of(sequencer=Sequencer.RANDOM, bank=2, samples=50)
    bank, free = ReferenceBM2(sprinkler()), ReferenceBM2(sprinkler(rng_reset="free"))
    for _ in range(2):
        bank.start(start)
        first = seen(bank, bank.reason)
        bank.start(start)
        assert seen(bank, bank.reason) == first
        bank.start(replace(start, bank=3))
        assert bank.results.tolist() != first["results"]
    free.start(start)
    at = free.rng_state, free.sequencer_state
    free.start(replace(start, samples=0))
    assert (free.rng_state.tolist(), free.sequencer_state) == (at[0].tolist(), at[1])
    free.reset()
    assert free.rng_state.tolist() == random_numbers(free.machine).restart(0).tolist()


def test_a_frame_without_a_state_does_not_run():
    kernel = ReferenceBM2(sprinkler())
    kernel.start(start_of())
    assert kernel.start(start_of(samples=0)) is kernel.reason is BM2StopReason.IMPOSSIBLE
    assert (kernel.cycles, kernel.samples, kernel.results.any()) == (0, 0, False)
    with pytest.raises(StartError, match="impossible"):
        kernel.resume(5)


def disagreeing(**changes):
    """Two CDEs of one bit that hardly ever agree, and one bit that is always written at once."""
    parameters = BM2Parameters(cardinalities=(2, 2), factors=((0,), (1,), (1,)), **changes)
    return BM2Machine.from_factors(parameters, [[1, 1], [0, 1], [1, 0]])


def test_a_bit_that_is_never_agreed_on_times_out():
    kernel = ReferenceBM2(disagreeing(sample_every="move"))
    start = start_of(known=0, state=0, ops_timeout=20, burn_in=0)
    assert kernel.start(start) is BM2StopReason.OPS_TIMEOUT
    # one move of bit 0, which is a sample, and 20 cycles of bit 1
    assert (kernel.cycles, kernel.samples, kernel.timed_out_bit) == (21, 1, 1)
    # coloured: both bits in one move, of which bit 0 is written at once
    assert kernel.start(replace(start, sequencer=Sequencer.COLOURED)) is BM2StopReason.OPS_TIMEOUT
    assert (kernel.cycles, kernel.samples, kernel.timed_out_bit) == (20, 0, 1)
    for call in (lambda: kernel.resume(1000), kernel.step):
        with pytest.raises(StartError, match="ops_timeout"):
            call()


def test_the_first_of_several_reasons_in_one_cycle():
    """Samples before the time-out, that before the maximum number of cycles, and that before a full stream."""
    kernel = ReferenceBM2(disagreeing(sample_every="move", stream=1))
    start = start_of(known=0, state=0, burn_in=0, samples=1, ops_timeout=1, max_cycles=1)
    assert kernel.start(start, pause_at=1) is BM2StopReason.SAMPLES
    assert kernel.resume(2) is BM2StopReason.MAX_CYCLES
    assert (kernel.cycles, kernel.samples, len(kernel.stream)) == (1, 1, 0)
    assert kernel.start(replace(start, samples=2), pause_at=1) is BM2StopReason.MAX_CYCLES
    more = replace(start, samples=3, max_cycles=2)
    assert kernel.start(more, pause_at=1) is BM2StopReason.FULL
    assert kernel.resume(3, pause_at=2) is BM2StopReason.OPS_TIMEOUT
    assert kernel.start(replace(more, ops_timeout=5), pause_at=2) is BM2StopReason.FULL
    assert kernel.resume(3, pause_at=2) is BM2StopReason.MAX_CYCLES
    assert kernel.start(replace(more, ops_timeout=5, max_cycles=99), pause_at=1) is BM2StopReason.FULL
    assert kernel.resume(3, pause_at=2) is BM2StopReason.PAUSED


def test_samples_are_states_after_sweeps_or_moves():
    states = {}
    for every, count in (("sweep", 40), ("move", 80)):
        kernel = ReferenceBM2(sprinkler(stream=100, sample_every=every))
        kernel.start(start_of(samples=count, burn_in=3))
        states[every] = kernel.stream.tolist()
        cycles = kernel.cycles
    assert states["sweep"] == states["move"][1::2]
    assert kernel.cycles == cycles


def test_samples_of_unused_values_are_counted_apart():
    """One variable of three values, which starts at the unused one: no bit leaves it soon."""
    kernel = ReferenceBM2(uniform((3, 2), searched=(0, 1), stream=100, prob_bits=2))
    reason = kernel.start(start_of(state=3, known=0, samples=100, burn_in=0))
    assert reason is BM2StopReason.SAMPLES
    unused = sum(row[0] & 3 == 3 for row in kernel.stream.tolist())
    assert 0 < kernel.unused == unused < 100
    histograms, joint = kernel.results[:6], kernel.results[6:].reshape(4, 2)
    assert histograms[3] == 0
    assert histograms[:4].sum() == histograms[4:].sum() == joint.sum() == 100 - unused
    assert joint.sum(axis=1).tolist() == histograms[:4].tolist()


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"state": 8}, "state is 8"),
        ({"known": 8}, "known is 8"),
        ({"known": 7}, "All variables are known"),
        ({"samples": 2**32}, "samples"),
        ({"samples": -1}, "samples"),
        ({"burn_in": -1}, "burn_in"),
        ({"ops_timeout": 0}, "ops_timeout"),
        ({"max_cycles": 0}, "max_cycles"),
        ({"bank": 16}, "bank is 16"),
        ({"samples": 1.5}, "integer"),
    ],
)
def test_refused_starts(changes, part):
    kernel = ReferenceBM2(sprinkler())
    kernel.start(start_of())
    before = seen(kernel, kernel.reason)
    with pytest.raises(StartError, match=part):
        kernel.start(start_of(**changes))
    assert seen(kernel, kernel.reason) == before


def test_refused_evidence_and_orders():
    kernel = ReferenceBM2(uniform((3, 2)))
    with pytest.raises(StartError, match="variable 0 is 3; it must be from 0 to 2"):
        kernel.start(start_of(state=3, known=3))
    with pytest.raises(StartError, match="some of the bits of variable 0"):
        kernel.start(start_of(state=0, known=1))
    with pytest.raises(StartError, match="literal"):
        ReferenceBM2(sprinkler(literal=True)).start(start_of(sequencer=Sequencer.COLOURED))


def test_refused_resumes():
    kernel = ReferenceBM2(sprinkler())
    with pytest.raises(StartError, match="reason none"):
        kernel.resume(5)
    kernel.start(start_of(), pause_at=9)
    with pytest.raises(StartError, match="reason paused"):
        kernel.resume(900)
    with pytest.raises(StartError, match="pause_at is 9"):
        kernel.step(9)
    kernel.step()
    with pytest.raises(StartError, match="samples is 300; it must be from 301"):
        kernel.resume(300)
    with pytest.raises(StartError, match="reason samples"):
        kernel.step()


# ---- parameters and machines ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"rng": "lfsr8"}, "lfsr8 biases"),
        ({"rng": "lfsr16"}, "lfsr16 biases"),
        ({"rng": "dice"}, "rng is 'dice'"),
        ({"prob_bits": 1}, "prob_bits is 1"),
        ({"prob_bits": 17}, "prob_bits is 17"),
        ({"steps_per_clock": 12}, "power of two"),
        ({"sequencer": "coloured", "literal": True}, "coloured"),
        ({"chain": 2, "chains": 2}, "chain is 2"),
        ({"ops_timeout": 0}, "ops_timeout is 0"),
        ({"searched": (GRASS,)}, "both searched and known"),
        ({"searched": (3,)}, "searched is 3"),
        ({"searched": (0, 0)}, "twice in searched"),
        ({"factors": ((0,), (0, 2))}, "Variable 1 is in no factor"),
        ({"factors": ((0,), (1, 0), (0, 1, 2))}, "rising order"),
        ({"factors": ((), (0, 1, 2))}, "one or more"),
        ({"factors": ((0, 1, 2, 3),)}, "factor 0 is 3"),
        ({"cardinalities": (2, 0, 2)}, "cardinality of variable 1 is 0"),
        ({"cardinalities": (1, 1, 1)}, "bits of the state is 0"),
        ({"cardinalities": (2**13, 2, 2)}, "words of the histograms"),
        ({"cardinalities": (2**9, 2**9, 2**9)}, "bits of factor 2 is 27"),
    ],
)
def test_refused_parameters(changes, part):
    parameters = {"cardinalities": (2, 2, 2), "factors": ((0,), (0, 1), (0, 1, 2)), "known": (GRASS,)}
    with pytest.raises(ParameterError, match=part):
        BM2Parameters(**{**parameters, **changes})


@pytest.mark.parametrize(
    ("factors", "part"),
    [
        ([[0.5, 0.5]], "1 tables"),
        ([[0.5, 0.5], [1, 1, 1]], "Factor 1 has the shape"),
        ([[0.5, -0.5], [1, 1]], "Factor 0 has a negative"),
        ([[0.5, np.inf], [1, 1]], "Factor 0 has a negative or non-finite"),
        ([[0.5, np.nan], [1, 1]], "Factor 0 has a negative or non-finite"),
        ([[0.5, 0.5], [0, 0]], "Factor 1 has .*only zeros"),
    ],
)
def test_refused_factors(factors, part):
    with pytest.raises(ParameterError, match=part):
        BM2Machine.from_factors(BM2Parameters(cardinalities=(2, 2), factors=((0,), (1,))), factors)


def test_refused_tables():
    machine = sprinkler()
    with pytest.raises(ParameterError, match="from 1 to"):
        BM2Machine(machine.parameters, (np.zeros(1, int), *machine.tables[1:]), machine.supports)
    with pytest.raises(ParameterError, match="CDE 2 has the shape"):
        BM2Machine(machine.parameters, (*machine.tables[:2], machine.tables[1]), machine.supports)
    with pytest.raises(ParameterError, match="rng_table"):
        sprinkler(rng="table")


def test_sizes():
    parameters = uniform((3, 1, 2, 9), searched=(3, 0)).parameters
    assert (parameters.bits, parameters.offsets, parameters.state_bits) == ((2, 0, 1, 4), (0, 2, 2, 3), 7)
    assert (parameters.histogram_words, parameters.joint_words) == (4 + 1 + 2 + 16, 64)
    assert parameters.masks == (0b11, 0, 0b100, 0b1111000)
    assert uniform((2048, 2), searched=(0,)).parameters.joint_words == 0
    assert uniform((2,) * 33).parameters.state_words == 2
    values = (2, 0, 1, 8)
    assert pack(parameters, values) == 0b1000_1_10
    assert unpack(parameters, pack(parameters, values)) == values


def test_machines_are_equal_by_their_tables():
    assert sprinkler() == sprinkler()
    assert hash(sprinkler()) == hash(sprinkler())
    assert sprinkler() != sprinkler(prob_bits=12)
    assert sprinkler() != replace(sprinkler(), tables=tuple(table // 2 + 1 for table in sprinkler().tables))


# ---- start states ---------------------------------------------------------------------------------


@given(runs(variables=6), st.randoms(use_true_random=False), st.booleans())
@settings(max_examples=100, suppress_health_check=list(HealthCheck), deadline=None)
def test_a_start_state_is_the_first_possible_one(run, random, largest):
    parameters = run.machine.parameters
    cardinalities = parameters.cardinalities
    if np.prod(cardinalities) > 5000:
        return
    evidence = {at: random.randrange(size) for at, size in enumerate(cardinalities) if random.random() < 0.3}
    possible = [
        values
        for values in product(*map(range, cardinalities))
        if all(values[at] == value for at, value in evidence.items())
        and all(
            factor[tuple(values[at] for at in scope)] > 0
            for scope, factor in zip(parameters.factors, run.factors, strict=True)
        )
    ]
    state = start_state(run.machine, evidence, largest=largest)
    if not possible:
        assert state is None
    else:
        assert unpack(parameters, state) == (max if largest else min)(possible)


def parity_chain(size, last):
    """Variables x and running parities p: the last parity is known, so that the first x depends on it."""
    factors = [(0, 1)] + [(2 * at - 1, 2 * at, 2 * at + 1) for at in range(1, size)]
    equal = np.eye(2)
    xor = np.array([[[1, 0], [0, 1]], [[0, 1], [1, 0]]])
    parameters = BM2Parameters(cardinalities=(2,) * (2 * size), factors=tuple(factors))
    machine = BM2Machine.from_factors(parameters, [equal] + [xor] * (size - 1))
    return machine, start_state(machine, {2 * size - 1: last})


def test_a_start_state_of_100_variables():
    """The evidence on the last variable decides on the last bit before it."""
    machine, state = parity_chain(50, 1)
    values = unpack(machine.parameters, state)
    assert values == (0,) * 98 + (1, 1)


def test_a_search_that_takes_too_long():
    """Pigeons without a hole: 9 variables of 8 values, all different."""
    pairs = tuple((a, b) for a in range(9) for b in range(a + 1, 9))
    machine = BM2Machine.from_factors(
        BM2Parameters(cardinalities=(8,) * 9, factors=pairs), [1 - np.eye(8)] * len(pairs)
    )
    with pytest.raises(StartError, match="too many zeros"):
        start_state(machine, {})


def test_the_work_of_a_search_is_bounded_not_only_its_dead_ends(monkeypatch):
    """Every value tried and every factor checked counts."""
    monkeypatch.setattr("machines.bm2.SEARCH_MAX", 1000)
    with pytest.raises(StartError, match="too many zeros"):
        parity_chain(200, 1)
    monkeypatch.setattr("machines.bm2.SEARCH_MAX", 300)
    with pytest.raises(StartError, match="too many zeros"):
        start_state(uniform((2,) * 400), {})


def test_a_machine_of_the_largest_numbers():
    """32 variables of a factor are the axes of its array; every variable has a word of results."""
    sizes = (2,) + (1,) * 4094
    rows = tuple(tuple(range(first, min(first + 32, 4095))) for first in range(0, 4095, 32))
    largest = uniform(sizes, rows + ((0,),) * (CDES_MAX - len(rows)))
    assert start_state(largest, {}) == 0
    with pytest.raises(ParameterError, match="number of factors is 8193"):
        BM2Parameters(cardinalities=(2,), factors=((0,),) * (CDES_MAX + 1))
    with pytest.raises(ParameterError, match="number of variables is 4097"):
        BM2Parameters(cardinalities=(*sizes, 1, 1), factors=rows)
    with pytest.raises(ParameterError, match="variables of factor 0 is 33"):
        BM2Parameters(cardinalities=(2,) + (1,) * 32, factors=(tuple(range(33)),))


def test_evidence_outside_the_values():
    with pytest.raises(StartError, match="variable 2 is 2; it must be from 0 to 1"):
        start_state(sprinkler(), {GRASS: 2})
    assert start_state(sprinkler(), {RAIN: 0, SPRINKLER: 0, GRASS: 1}) is None
