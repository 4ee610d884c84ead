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
    """Return the landmarks of a CSV file with the columns landmark, x_m and y_m, in the file's order.

    Raises:
        ModelError: The file cannot be read, has other columns or an invalid line, or has a landmark twice or
            none.
    """
    found: list[Landmark] = []
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file)
            for row in rows:
                found.append(_landmark(row, f"{path}, line {rows.line_num}"))
                if found[-1].number in {landmark.number for landmark in found[:-1]}:
                    raise ModelError(
                        f"{path}, line {rows.line_num}: landmark {found[-1].number} is listed twice"
                    )
    except OSError as reason:
        raise ModelError(f"the landmarks' file {path} cannot be read: {reason.strerror or reason}") from None
    except (UnicodeDecodeError, csv.Error) as reason:
        raise ModelError(f"{path} is not a CSV of landmarks: {reason}") from None
    if not found:
        raise ModelError(
            f"{path} does not hold landmarks; expected the columns landmark, x_m, y_m and a line for each"
        )
    return tuple(found)


def _landmark(row: dict[str, str], where: str) -> Landmark:
    try:
        landmark = Landmark(int(row["landmark"]), float(row["x_m"]), float(row["y_m"]))
    except KeyError as missing:
        raise ModelError(f"{where}: there is no column {missing}; expected landmark, x_m and y_m") from None
    except (TypeError, ValueError) as reason:
        raise ModelError(f"{where} is not a landmark: {reason}") from None
    if landmark.number < 0 or not (math.isfinite(landmark.x) and math.isfinite(landmark.y)):
        raise ModelError(f"{where} is not a landmark: expected a number from 0 and a finite position")
    return landmark
