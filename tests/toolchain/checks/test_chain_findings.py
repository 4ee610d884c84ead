"""Findings about a BM2: clipped factors, errors of the codes, states without a path, wide factors, random numbers."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.bm2 import BM2Machine, BM2Parameters, pack, unpack
from machines.rng import LFSR
from tests.toolchain.chains import network, sprinkler
from tests.toolchain.checks.test_check import found, only
from tests.toolchain.running import OPTIONS
from toolchain.building.bm2_machine import clipped, plan_bm2
from toolchain.building.build import assemble
from toolchain.checks.chain_findings import CheckedChain, chain_findings, legal_states, unconnected
from toolchain.checks.findings import Check, Severity

OR = [[[1.0, 0.0], [0.0, 0.0]], [[0.0, 1.0], [1.0, 1.0]]]
"""P(C | A, B) of a deterministic or, by C, A, B."""


def checked(model, *, samples=10_000, known_model=True, **options):
    """The findings about the BM2 of a network, or about its deployment, which does not have the model."""
    built = assemble(plan_bm2(model, replace(OPTIONS, target_count=samples, **options)))
    chain = CheckedChain(built.deployment, built.images[0].machine, model if known_model else None)
    return list(chain_findings(chain))


def gate(**options):
    """C is A or B; A and B are independent."""
    return network({"A": [0.8, 0.2], "B": [0.7, 0.3], "CAB": OR, "DC": [[0.9, 0.3], [0.1, 0.7]]}, **options)


def test_nothing_is_found_about_a_harmless_machine():
    assert checked(network({"A": [1, 2], "AB": [[1, 2], [3, 1]]}, known=("B",)), samples=100_000) == []


# Clipped factors and their error


def test_clipped_odds_are_counted():
    assert clipped(np.array([1.0, 3.0]), 8) == (0, 0, 1)
    assert clipped(np.array([1.0, 0.0]), 8) == (1, 1, 1)
    assert clipped(np.array([1.0, 0.003]), 8) == (0, 0, 1)  # the code is 1, by rounding
    assert clipped(np.array([1.0, 0.001]), 8) == (1, 0, 1)
    assert clipped(np.array([0.0, 0.0]), 8) == (0, 0, 1)  # 0 / 0 is even odds
    assert clipped(np.array([1.0, 1.0, 0.0]), 8) == (1, 1, 2)  # 0 with 1 and 2; 1 has no partner but 3
    assert clipped(np.array(OR), 16) == (8, 8, 12)


def test_a_clipped_factor_is_named_with_and_without_the_model():
    model = sprinkler()
    for known_model, title in (
        (True, "P(grass | sprinkler, rain)"),
        (False, "CDE 2 (rain, sprinkler, grass)"),
    ):
        finding = only(checked(model, known_model=known_model), Check.CLIPPED)
        assert finding.about == title
        assert "3 of its 12 odds are clipped to 1 in 65536, 3 of them because of zeros" in finding.what
        assert finding.advice == ""  # there are no more bits
    fewer = only(checked(model, prob_bits=12), Check.CLIPPED)
    assert "more --prob-bits" in fewer.advice
    small = network({"A": [1, 1e-4], "AB": [[1, 2], [3, 1]]})
    assert "1 of its 1 odds are clipped to 1 in 256" in only(checked(small, prob_bits=8), Check.CLIPPED).what
    assert not found(checked(small, prob_bits=8, known_model=False), Check.CLIPPED)
    assert not found(checked(small), Check.CLIPPED)


@pytest.mark.parametrize(("bits", "severity", "worst"), [(8, "warning", "0.018"), (16, "note", "0.00015")])
def test_the_error_of_the_codes(bits, severity, worst):
    finding = only(checked(sprinkler(("rain", "sprinkler")), prob_bits=bits), Check.CODES_ERROR)
    assert finding.severity == severity
    assert f"{worst} at worst (grass = yes)" in finding.what


def test_an_error_that_cannot_be_computed_is_said():
    ten = {f"{a}{b}": np.full((2, 2), 0.5) + np.eye(2) for a, b in zip("ABCDEFGHI", "BCDEFGHIJ", strict=True)}
    assert "was not computed" in only(checked(network(ten)), Check.CODES_ERROR).what


def test_samples_that_are_worth_few():
    assert "10000 of them are worth 97 independent ones" in only(checked(sprinkler()), Check.MIXING).what
    assert "20000 of them are worth 193" in only(checked(sprinkler(), partitions=2), Check.MIXING).what
    finding = only(checked(gate()), Check.MIXING)
    assert finding.severity is Severity.WARNING
    assert "1000 sweeps of burn-in leave" in finding.what
    assert not found(checked(sprinkler(), samples=10**6), Check.MIXING)


def test_limits_that_stop_a_frame_early():
    for limits, severity, about in (
        ({"max_cycles": 10}, Severity.ERROR, "max_cycles = 10"),
        ({"max_cycles": 21_999}, Severity.ERROR, "max_cycles = 21999"),
        ({"max_cycles": 22_000}, Severity.WARNING, "max_cycles = 22000"),
        ({"ops_timeout": 1}, Severity.WARNING, "ops_timeout = 1"),
    ):
        for known_model in (True, False):
            finding = only(checked(sprinkler(), known_model=known_model, **limits), Check.STOPPING)
            assert (finding.severity, finding.about) == (severity, about)
            assert "22,000 moves" in finding.what
    assert (
        "12,000 moves" in only(checked(sprinkler(), max_cycles=9, sample_every="move"), Check.STOPPING).what
    )
    assert not found(checked(sprinkler(), max_cycles=200_000, ops_timeout=200), Check.STOPPING)


# Clips in opposite directions


def test_opposite_clips():
    model = network({"AB": [[1, 0], [1, 1]], "AC": [[1, 1], [0, 1]], "B": [1, 1], "C": [1, 1]})
    finding = only(checked(model), Check.OPPOSITE_CLIPS)
    # A must be 0 for B = 1... unless C = 0, where it must be 1: 65,535 agree on 0 and as many on 1, of 2^32
    assert finding.about == "A"
    assert "32,769 cycles" in finding.what
    assert "the potential of A, B and the potential of A, C" in finding.what
    assert "ops_timeout" not in finding.what
    assert (
        "may exceed the 100000 of ops_timeout"
        in only(checked(model, ops_timeout=100_000), Check.OPPOSITE_CLIPS).what
    )
    assert "129 cycles" in only(checked(model, prob_bits=8), Check.OPPOSITE_CLIPS).what


def test_clips_in_one_direction_or_at_a_known_variable_cost_nothing():
    same = network({"AB": [[1, 0], [1, 1]], "AC": [[1, 0], [1, 1]]})
    assert not found(checked(same), Check.OPPOSITE_CLIPS)
    tables = {"AB": [[1, 0], [1, 1]], "AC": [[1, 1], [0, 1]]}
    assert not found(checked(network(tables, searched=("B",), known=("A",))), Check.OPPOSITE_CLIPS)
    optional = network(tables, searched=("B",), known=("A",), on_missing="missing")
    assert found(checked(optional), Check.OPPOSITE_CLIPS)


def test_an_unused_code_is_no_clip():
    three = network({"AB": np.ones((3, 2)) + np.eye(3)[:, :2], "AC": np.ones((3, 2))})
    assert not found(checked(three), Check.OPPOSITE_CLIPS)


def test_clips_in_a_large_neighbourhood_are_not_checked():
    wide = {f"A{other}": [[1, 0], [1, 1]] for other in "BCDEFGHIJKLMNOPQR"}
    finding = only(checked(network(wide)), Check.OPPOSITE_CLIPS)
    assert (finding.about, finding.severity) == ("A", Severity.NOTE)


# Connected states


def test_a_deterministic_or_is_not_connected():
    finding = only(checked(gate()), Check.CONNECTION)
    assert "from A = a0, C = c0 to A = a1, C = c1" in finding.what
    assert not found(checked(gate(known=("C", "A"), searched=("B",))), Check.CONNECTION)
    # with C known, B is free only if A is 1; a missing reading of C leads to the first case
    assert "with A = a0, without C, " in only(
        checked(gate(known=("C", "A"), searched=("B",), on_missing="missing")), Check.CONNECTION
    ).what.replace("without A", "")
    assert (
        "not checked: there are 2^21"
        in only(checked(network({f"{a}": [1, 2] for a in "ABCDEFGHIJKLMNOPQRSTU"})), Check.CONNECTION).what
    )


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_connection_is_that_of_a_search(data):
    """Compare with a search from each state, also where cardinalities are not powers of two."""
    sizes = data.draw(st.lists(st.integers(2, 5), min_size=2, max_size=3))
    count = math.prod(sizes)
    entries = data.draw(st.lists(st.sampled_from([0, 0, 1]), min_size=count, max_size=count))
    table = np.array(entries, dtype=float).reshape(sizes)
    table[(0,) * len(sizes)] = 1
    known = data.draw(st.sets(st.sampled_from(range(len(sizes))), max_size=len(sizes) - 1))
    machine = BM2Machine.from_factors(
        BM2Parameters(cardinalities=tuple(sizes), factors=(tuple(range(len(sizes))),)), [table]
    )
    p = machine.parameters
    states = [pack(p, values) for values in itertools.product(*map(range, sizes)) if table[values]]
    mask = sum(p.masks[each] for each in known)
    moves = [1 << bit for bit in range(p.state_bits) if not mask >> bit & 1]

    def reached(start):
        seen, waiting = {start}, [start]
        while waiting:
            state = waiting.pop()
            new = {state ^ move for move in moves} & set(states) - seen
            seen |= new
            waiting += new
        return seen

    apart = {(a, b) for a in states for b in states if a & mask == b & mask and b not in reached(a)}
    pair = unconnected(machine, legal_states(machine), sorted(known))
    assert (pair is None) == (not apart)
    if pair is not None:
        assert pair in apart
        assert all(table[unpack(p, state)] for state in pair)


def test_states_and_names_are_those_of_the_deployment():
    model = gate(known=("D",), searched=("B",))
    what = only(checked(model, known_model=False), Check.CONNECTION).what
    assert "with D = d0, " in what
    assert "from A = 0, C = 0 to A = 1, C = 1" in what  # hidden ones have names, but no states


# Memories


RANDOM = np.random.default_rng(2)


def test_a_factor_that_is_too_wide_is_named():
    model = network({"ABC": RANDOM.random((64, 64, 64)), "A": np.arange(1, 65)})
    finding = only(checked(model, known_model=False), Check.WIDE_FACTOR)
    assert finding.about == "CDE 0 (A, B, C)"
    assert "2,359,296 words of 16 bits" in finding.what
    assert "holds 2,102,272" in finding.what
    assert "all tables together" not in finding.what
    assert not found(checked(model, known_model=False, prob_bits=10), Check.WIDE_FACTOR)


def test_factors_that_fit_only_alone():
    tables = {"AB": RANDOM.random((256, 512)), "BC": RANDOM.random((512, 256))}
    finding = only(checked(network(tables), known_model=False), Check.WIDE_FACTOR)
    assert "all tables together take 2,176 of 2,053" in finding.what
    assert "1,114,112 words" in finding.what
    del tables["BC"]
    assert not found(checked(network(tables), known_model=False), Check.WIDE_FACTOR)


# Random numbers


def test_few_banks_and_few_steps():
    assert only(checked(sprinkler(), rng_banks=1), Check.RNG_BANKS)
    assert not found(checked(sprinkler(), rng_banks=1, rng_reset="free"), Check.RNG_BANKS)
    assert "biases all samples" in only(checked(sprinkler(), steps_per_clock=8), Check.RNG_STEPS).what
    assert not found(checked(sprinkler(), prob_bits=8, steps_per_clock=8), Check.RNG_STEPS)


def test_seeds_that_are_equal_on_two_boards(monkeypatch):
    monkeypatch.setattr(LFSR, "seeds", lambda _, numbers: numbers % np.uint64(7) + np.uint64(1))
    findings = checked(sprinkler(), partitions=4)
    finding = next(each for each in found(findings, Check.RNG_RELATION) if "have the same seed" in each.what)
    assert finding.severity is Severity.ERROR
    assert "P(rain) (board 0, bank 0) and P(sprinkler | rain) (board 2, bank 0)" in finding.what
    monkeypatch.undo()
    assert not found(checked(sprinkler(), partitions=4), Check.RNG_RELATION)


def test_bits_that_are_related():
    ring = {f"{a}{b}": [[1, 2], [3, 1]] for a, b in zip("ABCDEFGH", "BCDEFGHA", strict=True)}
    finding = only(checked(network(ring), rng="lfsr24"), Check.RNG_RELATION)
    assert "4 random bits XOR to 0 in every cycle" in finding.what
    assert finding.advice == "use --rng lfsr32, or fewer --prob-bits"
    many = network({f"{a}{b}": [[1, 2], [3, 1]] for a in "ABCDEFGHIJKL" for b in "MNOPQRSTUVWX"})
    assert any(
        "searched among 128 of 144 CDEs" in each.what for each in found(checked(many), Check.RNG_RELATION)
    )
    assert not found(checked(network(ring)), Check.RNG_RELATION)


def test_a_frame_that_is_long_for_its_period():
    assert not found(checked(sprinkler(), rng="lfsr24", samples=200_000), Check.RNG_PERIOD)
    finding = only(checked(sprinkler(), rng="lfsr24", samples=300_000), Check.RNG_PERIOD)
    assert "more than a tenth of the generators' period of 16777215" in finding.what
    long = only(checked(sprinkler(), burn_in=4 * 10**9), Check.RNG_PERIOD)
    assert long.advice == "use fewer --samples or a shorter --burn-in"  # no generator is wider
    assert found(checked(sprinkler(), rng="lfsr24", samples=150_000, partitions=2), Check.RNG_PERIOD)
    assert not found(checked(sprinkler(), rng="lfsr24", samples=10**8, max_cycles=10**6), Check.RNG_PERIOD)
