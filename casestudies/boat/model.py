"""The boat's model: P(distance | cell) and P(bearing | cell) for three beacons (thesis 2.1.2.1, 4.2).

The columns are in the order D1, D2, D3, B1, B2, B3. Lines start at the lower left corner: line = y * width + x.
"""

from typing import Literal

import numpy as np

from casestudies.boat.sensors import (
    BEACONS,
    BEARING_NAMES,
    BEARING_SIGMA,
    DISTANCE_NAMES,
    LONGEST_DISTANCE,
    MAP_HIGH,
    MAP_LOW,
    SENSOR_NAMES,
    distance_sigma,
)
from toolchain.errors import ModelError
from toolchain.models import (
    IntegerType,
    IntervalType,
    JointDistribution,
    Question,
    Symbol,
    conditional_normal,
    uniform,
)

DISTANCE_BITS = 7
BEARING_BITS = 9
TURN = 360


def model(
    width: int = 32,
    height: int = 32,
    distance_step: int = 1,
    bearing_step: int = 1,
    array: bool = False,
    on_missing: Literal["error", "missing"] = "missing",
) -> Question:
    """Return the question for the boat's cell, given its readings.

    The likelihoods of a cell are computed at the centre of the cell.

    Args:
        width: Number of cells along x. The thesis ran 32 and describes 64.
        height: Number of cells along y.
        distance_step: Map units between distinguishable distances. Readings are whole numbers 0..100, and other
            readings are clamped. The first and the last bin hold the tails of the distribution.
        bearing_step: Degrees between distinguishable bearings, a divisor of 360.
        array: Whether readings are six numbers in a std_msgs/Float64MultiArray, in the order of the columns. By
            default, they are fields named after the sensors. Use arrays for servers without `boat_msgs`.
        on_missing: `missing` computes frames that lack readings; `error` requires all six.

    Raises:
        ModelError: The grid has no cells, or a step is invalid.
    """
    if not 1 <= distance_step <= LONGEST_DISTANCE:
        raise ModelError(f"distance_step is {distance_step}, expected 1 to {LONGEST_DISTANCE}")
    if bearing_step < 1 or TURN % bearing_step:
        raise ModelError(f"bearing_step is {bearing_step}, expected a number of degrees that divides {TURN}")
    y = Symbol("y", IntervalType(MAP_LOW, MAP_HIGH, height))
    x = Symbol("x", IntervalType(MAP_LOW, MAP_HIGH, width))
    path = {name: f"data[{place}]" if array else "" for place, name in enumerate(SENSOR_NAMES)}
    distance_type = IntegerType(0, LONGEST_DISTANCE // distance_step, scale=distance_step, unit="m")
    bearing_type = IntegerType(0, TURN // bearing_step - 1, wraps=True, scale=bearing_step, unit="deg")
    north, east = y.values()[:, np.newaxis], x.values()
    factors = [uniform(y), uniform(x)]
    for name, (beacon_x, beacon_y) in zip(DISTANCE_NAMES, BEACONS, strict=True):
        distance = Symbol(
            name, distance_type, path[name], DISTANCE_BITS, on_range="clamp", on_missing=on_missing
        )
        away = np.hypot(east - beacon_x, north - beacon_y)
        factors.append(
            conditional_normal(distance, [y, x], mean=away, sigma=np.vectorize(distance_sigma)(away))
        )
    for name, (beacon_x, beacon_y) in zip(BEARING_NAMES, BEACONS, strict=True):
        bearing = Symbol(name, bearing_type, path[name], BEARING_BITS, on_missing=on_missing)
        direction = np.degrees(np.arctan2(north - beacon_y, east - beacon_x))
        factors.append(conditional_normal(bearing, [y, x], mean=direction, sigma=BEARING_SIGMA))
    return JointDistribution("boat", tuple(factors)).ask(searched=[y, x], known=SENSOR_NAMES)
