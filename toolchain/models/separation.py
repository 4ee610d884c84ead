"""The moral graph of a product of factors without its searched and given symbols."""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np

from toolchain.models.distribution import Distribution, Factor
from toolchain.models.elimination import Term

_LONGEST_DRAWN: Final = 12
"""Maximum number of symbols in a path that is shown completely."""
_SHOWN: Final = 4
"""Number of arcs shown at either end of a longer path."""


class Links:
    """Links between symbols that share a factor, without the searched and given ones.

    Symbols in different components are independent given the removed ones (moral graph criterion).
    """

    def __init__(self, terms: Sequence[Term], factors: Sequence[Factor], cut: set[str]) -> None:
        self._neighbours: dict[str, dict[str, Factor]] = {}
        for term, factor in zip(terms, factors, strict=True):
            inside = [name for name in term.scope if name not in cut]
            for name in inside:
                beside = self._neighbours.setdefault(name, {})
                for other in inside:
                    # an arc between the two is a better explanation than a common child
                    if other != name and (other not in beside or _is_arc(factor, name, other)):
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

    def joined(self, observed: Sequence[str]) -> bool:
        """Return whether two of some symbols are connected."""
        return any(len(component.intersection(observed)) > 1 for component in self.components())

    def path(self, start: str, end: str) -> list[str]:
        """Return the shortest path between two symbols; empty if they are not connected."""
        before = self._reached(start)
        if end not in before:
            return []
        path = [end]
        while path[-1] != start:
            path.append(before[path[-1]])
        return path[::-1]

    def lengths(self, start: str, ends: Sequence[str]) -> dict[str, int]:
        """Return the number of symbols on the shortest path to each connected one of some symbols."""
        before = self._reached(start)
        count = {start: 1}
        for name in before:  # nearer ones are first
            count.setdefault(name, count[before[name]] + 1)
        return {end: count[end] for end in ends if end in count}

    def _reached(self, start: str) -> dict[str, str]:
        """Return every symbol connected to one, with its predecessor on the shortest path."""
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
        """Return a path as text with arrows, common children between their parents; a long one is cut."""
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


def _is_arc(factor: Factor, name: str, other: str) -> bool:
    return isinstance(factor, Distribution) and factor.symbol.name in {name, other}


def relevant(factors: Iterable[Factor], asked: set[str]) -> list[Factor]:
    """Remove factors that sum to 1: distributions of unused symbols on which no other symbol depends."""
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
    """Return the factor without symbols that have no influence in it."""
    scope, table = list(factor.scope), factor.table
    for axis in range(len(scope) - 1, 0, -1):
        first = np.take(table, [0], axis=axis)
        if np.array_equal(np.broadcast_to(first, table.shape), table):
            table = first.squeeze(axis=axis)
            del scope[axis]
    if isinstance(factor, Distribution):
        return replace(factor, given=tuple(scope[1:]), table=table, normal=None)
    return replace(factor, scope=tuple(scope), table=table)
