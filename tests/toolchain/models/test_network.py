"""The network of a question for a BM2: its factors, variables and exact posterior, and the refused questions."""

import math

import numpy as np
import pytest

from tests.toolchain.builders import corridor
from toolchain.errors import ModelError, NotFusionError
from toolchain.models import JointDistribution, LabelType, Symbol, exact_posterior, potential, table, uniform
from toolchain.models.distribution import Potential
from toolchain.models.network import network_of
from toolchain.networks import read_network

RNG = np.random.default_rng(5)


def symbols(*sizes):
    return [Symbol(name, LabelType(*"klmnopqrs"[:size])) for name, size in zip("ABCDEF", sizes, strict=False)]


def some_table(symbol, *given):
    weights = RNG.random((symbol.size, *(each.size for each in given))) + 0.05
    return table(symbol, weights / weights.sum(axis=0), given=given)


def joint_table(joint):
    """The whole joint distribution, one axis per symbol in their order."""
    names = [each.name for each in joint.symbols]
    whole = np.ones([each.size for each in joint.symbols])
    for factor in joint.factors:
        axes = [names.index(each.name) for each in factor.scope]
        shape = [size if at in axes else 1 for at, size in enumerate(whole.shape)]
        whole *= np.transpose(factor.table, np.argsort(axes)).reshape(shape)
    return names, whole


def posterior_of(joint, searched, evidence):
    names, whole = joint_table(joint)
    part = whole[tuple(evidence.get(name, slice(None)) for name in names)]
    left = [name for name in names if name not in evidence]
    part = part.sum(axis=tuple(at for at, name in enumerate(left) if name not in searched))
    kept = [name for name in left if name in searched]
    part = np.transpose(part, [kept.index(name) for name in searched]).ravel()
    return part / part.sum()


def test_the_posterior_of_a_network_is_that_of_the_whole_joint_distribution():
    a, b, c, d, e, f = symbols(2, 3, 4, 2, 3, 2)
    factors = (some_table(a), some_table(b, a), some_table(d, c, b), some_table(c, a), some_table(e, d))
    joint = JointDistribution("six", (*factors, some_table(f, e, c), potential([b, e], RNG.random((3, 3)))))
    network = joint.ask(["E", "B"], ["C", "F"], given={"D": "l"}).network()
    assert network.names == ("A", "B", "C", "E", "F")
    for scope in (term.scope for term in network.factors):
        assert list(scope) == sorted(scope)
    assert [each.label for each in network.searched] == ["E", "B"]
    assert network.known == ("C", "F")
    for addresses in ((1, 0), (None, 1), (3, None), (None, None)):
        evidence = {"D": 1} | {n: v for n, v in zip(("C", "F"), addresses, strict=True) if v is not None}
        assert network.exact(addresses) == pytest.approx(posterior_of(joint, ["E", "B"], evidence))


def test_only_what_matters_to_the_question_is_sampled():
    a, b, c, d, one, g = [
        *symbols(2, 2, 2, 2),
        Symbol("one", LabelType("x")),
        Symbol("G", LabelType("k", "l")),
    ]
    idle = table(b, [[0.3, 0.3], [0.7, 0.7]], given=[a])  # B does not depend on A
    factors = (some_table(a), idle, some_table(c, b, one), uniform(one), some_table(d, a), some_table(g, b))
    network = JointDistribution("n", factors).ask(["B"], ["C"]).network()
    assert (network.names, network.cardinalities) == (("B", "C"), (2, 2))
    assert network.titles == ("P(B)", "P(C | B)")
    assert [term.table.shape for term in network.factors] == [(2,), (2, 2)]
    assert math.isclose(network.exact([0]).sum(), 1)


def test_a_searched_variable_of_constant_factors_is_uniform():
    a, b, one = [*symbols(2, 3), Symbol("one", LabelType("x"))]
    joint = JointDistribution("n", (uniform(one), some_table(a), potential([a, b], np.ones((2, 3)))))
    network = joint.ask(["B", "one"], ["A"]).network()
    assert network.names == ("one", "A", "B")
    assert network.exact([1]) == pytest.approx([1 / 3] * 3)
    assert network.titles == (
        "P(A)",
        "the potential of A",
        "uniform(one)",
        "uniform(B)",
    )  # every variable is in a factor


def test_a_naive_fusion_is_a_network_too():
    model = corridor(6)
    network = network_of(model)
    assert network.names == ("x", "range", "loud")
    assert network.searched == model.searched
    for addresses in ((3, 0), (20, 1), (None, 1)):
        assert network.exact(addresses) == pytest.approx(exact_posterior(model, addresses), abs=1e-12)
    with pytest.raises(ModelError, match="door selects the prior, which only a BM1 has"):
        network_of(corridor(6, select=True))


def test_the_refusal_of_a_bm1_has_a_type_of_its_own(network):
    question = read_network(network).ask(["rain"], ["sprinkler", "grass"])
    with pytest.raises(NotFusionError, match="joins them"):
        question.model()
    assert question.network().names == ("rain", "sprinkler", "grass")


@pytest.mark.parametrize(
    ("numbers", "given", "words"),
    [
        ([[-1, 1], [1, 1]], {}, "the potential of A, B holds a number that is negative"),
        ([[1, np.nan], [1, 1]], {}, "the potential of A, B holds a number that is negative, infinite or NaN"),
        ([[1, np.inf], [1, 1]], {}, "the potential of A, B holds a number"),
        ([[0, 0], [0, 0]], {}, "the potential of A, B is 0 everywhere$"),
        ([[0, 1], [0, 1]], {"B": "k"}, "n: the potential of A, B is 0 everywhere where B = k"),
    ],
)
def test_a_factor_without_probabilities_is_refused_by_its_name(numbers, given, words):
    a, b = symbols(2, 2)
    factor = Potential(scope=(a, b), table=np.array(numbers, dtype=float))
    with pytest.raises(ModelError, match=words):
        JointDistribution("n", (factor,)).ask(["A"], given=given).network()


def test_a_wrong_name_or_state_is_answered_with_the_nearest(network):
    joint = read_network(network)
    with pytest.raises(ModelError, match="garden has no variable 'rian'; did you mean 'rain'?"):
        joint.ask(["rian"])
    with pytest.raises(ModelError, match="grass is never 'wett'; did you mean 'wet'?"):
        joint.ask(["rain"], given={"grass": "wett"})
    impossible = joint.ask(["rain"], ["grass"], given={"sprinkler": "off"}).network()
    assert impossible.exact([0]) == pytest.approx([1, 0])  # dry rain: no sprinkler, no rain, no wet grass
