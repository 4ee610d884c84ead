"""Relations between columns' random bits: those found hold in every cycle, and none is missed."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.parameters import RngKind
from machines.rng import LFSR
from toolchain.checks.generators import relations


def numbers(kind, seeds, cycles, steps):
    """Return the generators' numbers for every column in each cycle: uint64[cycles, columns]."""
    lfsr, states, shown = LFSR(kind), np.asarray(seeds, dtype=np.uint64), []
    for _ in range(cycles):
        shown.append(states)
        for _ in range(steps):
            states = lfsr.step(states)
    return np.stack(shown)


def vanishes(shown, bits):
    parity = np.zeros(len(shown), dtype=np.uint64)
    for column, bit in bits:
        parity ^= (shown[:, column] >> np.uint64(bit)) & np.uint64(1)
    return not parity.any()


@settings(max_examples=25)
@given(st.data(), st.sampled_from([RngKind.LFSR8, RngKind.LFSR16]), st.sampled_from([1, 4, 8]))
def test_what_is_found_holds_and_nothing_shorter_does(data, kind, steps):
    columns, prob_bits = data.draw(st.integers(2, 5)), data.draw(st.integers(1, 4))
    seed = st.integers(1, LFSR(kind).period)
    seeds = np.array([data.draw(st.lists(seed, min_size=columns, max_size=columns))], dtype=np.uint64)
    shown = numbers(kind, seeds[0], 200, steps)
    found, _ = relations(kind, seeds, prob_bits)
    count = len(found[0].bits) if found else 5
    if found:
        assert vanishes(shown, found[0].bits)
        assert len({column for column, _ in found[0].bits}) > 1
    bits = [(column, bit) for column in range(columns) for bit in range(prob_bits)]
    for shorter in range(2, count):
        assert not any(vanishes(shown, some) for some in combinations(bits, shorter))


def test_phases_that_are_evenly_spaced_are_related():
    """3 divides 2**32 - 1, so three columns a third of the period apart XOR to 0 bit by bit."""
    lfsr = LFSR(RngKind.LFSR32)
    third = lfsr.period // 3
    seeds = lfsr.jump(np.full(3, 1, dtype=np.uint64), np.arange(3, dtype=np.uint64) * np.uint64(third))
    (relation,), _ = relations(RngKind.LFSR32, seeds[np.newaxis], 8)
    assert len(relation.bits) == 3
    assert vanishes(numbers(RngKind.LFSR32, seeds, 1000, 8), relation.bits)


def test_the_default_seeds_are_unrelated():
    numbers_of = np.arange(16 * 31, dtype=np.uint64).reshape(16, 31)
    assert relations(RngKind.LFSR32, LFSR(RngKind.LFSR32).seeds(numbers_of), 8) == ([], 16)


@pytest.mark.parametrize("distance", [0, 3, 7])
def test_columns_that_share_bits(distance):
    """A few steps apart, a bit of one is another bit of the other in the same cycle."""
    lfsr = LFSR(RngKind.LFSR24)
    seeds = lfsr.jump(np.full(2, 77, dtype=np.uint64), np.array([0, distance], dtype=np.uint64))
    both = np.stack([lfsr.seeds(np.arange(2, dtype=np.uint64)), seeds])
    (relation,), _ = relations(RngKind.LFSR24, both, 8)
    assert relation.group == 1
    assert len(relation.bits) == 2
    (one, first), (other, second) = relation.bits
    assert (one, other, abs(first - second)) == (0, 1, distance)


def test_too_many_groups_are_not_all_looked_at(monkeypatch):
    lfsr = LFSR(RngKind.LFSR32)
    seeds = lfsr.seeds(np.arange(40 * 4, dtype=np.uint64)).reshape(40, 4)
    assert relations(RngKind.LFSR32, seeds, 8)[1] == 40
    monkeypatch.setattr("toolchain.checks.generators._MOST_PAIRS", 32 * 31 // 2 * 7)
    assert relations(RngKind.LFSR32, seeds, 8)[1] == 7
