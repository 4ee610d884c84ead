"""The network that a BM2 samples: the relevant factors of a question, over its searched, known and unknown symbols (thesis 2.1.3).

Known symbols remain variables, because a reading may be missing; given ones are fixed in the tables. Symbols that
sum to 1 in every answer are left out.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from toolchain.deployment import Dimension, Variable
from toolchain.errors import ModelError
from toolchain.models.distribution import Distribution, Factor, IntegerType, LabelType, Potential, Symbol
from toolchain.models.inference import Term, eliminate, product, reduced, relevant, without_idle
from toolchain.models.model import Model, dimension, first_mistake


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NetworkModel:
    """P(searched | known) as a product of factors, computed by a BM2."""

    name: str
    """Name of the deployment."""
    symbols: tuple[Symbol, ...]
    """The variables of the machine, in the order of the joint distribution."""
    factors: tuple[Term, ...]
    """The factors, one for each CDE; each scope is in the order of `symbols`."""
    titles: tuple[str, ...]
    """The name of each factor, such as P(A | B)."""
    variables: tuple[Variable, ...]
    """The known variables as in `deployment.toml`, in the order of a frame's readings."""
    dimensions: tuple[Dimension, ...]
    """The searched variables as in `deployment.toml`, the slowest first."""

    def __repr__(self) -> str:
        return f"NetworkModel({self.name!r}, {len(self.symbols)} variables, {len(self.factors)} factors)"

    @property
    def searched(self) -> tuple[str, ...]:
        """The names of the searched variables, the slowest first."""
        return tuple(each.label for each in self.dimensions)

    @property
    def known(self) -> tuple[str, ...]:
        """The names of the known variables."""
        return tuple(each.name for each in self.variables)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all variables, in the order of the machine."""
        return tuple(each.name for each in self.symbols)

    @property
    def cardinalities(self) -> tuple[int, ...]:
        """The number of values of each variable."""
        return tuple(each.size for each in self.symbols)

    @property
    def lines(self) -> int:
        """The number of probabilities of a posterior."""
        return math.prod(each.size for each in self.dimensions)

    def exact(self, addresses: Sequence[int | None]) -> NDArray[np.float64]:
        """Return the exact posterior of the searched variables together, float64[lines], the first one slowest.

        Args:
            addresses: One per known variable; None for a missing reading.

        Raises:
            ModelError: The readings have the probability 0, or inference needs a table above the limit.
        """
        return self._posterior(self.searched, self._evidence(addresses))

    def marginals(self, addresses: Sequence[int | None]) -> dict[str, NDArray[np.float64]]:
        """Return the exact posterior of each variable that has no reading, by name; errors as for `exact`."""
        evidence = self._evidence(addresses)
        return {name: self._posterior((name,), evidence) for name in self.names if name not in evidence}

    def _evidence(self, addresses: Sequence[int | None]) -> dict[str, int]:
        pairs = zip(self.known, addresses, strict=True)
        return {name: address for name, address in pairs if address is not None}

    def _posterior(self, asked: Sequence[str], evidence: Mapping[str, int]) -> NDArray[np.float64]:
        sizes = {each.name: each.size for each in self.symbols}
        terms = [reduced(term, evidence) for term in self.factors]
        left = eliminate(terms, [name for name in sizes if name not in evidence and name not in asked], sizes)
        weights = product(left, asked, sizes).ravel()
        if not weights.sum() > 0:
            raise ModelError(f"{self.name}: these readings are impossible together: there is no posterior")
        posterior: NDArray[np.float64] = weights / weights.sum()
        return posterior


def network_model(
    name: str,
    factors: Iterable[Factor],
    symbols: Iterable[Symbol],
    searched: Sequence[Symbol],
    known: Sequence[Symbol],
    given: Mapping[str, int],
) -> NetworkModel:
    """Return the network of a question; `symbols` are those of its joint distribution, in the machine's order.

    Raises:
        ModelError: A factor has a number that is negative, infinite or NaN, or is 0 for all values that remain.
    """
    symbols = list(symbols)
    asked = {each.name for each in (*searched, *known)}
    fixed = {each.name: 0 for each in symbols if each.size == 1 and each.name not in asked} | dict(given)
    terms: list[Term] = []
    titles: list[str] = []
    place = {each.name: at for at, each in enumerate(symbols)}
    for factor in factors:
        _check(factor)
    for factor in relevant(map(without_idle, factors), asked | set(given)):
        term = reduced(Term(tuple(each.name for each in factor.scope), factor.table), fixed)
        if not term.table.any():
            which = [f"{each.name} = {_shown(each, fixed)}" for each in factor.scope if each.name in fixed]
            raise ModelError(f"{name}: {_title(factor)} is 0 everywhere where {' and '.join(which)}")
        if term.table.size > 1:  # a constant changes nothing
            terms.append(_in_order(term, place))
            titles.append(_title(factor))
    held = asked.union(*(term.scope for term in terms))
    used = tuple(each for each in symbols if each.name in held)
    for each in used:  # all of its factors were constants
        if not any(each.name in term.scope for term in terms):
            terms.append(Term((each.name,), np.ones(each.size)))
            titles.append(f"uniform({each.name})")
    return NetworkModel(
        name=name,
        symbols=used,
        factors=tuple(terms),
        titles=tuple(titles),
        variables=tuple(_variable(each) for each in known),
        dimensions=tuple(
            dimension(
                each.name,
                size=each.size,
                offset=each.type.offset,
                step=each.type.step,
                unit=each.type.unit,
                states=each.type.labels,
            )
            for each in searched
        ),
    )


def network_of(model: Model) -> NetworkModel:
    """Return a naive fusion as a network: its prior is one factor of all searched variables, and so is each table.

    Raises:
        ModelError: A known variable has the name of a searched one, or selects the prior.
    """
    if model.prior_select is not None:
        raise ModelError(
            f"{model.name}: {model.prior_select.name} selects the prior, which only a BM1 has: build one with --machine bm1"
        )
    searched = [_plain_symbol(each.label, each.size, each.states) for each in model.searched]
    known = [_plain_symbol(each.name, each.values, each.states) for each in model.known]
    shared = {each.name for each in searched} & {each.name for each in known}
    if shared:
        raise ModelError(f"{model.name}: {min(shared)} is both a searched and a known variable; rename one")
    shape = tuple(each.size for each in searched)
    tables = [
        model.prior_distribution.reshape(shape),
        *(each.table.reshape(-1, *shape) for each in model.known),
    ]
    scopes = [tuple(searched), *((each, *searched) for each in known)]
    factors = [Potential(scope=scope, table=table) for scope, table in zip(scopes, tables, strict=True)]
    network = network_model(model.name, factors, [*searched, *known], searched, known, {})
    return replace(network, variables=model.variables, dimensions=model.searched)


def _plain_symbol(name: str, size: int, states: tuple[str, ...]) -> Symbol:
    return Symbol(name, LabelType(*states) if states else IntegerType(0, size - 1))


def _in_order(term: Term, place: Mapping[str, int]) -> Term:
    """Return a term with its axes in the order of the symbols."""
    order = sorted(range(len(term.scope)), key=lambda axis: place[term.scope[axis]])
    return Term(tuple(term.scope[axis] for axis in order), np.transpose(term.table, order))


def _title(factor: Factor) -> str:
    if isinstance(factor, Distribution):
        return factor.title
    return f"the potential of {', '.join(each.name for each in factor.scope)}"


def _check(factor: Factor) -> None:
    if not np.all(np.isfinite(factor.table)) or np.any(factor.table < 0):
        raise ModelError(f"{_title(factor)} holds a number that is negative, infinite or NaN")
    if not factor.table.any():
        raise ModelError(f"{_title(factor)} is 0 everywhere")


def _shown(symbol: Symbol, fixed: Mapping[str, int]) -> str:
    at = fixed[symbol.name]
    return symbol.type.labels[at] if symbol.type.labels else f"{symbol.values()[at]:g}"


def _variable(symbol: Symbol) -> Variable:
    """Return the conversion of a known symbol's readings to its values; one more address means a missing reading."""
    try:
        return Variable(
            name=symbol.name,
            path=symbol.path,
            bits=symbol.bits or symbol.size.bit_length(),
            offset=symbol.type.offset,
            step=symbol.type.step,
            period=symbol.period,
            values=symbol.size,
            on_range=symbol.on_range,
            on_missing=symbol.on_missing,
            states=symbol.type.labels,
        )
    except ValidationError as reason:
        raise ModelError(f"variable {symbol.name!r}: {first_mistake(reason)}") from None
