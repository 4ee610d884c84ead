"""The boat's route and its noise."""

import math
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from casestudies.boat.sensors import BEACONS, BEARING_SIGMA, bearing, distance, distance_sigma
from casestudies.boat.simulator import Boat


def test_it_starts_in_the_middle():
    boat = Boat(1, 10)
    assert (boat.x, boat.y) == (0, 0)


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
        steps = []
        for _ in range(20):
            boat.sail(0.1)
            steps.append((boat.x, boat.y, boat.measure()))
        return steps

    assert journey(7) == journey(7)
    assert journey(7) != journey(8)


def test_the_noise_is_the_models():
    boat = Boat(11, 0)
    measured = [boat.measure() for _ in range(4000)]
    for column, beacon in enumerate(BEACONS):
        distances = [values[column] for values in measured]
        sigma = distance_sigma(distance(0, 0, beacon))
        assert statistics.fmean(distances) == pytest.approx(distance(0, 0, beacon), abs=0.08 * sigma)
        assert statistics.stdev(distances) == pytest.approx(sigma, rel=0.06)
        bearings = [math.degrees(values[3 + column]) for values in measured]
        assert statistics.fmean(bearings) == pytest.approx(bearing(0, 0, beacon), abs=0.8)
        assert statistics.stdev(bearings) == pytest.approx(BEARING_SIGMA, rel=0.06)
