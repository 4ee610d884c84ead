"""Conversion of the downloaded data set MR.CLAM into CSV files.

A robot's file has a row for each second in which the robot hardly moved.

python -m casestudies.mrclam.convert MRCLAM_Dataset1 -o DATA_DIR
"""

import csv
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer
from numpy.typing import NDArray

from casestudies.mrclam.player import LANDMARKS
from terminal.command_line import CommandLine
from terminal.errors import OutputError
from terminal.output import check_writable, warn
from toolchain.bounded_files import read_bounded
from toolchain.errors import ModelError

LARGEST_FILE: Final = 1 << 28
"""Maximum size of an input file in bytes. The data set has files of up to 20 million bytes."""
LEAST_LANDMARKS: Final = 3
MOST_MOVED_M: Final = 0.12
WINDOW_S: Final = 1.0
_REFERENCE_GAP_S: Final = 0.2
"""Maximum time in seconds between two positions of a track for positions in between to be interpolated."""
_REFERENCE_STD_M: Final = 0.001
"""Precision of the motion capture in metres, from the data set's page."""
_SUBJECTS: Final = range(1, 21)

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The positions of a robot, from motion capture. Each attribute is float64[n].

    Attributes:
        time: Times of the positions, in seconds.
        x: Coordinates along x, in metres.
        y: Coordinates along y, in metres.
        heading: Headings in radians, without jumps of a full turn.
    """

    time: Floats
    x: Floats
    y: Floats
    heading: Floats

    def at(self, time: float) -> tuple[float, float, float]:
        """Return x (m), y (m) and heading (rad) at a time in seconds, interpolated linearly."""
        x, y, heading = (float(np.interp(time, self.time, each)) for each in (self.x, self.y, self.heading))
        return x, y, heading

    def known(self, begin: float, end: float) -> bool:
        """Return whether the track has no gap between two times (s)."""
        inside = self.time[(self.time > begin) & (self.time < end)]
        around = np.concatenate((self.time[self.time <= begin][-1:], inside, self.time[self.time >= end][:1]))
        ends_known = len(around) > 1 and around[0] <= begin and around[-1] >= end
        return bool(ends_known and np.diff(around).max() <= _REFERENCE_GAP_S)

    def moved(self, begin: float, end: float) -> float:
        """Return the diagonal of the bounding box of all positions from `begin` to `end`, in metres."""
        inside = (self.time > begin) & (self.time < end)
        (x_0, y_0, _), (x_1, y_1, _) = self.at(begin), self.at(end)
        x, y = np.append(self.x[inside], (x_0, x_1)), np.append(self.y[inside], (y_0, y_1))
        return math.hypot(np.ptp(x), np.ptp(y))


@dataclass(frozen=True, slots=True)
class Measured:
    """A robot's sighting of a landmark. `time` is in seconds, and `bearing_rad` is relative to the robot's heading."""

    time: float
    landmark: int
    range_m: float
    bearing_rad: float


@dataclass(frozen=True, slots=True)
class Window:
    """The pose at the middle of a second, and each landmark's median range (m) and absolute bearing (rad)."""

    time: float
    x: float
    y: float
    heading: float
    seen: dict[int, tuple[float, float]]


def read_columns(path: Path, names: Sequence[str]) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Yield the place and the numbers of each line of a file, or raise a ModelError.

    The place is a path and a line number, for error messages. Numbers are separated by spaces, and comments begin with
    `#`.
    """
    text = read_bounded(path, LARGEST_FILE, ModelError).decode(errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        where = f"{path}, line {number}"
        try:
            values = tuple(float(word) for word in words)
        except ValueError:
            values = ()
        if len(values) != len(names) or not all(map(math.isfinite, values)):
            raise ModelError(f"{where}: expected {len(names)} numbers: {', '.join(names)}")
        yield where, values


def read_barcodes(folder: Path) -> dict[int, int]:
    """Return the subject of each barcode, or raise a ModelError.

    The subjects 1 to 5 are robots, and the subjects 6 to 20 are landmarks.
    """
    subjects: dict[int, int] = {}
    for where, (subject, barcode) in read_columns(folder / "Barcodes.dat", ("subject", "barcode")):
        if subject not in _SUBJECTS or barcode != int(barcode):
            raise ModelError(
                f"{where}: expected a subject from {_SUBJECTS[0]} to {_SUBJECTS[-1]} and its barcode"
            )
        subjects[int(barcode)] = int(subject)
    return subjects


def read_positions(folder: Path) -> dict[int, tuple[float, float]]:
    """Return the landmarks' positions in metres, from `Landmark_Groundtruth.dat`, or raise a ModelError."""
    path = folder / "Landmark_Groundtruth.dat"
    names = ("subject", "x (m)", "y (m)", "deviation of x", "deviation of y")
    positions = {}
    for where, (subject, x, y, _, _) in read_columns(path, names):
        if subject not in LANDMARKS:
            raise ModelError(f"{where}: expected a landmark's number, {LANDMARKS[0]} to {LANDMARKS[-1]}")
        positions[int(subject)] = (x, y)
    if not positions:
        raise ModelError(f"{path} holds no landmark")
    return positions


def read_track(folder: Path, robot: int) -> Track:
    """Return a robot's track from `RobotN_Groundtruth.dat`, or raise a ModelError."""
    path = folder / f"Robot{robot}_Groundtruth.dat"
    names = ("time (s)", "x (m)", "y (m)", "orientation (rad)")
    rows = np.array([values for _, values in read_columns(path, names)], dtype=np.float64).reshape(-1, 4)
    if not len(rows):
        raise ModelError(f"{path} holds no positions")
    if np.any(np.diff(rows[:, 0]) < 0):
        raise ModelError(f"{path}: its times do not rise")
    return Track(rows[:, 0], rows[:, 1], rows[:, 2], np.unwrap(rows[:, 3]))


def read_measured(folder: Path, robot: int, subjects: dict[int, int]) -> tuple[list[Measured], int]:
    """Return a robot's sightings of landmarks, and the number of omitted measurements.

    Measurements with an unknown barcode or a negative range are omitted.
    """
    path = folder / f"Robot{robot}_Measurement.dat"
    found, misread = [], 0
    for _, (time, barcode, away, bearing) in read_columns(
        path, ("time (s)", "barcode", "range (m)", "bearing (rad)")
    ):
        subject = subjects.get(int(barcode))
        if subject is None or away < 0:
            misread += 1
        elif subject in LANDMARKS:
            found.append(Measured(time, subject, away, bearing))
    return sorted(found, key=lambda each: each.time), misread


def windows(track: Track, measured: Sequence[Measured]) -> tuple[list[Window], Counter[str]]:
    """Return the one-second windows in which the robot saw enough landmarks and hardly moved.

    Also return the number of omitted windows for each reason.
    """
    kept: list[Window] = []
    left_out: Counter[str] = Counter()
    if not measured:
        return kept, left_out
    begin = measured[0].time
    by_window: dict[int, list[Measured]] = {}
    for each in measured:
        by_window.setdefault(math.floor((each.time - begin) / WINDOW_S), []).append(each)
    for number, inside in by_window.items():
        start, end = begin + number * WINDOW_S, begin + (number + 1) * WINDOW_S
        if not track.known(start, end):
            left_out["without a reference"] += 1
        elif track.moved(start, end) >= MOST_MOVED_M:
            left_out["moving"] += 1
        elif len({each.landmark for each in inside}) < LEAST_LANDMARKS:
            left_out[f"with fewer than {LEAST_LANDMARKS} landmarks"] += 1
        else:
            middle = (start + end) / 2
            x, y, heading = track.at(middle)
            kept.append(Window(middle, x, y, _wrapped(heading), _medians(track, inside)))
    return kept, left_out


def _medians(track: Track, sightings: Sequence[Measured]) -> dict[int, tuple[float, float]]:
    """Return the median range and absolute bearing (measured bearing plus heading) of each landmark."""
    seen = {}
    for landmark in sorted({each.landmark for each in sightings}):
        own = [each for each in sightings if each.landmark == landmark]
        bearings = np.array([each.bearing_rad + track.at(each.time)[2] for each in own])
        first = bearings[0]  # near the first bearing the circle is a line, which has a median
        away = np.median((bearings - first + math.pi) % (2 * math.pi) - math.pi)
        seen[landmark] = (float(np.median([each.range_m for each in own])), _wrapped(first + float(away)))
    return seen


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def write_recording(path: Path, kept: Sequence[Window]) -> None:
    """Write a CSV file for `casestudies.mrclam.player`, or raise an OutputError."""
    heading = ["time_s", "ref_x_m", "ref_y_m", "ref_std_m", "heading_rad"]
    heading += [name for number in LANDMARKS for name in (f"range_{number}_m", f"bearing_{number}_rad")]
    rows = []
    for each in kept:
        row = [
            f"{each.time:.3f}",
            f"{each.x:.4f}",
            f"{each.y:.4f}",
            f"{_REFERENCE_STD_M}",
            f"{each.heading:.4f}",
        ]
        for number in LANDMARKS:
            seen = each.seen.get(number)
            row += ["", ""] if seen is None else [f"{seen[0]:.3f}", f"{seen[1]:.4f}"]
        rows.append(row)
    _write(path, heading, rows)


def _write(path: Path, heading: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows([heading, *rows])
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from None


def robots_in(folder: Path) -> list[int]:
    """Return the numbers of the robots with measurements in the folder, or raise a ModelError."""
    found = sorted(
        int(match[1])
        for path in folder.glob("Robot*_Measurement.dat")
        if (match := re.match(r"Robot(\d+)_", path.name))
    )
    if not found:
        raise ModelError(
            f"{folder} does not hold a RobotN_Measurement.dat: name the folder that the data set was unpacked into"
        )
    return found


app = CommandLine()


@app.command(epilog="`python -m casestudies.mrclam.convert MRCLAM_Dataset1 -o DATA_DIR`")
def convert(
    folder: Annotated[
        Path,
        typer.Argument(
            help="The folder that the data set was unpacked into, with Barcodes.dat and all the others."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output-dir", "-o", help="Folder for landmarks.csv, and a file for each robot.", metavar="DIR"
        ),
    ],
    robot: Annotated[
        list[int] | None,
        typer.Option(help="A robot's number; repeat for more.", show_default="all", metavar="NUMBER"),
    ] = None,
) -> None:
    """Convert a downloaded data set into the case study's CSV files.

    A robot's file has a line for each second in which the robot moved less than 0.12 m and saw at least three
    landmarks.
    """
    subjects, positions = read_barcodes(folder), read_positions(folder)
    robots = robot or robots_in(folder)
    check_writable(output)
    places = [[str(number), f"{x:.4f}", f"{y:.4f}"] for number, (x, y) in sorted(positions.items())]
    _write(output / "landmarks.csv", ["landmark", "x_m", "y_m"], places)
    print(f"wrote {output / 'landmarks.csv'}: {len(places)} landmarks", flush=True)
    data_set = "".join(re.findall(r"\d+$", folder.resolve().name))
    for number in robots:
        measured, misread = read_measured(folder, number, subjects)
        kept, left_out = windows(read_track(folder, number), measured)
        reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(left_out.items())) or "none"
        said = f"{len(kept)} seconds; left out: {reasons}"
        if misread:
            said += f"; misread barcodes: {misread}"
        if not kept:
            warn(f"robot {number}: nothing to write, {said}")
            continue
        path = output / f"ds{data_set}_robot{number}.csv"
        write_recording(path, kept)
        print(f"wrote {path}: {said}", flush=True)


if __name__ == "__main__":
    app()
