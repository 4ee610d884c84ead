"""Standard ROS messages of posteriors, against known values and NumPy.

y up      row 1   . .      data = [row 0, row 1], the row of the smallest y first
x right   row 0   . .
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from machines.kind import BoardResult
from posteriors.standard_messages import (
    Level,
    Plane,
    counts_message,
    decision_statuses,
    diagnostics,
    grid_message,
    has_coordinates,
    pose_message,
    status,
)
from toolchain.deployment import Dimension

Y = Dimension(label="y", size=2, offset=10, step=0.5, unit="m")
X = Dimension(label="x", size=3, offset=-1, step=0.5, unit="m")
P = np.array([0.1, 0.2, 0.4, 0.0, 0.3, 0.0])
"""Row 0 is y = 10, column 0 is x = -1."""


def grid(*dimensions, values=P, ros=2):
    return grid_message(values, Plane.of(dimensions), 5_000_000_007, ros)


def test_an_occupancy_grid_begins_at_the_lower_left():
    message = grid(Y, X)
    assert message["data"].tolist() == [24, 49, 98, 0, 74, 0]
    assert message["data"].dtype == np.int8
    info = message["info"]
    assert (info["width"], info["height"], info["resolution"]) == (3, 2, 0.5)
    assert info["origin"]["position"] == {"x": -1.25, "y": 9.75, "z": 0}
    assert info["origin"]["orientation"]["w"] == 1
    assert message["header"]["frame_id"] == "map"


@pytest.mark.parametrize(("ros", "keys"), [(1, {"secs": 5, "nsecs": 7}), (2, {"sec": 5, "nanosec": 7})])
def test_stamps_are_those_of_the_ros_version(ros, keys):
    message = grid(Y, X, ros=ros)
    assert message["header"]["stamp"] == message["info"]["map_load_time"] == keys
    assert pose_message(P, Plane.of([Y, X]), 5_000_000_007, ros)["header"]["stamp"] == keys
    assert diagnostics([], 5_000_000_007, "bm", ros)["header"]["stamp"] == keys


def test_x_comes_first_in_some_models():
    """The same posterior with x as the slow dimension gives the same messages."""
    turned = P.reshape(2, 3).T.ravel()
    a, b = grid(Y, X), grid(X, Y, values=turned)
    assert (a["info"], a["data"].tolist()) == (b["info"], b["data"].tolist())
    a, b = pose_message(P, Plane.of([Y, X]), 0, 2), pose_message(turned, Plane.of([X, Y]), 0, 2)
    assert (a["pose"]["pose"], a["pose"]["covariance"].tolist()) == (
        b["pose"]["pose"],
        pytest.approx(b["pose"]["covariance"].tolist()),
    )


def test_a_falling_axis_is_turned_round():
    falling = Y.replace(offset=10.5, step=-0.5)
    upside_down = P.reshape(2, 3)[::-1].ravel()
    assert grid(falling, X, values=upside_down)["data"].tolist() == grid(Y, X)["data"].tolist()
    assert grid(falling, X, values=upside_down)["info"] == grid(Y, X)["info"]


def test_lengths_become_metres():
    centimetres = (Y.replace(offset=1000, step=50, unit="cm"), X.replace(offset=-100, step=50, unit="cm"))
    assert grid(*centimetres)["info"]["origin"]["position"] == pytest.approx({"x": -1.25, "y": 9.75, "z": 0})


def a_posterior(rows, columns):
    return arrays.arrays(np.float64, rows * columns, elements=st.floats(0, 1)).filter(
        lambda p: p.max() > 1e-9
    )


@given(st.data(), st.integers(1, 6), st.integers(1, 6), st.sampled_from([0.25, -0.25, 3.0]))
def test_any_posterior_has_its_maximum_where_the_grid_is_98(data, rows, columns, step):
    p = data.draw(a_posterior(rows, columns))
    y = Dimension(label="y", size=rows, offset=2, step=step)
    x = Dimension(label="x", size=columns, offset=-7, step=-step)
    message = grid(y, x, values=p)
    cells, info = message["data"].reshape(rows, columns), message["info"]
    assert (cells.max(), cells.min() >= 0) == (98, True)
    best_row, best_column = divmod(int(p.argmax()), columns)
    at_x = (x.value(best_column) - info["origin"]["position"]["x"]) / info["resolution"]
    at_y = (y.value(best_row) - info["origin"]["position"]["y"]) / info["resolution"]
    assert cells[int(at_y), int(at_x)] == 98
    assert (at_x % 1, at_y % 1) == (pytest.approx(0.5), pytest.approx(0.5))


@given(st.data(), st.integers(1, 5), st.integers(1, 5))
def test_a_pose_has_the_moments_of_its_posterior(data, rows, columns):
    p = data.draw(a_posterior(rows, columns))
    y = Dimension(label="y", size=rows, offset=2, step=0.5)
    x = Dimension(label="x", size=columns, offset=-7, step=-3)
    pose = pose_message(p, Plane.of([y, x]), 0, 2)["pose"]
    points = np.array([(x.value(at % columns), y.value(at // columns)) for at in range(rows * columns)])
    mean = np.average(points, axis=0, weights=p)
    covariance = pose["covariance"].reshape(6, 6)
    assert [pose["pose"]["position"][axis] for axis in "xy"] == pytest.approx(mean.tolist(), abs=1e-9)
    expected = (points - mean).T @ ((points - mean) * (p / p.sum())[:, np.newaxis])
    np.testing.assert_allclose(covariance[:2, :2], expected, atol=1e-9)
    assert covariance[5, 5] == pytest.approx(math.pi**2 / 3)
    assert np.count_nonzero(covariance[2:]) == np.count_nonzero(covariance[:, 2:]) == 1


@pytest.mark.parametrize(
    ("dimensions", "there"),
    [
        ((Y, X), True),
        ((Y.replace(unit=""), X.replace(unit="")), True),
        ((Y.replace(unit="deg"), X), False),
        ((Dimension(label="y", size=2), Dimension(label="x", size=2)), False),
        ((Y, X, X), False),
        ((X,), False),
        ((Y, X.replace(states=("a", "b", "c"))), False),
    ],
)
def test_coordinates_are_lengths_or_numbers_that_are_no_indices(dimensions, there):
    assert has_coordinates(dimensions) == there


@pytest.mark.parametrize(
    "dimensions",
    [(X,), (Y, X, X), (Dimension(label="replica", size=2), X), (Y, X.replace(states=("a", "b", "c")))],
)
def test_what_is_no_plane_is_refused(dimensions):
    with pytest.raises(ValueError, match=r"no plane|names"):
        Plane.of(dimensions)


def test_cells_that_are_not_square():
    assert Plane.of([Y, X.replace(step=-50, unit="cm")], square=True).x.step == -0.5
    with pytest.raises(ValueError, match="not be square: 0.6 along x, 0.5 along y"):
        Plane.of([Y, X.replace(step=0.6)], square=True)


def test_counts_have_a_row_for_each_board():
    boards = [BoardResult(np.array(counts, "<u4").tobytes(), 9, 1) for counts in ([1, 2, 2**32 - 1], [4, 5])]
    message = counts_message(boards)
    assert message["data"].tolist() == [1, 2, 2**32 - 1, 4, 5, 0]
    assert [(each["size"], each["stride"]) for each in message["layout"]["dim"]] == [(2, 6), (3, 3)]


def decided(values, *dimensions, why="", replicas=1):
    deployment = SimpleNamespace(name="boat", searched=dimensions, machine=SimpleNamespace(replicas=replicas))
    row = None if values is None else np.array(values, float)
    statuses = decision_statuses(row, deployment, why=why, number=7, age_ms=2.34)
    return [
        (one["name"], one["level"], one["message"], {pair["key"]: pair["value"] for pair in one["values"]})
        for one in statuses
    ]


def test_a_decision_has_name_probability_margin_and_entropy():
    room = Dimension(label="room", size=2, states=("kitchen", "hall"))
    ((name, level, message, values),) = decided([0, 0, 0.125, 0, 0.5, 0.375], room, X)
    assert (name, level, message) == ("rosbayes: decision", Level.OK, "room hall, x -0.5 m")
    assert values == {
        "value.room": "hall",
        "value.x": "-0.5 m",
        "probability": "0.5",
        "margin": "0.125",
        "entropy_bits": "1.40564",
        "valid": "true",
        "why": "",
        "age_ms": "2.3",
        "number": "7",
    }


def test_a_decision_gives_x_before_y():
    ((_, _, message, _),) = decided([0, 0, 0, 0, 0, 1], Y, X)
    assert message == "x 0 m, y 10.5 m"


def test_a_decision_without_a_posterior_or_of_a_biased_one_is_not_valid():
    ((_, level, message, values),) = decided(None, X, why="no posterior: impossible")
    assert (level, message, values["valid"]) == (Level.WARN, "no posterior: impossible", "false")
    assert "probability" not in values
    ((_, level, message, values),) = decided([0, 1, 0], X, why="biased")
    assert (level, message, values["valid"], values["why"]) == (Level.WARN, "x -0.5 m", "false", "biased")
    assert (values["margin"], values["entropy_bits"]) == ("1", "0")
    assert decided([1], Dimension(label="x", size=1))[0][3]["margin"] == "1"


def test_each_replica_decides():
    first, second = decided([0, 0, 0, 0, 0, 1], X, replicas=2)
    assert (first[0], first[3]["valid"]) == ("rosbayes: decision of replica 0", "false")
    assert (second[2], second[3]["valid"]) == ("x 0 m", "true")


def test_a_status_leaves_out_what_is_unknown():
    made = status("board 0", Level.STALE, "no frame yet", "board0", {"cycles": None, "image": "a"})
    assert (made["level"], made["values"]) == (3, [{"key": "image", "value": "a"}])
