"""Exact inference on a product of factors: tests of independence, and sums over the symbols that a question omits.

Independence is tested on the moral graph, from which the searched and the fixed symbols are removed. Omitted symbols
are eliminated one by one, exactly, in float64.

The order of elimination is planned in advance by two rules. By the first rule, the next symbol is the symbol that
needs the smallest table (min-weight). By the second rule, the next symbol is the symbol that joins the fewest pairs
of symbols (min-fill). The order with the smaller tables is used. If both orders need a table above the limit, the
question is refused.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush
from itertools import combinations, pairwise
from typing import Final, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from toolchain.errors import ModelError
from toolchain.models.distribution import Distribution, Factor
from toolchain.models.model import MAX_ENTRIES

_NAMED: Final = 6
_CHEAP: Final = 2**16
"""If the tables of the min-weight order have at most this many entries in all, the min-fill order is not planned."""
_MOST_COUNTED: Final = 64
"""Maximum number of neighbours of a symbol among which `_fill` counts the pairs."""

_Graph: TypeAlias = dict[str, set[str]]
"""For each symbol's name, the names of the symbols that are in a term (factor) with it."""


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """A factor of a product: a float64 table, and the names of the table's axes."""

    scope: tuple[str, ...]
    table: NDArray[np.float64]

    @classmethod
    def of(cls, factor: Factor) -> Self:
        """Convert a factor of a joint distribution to a term."""
        return cls(tuple(symbol.name for symbol in factor.scope), factor.table)


def reduced(term: Term, values: Mapping[str, int]) -> Term:
    """Fix each symbol in `values` at the given index, and return the term over the remaining symbols."""
    if not any(name in values for name in term.scope):
        return term
    at = tuple(values.get(name, slice(None)) for name in term.scope)
    return Term(tuple(name for name in term.scope if name not in values), np.asarray(term.table[at]))


def product(terms: Sequence[Term], scope: Sequence[str], sizes: Mapping[str, int]) -> NDArray[np.float64]:
    """Return the product of terms, float64[size of each symbol in `scope`].

    Raises a ModelError if the product is too large.
    """
    _check_size(scope, sizes, "the answer")
    if len(terms) == 1 and terms[0].scope == tuple(scope):  # not copied: it may be large
        return terms[0].table
    found = np.ones(tuple(sizes[name] for name in scope))
    for term in terms:
        order = sorted(range(len(term.scope)), key=lambda axis: scope.index(term.scope[axis]))
        shape = tuple(sizes[name] if name in term.scope else 1 for name in scope)
        found *= np.transpose(term.table, order).reshape(shape)
    return found


def eliminate(terms: Iterable[Term], names: Iterable[str], sizes: Mapping[str, int]) -> list[Term]:
    """Sum the product of terms over the symbols in `names`; return terms with a product proportional to the sum.

    Each table is scaled by its maximum, so long products do not underflow. The result is therefore exact up to a
    constant factor. If every order needs an intermediate table above the limit, a ModelError is raised.
    """
    left = dict(enumerate(terms))
    names = set(names)
    holding: dict[str, set[int]] = {name: set() for name in names}
    for number, term in left.items():
        for name in names.intersection(term.scope):
            holding[name].add(number)
    for number, name in enumerate(_order(left.values(), names, sizes), start=len(left)):
        touched = [left.pop(each) for each in sorted(holding.pop(name))]
        if not touched:
            continue
        scope = tuple(dict.fromkeys(name for term in touched for name in term.scope))
        summed = product(touched, scope, sizes).sum(axis=scope.index(name))
        largest = summed.max()
        made = Term(
            tuple(other for other in scope if other != name), summed / largest if largest > 0 else summed
        )
        left[number] = made
        for other in holding.keys() & set(made.scope):
            holding[other] = {each for each in holding[other] if each in left} | {number}
    return list(left.values())


@dataclass(frozen=True, slots=True)
class _Plan:
    """An order of elimination. Its largest table has `largest` entries; above the limit, the order is incomplete."""

    order: tuple[str, ...]
    entries: int
    largest: int
    scope: tuple[str, ...]


def _order(terms: Iterable[Term], names: set[str], sizes: Mapping[str, int]) -> tuple[str, ...]:
    """Return the cheaper of the min-weight and the min-fill order in which to sum out `names`.

    Raises a ModelError if the largest table of this order is above the limit.
    """
    graph: _Graph = {name: set() for name in names}
    for term in terms:
        for name in term.scope:
            graph.setdefault(name, set()).update(term.scope)
    for name, neighbours in graph.items():
        neighbours.discard(name)
    plan = _planned(graph, names, sizes, lambda at, name: _entries(at, name, sizes))
    if plan.entries > _CHEAP:
        other = _planned(graph, names, sizes, _fill)
        plan = min(plan, other, key=lambda each: (each.largest, each.entries))
    if plan.largest > MAX_ENTRIES:
        _check_size(plan.scope, sizes, f"summing over {plan.scope[0]}")
    return plan.order


def _planned(
    graph: _Graph, names: set[str], sizes: Mapping[str, int], cost: Callable[[_Graph, str], int]
) -> _Plan:
    """Return the order that eliminates at each step the symbol with the lowest `cost`."""
    graph = {name: set(neighbours) for name, neighbours in graph.items()}
    costs = {name: cost(graph, name) for name in names}
    # The name breaks ties, so the same question gives the same sums, bit for bit. A changed cost is a new
    # entry of the heap.
    cheapest = [(each, name) for name, each in costs.items()]
    heapify(cheapest)
    order: list[str] = []
    entries = largest = 0
    widest: tuple[str, ...] = ()
    while costs:
        each, name = heappop(cheapest)
        if each != costs.get(name):
            continue
        del costs[name]
        order.append(name)
        own = _entries(graph, name, sizes)
        entries += own
        neighbours = graph.pop(name)
        if own > largest:
            largest, widest = own, (name, *sorted(neighbours))
        if own > MAX_ENTRIES:
            break
        changed_names = set(neighbours)
        for other in neighbours:
            graph[other].discard(name)
        for one, other in combinations(sorted(neighbours), 2):
            if other not in graph[one]:
                changed_names |= graph[one] & graph[other]
                graph[one].add(other)
                graph[other].add(one)
        for other in costs.keys() & changed_names:
            changed = cost(graph, other)
            if changed != costs[other]:
                costs[other] = changed
                heappush(cheapest, (changed, other))
    return _Plan(tuple(order), entries, largest, widest)


def _entries(graph: _Graph, name: str, sizes: Mapping[str, int]) -> int:
    """Return the size of the table over a symbol and its neighbours, or the limit + 1 for a table above the limit."""
    entries = sizes[name]
    for other in graph[name]:
        entries *= sizes[other]
        if entries > MAX_ENTRIES:  # a name may have thousands of neighbours
            return MAX_ENTRIES + 1
    return entries


def _fill(graph: _Graph, name: str) -> int:
    """Return how many pairs of a symbol's neighbours are not adjacent; for many neighbours, an upper bound."""
    neighbours = graph[name]
    if len(neighbours) > _MOST_COUNTED:
        return len(neighbours) ** 2
    return sum(other not in graph[one] for one, other in combinations(neighbours, 2))


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


_LONGEST_DRAWN: Final = 12
"""Maximum number of symbols in a path that is shown completely."""
_SHOWN: Final = 4
"""Number of arcs shown at each end of a path that is shortened."""


class Links:
    """Links between symbols that share a factor. The searched and the fixed symbols, named in `cut`, are left out.

    Symbols in different components are independent, given the symbols in `cut` (moral graph criterion).
    """

    def __init__(self, factors: Iterable[Factor], cut: set[str]) -> None:
        self._neighbours: dict[str, dict[str, Factor]] = {}
        for factor in factors:
            inside = [symbol.name for symbol in factor.scope if symbol.name not in cut]
            for name in inside:
                beside = self._neighbours.setdefault(name, {})
                for other in inside:
                    # an arc between the two is a better explanation than a common child
                    arc = isinstance(factor, Distribution) and factor.symbol.name in {name, other}
                    if other != name and (other not in beside or arc):
                        beside[other] = factor

    def components(self) -> list[set[str]]:
        """Return the connected components, in a fixed order."""
        found: list[set[str]] = []
        placed: set[str] = set()
        for name in self._neighbours:
            if name not in placed:
                found.append(set(self._reached(name)))
                placed |= found[-1]
        return found

    def path(self, start: str, end: str) -> list[str]:
        """Return the shortest path between two symbols, or an empty list if they are not connected."""
        before = self._reached(start)
        if end not in before:
            return []
        path = [end]
        while path[-1] != start:
            path.append(before[path[-1]])
        return path[::-1]

    def lengths(self, start: str, ends: Sequence[str]) -> dict[str, int]:
        """Return the length of the shortest path from `start` to each symbol in `ends`.

        A length is the number of symbols on the path, with both ends. Symbols without a path from `start` are left out.
        """
        before = self._reached(start)
        count = {start: 1}
        for name in before:  # nearer ones are first
            count.setdefault(name, count[before[name]] + 1)
        return {end: count[end] for end in ends if end in count}

    def _reached(self, start: str) -> dict[str, str]:
        """Return every symbol connected to `start`, with its predecessor on the shortest path."""
        before = {start: start}
        waiting = deque([start])
        while waiting:
            name = waiting.popleft()
            for other in self._neighbours.get(name, ()):
                if other not in before:
                    before[other] = name
                    waiting.append(other)
        return before

    def drawn(self, path: Sequence[str]) -> str:
        """Return a path as text with arrows. A long path is shortened.

        If two neighbours on the path are parents of one child, the child stands between the two: `A -> child <- B`.
        """
        arrows = [self._arrow(before, after) for before, after in pairwise(path)]
        if len(path) > _LONGEST_DRAWN:
            arrows[_SHOWN:-_SHOWN] = [f" ... {path[-1 - _SHOWN]}"]
        return path[0] + "".join(arrows)

    def _arrow(self, before: str, after: str) -> str:
        factor = self._neighbours[before][after]
        if not isinstance(factor, Distribution):
            return f" -- {after}"
        if factor.symbol.name == after:
            return f" -> {after}"
        if factor.symbol.name == before:
            return f" <- {after}"
        return f" -> {factor.symbol.name} <- {after}"


def relevant(factors: Iterable[Factor], asked: set[str]) -> list[Factor]:
    """Return the factors that a result over the symbols `asked` needs.

    A distribution P(A | ...) is left out if A is neither in `asked` nor in another remaining factor. Summing out A
    then only multiplies by 1.
    """
    kept = list(factors)
    uses: dict[str, int] = {}
    own: dict[str, int] = {}
    for number, factor in enumerate(kept):
        if isinstance(factor, Distribution):
            own[factor.symbol.name] = number
        for symbol in factor.scope:
            uses[symbol.name] = uses.get(symbol.name, 0) + 1
    gone: set[int] = set()
    waiting = list(own)
    while waiting:
        name = waiting.pop()
        if name not in own or name in asked or uses[name] > 1:
            continue
        number = own.pop(name)
        gone.add(number)
        for symbol in kept[number].scope:
            uses[symbol.name] -= 1
            if uses[symbol.name] == 1:
                waiting.append(symbol.name)
    return [factor for number, factor in enumerate(kept) if number not in gone]


def without_idle(factor: Factor) -> Factor:
    """Return the factor without the symbols on which its values do not depend. The first symbol always stays."""
    scope, table = list(factor.scope), factor.table
    for axis in range(len(scope) - 1, 0, -1):
        first, last = np.take(table, [0], axis=axis), np.take(table, [-1], axis=axis)
        # most tables differ here already, and large ones need no further look
        if np.array_equal(first, last) and np.array_equal(np.broadcast_to(first, table.shape), table):
            table = first.squeeze(axis=axis)
            del scope[axis]
    if isinstance(factor, Distribution):
        return replace(factor, given=tuple(scope[1:]), table=table, normal=None)
    return replace(factor, scope=tuple(scope), table=table)
