"""Joint distributions as products of factors, and questions about joint distributions, as in ProBT.

A BM2 samples any question, as a `NetworkModel`. A BM1 computes a question in the form of naive fusion,
P(S) P(k_1 | S) ... P(k_N | S) (equation 2.2), as a `Model`. Symbols that are neither searched nor known are summed
out exactly. If a question has another form, a BM1 cannot compute it. The error contains the path that joins two
known symbols.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from operator import itemgetter
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from toolchain.bounded_files import nearest_name
from toolchain.deployment.filter import Transition
from toolchain.errors import ModelError, NotFusionError
from toolchain.models.distribution import Distribution, Factor, Symbol
from toolchain.models.inference import Links, Term, eliminate, product, reduced, relevant, without_idle
from toolchain.models.model import (
    MAX_ENTRIES,
    MAX_MODEL_ENTRIES,
    Known,
    Model,
    Normal,
    PriorSelect,
    check_size,
)
from toolchain.models.network import NetworkModel, network_model

Named: TypeAlias = Symbol | str
_ROUNDING: Final = 1e-12
"""A sum of a distribution that differs from 1 by less than this is taken as 1."""


@dataclass(frozen=True, eq=False)
class JointDistribution:
    """A product of factors. It is a Bayesian network or, if a factor is a potential, a Markov network."""

    name: str
    """The name of the model in deployments."""
    factors: tuple[Factor, ...]
    """Distributions such as P(A | B, C), and potentials. Parents such as B and C have factors of their own."""
    symbols: tuple[Symbol, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "factors", tuple(self.factors))
        symbols: dict[str, Symbol] = {}
        for factor in self.factors:
            for symbol in factor.scope:
                if symbols.setdefault(symbol.name, symbol) != symbol:
                    raise ModelError(f"{self.name}: there are two different symbols {symbol.name!r}")
        children: dict[str, tuple[str, ...]] = {}
        bare = set(symbols)
        for factor in self.factors:
            if isinstance(factor, Distribution):
                if factor.symbol.name in children:
                    raise ModelError(f"{self.name}: {factor.symbol.name} has two distributions")
                children[factor.symbol.name] = tuple(each.name for each in factor.given)
                bare.discard(factor.symbol.name)
            else:
                bare.difference_update(each.name for each in factor.scope)
        if bare:
            raise ModelError(
                f"{self.name}: {min(bare)} has no distribution; give it one, such as uniform({min(bare)})"
            )
        try:
            TopologicalSorter(children).prepare()
        except CycleError as error:
            cycle = " -> ".join(error.args[1])  # the first one is again at the end
            raise ModelError(f"{self.name}: {cycle} is a cycle; a joint distribution has none") from None
        object.__setattr__(self, "symbols", tuple(symbols.values()))

    @cached_property
    def active(self) -> tuple[Factor, ...]:
        """The factors, each without the symbols on which its values do not depend."""
        return tuple(map(without_idle, self.factors))

    def symbol(self, name: Named) -> Symbol:
        """Return the symbol with this name, or raise a ModelError."""
        wanted = name if isinstance(name, str) else name.name
        for symbol in self.symbols:
            if symbol.name == wanted:
                return symbol
        names = [symbol.name for symbol in self.symbols]
        raise ModelError(f"{self.name} has no variable {wanted!r}; {nearest_name(wanted, names)}")

    def ask(
        self,
        searched: Sequence[Named],
        known: Sequence[Named] = (),
        *,
        given: Mapping[str, str] | None = None,
        prior_select: Named | None = None,
        previous: Sequence[Named] = (),
    ) -> Question:
        """Return the question P(searched | known).

        Args:
            searched: The searched symbols, the slowest dimension first. Each combination of their values is a line of
                the machine.
            known: The symbols known in every frame, in the order of the machine's columns.
            given: The fixed value of each symbol that has one, by name. A value is given by its label or number.
            prior_select: A known symbol that selects the row of the prior. It has no column (thesis 2.1.2).
            previous: For a filter: the searched symbols one frame earlier, in the order of `searched`. The arcs from
                the earlier to the searched symbols are the transition. The distribution of the earlier symbols is P(S)
                before the first frame.

        Raises:
            ModelError: A symbol does not exist or is in the question twice, or no symbol is searched.
        """
        fixed = {
            self.symbol(name).name: self.symbol(name).index(label) for name, label in (given or {}).items()
        }
        question = Question(
            joint=self,
            searched=tuple(self.symbol(each) for each in searched),
            known=tuple(self.symbol(each) for each in known),
            given=fixed,
            prior_select=None if prior_select is None else self.symbol(prior_select),
            previous=tuple(self.symbol(each) for each in previous),
        )
        symbols = (*question.searched, *question.observed, *question.previous)
        names = [each.name for each in symbols] + list(fixed)
        for name in names:
            if names.count(name) > 1:
                raise ModelError(
                    f"{self.name}: {name} is in the question twice; it can be either searched, known, given or previous"
                )
        if not question.searched:
            raise ModelError(f"{self.name}: the question does not search anything")
        return question


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Question:
    """P(searched | known) of a joint distribution, created by `JointDistribution.ask`."""

    joint: JointDistribution
    """The joint distribution."""
    searched: tuple[Symbol, ...]
    """The searched symbols, the slowest dimension first."""
    known: tuple[Symbol, ...]
    """The known symbols, in the columns' order."""
    given: Mapping[str, int]
    """The index of each fixed symbol's value, by the name of the symbol."""
    prior_select: Symbol | None
    """The symbol that selects the prior, or None."""
    previous: tuple[Symbol, ...] = ()
    """For a filter, the symbols of the previous frame, in the order of `searched`. Without a filter, it is empty."""

    def __repr__(self) -> str:
        known = [*(each.name for each in self.observed), *(f"{name}={at}" for name, at in self.given.items())]
        asked = " | ".join(
            ", ".join(names) for names in ([each.name for each in self.searched], known) if names
        )
        return f"Question({self.joint.name!r}, P({asked}))"

    @property
    def observed(self) -> tuple[Symbol, ...]:
        """The symbols that have a reading in every frame."""
        return self.known if self.prior_select is None else (*self.known, self.prior_select)

    def model(self) -> Model:
        """Return the model that a BM1 computes.

        Raises:
            NotFusionError: The question is not naive fusion. The error names the path that joins two known symbols.
            ModelError: The question is impossible, or needs a table above the limit.
        """
        observed = [symbol.name for symbol in self.observed]
        searched = [symbol.name for symbol in self.searched]
        sizes = {symbol.name: symbol.size for symbol in self.joint.symbols}
        lines = math.prod(symbol.size for symbol in self.searched)
        values = [symbol.size for symbol in self.observed]
        tables = f"{self.joint.name}: a table of {lines} lines"
        check_size(tables, lines * max(values, default=1), MAX_ENTRIES, ": search fewer variables")
        check_size(
            f"{tables} for all",
            lines * sum(values),
            MAX_MODEL_ENTRIES,
            ": use fewer searched and known variables",
        )
        if (refusal := self.refusal()) is not None:
            raise refusal
        factors, links = self._linked(self.joint.active, observed)
        terms = [reduced(Term.of(factor), self.given) for factor in factors]
        own: dict[str, list[Term]] = {symbol.name: [] for symbol in self.observed}
        common: list[Term] = []
        for component in links.components():
            here = [term for term in terms if component.intersection(term.scope)]
            kept = component.intersection(own)
            left = eliminate(here, component - kept, sizes)
            if kept:
                own[kept.pop()] += left
            else:
                common += left
        common += [term for term in terms if set(term.scope) <= set(searched)]
        model = self._fusion(own, product(common, searched, sizes).ravel(), sizes)
        return replace(model, prior=None, transition=self._transition()) if self.previous else model

    def _transition(self) -> Transition:
        """Return the start and the transition of the filter, or raise a ModelError if the question has no filter."""
        name, lines = self.joint.name, math.prod(symbol.size for symbol in self.searched)
        pairs = list(zip(self.searched, self.previous, strict=False))
        if len(self.previous) != len(self.searched):
            raise ModelError(
                f"{name}: {len(self.searched)} searched and {len(self.previous)} previous variables; name the earlier self of "
                "each searched one, in the same order"
            )
        for symbol, before in pairs:
            if symbol.type != before.type:
                raise ModelError(
                    f"{name}: {before.name}, the previous {symbol.name}, does not have the same values"
                )
        if self.given or self.prior_select:
            other = self.prior_select.name if self.prior_select else next(iter(self.given))
            raise ModelError(
                f"{name}: a filter has searched, known and previous variables alone: leave {other} out"
            )
        advice = ": search fewer variables or values"
        check_size(f"{name}: the transition between {lines} lines", lines * lines, MAX_ENTRIES, advice)
        earlier = {symbol.name for symbol in self.previous}
        start: list[Term] = []
        moves: list[Term] = []
        for factor in relevant(self.joint.active, earlier | {symbol.name for symbol in self.searched}):
            if not isinstance(factor, Distribution):
                raise ModelError(f"{name}: a filter needs distributions, but {factor.title} is none")
            others = {symbol.name for symbol in factor.given} - earlier
            if factor.symbol.name in earlier and others:
                raise ModelError(
                    f"{name}: {factor.symbol.name}, which is previous, depends on {min(others)}, which is not"
                )
            terms = start if factor.symbol.name in earlier else moves
            terms.append(Term.of(factor))
        if not any(earlier.intersection(term.scope) for term in moves):
            names = [" and ".join(each.name for each in group) for group in zip(*pairs, strict=True)]
            raise ModelError(f"{name}: {names[0]} does not depend on {names[1]}, the previous {names[0]}")
        self._check_known(earlier)
        sizes = {symbol.name: symbol.size for symbol in self.joint.symbols}
        scope = [symbol.name for symbol in (*self.previous, *self.searched)]
        hidden = {each for term in moves for each in term.scope} - set(scope)
        table = product(eliminate(moves, hidden, sizes), scope, sizes).reshape(lines, lines)
        first = product(start, scope[: len(self.previous)], sizes).ravel()
        return Transition(first / first.sum(), table / table.sum(axis=1, keepdims=True))

    def _check_known(self, earlier: set[str]) -> None:
        """Raise a ModelError if a known symbol depends on the `earlier` frame's symbols, given the searched ones."""
        active = self.joint.active
        _, links = self._linked(active, [*(symbol.name for symbol in self.known), *earlier])
        for component in links.components():
            for symbol in self.known if component & earlier else ():
                for before in sorted(component & earlier) if symbol.name in component else ():
                    _, own = self._linked(active, [symbol.name, before])
                    if path := own.path(symbol.name, before):
                        searched = ", ".join(each.name for each in self.searched)
                        raise ModelError(
                            f"{self.joint.name}: {symbol.name} is not independent of the previous frame given {searched}: "
                            f"{own.drawn(path)} joins it with {before}; search what is between, or leave {symbol.name} out"
                        )

    def network(self) -> NetworkModel:
        """Return the network that a BM2 samples, or raise a ModelError.

        A BM2 cannot select a prior. The network therefore treats the symbol `prior_select` like the known symbols.
        """
        joint = self.joint
        return network_model(
            joint.name, joint.factors, joint.symbols, self.searched, self.observed, self.given
        )

    def refusal(self) -> NotFusionError | None:
        """Return an error that says why the question is not naive fusion, or None if it is naive fusion."""
        observed = [symbol.name for symbol in self.observed]
        _, links = self._linked(self.joint.active, observed)
        if any(len(component.intersection(observed)) > 1 for component in links.components()):
            return self._refusal()
        return None

    def dependent(self) -> list[tuple[str, str]]:
        """Return the pairs of known symbols that are dependent given the searched symbols.

        Only one symbol of a pair can be known in a BM1.
        """
        factors, pairs = self._pairs()
        return [
            (one, other) for _, one, other in pairs if self._linked(factors, [one, other])[1].path(one, other)
        ]

    def _linked(self, active: Sequence[Factor], observed: Sequence[str]) -> tuple[list[Factor], Links]:
        """Return the factors relevant for some observed symbols, and their links, cut at searched and given symbols."""
        cut = {*(symbol.name for symbol in self.searched), *self.given}
        factors = relevant(active, cut | set(observed))
        return factors, Links(factors, cut)

    def _pairs(self) -> tuple[list[Factor], list[tuple[int, str, str]]]:
        """Return the factors relevant for all observed symbols, and the pairs that they join, with lengths of paths.

        Only these pairs may be dependent. To find out whether a pair is, use the factors relevant for that pair alone.
        Those factors are a part of the returned ones, so the pair's path through them has at least the returned length.
        """
        observed = [symbol.name for symbol in self.observed]
        factors, links = self._linked(self.joint.active, observed)
        return factors, [
            (length, one, other)
            for at, one in enumerate(observed)
            for other, length in links.lengths(one, observed[at + 1 :]).items()
        ]

    def _refusal(self) -> NotFusionError:
        """Return an error that names two dependent observed symbols and the path of arcs between both, with advice.

        By d-separation, if a set of observed symbols is not independent, then at least two of its symbols are dependent
        as a pair.
        """
        factors, pairs = self._pairs()
        path: list[str] = []
        drawn = ""
        for length, one, other in sorted(pairs, key=itemgetter(0)):  # because there may be thousands
            if path and len(path) <= length:
                break
            _, links = self._linked(factors, [one, other])
            between = links.path(one, other)
            if between and (not path or len(between) < len(path)):
                path, drawn = between, links.drawn(between)
        ends = f"{path[0]} or {path[-1]}"
        way_out = f"search {path[1]} too, or leave {ends} out" if len(path) > 2 else f"leave {ends} out"
        names = ", ".join(each.name for each in self.searched)
        return NotFusionError(
            f"{path[0]} and {path[-1]} are not independent given {names}: {drawn} joins them",
            f"{way_out} of the known variables",
        )

    def _fusion(
        self, own: Mapping[str, Sequence[Term]], weight: NDArray[np.float64], sizes: Mapping[str, int]
    ) -> Model:
        """Return the model from the terms of each observed symbol and the weight of each line, float64[lines]."""
        searched = [symbol.name for symbol in self.searched]
        tables = {
            name: product(terms, (name, *searched), sizes).reshape(sizes[name], -1)
            for name, terms in own.items()
        }
        sums = {name: _sums(table) for name, table in tables.items()}
        prior = _scaled(weight)
        for total in sums.values():
            prior = _scaled(prior * total)
        if not prior.sum() > 0:
            raise ModelError(f"{self.joint.name}: the given values are impossible together")
        prior /= prior.sum()
        given_line = {name: _given_line(tables[name], sums[name], prior) for name in tables}
        normals = {symbol.name: self._normal(symbol) for symbol in self.known}
        return Model(
            name=self.joint.name,
            searched=tuple(each.dimension() for each in self.searched),
            known=tuple(
                Known(
                    table=given_line[symbol.name],
                    floor=0.0 if (normal := normals[symbol.name]) is None else normal.floor,
                    normal=normal,
                    **symbol.reading,
                )
                for symbol in self.known
            ),
            prior=prior,
            prior_select=None
            if (select := self.prior_select) is None
            else PriorSelect(table=_given_value(given_line[select.name] * prior, prior), **select.reading),
        )

    def _normal(self, symbol: Symbol) -> Normal | None:
        """Return the normals from which a known symbol's table was computed, if all its parents are searched."""
        for factor in self.joint.factors:
            if isinstance(factor, Distribution) and factor.symbol == symbol and factor.normal is not None:
                break
        else:
            return None
        if not set(factor.given) <= set(self.searched):
            return None
        names = [each.name for each in self.searched]
        sizes = {each.name: each.size for each in self.searched}
        scope = tuple(each.name for each in factor.given)
        shape = tuple(each.size for each in factor.given)
        mean, sigma = (
            product([Term(scope, np.asarray(values, dtype=np.float64).reshape(shape))], names, sizes).ravel()
            for values in (factor.normal.mean, factor.normal.sigma)
        )
        return Normal(mean=mean, sigma=sigma, floor=factor.normal.floor, outliers=factor.normal.outliers)


def _sums(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum of each line, float64[lines], set to exactly 1 if it differs from 1 only by rounding."""
    sums: NDArray[np.float64] = table.sum(axis=0)
    sums[np.abs(sums - 1) < _ROUNDING] = 1
    return sums


def _given_line(
    together: NDArray[np.float64], total: NDArray[np.float64], prior: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return P(K | S), float64[values, lines], from a table that is proportional to P(K | S) on each line.

    An impossible line gets P(K), which does not change the codes of other lines. If all lines sum to 1, the table is
    returned unchanged.
    """
    if np.all(total == 1):
        return together
    safe = np.where(total > 0, total, 1)
    table: NDArray[np.float64] = together / safe
    marginal = table @ np.where(total > 0, prior, 0)
    table = np.where(total > 0, table, (marginal / marginal.sum())[:, np.newaxis])
    normalised: NDArray[np.float64] = table / table.sum(axis=0)
    return normalised


def _given_value(together: NDArray[np.float64], prior: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return P(S | A) from P(A, S), float64[values, lines]; an impossible value selects the plain prior."""
    total = together.sum(axis=1, keepdims=True)
    rows = np.where(total > 0, together / np.where(total > 0, total, 1), prior)
    normalised: NDArray[np.float64] = rows / rows.sum(axis=1, keepdims=True)
    return normalised


def _scaled(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    largest = weights.max()
    scaled: NDArray[np.float64] = weights / largest if largest > 0 else weights
    return scaled
