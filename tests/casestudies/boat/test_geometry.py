"""Distances and bearings of the boat from the beacons."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from casestudies.boat.sensors import BEACONS, bearing, distance, distance_sigma

on_map = st.floats(-50, 50)


@given(on_map, on_map, st.sampled_from(BEACONS))
def test_distance_and_bearing_lead_back_to_the_boat(x, y, beacon):
    length, angle = distance(x, y, beacon), math.radians(bearing(x, y, beacon))
    assert beacon[0] + length * math.cos(angle) == pytest.approx(x, abs=1e-9)
    assert beacon[1] + length * math.sin(angle) == pytest.approx(y, abs=1e-9)


@given(st.floats(-100, 100), st.floats(-100, 100), st.sampled_from(BEACONS))
def test_a_bearing_is_within_one_turn(x, y, beacon):
    assert 0 <= bearing(x, y, beacon) < 360


def test_just_below_the_axis_is_not_a_full_turn():
    assert bearing(0.0, -1e-300, BEACONS[1]) == 0.0


def test_far_is_noisier():
    assert distance_sigma(0) == 5
    assert distance_sigma(100) == 15
