"""Joint distributions: questions are exact or refused for a reason, and sums are planned."""

import itertools
import re

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.toolchain.builders import interval, normal, wrapped_normal
from toolchain.errors import ModelError
from toolchain.models import inference
from toolchain.models.distribution import (
    IntegerType,
    IntervalType,
    LabelType,
    Symbol,
    conditional_normal,
    potential,
    table,
    uniform,
)
from toolchain.models.inference import Term, eliminate, product
from toolchain.models.joint import JointDistribution, Question
from toolchain.models.model import cell_centres, exact_posterior

YES_NO = LabelType("no", "yes")
R, S, G = (Symbol(name, YES_NO) for name in ("R", "S", "G"))
SPRINKLER = JointDistribution(
    "sprinkler",
    (
        table(R, [0.8, 0.2]),
        table(S, [[0.6, 0.99], [0.4, 0.01]], given=[R]),
        table(G, [[[1, 0.2], [0.1, 0.01]], [[0, 0.8], [0.9, 0.99]]], given=[S, R]),
    ),
)


def full_table(joint):
    """The whole joint distribution, and its axes' names."""
    names = [symbol.name for symbol in joint.symbols]
    letters = dict(zip(names, itertools.count(), strict=False))
    operands = []
    for factor in joint.factors:
        operands += [factor.table, [letters[symbol.name] for symbol in factor.scope]]
    return np.einsum(*operands, list(letters.values())), names


def marginal(joint, names, fixed):
    """The whole table summed over all axes but the named ones, in their order, where some variables are fixed."""
    whole, axes = full_table(joint)
    at = [slice(None)] * len(axes)
    for name, value in fixed:
        at[axes.index(name)] = slice(value, value + 1)
    order = [axes.index(name) for name in names]
    return np.einsum(whole[tuple(at)], list(range(len(axes))), order)


def enumerated(joint, searched, known, values, fixed=()):
    """P(searched | known = values) by summing the whole table."""
    left = marginal(joint, searched, [*zip(known, values, strict=True), *fixed])
    return (left / left.sum()).ravel()


def test_the_sprinkler_of_the_thesis_and_how_a_notebook_shows_it():
    asked = SPRINKLER.ask(["R"], ["G"])
    model = asked.model()
    assert exact_posterior(model, [1])[1] == pytest.approx(0.16038 / 0.44838)
    assert model.known[0].states == model.searched[0].states == ("no", "yes")
    factors = "Distribution(P(R), 2), Distribution(P(S | R), 2 x 2), Distribution(P(G | S, R), 2 x 2 x 2)"
    assert repr(SPRINKLER) == f"JointDistribution(name='sprinkler', factors=({factors}))"
    assert repr(potential([R, S], [[1, 2], [3, 4]])) == "Potential(R, S, 2 x 2)"
    given_too = SPRINKLER.ask(searched=[R], known=[G], given={"S": "yes"})
    assert repr(given_too) == "Question('sprinkler', P(R | G, S=1))"


def random_network(seed, size):
    random = np.random.default_rng(seed)
    symbols = [Symbol(f"v{at}", IntegerType(0, int(random.integers(1, 4)) - (at == 0))) for at in range(size)]
    factors = []
    for at, symbol in enumerate(symbols):
        parents = [symbols[k] for k in range(at) if random.random() < 0.4]
        shape = (symbol.size, *(parent.size for parent in parents))
        weights = random.gamma(0.7, size=shape) + 1e-3
        factors.append(table(symbol, weights / weights.sum(axis=0), given=parents))
    random.shuffle(factors)
    return JointDistribution("random", tuple(factors)), random


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32), st.integers(2, 7), st.integers(1, 2), st.integers(1, 3), st.integers(0, 1))
def test_a_question_is_exact_or_refused_for_a_reason(seed, size, searching, knowing, giving):
    assume(searching + knowing + giving <= size)
    joint, random = random_network(seed, size)
    names = random.permutation([symbol.name for symbol in joint.symbols]).tolist()
    searched, known = names[:searching], names[searching : searching + knowing]
    fixed = [(name, 0) for name in names[searching + knowing :][:giving]]
    given_ = {name: str(int(joint.symbol(name).values()[value])) for name, value in fixed}
    try:
        model = joint.ask(searched, known, given=given_).model()
    except ModelError as error:
        match = re.match(r"(\w+) and (\w+) are not independent given", str(error))
        assert dependence(joint, searched, [match[1], match[2]], fixed) > 1e-13
        return
    sizes = [joint.symbol(name).size for name in known]
    for values in itertools.product(*map(range, sizes)):
        expected = enumerated(joint, searched, known, values, fixed)
        assert exact_posterior(model, values) == pytest.approx(expected, abs=1e-12)
    partly = [None] + [0] * (len(known) - 1)  # a missing reading is summed over, too
    expected = enumerated(joint, searched, known[1:], partly[1:], fixed)
    assert exact_posterior(model, partly) == pytest.approx(expected, abs=1e-12)


def dependence(joint, searched, pair, fixed):
    left = marginal(joint, [*pair, *searched], fixed)
    left = left.reshape(*left.shape[:2], -1)
    left /= left.sum(axis=(0, 1))
    product = left.sum(axis=1, keepdims=True) * left.sum(axis=0, keepdims=True)
    return np.abs(left - product).max()


def chain(*names, arrows):
    """A network along a line: `>` has the left one as the parent of the right one."""
    symbols = [Symbol(name, YES_NO) for name in names]
    parents = {name: [] for name in names}
    for (left, right), arrow in zip(itertools.pairwise(symbols), arrows, strict=True):
        (parents[right.name] if arrow == ">" else parents[left.name]).append(left if arrow == ">" else right)
    random = np.random.default_rng(5)
    factors = []
    for symbol in symbols:
        above = parents[symbol.name]
        weights = random.random((2, *(2 for _ in above))) + 0.1
        factors.append(table(symbol, weights / weights.sum(axis=0), given=above))
    return JointDistribution("chain", tuple(factors))


def long_chain(length):
    """Return v0 -> v1 -> v2 and so on."""
    return chain(*(f"v{number}" for number in range(length)), arrows=">" * (length - 1))


@pytest.mark.parametrize(
    ("joint", "searched", "known", "path"),
    [
        (SPRINKLER, ["G"], ["R", "S"], "R -> S joins them; leave R or S out"),
        (chain("k", "h", "l", "s", arrows="<>>"), ["s"], ["k", "l"], "k <- h -> l joins them; search h too"),
        (chain("k", "s", "l", arrows="><"), ["s"], ["k", "l"], "k -> s <- l joins them"),
        (long_chain(40), ["v0"], ["v1", "v39"], "v1 -> v2 -> v3 -> v4 -> v5 ... v35 -> v36 -> v37"),
    ],
)
def test_refusals_draw_the_path(joint, searched, known, path):
    with pytest.raises(ModelError, match=re.escape(path)):
        joint.ask(searched, known).model()


def test_a_refusal_looks_only_at_pairs_that_could_have_the_shortest_path(monkeypatch):
    looked_at = []
    whole = Question._linked

    def counted(self, active, observed):
        looked_at.append(tuple(observed))
        return whole(self, active, observed)

    monkeypatch.setattr(Question, "_linked", counted)
    with pytest.raises(ModelError, match="v50 and v51 are not independent"):
        long_chain(200).ask(["v0"], [f"v{number}" for number in (*range(10, 200, 4), 51)]).model()
    assert len(looked_at) < 5, looked_at


def test_a_long_chain_is_summed_over():
    joint = long_chain(3000)
    far = joint.ask(["v0"], ["v2999"]).model().known[0].table
    assert far[:, 0] == pytest.approx(far[:, 1])
    near = joint.ask(["v0"], ["v2"]).model().known[0].table
    assert near == pytest.approx(joint.factors[2].table @ joint.factors[1].table)


def test_an_arc_that_changes_nothing_joins_nothing():
    k, s, m = (Symbol(name, YES_NO) for name in "ksm")
    idle = table(m, np.array([[[0.3, 0.6]] * 2, [[0.7, 0.4]] * 2]), given=[k, s])
    joint = JointDistribution(
        "idle", (table(s, [0.4, 0.6]), table(k, [[0.2, 0.9], [0.8, 0.1]], given=[s]), idle)
    )
    model = joint.ask(["s"], ["k", "m"]).model()
    assert exact_posterior(model, [1, 0]) == pytest.approx(enumerated(joint, ["s"], ["k", "m"], [1, 0]))


def test_a_markov_network():
    random = np.random.default_rng(3)
    a, b, c, d = (Symbol(name, IntegerType(0, 2)) for name in "abcd")
    factors = tuple(potential(pair, random.random((3, 3))) for pair in ([a, b], [c, a], [c, d]))
    joint = JointDistribution("markov", factors)
    model = joint.ask(["a"], ["b", "d"]).model()
    assert exact_posterior(model, [2, 1]) == pytest.approx(enumerated(joint, ["a"], ["b", "d"], [2, 1]))
    with pytest.raises(ModelError, match="b -- a -- c joins them; search a too"):
        joint.ask(["d"], ["b", "c"]).model()


def test_a_line_that_is_impossible_changes_no_code():
    s, k = Symbol("s", IntegerType(0, 2)), Symbol("k", YES_NO)
    joint = JointDistribution(
        "impossible", (table(s, [0.5, 0.5, 0]), table(k, [[0.9, 0.8, 0.0], [0.1, 0.2, 1.0]], given=[s]))
    )
    model = joint.ask(["s"], ["k"]).model()
    assert model.prior_distribution.tolist() == [0.5, 0.5, 0]
    assert exact_posterior(model, [1]) == pytest.approx([1 / 3, 2 / 3, 0])


COIN = [[0.5, 0.5], [0.5, 0.5]]
CYCLE = [table(a, COIN, given=[b]) for a, b in ((R, S), (S, G), (G, R))]
NEVER = (uniform(S), table(R, [[1, 1], [0, 0]], given=[S]))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: SPRINKLER.ask([], ["G"]), "sprinkler"),
        (lambda: SPRINKLER.ask(["R"], ["R"]), "R is "),
        (lambda: SPRINKLER.ask(["R"], ["G"], given={"G": "yes"}), "G is "),
        (lambda: SPRINKLER.ask(["R"], ["G"], prior_select="G"), "G is "),
        (lambda: SPRINKLER.ask(["rain"], ["G"]), "'rain'; .*R, S, G"),
        (lambda: SPRINKLER.ask(["R"], given={"S": "maybe"}), "S .*'maybe'; .*no, yes"),
        (lambda: JointDistribution("j", (table(S, COIN, given=[R]),)), r"uniform\(R\)"),
        (lambda: JointDistribution("j", (uniform(R), uniform(R))), "j: R "),
        (lambda: JointDistribution("j", (uniform(R), uniform(Symbol("R", IntegerType(0, 1))))), "j: .*'R'"),
        (lambda: JointDistribution("j", tuple(CYCLE)), "j: .* -> "),
        (lambda: JointDistribution("j", NEVER).ask(["S"], given={"R": "yes"}).model(), "j: "),
    ],
)
def test_refused_joints_and_questions(make, sentence):
    with pytest.raises(ModelError, match=sentence):
        make()


def test_a_known_variable_has_the_rule_and_the_normal_of_its_symbol():
    x = Symbol("x", IntervalType(0, 8, 8))
    distance = Symbol(
        "D", IntegerType(0, 100, unit="m"), bits=7, on_range="clamp", on_missing="missing", path="d"
    )
    bearing = Symbol("B", IntegerType(0, 359, wraps=True, unit="deg"), bits=9)
    factors = (
        uniform(x),
        conditional_normal(distance, [x], mean=lambda x: 10 * x, sigma=2.0),
        conditional_normal(bearing, [x], mean=lambda x: 40 * x, sigma=9.0),
    )
    asked = JointDistribution("j", factors).ask(["x"], ["D", "B"]).model()
    searched = interval("x", 0, 8, cells=8)
    (centres,) = cell_centres(searched)
    expected = (
        normal(
            "D", mean=10 * centres, sigma=2.0, values=101, unit="m", bits=7, on_missing="missing", path="d"
        ),
        wrapped_normal("B", mean=40 * centres, sigma=9.0, values=360, unit="deg", bits=9),
    )
    assert asked.searched == (searched,)
    for ours, theirs in zip(asked.known, expected, strict=True):
        assert ours.as_variable() == theirs.as_variable()
        assert ours.as_variable().unit
        assert np.array_equal(ours.table, theirs.table)
        assert np.array_equal(ours.normal.mean, theirs.normal.mean)


def random_terms(seed):
    """Terms of a random directed graph of 8 to 13 names, with sizes of 2 to 5."""
    random, numbers = np.random.default_rng(seed), np.random.default_rng((seed, 1))
    names = [f"v{at}" for at in range(random.integers(8, 14))]
    sizes = {name: int(random.integers(2, 6)) for name in names}
    terms = []
    for at, name in enumerate(names):
        count = min(at, int(random.integers(1, 3)))
        parents = [names[each] for each in random.choice(at, count, replace=False)] if count else []
        scope = (name, *parents)
        terms.append(Term(scope, numbers.random([sizes[each] for each in scope])))
    return terms, names, sizes


def summed(terms, names, sizes, kept):
    """The answer by inference, and by one sum over everything; both normalised."""
    left = eliminate(terms, [name for name in names if name not in kept], sizes)
    found = product(left, kept, sizes)
    letters = {name: chr(ord("a") + at) for at, name in enumerate(names)}
    scopes = ",".join("".join(letters[name] for name in term.scope) for term in terms)
    whole = np.einsum(
        f"{scopes}->{''.join(letters[name] for name in kept)}", *(term.table for term in terms), optimize=True
    )
    return found / found.sum(), whole / whole.sum()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_it_is_the_sum(seed, both_orders):
    terms, names, sizes = random_terms(seed)
    with pytest.MonkeyPatch.context() as patch:
        if both_orders:
            patch.setattr(inference, "_CHEAP", 0)
        found, whole = summed(terms, names, sizes, [names[0], names[-1]])
    assert found == pytest.approx(whole)


def test_min_fill_answers_what_smallest_tables_would_refuse(monkeypatch):
    terms, names, sizes = random_terms(2964)  # the largest tables have 1600 and 480 entries

    def answer(most, cheap):
        monkeypatch.setattr(inference, "MAX_ENTRIES", most)
        monkeypatch.setattr(inference, "_CHEAP", cheap)
        return summed(terms, names, sizes, [names[0], names[-1]])

    for most, cheap in ((1000, 10**9), (100, 0)):
        with pytest.raises(ModelError, match=r"summing over v\d+ needs a table of \d+ entries"):
            answer(most, cheap)
    found, whole = answer(1000, 100)
    assert found == pytest.approx(whole)


def test_a_name_with_thousands_of_neighbours():
    sizes = {f"leaf{at}": 2 for at in range(2000)} | {"hub": 2}
    terms = [Term((name, "hub"), np.ones((2, 2))) for name in sizes if name != "hub"]
    (left,) = eliminate(terms, sizes, sizes)
    assert left.table > 0
