"""The boat's model: where on the map it is, given distances and bearings to three beacons (thesis 2.1.2.1)."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np

from casestudies.boat.geometry import BEACONS, BEARING_SIGMA, MAP_HIGH, MAP_LOW
from toolchain.conditional import normal, wrapped_normal
from toolchain.errors import ModelError
from toolchain.model import Known, Model, cell_centres, interval

DISTANCE_BITS: Final = 7
BEARING_BITS: Final = 9


def model(
    width: int = 32,
    height: int = 32,
    distance_step: int = 1,
    bearing_step: int = 1,
    on_range: Literal["error", "clamp", "missing"] = "clamp",
    array: bool = False,
) -> Model:
    """The published model (Bessiere et al., Bayesian Programming, ch. 7) on a grid of cells.

    Args:
        width: Cells along x; the thesis ran 32 and describes 64.
        height: Cells along y.
        distance_step: Distances per address; 1 serves 0..100.
        bearing_step: Degrees per address; a divisor of 360.
        on_range: What a distance beyond 100 is; `clamp` takes it for the largest.
        array: The six readings come as `data[0]` to `data[5]` of an array instead of fields by name.

    Raises:
        ModelError: A step that does not fit.
    """
    if distance_step < 1 or bearing_step < 1 or 360 % bearing_step:
        raise ModelError("distance_step must be 1 or more, and bearing_step a divisor of 360")
    rows = interval("y", MAP_LOW, MAP_HIGH, cells=height)
    columns = interval("x", MAP_LOW, MAP_HIGH, cells=width)
    y, x = cell_centres(rows, columns)
    distances: list[Known] = []
    bearings: list[Known] = []
    for at, (beacon_x, beacon_y) in enumerate(BEACONS):
        distance = np.hypot(x - beacon_x, y - beacon_y)
        distances.append(
            normal(
                f"D{at + 1}",
                mean=distance,
                sigma=distance / 10 + 5,
                values=100 // distance_step + 1,
                step=distance_step,
                bits=DISTANCE_BITS,
                on_range=on_range,
                path=f"data[{at}]" if array else "",
            )
        )
        bearings.append(
            wrapped_normal(
                f"B{at + 1}",
                mean=np.degrees(np.arctan2(y - beacon_y, x - beacon_x)) % 360,
                sigma=BEARING_SIGMA,
                values=360 // bearing_step,
                step=bearing_step,
                bits=BEARING_BITS,
                path=f"data[{at + 3}]" if array else "",
            )
        )
    return Model(name="boat", searched=(rows, columns), known=(*distances, *bearings))
