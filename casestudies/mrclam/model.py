"""The model of a robot's position: P(range | cell) and P(bearing | cell) for each landmark, with a floor for outliers.

The machine's columns are range_6, bearing_6, range_7, bearing_7 and so on, in the order of the landmarks' file. The
line of a cell is y * width + x, from the lower left corner. Readings of a landmark that is not seen are missing.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolchain.errors import ModelError
from toolchain.learning.fitted import with_fit
from toolchain.learning.recording import read_recording
from toolchain.models import (
    IntegerType,
    IntervalType,
    JointDistribution,
    Model,
    Symbol,
    conditional_normal,
    uniform,
)


@dataclass(frozen=True, slots=True)
class Landmark:
    """A landmark's number and its position in metres."""

    number: int
    x: float
    y: float


def read_landmarks(path: Path) -> tuple[Landmark, ...]:
    """Return the landmarks of a CSV file (landmark, x_m, y_m), in the order of its rows, or raise a ModelError."""
    columns = read_recording(Path(path), ("landmark", "x_m", "y_m")).columns
    found: dict[int, Landmark] = {}
    for row, values in enumerate(zip(*columns.values(), strict=True), start=1):
        number, x, y = (value if isinstance(value, float) else math.nan for value in values)
        if not (number.is_integer() and number >= 0 and math.isfinite(x) and math.isfinite(y)):
            raise ModelError(f"{path}, row {row}: expected a landmark's number from 0 and a finite position")
        if number in found:
            raise ModelError(f"{path}, row {row}: landmark {number:g} is listed twice")
        found[int(number)] = Landmark(int(number), x, y)
    return tuple(found.values())


X_LIMITS = (-2.0, 7.0)
Y_LIMITS = (-7.0, 7.0)
RANGE_SIGMA = 0.25
BEARING_SIGMA = 0.12
FLOOR = 0.05


def model(
    landmarks: Path,
    width: int = 32,
    height: int = 32,
    floor: float = FLOOR,
    range_step: float = 0.05,
    range_values: int = 255,
    bearing_values: int = 255,
    fit: Path | None = None,
) -> Model:
    """Return the model of a robot's position, in metres, given the robot's sightings of landmarks.

    Args:
        landmarks: A CSV file with the columns landmark, x_m and y_m. The README of the data set says where to get it.
        width: Number of cells along x in [-2, 7] m.
        height: Number of cells along y in [-7, 7] m.
        floor: Smallest likelihood of a reading, relative to the most likely reading. The floor allows for outliers.
            Codes of 8 bits round a floor of 1e-3 to 0. A single outlier then makes every line impossible.
        range_step: Step between distinguishable ranges, in metres, from 0. Readings beyond the largest range are
            clamped.
        range_values: The number of distinguishable ranges.
        bearing_values: The number of distinguishable bearings in a turn. Readings are in radians, and may include
            whole turns.
        fit: A file written by `toolchain fit`. Its sigmas and outliers replace the values set by hand.

    Raises:
        ModelError: The file does not contain landmarks, or a size is not positive.
    """
    if bearing_values < 1:
        raise ModelError(
            f"bearing_values is {bearing_values}, expected the number of bearings in a turn, from 1"
        )
    y = Symbol("y", IntervalType(*Y_LIMITS, height, unit="m"))
    x = Symbol("x", IntervalType(*X_LIMITS, width, unit="m"))
    range_type = IntegerType(0, range_values - 1, scale=range_step, unit="m")
    bearing_type = IntegerType(
        0, bearing_values - 1, wraps=True, scale=2 * np.pi / bearing_values, unit="rad"
    )
    north, east = y.values()[:, np.newaxis], x.values()
    factors, known = [uniform(y), uniform(x)], []
    for landmark in read_landmarks(landmarks):
        up, right = landmark.y - north, landmark.x - east
        away = Symbol(f"range_{landmark.number}", range_type, on_range="clamp", on_missing="missing")
        bearing = Symbol(f"bearing_{landmark.number}", bearing_type, on_missing="missing")
        known += [away, bearing]
        for symbol, mean, sigma in (
            (away, np.hypot(right, up), RANGE_SIGMA),
            (bearing, np.arctan2(up, right), BEARING_SIGMA),
        ):
            factors.append(conditional_normal(symbol, [y, x], mean=mean, sigma=sigma, floor=floor))
    question = JointDistribution("mrclam", tuple(factors)).ask(searched=[y, x], known=known)
    return with_fit(question.model(), fit)
