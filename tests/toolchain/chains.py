"""Networks and their BM2s, for the tests of exact chains and of the findings about them."""

import numpy as np

from machines.bm2 import BM2Machine, BM2Parameters
from toolchain.models import JointDistribution, LabelType, Symbol, potential, table

SPRINKLER = [[[1.0, 0.2], [0.1, 0.01]], [[0.0, 0.8], [0.9, 0.99]]]
"""P(grass | sprinkler, rain), by grass, sprinkler, rain; 0 is no."""


def sprinkler(searched=("rain",), known=("grass",)):
    """The sprinkler of the thesis (2.1.3.1)."""
    rain, on, grass = (Symbol(name, LabelType("no", "yes")) for name in ("rain", "sprinkler", "grass"))
    factors = (
        table(rain, [0.8, 0.2]),
        table(on, [[0.6, 0.99], [0.4, 0.01]], given=[rain]),
        table(grass, SPRINKLER, given=[on, rain]),
    )
    return JointDistribution("sprinkler", factors).ask(searched, known).network()


def network(tables, *, searched=("A",), known=(), on_missing="error"):
    """A network of potentials by their scopes, such as {"AB": [[1, 2], [3, 4]]}, with the variables in their order."""
    arrays = {scope: np.asarray(each, dtype=float) for scope, each in tables.items()}
    sizes = {
        name: size for scope, each in arrays.items() for name, size in zip(scope, each.shape, strict=True)
    }
    of = {
        name: Symbol(name, LabelType(*(f"{name.lower()}{at}" for at in range(size))), on_missing=on_missing)
        for name, size in sizes.items()
    }
    factors = [potential([of[name] for name in scope], each) for scope, each in arrays.items()]
    return JointDistribution("net", factors).ask(searched, known).network()


def machine_of(model, **parameters):
    """The BM2 of a network."""
    places = {name: at for at, name in enumerate(model.names)}
    return BM2Machine.from_factors(
        BM2Parameters(
            cardinalities=model.cardinalities,
            factors=tuple(tuple(places[name] for name in term.scope) for term in model.factors),
            searched=tuple(places[each.label] for each in model.searched),
            known=tuple(places[name] for name in model.known),
            **parameters,
        ),
        [term.table for term in model.factors],
    )
