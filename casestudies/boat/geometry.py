"""The boat's map: beacons, readings at a position, and their noise.

The boat localisation problem of thesis 2.1.2.1 with the numbers of its published version (Bessiere et al.,
Bayesian Programming, ch. 7). Distances are in map units, bearings in degrees.
"""

import math
from typing import Final

from casestudies.grid import Grid

MAP_LOW: Final = -50.0
"""Lowest coordinate of the map, the square [MAP_LOW, MAP_HIGH]^2."""
MAP_HIGH: Final = 50.0
BEACONS: Final = ((-50.0, -50.0), (-50.0, 0.0), (0.0, -50.0))
"""Positions of the beacons: lower left corner, middle of the left side, middle of the lower side (4.1).
"""
DISTANCE_NAMES: Final = ("D1", "D2", "D3")
BEARING_NAMES: Final = ("B1", "B2", "B3")
SENSOR_NAMES: Final = DISTANCE_NAMES + BEARING_NAMES
"""Names of the sensors, in the order of the machine's columns and of the numbers in an array message."""
LONGEST_DISTANCE: Final = 100
"""Readings are whole numbers 0..100; longer distances, such as those to the map's far corners, are clamped.
"""
BEARING_SIGMA: Final = 10.0
"""Standard deviation of a bearing, in degrees."""


def map_grid(width: int = 32, height: int = 32) -> Grid:
    """Return the map as a grid of cells; the thesis ran 32 x 32 on four boards (4.2)."""
    return Grid(x_low=MAP_LOW, x_high=MAP_HIGH, y_low=MAP_LOW, y_high=MAP_HIGH, width=width, height=height)


def distance(x: float, y: float, beacon: tuple[float, float]) -> float:
    """Return the distance from (x, y) to a beacon."""
    return math.hypot(x - beacon[0], y - beacon[1])


def bearing(x: float, y: float, beacon: tuple[float, float]) -> float:
    """Return the absolute bearing of (x, y) as seen from a beacon, in degrees, 0 <= bearing < 360, 0 along +x."""
    degrees = math.degrees(math.atan2(y - beacon[1], x - beacon[0])) % 360.0
    return degrees if degrees < 360.0 else 0.0  # a tiny negative angle rounds up to 360 in the modulo


def distance_sigma(true_distance: float) -> float:
    """Return the standard deviation of a distance reading at this true distance, in map units."""
    return true_distance / 10.0 + 5.0
