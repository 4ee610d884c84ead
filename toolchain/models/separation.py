"""The moral graph of a product of factors without its searched and given symbols: which symbols it joins."""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np

from toolchain.models.distribution import Distribution, Factor
from toolchain.models.elimination import Term

_LONGEST_DRAWN: Final = 12
"""Symbols of a path that is drawn whole."""
_SHOWN: Final = 4
"""Arcs that are drawn at either end of a longer path."""


class Links:
    """The symbols that share a factor, without the searched and given ones.

    After cutting, symbols of different components are independent given what was cut (the moral graph's criterion).
    """

    def __init__(self, terms: Sequence[Term], factors: Sequence[Factor], cut: set[str]) -> None:
        self._neighbours: dict[str, dict[str, Factor]] = {}
        for term, factor in zip(terms, factors, strict=True):
            inside = [name for name in term.scope if name not in cut]
            for name in inside:
                beside = self._neighbours.setdefault(name, {})
                for other in inside:
                    # an arc between the two explains more than a common child
                    if other != name and (other not in beside or _is_arc(factor, name, other)):
                        beside[other] = factor

    def components(self) -> list[set[str]]:
        """Return the sets of symbols that are joined, in a fixed order."""
        found: list[set[str]] = []
        placed: set[str] = set()
        for name in self._neighbours:
            if name not in placed:
                found.append(set(self._reached(name)))
                placed |= found[-1]
        return found

    def joined(self, observed: Sequence[str]) -> bool:
        """Return whether two of some symbols are joined."""
        return any(len(component.intersection(observed)) > 1 for component in self.components())

    def path(self, start: str, end: str) -> list[str]:
        """Return the shortest path between two symbols; empty where they are not joined."""
        before = self._reached(start)
        if end not in before:
            return []
        path = [end]
        while path[-1] != start:
            path.append(before[path[-1]])
        return path[::-1]

    def lengths(self, start: str, ends: Sequence[str]) -> dict[str, int]:
        """Return the number of symbols on the shortest path to each of some symbols that is joined, both ends included."""
        before = self._reached(start)
        count = {start: 1}
        for name in before:  # nearer ones come first
            count.setdefault(name, count[before[name]] + 1)
        return {end: count[end] for end in ends if end in count}

    def _reached(self, start: str) -> dict[str, str]:
        """Return every symbol that is joined to one, with the symbol before it on the shortest path."""
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
        """Return a path as arrows, with common children between their parents; of a long path only the ends."""
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
    """Leave out factors that sum to 1: distributions of symbols that are not asked for and on which none depends."""
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
    """Return the factor without the symbols that change nothing in it."""
    scope, table = list(factor.scope), factor.table
    for axis in range(len(scope) - 1, 0, -1):
        first = np.take(table, [0], axis=axis)
        if np.array_equal(np.broadcast_to(first, table.shape), table):
            table = first.squeeze(axis=axis)
            del scope[axis]
    if isinstance(factor, Distribution):
        return replace(factor, given=tuple(scope[1:]), table=table, normal=None)
    return replace(factor, scope=tuple(scope), table=table)
