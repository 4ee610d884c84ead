"""Relations between the random bits of different columns, which make their AND wrong permanently.

A bit of an LFSR's state is a linear function of its initial state. Columns use the same sequence with
different phases, so bits of the numbers of two to four columns may XOR to 0 in every cycle. Then the columns
are not independent, and no number of cycles averages this out.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machines.parameters import RngKind
from machines.rng import LFSR

Bit = tuple[int, int]
"""A column, 0 being the prior, and a bit of its numbers."""

_MOST_PAIRS: Final = 20_000_000


@dataclass(frozen=True, slots=True)
class Relation:
    """Bits that XOR to 0 in every cycle, in one group: a bank, or a line's cells in a bank."""

    group: int
    bits: tuple[Bit, ...]


@dataclass(frozen=True, slots=True)
class Relations:
    """At most one relation of the fewest bits for each group, and the number of groups that were searched."""

    found: tuple[Relation, ...]
    groups: int


def relations(kind: RngKind, seeds: NDArray[np.uint64], prob_bits: int) -> Relations:
    """Search for relations of 2, 3 or 4 bits between columns, in as many groups as a few seconds permit.

    `seeds` are uint64[groups, columns]; the columns of a group are those whose bits are ANDed. The low
    `prob_bits` bits of a state are compared with a code.
    """
    groups, columns = seeds.shape
    bits = columns * prob_bits
    pairs = max(1, bits * (bits - 1) // 2)
    groups = min(groups, max(1, _MOST_PAIRS // pairs))
    words = _bit_words(kind, seeds[:groups], prob_bits)
    found = [
        Relation(group, tuple((at // prob_bits, at % prob_bits) for at in related))
        for group, row in enumerate(words)
        if (related := _related(row)) is not None
    ]
    return Relations(tuple(found), groups)


def _bit_words(kind: RngKind, seeds: NDArray[np.uint64], prob_bits: int) -> NDArray[np.uint64]:
    """Return each bit's values in the first steps, as many as the state has bits: uint64[groups, bits].

    Two bits with the same word are always the same, because so many steps determine a linear sequence.
    """
    lfsr = LFSR(kind)
    shifts = np.arange(prob_bits, dtype=np.uint64)
    words = np.zeros((*seeds.shape, prob_bits), dtype=np.uint64)
    states = seeds
    for step in range(lfsr.bits):
        words |= ((states[..., np.newaxis] >> shifts) & np.uint64(1)) << np.uint64(step)
        states = lfsr.step(states)
    return words.reshape(len(seeds), -1)


def _related(words: NDArray[np.uint64]) -> tuple[int, ...] | None:
    """Return the indices of the fewest words, at most 4, whose XOR is 0."""
    order = np.argsort(words, kind="stable")
    ordered = words[order]
    same = np.flatnonzero(ordered[1:] == ordered[:-1])
    if same.size:
        return tuple(sorted(int(index) for index in order[same[0] : same[0] + 2]))
    first, second = np.triu_indices(len(words), 1)
    sums = words[first] ^ words[second]
    places = np.minimum(np.searchsorted(ordered, sums), len(words) - 1)
    third = np.flatnonzero(ordered[places] == sums)
    if third.size:
        at = third[0]
        return tuple(sorted((int(first[at]), int(second[at]), int(order[places[at]]))))
    by_sum = np.argsort(sums, kind="stable")
    sums = sums[by_sum]
    fourth = np.flatnonzero(sums[1:] == sums[:-1])
    if fourth.size:
        # two pairs with the same XOR have no word in common: the other two would be equal
        one, other = by_sum[fourth[0]], by_sum[fourth[0] + 1]
        return tuple(sorted(int(index) for pair in (one, other) for index in (first[pair], second[pair])))
    return None
