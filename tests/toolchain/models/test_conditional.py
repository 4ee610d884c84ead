"""Normals over bins: against a plain sum of error functions, and what every distribution must be."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from toolchain.errors import ModelError
from toolchain.models.conditional import normal, wrapped_normal

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
