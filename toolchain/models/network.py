"""The network that a BM2 samples: the relevant factors of a question and their symbols (thesis 2.1.3).

Known symbols remain variables, because a reading may be missing. Each given symbol is fixed at its value in the tables.
A symbol that is not searched, known or given is left out if only its own distribution contains it. The distribution
sums to 1, so the symbol cannot change the answer. The rule is applied until no such symbol is left.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolchain.deployment import Dimension, Variable
from toolchain.errors import ModelError
from toolchain.models.distribution import Factor, IntegerType, LabelType, Potential, Symbol
from toolchain.models.inference import Term, eliminate, product, reduced, relevant, without_idle
from toolchain.models.model import Model, checked_variable


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NetworkModel:
    """P(searched | known) as a product of factors, computed by a BM2."""

    name: str
    """Name of the deployment."""
    symbols: tuple[Symbol, ...]
    """The variables of the machine, in the order of the joint distribution."""
    factors: tuple[Term, ...]
    """The factors, each for one conditional distribution encoder (CDE) of the machine. The names in a factor's scope
    are in the order of `symbols`.
    """
    titles: tuple[str, ...]
    """The name of each factor, such as P(A | B)."""
    variables: tuple[Variable, ...]
    """The known variables as in `deployment.toml`, in the order of a frame's readings."""
    searched: tuple[Dimension, ...]
    """The searched variables as in `deployment.toml`. The first varies slowest in a posterior."""

    def __repr__(self) -> str:
        return f"NetworkModel({self.name!r}, {len(self.symbols)} variables, {len(self.factors)} factors)"

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
        """The number of probabilities in a posterior, one for each combination of searched values."""
        return math.prod(each.size for each in self.searched)

    def exact(self, addresses: Sequence[int | None]) -> NDArray[np.float64]:
        """Return the exact joint posterior of the searched variables, float64[lines].

        The first variable varies slowest. `addresses` has an address for each known variable, or None for a missing
        reading. Raises a ModelError if the readings have the probability 0, or if a table would exceed the limit.
        """
        asked = [each.label for each in self.searched]
        sizes = dict(zip(self.names, self.cardinalities, strict=True))
        pairs = zip(self.known, addresses, strict=True)
        evidence = {name: address for name, address in pairs if address is not None}
        terms = [reduced(term, evidence) for term in self.factors]
        left = eliminate(terms, sizes.keys() - evidence.keys() - set(asked), sizes)
        weights = product(left, asked, sizes).ravel()
        if not weights.sum() > 0:
            raise ModelError(f"{self.name}: these readings are impossible together: there is no posterior")
        posterior: NDArray[np.float64] = weights / weights.sum()
        return posterior


def network_model(
    name: str,
    factors: Sequence[Factor],
    symbols: Sequence[Symbol],
    searched: Sequence[Symbol],
    known: Sequence[Symbol],
    given: Mapping[str, int],
) -> NetworkModel:
    """Return the network of P(searched | known), with the variables in `given` fixed at their values.

    `symbols` are all variables of the joint distribution. The network has only the variables that the question needs,
    in the order of `symbols`.

    Raises:
        ModelError: A factor contains a number that is negative, infinite or NaN, or contains only zeros for the
            values in `given`.
    """
    for factor in factors:
        if not np.all(np.isfinite(factor.table)) or np.any(factor.table < 0):
            raise ModelError(f"{factor.title} holds a number that is negative, infinite or NaN")
        if not factor.table.any():
            raise ModelError(f"{factor.title} is 0 everywhere")
    asked = {each.name for each in (*searched, *known)}
    fixed = {each.name: 0 for each in symbols if each.size == 1 and each.name not in asked} | dict(given)
    place = {each.name: at for at, each in enumerate(symbols)}
    terms: list[Term] = []
    titles: list[str] = []
    for factor in relevant(map(without_idle, factors), asked | set(given)):
        term = reduced(Term.of(factor), fixed)
        if not term.table.any():
            which = [
                f"{each.name} = {each.shown(fixed[each.name])}" for each in factor.scope if each.name in fixed
            ]
            raise ModelError(f"{name}: {factor.title} is 0 everywhere where {' and '.join(which)}")
        if term.table.size > 1:  # a constant changes nothing
            order = sorted(range(len(term.scope)), key=lambda axis: place[term.scope[axis]])
            terms.append(Term(tuple(term.scope[axis] for axis in order), np.transpose(term.table, order)))
            titles.append(factor.title)
    held = {each for term in terms for each in term.scope}
    for each in symbols:
        if each.name in asked - held:  # all of its factors were constants
            terms.append(Term((each.name,), np.ones(each.size)))
            titles.append(f"uniform({each.name})")
    return NetworkModel(
        name=name,
        symbols=tuple(each for each in symbols if each.name in held | asked),
        factors=tuple(terms),
        titles=tuple(titles),
        variables=tuple(
            checked_variable(**each.reading | {"bits": each.bits or each.size.bit_length()}, values=each.size)
            for each in known
        ),
        searched=tuple(each.dimension() for each in searched),
    )


def network_of(model: Model) -> NetworkModel:
    """Return a naive fusion as a network, or raise a ModelError. Each table depends on all searched variables."""
    if model.prior_select is not None:
        raise ModelError(
            f"{model.name}: {model.prior_select.name} selects the prior, which only a BM1 has: build one with "
            "--machine bm1"
        )
    searched = [_plain_symbol(each.label, each.size, each.states) for each in model.searched]
    known = [_plain_symbol(each.name, each.values, each.states) for each in model.known]
    shared = {each.name for each in searched} & {each.name for each in known}
    if shared:
        raise ModelError(f"{model.name}: {min(shared)} is both a searched and a known variable; rename one")
    shape = tuple(each.size for each in searched)
    factors = [
        Potential(scope=tuple(searched), table=model.prior_distribution.reshape(shape)),
        *(
            Potential(scope=(symbol, *searched), table=each.table.reshape(-1, *shape))
            for symbol, each in zip(known, model.known, strict=True)
        ),
    ]
    network = network_model(model.name, factors, [*searched, *known], searched, known, {})
    return replace(network, variables=model.variables, searched=model.searched)


def _plain_symbol(name: str, size: int, states: tuple[str, ...]) -> Symbol:
    return Symbol(name, LabelType(*states) if states else IntegerType(0, size - 1))
