"""Variable elimination: names are summed out of a product of tables one by one.

Exact, in float64. The next name is always the one whose table is the smallest; a table above the limit is refused.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from itertools import count

import numpy as np
from numpy.typing import NDArray

from toolchain.errors import ModelError
from toolchain.models.limits import MAX_ENTRIES

_NAMED = 6


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """A factor of a product: a table, float64, and the names of its axes."""

    scope: tuple[str, ...]
    table: NDArray[np.float64]


def reduced(term: Term, values: Mapping[str, int]) -> Term:
    """Return the term with some of its names at fixed values."""
    if not any(name in values for name in term.scope):
        return term
    at = tuple(values.get(name, slice(None)) for name in term.scope)
    return Term(tuple(name for name in term.scope if name not in values), np.asarray(term.table[at]))


def product(terms: Sequence[Term], scope: Sequence[str], sizes: Mapping[str, int]) -> NDArray[np.float64]:
    """Return the product of terms over all their names, float64[size of each]; a ModelError above the limit."""
    _check_size(scope, sizes, "the answer")
    found = np.ones(tuple(sizes[name] for name in scope))
    for term in terms:
        order = sorted(range(len(term.scope)), key=lambda axis: scope.index(term.scope[axis]))
        shape = tuple(sizes[name] if name in term.scope else 1 for name in scope)
        found *= np.transpose(term.table, order).reshape(shape)
    return found


def eliminate(terms: Iterable[Term], names: Iterable[str], sizes: Mapping[str, int]) -> list[Term]:
    """Return terms whose product is the product of the given terms, summed over some names.

    Tables are scaled by their maxima, so that long products don't underflow: the result is exact up to a
    factor. An intermediate table above the limit raises a ModelError.
    """
    left = dict(enumerate(terms))
    fresh = count(len(left))
    holding: dict[str, set[int]] = {name: set() for name in names}
    for number, term in left.items():
        for name in holding.keys() & set(term.scope):
            holding[name].add(number)
    unions = {name: _union(left[number] for number in sorted(holding[name])) for name in holding}
    costs = {name: math.prod(sizes[other] for other in unions[name]) for name in holding}
    # The name breaks ties, so the same question gives the same sums, bit for bit. A changed cost is a new
    # entry of the heap.
    cheapest = [(cost, name) for name, cost in costs.items()]
    heapify(cheapest)
    while holding:
        cost, name = heappop(cheapest)
        if name not in holding or cost != costs[name]:
            continue
        touched = [left.pop(number) for number in sorted(holding.pop(name))]
        scope = unions[name]
        if not touched:
            continue
        _check_size(scope, sizes, f"summing over {name}")
        summed = product(touched, scope, sizes).sum(axis=scope.index(name))
        largest = summed.max()
        made = Term(
            tuple(other for other in scope if other != name), summed / largest if largest > 0 else summed
        )
        number = next(fresh)
        left[number] = made
        for other in holding.keys() & set(made.scope):
            holding[other] = {each for each in holding[other] if each in left} | {number}
            unions[other] = _union(left[each] for each in sorted(holding[other]))
            costs[other] = math.prod(sizes[each] for each in unions[other])
            heappush(cheapest, (costs[other], other))
    return list(left.values())


def _union(terms: Iterable[Term]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for term in terms for name in term.scope))


def _check_size(scope: Sequence[str], sizes: Mapping[str, int], what: str) -> None:
    entries = math.prod(sizes[name] for name in scope)
    if entries > MAX_ENTRIES:
        names = ", ".join(scope[:_NAMED]) + (
            f" and {len(scope) - _NAMED} more" if len(scope) > _NAMED else ""
        )
        raise ModelError(
            f"{what} needs a table of {entries} entries over {names}; the maximum is {MAX_ENTRIES}: use fewer "
            "searched and known variables, or ones that are closer to each other"
        )
