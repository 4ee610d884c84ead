"""The boat's model: P(distance | cell) and P(bearing | cell) for three beacons (thesis 2.1.2.1, 4.2).

Column order D1, D2, D3, B1, B2, B3; line = y * width + x from the lower left corner.
"""

import math
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
from toolchain.models import Known, Model, cell_centres, interval, normal, wrapped_normal

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
) -> Model:
    """Return the boat's model; the likelihood of a cell is that of its centre.

    Args:
        width: Cells along x; the thesis ran 32 and describes 64.
        height: Cells along y.
        distance_step: Map units between distinguishable distances; readings are whole numbers 0..100, others
            are clamped and the first and last bins hold the tails.
        bearing_step: Degrees between distinguishable bearings; a divisor of 360.
        array: Whether readings are six numbers in a std_msgs/Float64MultiArray, in the order of the columns,
            instead of fields named after the sensors; for servers that accept only installed message types.
        on_missing: Whether the other readings of a frame suffice (`missing`), or each is needed (`error`).

    Raises:
        ModelError: A grid without cells, or a step that does not fit.
    """
    if not 1 <= distance_step <= LONGEST_DISTANCE:
        raise ModelError(f"distance_step is {distance_step}, expected 1 to {LONGEST_DISTANCE}")
    if bearing_step < 1 or TURN % bearing_step:
        raise ModelError(f"bearing_step is {bearing_step}, expected a number of degrees that divides {TURN}")
    rows = interval("y", MAP_LOW, MAP_HIGH, cells=height)
    columns = interval("x", MAP_LOW, MAP_HIGH, cells=width)
    y, x = cell_centres(rows, columns)
    path = {name: f"data[{place}]" if array else "" for place, name in enumerate(SENSOR_NAMES)}
    known: list[Known] = []
    for name, (beacon_x, beacon_y) in zip(DISTANCE_NAMES, BEACONS, strict=True):
        true_distance = np.hypot(x - beacon_x, y - beacon_y)
        known.append(
            normal(
                name,
                mean=true_distance,
                sigma=np.array([distance_sigma(d) for d in true_distance.tolist()]),
                values=math.floor(LONGEST_DISTANCE / distance_step) + 1,
                step=distance_step,
                unit="m",
                bits=DISTANCE_BITS,
                path=path[name],
                on_missing=on_missing,
            )
        )
    for name, (beacon_x, beacon_y) in zip(BEARING_NAMES, BEACONS, strict=True):
        known.append(
            wrapped_normal(
                name,
                mean=np.degrees(np.arctan2(y - beacon_y, x - beacon_x)),
                sigma=BEARING_SIGMA,
                values=TURN // bearing_step,
                step=bearing_step,
                unit="deg",
                bits=BEARING_BITS,
                path=path[name],
                on_missing=on_missing,
            )
        )
    return Model(name="boat", searched=(rows, columns), known=tuple(known))
