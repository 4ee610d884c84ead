"""Models, their limits, and exact fusion; symbols and their types."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.toolchain.builders import interval, normal, wrapped_normal
from tests.toolchain.running import OPTIONS, refused_within
from toolchain.building.machine import partition_lines, plan_machine
from toolchain.errors import BuildError, ModelError
from toolchain.models import (
    IntegerType,
    IntervalType,
    LabelType,
    Symbol,
    conditional_normal,
    potential,
    table,
)
from toolchain.models.joint import JointDistribution
from toolchain.models.model import Known, Model, PriorSelect, cell_centres, dimension, exact_posterior, fuse


def known(name="K", values=3, lines=4, **fields):
    return Known(name=name, table=np.full((values, lines), 1 / values), **fields)


def test_cells_are_row_major_with_the_first_dimension_slowest():
    y, x = interval("y", -1, 1, cells=2), dimension("x", size=3, offset=10, step=5)
    ys, xs = cell_centres(y, x)
    assert ys.tolist() == [-0.5, -0.5, -0.5, 0.5, 0.5, 0.5]
    assert xs.tolist() == [10, 15, 20, 10, 15, 20]
    assert [y.value(i) for i in (0, 1)] == [-0.5, 0.5]


def test_a_model_has_a_uniform_prior_and_as_few_bits_as_will_do():
    model = Model(name="m", searched=(dimension("s", size=4),), known=(known(), known("L", values=4)))
    assert model.prior_distribution.tolist() == [0.25] * 4
    assert [k.bits for k in model.known] == [2, 3]  # 4 values and the missing reading's address need 3 bits
    assert [k.as_variable().values for k in model.known] == [3, 4]


def test_a_model_searches_at_most_the_maximum_of_values(monkeypatch):
    monkeypatch.setattr("toolchain.models.model.MAX_LINES", 6)
    width = dimension("x", size=3)
    largest = Model(name="m", searched=(dimension("y", size=2), width), known=(known(lines=6),))
    assert largest.lines == 6
    with pytest.raises(ModelError):
        Model(name="m", searched=(width, dimension("y", size=3)), known=(known(lines=9),))


def test_tables_are_copies_that_cannot_be_written():
    table = np.full((2, 4), 0.5)
    one = Known(name="K", table=table)
    table[0, 0] = 7
    assert one.table[0, 0] == 0.5
    with pytest.raises(ValueError, match="read-only"):
        one.table[0, 0] = 1


def changed(at, to):
    table = np.full((2, 4), 0.5)
    table[at] = to
    return table


def model_with(**fields):
    return Model(**({"name": "m", "searched": (dimension("s", size=4),), "known": ()} | fields))


@pytest.mark.parametrize(
    "make",
    [
        lambda: known(lines=3),
        lambda: Known(name="K", table=np.ones(4)),
        lambda: Known(name="K", table=np.ones((0, 4))),
        lambda: Known(name="K", table=changed((1, 2), 0.4)),
        lambda: Known(name="K", table=changed((1, 2), np.nan)),
        lambda: Known(name="K", table=changed((slice(None), 1), [1.5, -0.5])),
        lambda: known(name="a\x1b[2J"),
        lambda: known(step=0.0),
        lambda: known(values=65536),
        lambda: known(values=5, bits=2),
        lambda: known(on_range="ignore"),
        lambda: model_with(known=(known(), known())),
        lambda: model_with(searched=(dimension("x", size=2), dimension("x", size=2))),
        lambda: model_with(searched=()),
        lambda: model_with(searched=(dimension("x", size=50_000), dimension("y", size=50_000))),
        lambda: model_with(name="a\nb"),
        lambda: model_with(name=3),
        lambda: model_with(prior=np.full(3, 1 / 3)),
        lambda: model_with(prior=np.full(4, 0.3)),
        lambda: dimension("", size=1),
    ],
)
def test_refused_parts_of_a_model(make):
    with pytest.raises(ModelError):
        model_with(known=(make(),))


AXIS = dimension("x", size=5000)


def view(*shape):
    """Return an array of this shape that takes no memory."""
    return np.broadcast_to(1 / shape[0], shape)


def model_of_views(lines, bits):
    known = Known(name="K", table=np.full((2, 1), 0.5), bits=bits)
    object.__setattr__(known, "table", view(2, lines))
    return Model(name="m", searched=(dimension("s", size=lines),), known=(known,), prior=view(lines))


def question(lines, *sizes):
    symbols = [Symbol(f"k{i}", IntegerType(1, size)) for i, size in enumerate(sizes)]
    searched = Symbol("s", IntegerType(1, lines))
    factors = [table(each, view(each.size)) for each in (searched, *symbols)]
    return JointDistribution("j", tuple(factors)).ask([searched], symbols)


@pytest.mark.parametrize(
    "too_large",
    [
        lambda: dimension("x", size=2**24 + 1),
        lambda: cell_centres(AXIS, AXIS),
        lambda: normal("K", mean=np.zeros(2), sigma=1, values=10**9),
        lambda: normal("K", mean=np.zeros(5000), sigma=1, values=2**16 - 1),
        lambda: wrapped_normal("K", mean=np.zeros(2), sigma=1, values=10**9),
        lambda: Known(name="K", table=view(2, 10**9)),
        lambda: PriorSelect(name="K", table=view(10**9, 2)),
        lambda: Model(name="m", searched=(dimension("s", size=4),), known=(), prior=view(10**9)),
        lambda: Symbol("n", IntegerType(0, 10**9)),
        lambda: Symbol("n", IntervalType(0.0, 1.0, 10**9)),
        lambda: conditional_normal(
            Symbol("n", IntegerType(0, 9999)), [Symbol("m", IntegerType(0, 9999))], mean=0, sigma=1
        ),
    ],
)
def test_a_model_part_above_its_limit_is_refused_unmade(too_large):
    with refused_within(4 << 20, ModelError):
        too_large()


def searched_together(count):
    """A question for symbols of 16 values each that are joined by one that is summed over."""
    hidden = Symbol("h", IntegerType(0, 1))
    symbols = [Symbol(f"s{at}", IntegerType(0, 15)) for at in range(count)]
    joint = JointDistribution("many", tuple(potential([each, hidden], np.ones((16, 2))) for each in symbols))
    return joint.ask(symbols[:4] if count == 5 else symbols, symbols[4:] if count == 5 else ())


@pytest.mark.parametrize(
    "too_large", [question(1501, *[10_000] * 20), question(5000, 2, 10_000), searched_together(7)]
)
def test_a_question_with_tables_that_are_too_large_is_refused_unmade(too_large):
    with refused_within(64 << 20, ModelError):
        too_large.model()


def test_codes_that_no_memory_holds_are_refused_before_they_are_made():
    assert plan_machine(model_of_views(2**14, 16), OPTIONS).parameters.lines == 2**14
    with pytest.raises(BuildError):
        plan_machine(model_of_views(2**14 + 1, 16), OPTIONS)


def test_a_board_for_every_line_takes_linear_time():
    assert partition_lines(2**18, 2**18)[-1].end == 2**18


def random_model(seed, lines=5, sensors=3, values=4):
    random = np.random.default_rng(seed)
    return Model(
        name="random",
        searched=(dimension("s", size=lines),),
        known=tuple(
            Known(name=f"K{i}", table=random.dirichlet(np.ones(values), size=lines).T) for i in range(sensors)
        ),
        prior=random.dirichlet(np.ones(lines)),
    )


@given(st.integers(0, 2**32 - 1), st.lists(st.none() | st.integers(0, 3), min_size=3, max_size=3))
def test_the_product_normalised_and_missing_readings_left_out(seed, addresses):
    model = random_model(seed)
    product = model.prior_distribution.copy()
    for known, address in zip(model.known, addresses, strict=True):
        if address is not None:
            product *= known.table[address]
    assert exact_posterior(model, addresses) == pytest.approx(product / product.sum(), rel=1e-9)


def test_it_does_not_underflow():
    factors = [np.array([1e-300, 2e-300])] * 40
    assert fuse(np.array([0.5, 0.5]), factors) == pytest.approx([1 / (1 + 2.0**40), 1 / (1 + 2.0**-40)])


def test_refused_readings():
    model = random_model(1)
    with pytest.raises(ModelError, match="2 readings for the 3 known variables"):
        exact_posterior(model, [0, 1])
    with pytest.raises(ModelError, match="K1: address 4 is not one of its 4"):
        exact_posterior(model, [0, 4, 0])
    with pytest.raises(ModelError, match="impossible on every line"):
        fuse(np.array([1.0, 0.0]), [np.array([0.0, 1.0])])


def numbers(type_):
    return Symbol("s", type_).values().tolist()


@pytest.mark.parametrize(
    ("type_", "expected"),
    [
        (IntegerType(-1, 2), [-1, 0, 1, 2]),
        (IntegerType(-1, 2, scale=0.05), [-0.05, 0, 0.05, 0.1]),
        (IntervalType(0, 10, 4), [1.25, 3.75, 6.25, 8.75]),
        (LabelType("low", "middle", "high"), [0, 1, 2]),
        (LabelType("10", "20", "30"), [10, 20, 30]),
        (LabelType("2", "1", "0"), [2, 1, 0]),
        (LabelType("0.5", "1", "1.5"), [0.5, 1, 1.5]),
        (LabelType("1", "2", "4"), [0, 1, 2]),
        (LabelType("7"), [0]),
        (LabelType("<5", "5-12", "12+"), [0, 1, 2]),
        (LabelType("yes", "no"), [1, 0]),
        (LabelType("No", "Yes"), [0, 1]),
        (LabelType("True", "False"), [1, 0]),
        (LabelType("off", "on"), [0, 1]),
        (LabelType("yes", "no", "maybe"), [0, 1, 2]),
        (LabelType("1_0", "2_0"), [0, 1]),
    ],
)
def test_values_of_symbols(type_, expected):
    assert numbers(type_) == pytest.approx(expected)
    assert Symbol("s", type_).size == len(expected)


def test_a_circle_has_a_period():
    assert Symbol("b", IntervalType(0, 360, 36, wraps=True)).period == 36
    assert Symbol("b", IntegerType(0, 359, wraps=True)).period == 360
    assert Symbol("d", IntegerType(0, 100)).period is None


@given(st.integers(-50, 50), st.integers(0, 30), st.integers(-100, 100))
def test_a_number_is_its_value_or_refused(low, more, number):
    symbol = Symbol("n", IntegerType(low, low + more))
    if low <= number <= low + more:
        assert symbol.index(str(number)) == number - low
    else:
        with pytest.raises(ModelError, match=f"n is never '{number}'; expected {low} to {low + more}"):
            symbol.index(str(number))


def test_a_label_is_its_value_or_the_labels_are_listed():
    symbol = Symbol("smoke", LabelType("yes", "no"))
    assert [symbol.index(label) for label in ("yes", "no")] == [0, 1]
    with pytest.raises(ModelError, match="smoke is never 'maybe'; expected one of yes, no"):
        symbol.index("maybe")


@pytest.mark.parametrize(
    "make",
    [
        lambda: IntegerType(3, 2),
        lambda: IntegerType(0, 3.5),
        lambda: IntegerType(0, 3, scale=0.0),
        lambda: IntervalType(0, 1, 4.0),
        lambda: IntervalType(1, 1, 3),
        lambda: IntervalType(0, 1, 0),
        lambda: IntervalType(float("-inf"), 1, 2),
        LabelType,
        lambda: LabelType("a", "a"),
        lambda: LabelType("a", ""),
        lambda: Symbol("", IntegerType(0, 1)),
    ],
)
def test_refused_symbols(make):
    with pytest.raises(ModelError):
        make()
