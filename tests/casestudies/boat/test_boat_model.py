"""The boat: its map, its tables (boat.md, thesis 2.1.2.1), its simulator, and the whole numbers of its readings."""

import math
import statistics

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from casestudies.boat import sensors
from casestudies.boat.model import model
from casestudies.boat.normaliser import app, normalise, normalise_bearing, normalise_distance
from casestudies.boat.simulator import Boat
from tests.casestudies.cells import centre, line_at
from tests.casestudies.figures import coverage, distances, means
from tests.command_runner import invoke
from toolchain.errors import ModelError
from toolchain.models.model import exact_posterior

on_map = st.floats(-50, 50)


@given(on_map, on_map, st.sampled_from(sensors.BEACONS))
def test_distance_and_bearing_lead_back_to_the_boat(x, y, beacon):
    length, angle = sensors.distance(x, y, beacon), math.radians(sensors.bearing(x, y, beacon))
    assert beacon[0] + length * math.cos(angle) == pytest.approx(x, abs=1e-9)
    assert beacon[1] + length * math.sin(angle) == pytest.approx(y, abs=1e-9)


def test_just_below_the_axis_is_not_a_full_turn():
    assert sensors.bearing(0.0, -1e-300, sensors.BEACONS[1]) == 0.0


BOAT = model().model()
GRID = sensors.map_grid()
LINES = st.integers(0, GRID.width * GRID.height - 1)


def test_shape_order_and_widths():
    assert tuple(known.name for known in BOAT.known) == sensors.SENSOR_NAMES
    assert [known.table.shape for known in BOAT.known] == [(101, 1024)] * 3 + [(360, 1024)] * 3
    assert [known.bits for known in BOAT.known] == [7] * 3 + [9] * 3
    assert [known.on_missing for known in BOAT.known] == ["missing"] * 6
    assert [known.on_missing for known in model(2, 2, on_missing="error").model().known] == ["error"] * 6
    assert [(d.label, d.size) for d in BOAT.searched] == [("y", 32), ("x", 32)]
    assert BOAT.prior_distribution == pytest.approx(np.full(1024, 1 / 1024))


@given(LINES)
def test_lines_are_the_grids_cells(line):
    row, column = divmod(line, 32)
    y, x = BOAT.searched
    assert (x.value(column), y.value(row)) == pytest.approx(centre(GRID, line))
    assert (x.value(-0.5), y.value(31.5)) == pytest.approx((-50, 50))


def test_tables_are_normals_around_distance_and_bearing():
    centres = [centre(GRID, line) for line in range(GRID.width * GRID.height)]
    for away, around, beacon in zip(BOAT.known[:3], BOAT.known[3:], sensors.BEACONS, strict=True):
        means = np.array([sensors.distance(x, y, beacon) for x, y in centres])
        assert away.normal.mean == pytest.approx(means)
        assert away.normal.sigma == pytest.approx(means / 10 + 5)
        turned = np.array([sensors.bearing(x, y, beacon) for x, y in centres])
        assert around.normal.mean % 360 == pytest.approx(turned)
        assert np.all(around.normal.sigma == 10)
        assert (away.offset, away.step, around.offset, around.step) == (0, 1, 0, 1)
        assert (away.period, around.period) == (None, 360)


@pytest.mark.parametrize(
    ("width", "height", "distance_step", "bearing_step"), [(64, 64, 1, 1), (8, 4, 7, 45), (1, 1, 100, 360)]
)
def test_other_sizes(width, height, distance_step, bearing_step):
    other = model(width, height, distance_step, bearing_step).model()
    assert other.lines == width * height
    assert [d.size for d in other.searched] == [height, width]
    assert other.known[0].values == 100 // distance_step + 1
    assert (other.known[5].values, other.known[5].period) == (360 // bearing_step, 360 // bearing_step)
    assert [known.bits for known in other.known] == [7] * 3 + [9] * 3


@pytest.mark.parametrize(
    "wrong",
    [{"width": 0}, {"distance_step": 0}, {"distance_step": 101}, {"bearing_step": 7}, {"bearing_step": 0}],
)
def test_sizes_that_do_not_fit(wrong):
    with pytest.raises(ModelError):
        model(**wrong)


def test_an_array_of_readings_has_paths_and_the_same_tables():
    array, named = model(4, 4, array=True).model(), model(4, 4).model()
    assert [known.as_variable().path for known in array.known] == [f"data[{place}]" for place in range(6)]
    assert [known.as_variable().path for known in named.known] == [""] * 6
    assert np.array_equal(array.known[0].table, named.known[0].table)


@given(st.integers(0, 1000), st.floats(0, 500), st.floats(0.001, 1))
def test_the_boat_stays_on_the_map_and_within_its_speed(seed, speed, seconds):
    boat = Boat(seed, speed)
    for _ in range(30):
        before = (boat.x, boat.y)
        boat.sail(seconds)
        assert -50 <= boat.x <= 50
        assert -50 <= boat.y <= 50
        assert math.dist(before, (boat.x, boat.y)) <= speed * seconds * (1 + 1e-9)


def test_it_gets_about():
    boat = Boat(3, 60)
    seen = set()
    for _ in range(400):
        boat.sail(0.1)
        seen.add((boat.x > 0, boat.y > 0))
    assert len(seen) == 4


def test_a_seed_is_a_journey():
    def journey(seed):
        boat = Boat(seed, 60)
        return [(boat.sail(0.1), boat.x, boat.y, boat.measure()) for _ in range(20)]

    assert journey(7) == journey(7)
    assert journey(7) != journey(8)


def test_the_noise_is_the_models():
    boat = Boat(11, 0)
    measured = [boat.measure() for _ in range(4000)]
    for column, beacon in enumerate(sensors.BEACONS):
        distances = [values[column] for values in measured]
        sigma = sensors.distance_sigma(sensors.distance(0, 0, beacon))
        assert statistics.fmean(distances) == pytest.approx(sensors.distance(0, 0, beacon), abs=0.08 * sigma)
        assert statistics.stdev(distances) == pytest.approx(sigma, rel=0.06)
        bearings = [math.degrees(values[3 + column]) for values in measured]
        assert statistics.fmean(bearings) == pytest.approx(sensors.bearing(0, 0, beacon), abs=0.8)
        assert statistics.stdev(bearings) == pytest.approx(sensors.BEARING_SIGMA, rel=0.06)


def pose(x, y):
    return {"pose": {"position": {"x": x, "y": y, "z": math.nan}}}


def test_a_boat_that_is_put_somewhere_lies_still_until_it_sails_on():
    boat = Boat(5, 60)
    boat.put(*sensors.read_set_pose(pose(-20, 30.5)))
    boat.sail(1.0)
    assert (boat.x, boat.y) == (-20, 30.5)
    boat.put(1e300, -51)
    assert (boat.x, boat.y) == (50, -50)
    assert boat.changed.is_set()
    boat.switch("sail", on=True)
    boat.sail(0.1)
    assert math.dist((boat.x, boat.y), (50, -50)) == pytest.approx(6)


@pytest.mark.parametrize(
    ("message", "field"),
    [
        ({}, "pose.position.x"),
        ({"pose": "here"}, "pose.position.x"),
        ({"pose": {"position": {"y": 1.0}}}, "pose.position.x"),
        (pose("1", 2), "pose.position.x"),
        (pose(True, 2), "pose.position.x"),
        (pose(1, math.nan), "pose.position.y"),
        (pose(1, math.inf), "pose.position.y"),
        (pose(1, [2.0]), "pose.position.y"),
    ],
)
def test_a_place_that_is_no_place_is_refused(message, field):
    with pytest.raises(sensors.BadNumberError, match=field):
        sensors.read_set_pose(message)


def twist(forward, turn):
    return {"linear": {"x": forward}, "angular": {"z": turn}}


@pytest.mark.parametrize(
    ("message", "field"), [({}, "linear.x"), (twist(math.nan, 0), "linear.x"), (twist(1, None), "angular.z")]
)
def test_a_velocity_that_is_none_is_refused(message, field):
    with pytest.raises(sensors.BadNumberError, match=field):
        sensors.read_drive(message)


def test_a_boat_that_is_driven_follows_the_velocity_for_a_second_and_stays_on_the_map():
    boat = Boat(5, 60)
    boat.drive(*sensors.read_drive(twist(10.0, 0.0)))
    for _ in range(20):  # two seconds: the velocity is too old in the second one
        boat.sail(0.1)
    assert (boat.x, boat.y, boat.heading) == (pytest.approx(10), 0, 0)
    boat.drive(0.0, math.pi / 2)
    boat.sail(1.0)
    boat.drive(-5.0, 0.0)
    boat.sail(1.0)
    assert (boat.x, boat.y, boat.heading) == pytest.approx((10, -5, math.pi / 2))
    boat.drive(1e300, 0.0)  # no faster than its speed
    boat.sail(0.5)
    assert boat.y == pytest.approx(25)
    boat.sail(0.5)
    assert boat.y == 50
    boat.switch("sail", on=True)
    boat.sail(0.5)
    assert math.dist((boat.x, boat.y), (10, 50)) > 1


def test_a_turn_while_driving_is_an_arc_to_the_left():
    boat = Boat(5, 60)
    for _ in range(1000):  # a quarter of a circle of radius 20
        boat.drive(20.0, 1.0)
        boat.sail(math.pi / 2000)
    assert (boat.x, boat.y) == (pytest.approx(20), pytest.approx(20))


def test_switches_of_the_boat():
    boat = Boat(5, 0)
    boat.put(*sensors.BEACONS[1])
    boat.switch("noise", on=False)
    exact = (50, 0, math.hypot(50, 50), math.pi / 2, 0, math.radians(135))
    assert boat.measure() == pytest.approx(exact)
    boat.switch("D1/plugged", on=False)
    boat.switch("B3/plugged", on=False)
    assert [value is None for value in boat.measure()] == [True, *[False] * 4, True]
    assert boat.switch("D1/plugged", on=True) != boat.switch("D1/plugged", on=False)
    boat.switch("beacon2/works", on=False)
    measured = [boat.measure() for _ in range(2000)]
    for column, turn in ((1, sensors.LONGEST_DISTANCE), (4, 2 * math.pi)):
        values = [each[column] for each in measured]
        assert 0 <= min(values) < 0.01 * turn
        assert 0.99 * turn < max(values) <= turn
        assert statistics.fmean(values) == pytest.approx(turn / 2, rel=0.06)
    assert {each[2] for each in measured} == {math.hypot(50, 50)}


@pytest.mark.parametrize("seed", [1, 2])
def test_float64_fusion_covers_the_truth(seed):
    grid, boat = sensors.map_grid(), Boat(seed, 60)
    lines, posteriors = [], []
    for _ in range(500):
        boat.sail(0.5)
        readings = normalise(boat.measure())
        posteriors.append(exact_posterior(BOAT, readings))
        lines.append(line_at(grid, boat.x, boat.y))
    exact = np.array(posteriors)
    assert coverage(lines, exact) == pytest.approx(0.95, abs=0.03)
    truth = np.stack(np.divmod(lines, grid.width)[::-1], axis=1)
    assert np.median(distances(means(exact, grid.width), truth)) < 3


HEAD = {"stamp": {"secs": 5, "nsecs": 6}, "frame_id": "map", "seq": 3}
RAW = {"D1": 1.5, "D2": -3, "D3": 170.0, "B1": 0.0, "B2": math.pi, "B3": -math.pi / 2}


@pytest.mark.parametrize(
    ("raw", "whole"), [(0.49, 0), (0.5, 1), (99.5, 100), (-0.5, 0), (-7.3, 0), (141.4, 100), (41.0, 41)]
)
def test_distances_are_rounded_and_clamped(raw, whole):
    assert normalise_distance(raw) == whole


@pytest.mark.parametrize(
    ("degrees", "whole"), [(0.4, 0), (0.6, 1), (359.6, 0), (-0.4, 0), (-0.6, 359), (360, 0), (-450, 270)]
)
def test_bearings_are_rounded_and_turned_into_one_turn(degrees, whole):
    assert normalise_bearing(math.radians(degrees)) == whole


@given(st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=6))
def test_all_that_leaves_is_in_range(raw):
    whole = normalise(tuple(raw))
    assert all(type(value) is int for value in whole)
    assert all(0 <= value <= 100 for value in whole[:3])
    assert all(0 <= value <= 359 for value in whole[3:])


def test_header_and_names_are_kept():
    values, head = sensors.read_raw({"header": HEAD, **RAW}, array=False)
    whole = {"D1": 2, "D2": 0, "D3": 100, "B1": 0, "B2": 180, "B3": 270}
    assert sensors.readings_message(normalise(values), head, array=False) == {"header": HEAD, **whole}


def test_arrays_hold_the_numbers_in_the_columns_order():
    values, head = sensors.read_raw({"layout": {}, "data": list(RAW.values())}, array=True)
    assert head is None
    message = sensors.readings_message(normalise(values), head, array=True)
    assert message["data"] == [2.0, 0.0, 100.0, 0.0, 180.0, 270.0]
    assert message["layout"]["dim"] == [{"label": "sensor", "size": 6, "stride": 6}]


@pytest.mark.parametrize("bad", ["12", math.inf, True, [1.0]])
def test_a_reading_that_is_not_a_number_is_refused_by_name(bad):
    with pytest.raises(sensors.BadNumberError, match="B2"):
        sensors.read_raw(RAW | {"B2": bad}, array=False)


@pytest.mark.parametrize("missing", [{}, {"B2": None}, {"B2": math.nan}])
def test_a_missing_reading_stays_missing(missing):
    rest = {name: value for name, value in RAW.items() if name != "B2"}
    whole = normalise(sensors.read_raw({"header": HEAD, **rest, **missing}, array=False)[0])
    assert whole == (2, 0, 100, 0, None, 270)
    named = sensors.readings_message(whole, HEAD, array=False)
    assert list(named) == ["header", "D1", "D2", "D3", "B1", "B3"]
    data = [missing.get(name, RAW[name]) if name != "B2" else missing.get("B2") for name in RAW]
    again = normalise(sensors.read_raw({"data": data}, array=True)[0])
    assert sensors.readings_message(again, None, array=True)["data"] == [2.0, 0.0, 100.0, 0.0, None, 270.0]


@pytest.mark.parametrize("data", [None, [], [1.0] * 5, "AAAA"])
def test_an_array_needs_six_numbers(data):
    with pytest.raises(sensors.BadNumberError):
        sensors.read_raw({"data": data}, array=True)


def test_the_message_types_can_be_printed():
    ended = invoke(app, ["--print-msg"])
    assert ended.exit_code == 0
    assert "# boat_msgs/Sensors" in ended.stdout
    assert "uint16 B3" in ended.stdout
    assert not ended.stderr
