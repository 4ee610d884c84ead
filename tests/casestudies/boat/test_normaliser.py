"""From raw readings to whole numbers in the ranges of the machine's columns."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from casestudies.boat.normaliser import app, normalise, normalise_bearing, normalise_distance
from casestudies.boat.sensors import BadReadingError, read_raw, readings_message
from tests.command_runner import invoke

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
    values, head = read_raw({"header": HEAD, **RAW}, array=False)
    whole = {"D1": 2, "D2": 0, "D3": 100, "B1": 0, "B2": 180, "B3": 270}
    assert readings_message(normalise(values), head, array=False) == {"header": HEAD, **whole}


def test_arrays_hold_the_numbers_in_the_columns_order():
    values, head = read_raw({"layout": {}, "data": list(RAW.values())}, array=True)
    assert head is None
    message = readings_message(normalise(values), head, array=True)
    assert message["data"] == [2.0, 0.0, 100.0, 0.0, 180.0, 270.0]
    assert message["layout"]["dim"] == [{"label": "sensor", "size": 6, "stride": 6}]


@pytest.mark.parametrize("bad", [None, "12", math.nan, math.inf, True, [1.0]])
def test_a_reading_that_is_not_a_number_is_refused_by_name(bad):
    absent = {name: value for name, value in RAW.items() if name != "B2"}
    for reading in (RAW | {"B2": bad}, absent):
        with pytest.raises(BadReadingError, match="B2"):
            read_raw(reading, array=False)


@pytest.mark.parametrize("data", [None, [], [1.0] * 5, "AAAA"])
def test_an_array_needs_six_numbers(data):
    with pytest.raises(BadReadingError):
        read_raw({"data": data}, array=True)


def test_the_message_types_can_be_printed():
    ended = invoke(app, ["--print-msg"])
    assert ended.exit_code == 0
    assert "# boat_msgs/Sensors" in ended.stdout
    assert "uint16 B3" in ended.stdout
    assert not ended.stderr
