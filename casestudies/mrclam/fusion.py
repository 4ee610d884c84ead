"""Unquantised float64 fusion of raw readings, the reference for the machine's posteriors.

Gaussian densities at the cells' centres and the same outlier floor, without bins, codes or counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casestudies.mrclam.landmarks import Landmark
from casestudies.mrclam.model import BEARING_SIGMA, FLOOR, RANGE_SIGMA, X_LIMITS, Y_LIMITS
from toolchain.models.model import cell_centres, fuse, interval


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkReading:
    """A reading of one landmark: metres and radians (absolute, any turn), or None if it was not seen."""

    range_m: float | None = None
    bearing_rad: float | None = None


def unquantised_posterior(
    landmarks: Sequence[Landmark],
    readings: Sequence[LandmarkReading],
    *,
    width: int = 32,
    height: int = 32,
    floor: float = FLOOR,
) -> NDArray[np.float64]:
    """Return the posterior over the cells, float64[width * height] with line = y * width + x.

    There is one reading for each landmark, in the same order. An outlier's density is the floor everywhere,
    relative to the peak. Without a floor, readings that are impossible on every line raise a ModelError.
    """
    y, x = cell_centres(interval("y", *Y_LIMITS, cells=height), interval("x", *X_LIMITS, cells=width))
    factors = []
    for landmark, reading in zip(landmarks, readings, strict=True):
        if reading.range_m is not None:
            away = reading.range_m - np.hypot(landmark.x - x, landmark.y - y)
            factors.append(_likelihood(away / RANGE_SIGMA, floor))
        if reading.bearing_rad is not None:
            away = reading.bearing_rad - np.arctan2(landmark.y - y, landmark.x - x)
            away = (away + np.pi) % (2 * np.pi) - np.pi
            factors.append(_likelihood(away / BEARING_SIGMA, floor))
    return fuse(np.ones(width * height), factors)


def _likelihood(z: NDArray[np.float64], floor: float) -> NDArray[np.float64]:
    likelihood: NDArray[np.float64] = np.exp(-0.5 * z**2) + floor
    return likelihood
