"""Which symbols of a product of factors are joined, once what is searched and given is cut out (the moral graph)."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from toolchain.models.distribution import Distribution, Factor

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from toolchain.models.elimination import Term


class Links:
    """Which symbols stand in a factor together, what is searched and given being cut out: the question's shape.

    After cutting, symbols of different components are independent given what was cut (the moral graph's criterion).
    """

    def __init__(self, terms: Sequence[Term], factors: Sequence[Factor], cut: set[str]) -> None:
        self._neighbours: dict[str, dict[str, Factor]] = {}
        for term, factor in zip(terms, factors, strict=True):
            inside = [name for name in term.scope if name not in cut]
            for name in inside:
                beside = self._neighbours.setdefault(name, {})
                for other in inside:
                    # A distribution that has one as the other's parent says more than a common child does.
                    if other != name and (other not in beside or _is_arc(factor, name, other)):
                        beside[other] = factor

    def components(self) -> list[set[str]]:
        """Return the sets of symbols that are joined, in a fixed order."""
        left = dict.fromkeys(self._neighbours)
        found = []
        while left:
            component = set(self._paths_from(next(iter(left))))
            found.append(component)
            left = {name: None for name in left if name not in component}
        return found

    def joined(self, observed: Sequence[str]) -> bool:
        """Return whether two of some symbols are joined."""
        return any(len(component.intersection(observed)) > 1 for component in self.components())

    def path(self, start: str, end: str) -> list[str]:
        """Return the shortest path between two symbols; empty where they are not joined."""
        return self._paths_from(start).get(end, [])

    def _paths_from(self, start: str) -> dict[str, list[str]]:
        paths = {start: [start]}
        waiting = deque([start])
        while waiting:
            name = waiting.popleft()
            for other in self._neighbours.get(name, ()):
                if other not in paths:
                    paths[other] = [*paths[name], other]
                    waiting.append(other)
        return paths

    def drawn(self, path: Sequence[str]) -> str:
        """Return a path as arrows; a common child stands between its two parents."""
        text = path[0]
        for before, after in pairwise(path):
            factor = self._neighbours[before][after]
            if not isinstance(factor, Distribution):
                text += f" -- {after}"
            elif factor.symbol.name == after:
                text += f" -> {after}"
            elif factor.symbol.name == before:
                text += f" <- {after}"
            else:
                text += f" -> {factor.symbol.name} <- {after}"
        return text


def _is_arc(factor: Factor, name: str, other: str) -> bool:
    return isinstance(factor, Distribution) and factor.symbol.name in {name, other}


def relevant(factors: Iterable[Factor], asked: set[str]) -> list[Factor]:
    """Leave out what sums to 1: distributions of symbols that nothing left depends on and nobody asks for."""
    left = list(factors)
    uses: dict[str, int] = {}
    for factor in left:
        for symbol in factor.scope:
            uses[symbol.name] = uses.get(symbol.name, 0) + 1
    while True:
        kept: list[Factor] = []
        for factor in left:
            name = factor.symbol.name if isinstance(factor, Distribution) else ""
            if isinstance(factor, Distribution) and name not in asked and uses[name] == 1:
                for symbol in factor.scope:
                    uses[symbol.name] -= 1
            else:
                kept.append(factor)
        if len(kept) == len(left):
            return kept
        left = kept


def without_idle(factor: Factor) -> Factor:
    """Return the factor without the symbols that change nothing in it: an arc in name alone joins nothing."""
    scope, table = list(factor.scope), factor.table
    for axis in range(len(scope) - 1, 0, -1):
        first = np.take(table, [0], axis=axis)
        if np.array_equal(np.broadcast_to(first, table.shape), table):
            table = first.squeeze(axis=axis)
            del scope[axis]
    if isinstance(factor, Distribution):
        return replace(factor, given=tuple(scope[1:]), table=table, normal=None)
    return replace(factor, scope=tuple(scope), table=table)
