"""Normals over bins and circles, and the distributions of symbols."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tests.toolchain.builders import normal, wrapped_normal
from toolchain.errors import ModelError
from toolchain.models.distribution import (
    MAX_ENTRIES,
    IntegerType,
    IntervalType,
    LabelType,
    Symbol,
    conditional_normal,
    function,
    potential,
    table,
    uniform,
)

MEANS = st.lists(st.floats(-200, 200), min_size=1, max_size=4).map(np.array)
SIGMAS = st.floats(0.05, 100)


def phi(z):
    return 0.5 * math.erfc(-z / math.sqrt(2))


@given(MEANS, SIGMAS, st.integers(1, 30), st.floats(-50, 50), st.floats(0.1, 10))
def test_a_normal_is_the_integral_over_each_bin_with_tails_at_the_ends(mean, sigma, values, offset, step):
    known = normal("D", mean=mean, sigma=sigma, values=values, offset=offset, step=step)
    for line, m in enumerate(mean):
        for k in range(values):
            low = -math.inf if k == 0 else offset + (k - 0.5) * step
            high = math.inf if k == values - 1 else offset + (k + 0.5) * step
            expected = phi((high - m) / sigma) - phi((low - m) / sigma)
            assert known.table[k, line] == pytest.approx(expected, abs=1e-12)
    assert known.table.sum(axis=0) == pytest.approx(1)


@given(MEANS, st.floats(0.05, 30), st.integers(1, 30), st.floats(-50, 50), st.floats(0.1, 3))
@example(np.array([1.0]), 0.125, 2, 0.0, 1.5)  # the wide bin opposite the mean has its mass on the near side
def test_a_wrapped_normal_is_the_sum_over_all_turns(mean, sigma, values, offset, step):
    known = wrapped_normal("B", mean=mean, sigma=sigma, values=values, offset=offset, step=step)
    turn = values * step
    reach = math.ceil((9 * sigma + 250 + turn) / turn)
    for line, m in enumerate(mean):
        for k in range(0, values, 5):
            expected = sum(
                phi((offset + (k + 0.5) * step - m + n * turn) / sigma)
                - phi((offset + (k - 0.5) * step - m + n * turn) / sigma)
                for n in range(-reach, reach + 1)
            )
            assert known.table[k, line] == pytest.approx(expected, abs=1e-9)
    assert known.period == values


def test_a_wide_bearing_is_uniform_and_takes_no_time():
    table = wrapped_normal("B", mean=np.zeros(2), sigma=1e12, values=36).table
    assert table == pytest.approx(np.full((36, 2), 1 / 36))


def test_tails_are_accurate_where_differences_of_phi_vanish():
    known = normal("D", mean=np.array([0.0, 40.0]), sigma=1.0, values=41)
    far = math.erfc(19.5 / math.sqrt(2)) / 2
    assert known.table[20, 0] == pytest.approx(far - math.erfc(20.5 / math.sqrt(2)) / 2, rel=1e-9)
    assert known.table[20, 1] == pytest.approx(known.table[20, 0], rel=1e-9)
    assert known.table[20, 0] < 1e-80


@pytest.mark.parametrize("distribution", [normal, wrapped_normal])
def test_a_floor_is_a_share_of_the_peak_and_stays_a_distribution(distribution):
    mean, sigma = np.array([20.0, 20.0]), np.array([2.0, 4.0])
    plain = distribution("K", mean=mean, sigma=sigma, values=41).table
    known = distribution("K", mean=mean, sigma=sigma, values=41, floor=0.05)
    assert known.floor == 0.05
    assert known.table.sum(axis=0) == pytest.approx(1)
    peak = plain[20]
    expected = (plain + 0.05 * peak) / (1 + 41 * 0.05 * peak)
    assert known.table == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("distribution", [normal, wrapped_normal])
@pytest.mark.parametrize(
    "fields",
    [
        {"sigma": 0.0},
        {"sigma": np.array([1.0, 2.0, 3.0])},
        {"sigma": math.nan},
        {"values": 0},
        {"step": -1.0},
        {"floor": -0.1},
        {"mean": np.array([0.0, math.inf])},
        {"mean": 3.0},
        {"bits": 3},
    ],
)
def test_refusals(distribution, fields):
    given = {"mean": np.zeros(2), "sigma": 1.0, "values": 10} | fields
    with pytest.raises(ModelError):
        distribution("D", **given)


A = Symbol("A", LabelType("no", "yes"))
B = Symbol("B", IntegerType(0, 2))
X = Symbol("x", IntervalType(0, 4, 4))


def test_a_table_keeps_its_numbers_and_cannot_be_written():
    given = table(A, [[0.1, 0.5, 1], [0.9, 0.5, 0]], given=[B])
    assert given.title == "P(A | B)"
    assert given.table[:, 2].tolist() == [1, 0]
    with pytest.raises(ValueError, match="read-only"):
        given.table[0, 0] = 1
    assert uniform(B).table.tolist() == pytest.approx([1 / 3] * 3)


def test_a_conditional_normal_is_the_normal_of_a_model():
    distance = Symbol("D", IntegerType(0, 9))
    made = conditional_normal(
        distance, (X, B), mean=lambda x, b: x + b, sigma=lambda x, b: 0.5 + x, floor=0.1
    )
    x, b = (grid.ravel() for grid in np.meshgrid(X.values(), B.values(), indexing="ij"))
    expected = normal("D", mean=x + b, sigma=0.5 + x, values=10, floor=0.1).table
    assert made.table.shape == (10, 4, 3)
    assert made.table.reshape(10, -1) == pytest.approx(expected)
    assert made.normal.mean == pytest.approx(x + b)
    assert conditional_normal(B, (), mean=1.0, sigma=0.1).table == pytest.approx([0, 1, 0], abs=1e-5)


def test_a_conditional_normal_on_a_circle_wraps():
    bearing = Symbol("B", IntervalType(-5, 355, 36, wraps=True))
    made = conditional_normal(bearing, [X], mean=lambda x: 90 * x, sigma=20, outliers=0.2)
    expected = wrapped_normal("B", mean=90 * X.values(), sigma=20, values=36, step=10, outliers=0.2).table
    assert made.table == pytest.approx(expected)
    plain = wrapped_normal("B", mean=90 * X.values(), sigma=20, values=36, step=10).table
    assert expected == pytest.approx(0.8 * plain + 0.2 / 36)


def test_a_function_has_one_value():
    square = Symbol("q", IntegerType(0, 4))
    assert function(square, [B], lambda b: b**2).table.argmax(axis=0).tolist() == [0, 1, 4]
    clock = Symbol("c", IntegerType(0, 2, wraps=True))
    assert function(clock, [B], lambda b: b + 2).table.argmax(axis=0).tolist() == [2, 0, 1]
    short = Symbol("s", IntegerType(0, 1), on_range="clamp")
    assert function(short, [B], lambda b: b).table.argmax(axis=0).tolist() == [0, 1, 1]
    down = Symbol("d", LabelType("2", "1", "0"))
    assert function(down, [B], lambda b: b).table.argmax(axis=0).tolist() == [2, 1, 0]


@pytest.mark.parametrize(
    "make",
    [
        lambda: table(A, [0.5, 0.6]),
        lambda: table(A, [[0.1, 0.5, 0.2], [0.9, 0.5, 0.9]], given=[B]),
        lambda: table(A, [0.5]),
        lambda: table(A, [-0.5, 1.5]),
        lambda: table(A, [np.nan, 1]),
        lambda: table(A, np.full((2, 2), 0.5), given=[A]),
        lambda: conditional_normal(A, [X], mean=1, sigma=1),
        lambda: conditional_normal(B, [X], mean=[1, 2], sigma=1),
        lambda: conditional_normal(B, [X], mean=lambda x: x, sigma=0),
        lambda: conditional_normal(B, [X], mean=lambda x: x, sigma=1, outliers=1.5),
        lambda: function(B, [X], lambda x: x),
        lambda: function(B, [X], lambda x: np.log(x - 0.5)),
        lambda: potential([A, B], np.ones((3, 2))),
        lambda: potential([A], [1, -1]),
        lambda: uniform(Symbol("n", IntegerType(0, MAX_ENTRIES))),
    ],
)
def test_refused_distributions(make):
    with np.errstate(divide="ignore"), pytest.raises(ModelError):
        make()


def test_a_function_gets_the_numbers_of_labels_as_arrays_of_all_combinations():
    valve, pressure = Symbol("valve", LabelType("shut", "open")), Symbol("pressure", IntegerType(0, 2))
    got = []

    def inside(bar, position):
        got.append((bar, position))
        return np.where(position == 1, bar, 0)

    function(Symbol("inside", IntegerType(0, 2)), [pressure, valve], inside)
    ((bar, position),) = got
    assert bar.dtype == position.dtype == np.float64
    assert bar.tolist() == [[0, 0], [1, 1], [2, 2]]
    assert position.tolist() == [[0, 1]] * 3
