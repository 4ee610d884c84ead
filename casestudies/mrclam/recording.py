"""Recorded frames of a robot among landmarks: their CSV file, and each frame as a ROS message."""

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from casestudies.errors import DataFileError
from casestudies.grid import Grid

SIGHTINGS_TOPIC: Final = "/mrclam/sightings"
SIGHTINGS_TYPE: Final = "mrclam_msgs/Sightings"
MAP_FRAME: Final = "map"
LANDMARKS: Final = range(6, 21)
"""The data set's numbers of the 15 landmarks; 1 to 5 are the robots."""

SIGHTINGS_MSG: Final = (
    "# mrclam_msgs/Sightings: range (m) and absolute bearing (rad, counter-clockwise from +x) of the landmarks "
    "seen.\n# NaN where a landmark was not seen; a client without message definitions leaves the field out.\n"
    "std_msgs/Header header\n"
    + "".join(f"float64 range_{number}\nfloat64 bearing_{number}\n" for number in LANDMARKS)
)

_SIGHTING_COLUMN: Final = re.compile(r"range_(\d+)_m")
_REFERENCE_COLUMNS: Final = ("time_s", "ref_x_m", "ref_y_m", "ref_std_m", "heading_rad")


def area_grid(width: int = 32, height: int = 32) -> Grid:
    """Return the area of the experiment, x in [-2, 7] m and y in [-7, 7] m, as a grid of cells."""
    return Grid(x_low=-2.0, x_high=7.0, y_low=-7.0, y_high=7.0, width=width, height=height)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sighting:
    """A sighting of one landmark: its range in metres, its absolute bearing in radians."""

    landmark: int
    range_m: float
    bearing_rad: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedFrame:
    """The sightings of one second, and the robot's reference position in metres."""

    number: int
    time_s: float
    x: float
    y: float
    sightings: tuple[Sighting, ...]


def read_recording(path: Path) -> tuple[RecordedFrame, ...]:
    """Read a file such as `ds1_robot3.csv`, or raise a DataFileError that names the damaged line."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.reader(file, strict=True)
            columns = next(rows, [])
            landmarks = _landmarks(path, columns)
            frames = tuple(_frames(path, columns, landmarks, rows))
    except OSError as error:
        raise DataFileError(
            f"{path} cannot be read: {error.strerror or error}; the case study's page says where to get the data"
        ) from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataFileError(f"{path} is not a CSV file: {error}") from None
    if not frames:
        raise DataFileError(f"{path} has a heading but no frames")
    return frames


def sightings_message(frame: RecordedFrame, header: Mapping[str, Any]) -> dict[str, Any]:
    """Return a frame as a `mrclam_msgs/Sightings` message, without the landmarks that were not seen."""
    message: dict[str, Any] = {"header": dict(header)}
    for sighting in frame.sightings:
        message[f"range_{sighting.landmark}"] = sighting.range_m
        message[f"bearing_{sighting.landmark}"] = sighting.bearing_rad
    return message


def _landmarks(path: Path, columns: Sequence[str]) -> tuple[int, ...]:
    """Return the landmarks that the file has columns for."""
    landmarks = tuple(int(match[1]) for column in columns if (match := _SIGHTING_COLUMN.fullmatch(column)))
    wanted = [*_REFERENCE_COLUMNS, *(f"bearing_{landmark}_rad" for landmark in landmarks)]
    missing = [column for column in wanted if column not in columns]
    if missing or not landmarks:
        raise DataFileError(
            f"{path} is not a recording of sightings: its first line lacks the column "
            f"{missing[0] if missing else 'range_N_m'}; name a file such as ds1_robot3.csv"
        )
    if unknown := set(landmarks) - set(LANDMARKS):
        raise DataFileError(
            f"{path} has sightings of landmark {min(unknown)}, but the landmarks are "
            f"{LANDMARKS[0]} to {LANDMARKS[-1]}"
        )
    return landmarks


def _frames(
    path: Path, columns: Sequence[str], landmarks: Sequence[int], rows: Iterator[list[str]]
) -> Iterator[RecordedFrame]:
    for number, row in enumerate(rows, start=1):
        where = f"{path}, line {number + 1}"
        if len(row) != len(columns):
            raise DataFileError(
                f"{where} has {len(row)} values, but the heading has {len(columns)}: is the file truncated?"
            )
        cells = dict(zip(columns, row, strict=True))
        sightings = []
        for landmark in landmarks:
            range_text, bearing_text = cells[f"range_{landmark}_m"], cells[f"bearing_{landmark}_rad"]
            if bool(range_text) != bool(bearing_text):
                raise DataFileError(f"{where}: landmark {landmark} has a range or a bearing, but not both")
            if range_text:
                sightings.append(
                    Sighting(
                        landmark=landmark,
                        range_m=_number(range_text, where, f"range_{landmark}_m"),
                        bearing_rad=_number(bearing_text, where, f"bearing_{landmark}_rad"),
                    )
                )
        yield RecordedFrame(
            number=number,
            time_s=_number(cells["time_s"], where, "time_s"),
            x=_number(cells["ref_x_m"], where, "ref_x_m"),
            y=_number(cells["ref_y_m"], where, "ref_y_m"),
            sightings=tuple(sightings),
        )


def _number(text: str, where: str, column: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataFileError(f"{where}: {column} must be a number, not {text!r}")
    return value
