"""The landmarks' surveyed positions, from the data set's CSV."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

from toolchain.errors import ModelError


@dataclass(frozen=True, slots=True)
class Landmark:
    """A landmark's number and its position in metres."""

    number: int
    x: float
    y: float


def read_landmarks(path: Path) -> tuple[Landmark, ...]:
    """Return the landmarks of a CSV with the columns landmark, x_m and y_m, in the file's order.

    Raises:
        ModelError: The file can't be read, has other columns, a line that is no landmark, one twice, or none.
    """
    found: list[Landmark] = []
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file)
            for row in rows:
                found.append(_landmark(row, f"{path}, line {rows.line_num}"))
                if found[-1].number in {landmark.number for landmark in found[:-1]}:
                    message = f"{path}, line {rows.line_num}: landmark {found[-1].number} is there twice"
                    raise ModelError(message)
    except OSError as reason:
        message = f"the landmarks' file {path} can't be read: {reason.strerror or reason}"
        raise ModelError(message) from None
    except (UnicodeDecodeError, csv.Error) as reason:
        message = f"{path} is no CSV of landmarks: {reason}"
        raise ModelError(message) from None
    if not found:
        message = f"{path} holds no landmarks; expected the columns landmark, x_m, y_m and a line for each"
        raise ModelError(message)
    return tuple(found)


def _landmark(row: dict[str, str], where: str) -> Landmark:
    try:
        landmark = Landmark(int(row["landmark"]), float(row["x_m"]), float(row["y_m"]))
    except KeyError as missing:
        message = f"{where}: there is no column {missing}; expected landmark, x_m and y_m"
        raise ModelError(message) from None
    except (TypeError, ValueError) as reason:
        message = f"{where} is no landmark: {reason}"
        raise ModelError(message) from None
    if landmark.number < 0 or not (math.isfinite(landmark.x) and math.isfinite(landmark.y)):
        message = f"{where} is no landmark: expected a number from 0 and a finite position"
        raise ModelError(message)
    return landmark
