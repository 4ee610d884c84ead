"""Types and symbols: the number of each value, and refused values."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolchain.errors import ModelError
from toolchain.models.symbol import IntegerType, IntervalType, LabelType, Symbol


def numbers(type_):
    return Symbol("s", type_).values().tolist()


@pytest.mark.parametrize(
    ("type_", "expected"),
    [
        (IntegerType(-1, 2), [-1, 0, 1, 2]),
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
def test_values(type_, expected):
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
    with pytest.raises(ModelError, match="smoke is never 'maybe'; expected yes, no"):
        symbol.index("maybe")


@pytest.mark.parametrize(
    "make",
    [
        lambda: IntegerType(3, 2),
        lambda: IntegerType(0, 3.5),
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
def test_refusals(make):
    with pytest.raises(ModelError):
        make()
