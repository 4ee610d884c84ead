"""Recorded readings with ground truth, as columns: from CSV files, MCAP files and bags.

The header of a CSV file names the columns. A column of a bag is TOPIC:PATH, such as `/scan:ranges[3]`. Each message
on the topic of the first column is a row of the bag. On every other topic, the row takes the message nearest in time.
"""

import csv
import math
import re
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from io import TextIOWrapper
from pathlib import Path
from typing import Any, Final, TextIO

from toolchain.bounded_files import open_regular
from toolchain.errors import BuildError, ModelError
from toolchain.flags import key_values

MAX_ROWS: Final = 2_000_000
_LONGEST_LINE: Final = 1 << 20

_STAMP_UNITS: Final = {"stamp_ns": 1, "time_s": 10**9}
"""Names of a time column in CSV files that this project writes, each with the nanoseconds in the column's unit."""
_STEP: Final = re.compile(r"(\w+)((?:\[\d{1,9}\])*)")


@dataclass(frozen=True, slots=True)
class Recording:
    """The requested columns of a recording."""

    path: Path
    """The file."""
    rows: int
    """The number of rows."""
    columns: dict[str, list[object]]
    """For each column name, the values of all rows. A value is a number, a text, or None if it is missing."""
    stamps: tuple[int, ...] = ()
    """The time of each row in nanoseconds. For a CSV file, there are times only if its time column was read."""


def read_recording(
    path: Path, columns: Iterable[str], *, tolerance_s: float = 0.1, stamped: bool = False
) -> Recording:
    """Return the named columns of a recording: a CSV file (`.csv`), an MCAP file, a ROS 1 bag or a ROS 2 bag's folder.

    In a bag, each message on the topic of the first column is a row. The stamps of the other topics may differ from
    the row's stamp by `tolerance_s`. With `stamped`, the stamps of a CSV file come from its column `stamp_ns` or
    `time_s`.

    Raises:
        ModelError: The recording is missing or damaged, lacks a column, or has more than `MAX_ROWS` rows. If a
            column is missing, the message lists the existing columns.
    """
    if not path.exists():
        raise ModelError(f"the recording {path} does not exist")
    once = list(dict.fromkeys(columns))
    if path.suffix.lower() == ".csv":
        return _read_csv(path, once, stamped=stamped)
    return _read_bag(path, once, round(tolerance_s * 1e9))


def reading_columns(names: Sequence[str], given: Sequence[str]) -> dict[str, str]:
    """Return the name of the column of each variable.

    Without `given`, the column has the variable's name. `given` contains `PATTERN=COLUMN` for variables whose names
    match PATTERN. All other variables then have no column.

    Raises:
        BuildError: No variable matches a pattern.
    """
    if not given:
        return {name: name for name in names}
    columns: dict[str, str] = {}
    for pattern, column in key_values(given, "--reading", "range=COLUMN").items():
        before, star, after = pattern.partition("*")
        fitting = [
            name
            for name in names
            if (
                name.startswith(before) and name.endswith(after) and len(name) >= len(before) + len(after)
                if star
                else name == pattern
            )
        ]
        if not fitting:
            raise BuildError(
                f"--reading {pattern}: not a known variable of the model; expected one of {', '.join(names[:20])}"
            )
        for name in fitting:
            same = name[len(before) : len(name) - len(after)] if star else ""
            columns[name] = column.replace("*", same)
    return columns


def _read_csv(path: Path, columns: Sequence[str], *, stamped: bool) -> Recording:
    found: dict[str, list[object]] = {column: [] for column in columns}
    stamps: list[int] = []
    rows = 0
    try:
        with TextIOWrapper(open_regular(path, ModelError), encoding="utf-8-sig", newline="") as file:
            lines = csv.reader(_lines(path, file), strict=True)
            heading = [name.strip() for name in next(lines, [])]
            places = {column: _place(path, heading, column) for column in found}
            stamp_column = next((name for name in _STAMP_UNITS if stamped and name in heading), None)
            for line in lines:
                if not line:
                    continue
                if len(line) != len(heading):
                    raise ModelError(
                        f"{path}, line {lines.line_num}: {len(line)} values, but the heading has {len(heading)}"
                    )
                rows += 1
                _check_rows(path, rows)
                for column, place in places.items():
                    found[column].append(_cell(line[place]))
                if stamp_column is not None:
                    text = line[_place(path, heading, stamp_column)]
                    stamps.append(_stamp(text, stamp_column, f"{path}, line {lines.line_num}"))
            if not rows:
                raise ModelError(f"{path} has a heading and no rows")
    except OSError as reason:
        raise ModelError(f"{path} cannot be read: {reason.strerror or reason}") from None
    except UnicodeDecodeError:
        raise ModelError(
            f"{path} is not a CSV file: it is not UTF-8 text, at the line after {lines.line_num} or later"
        ) from None
    except csv.Error as reason:
        raise ModelError(f"{path} is not a CSV file: {reason}") from None
    return Recording(path, rows, found, tuple(stamps))


def _stamp(text: str, column: str, where: str) -> int:
    """Return a stamp in nanoseconds, computed without floats, which would round it."""
    with suppress(ArithmeticError):  # not a number, or NaN
        stamp = Decimal(text.strip()) * _STAMP_UNITS[column]
        if 0 <= stamp < 1 << 63:
            return round(stamp)
    raise ModelError(
        f"{where}: {column} is {text[:80]!r}, expected a time that is not negative; correct it, or rename the column"
    )


def _lines(path: Path, file: TextIO) -> Iterator[str]:
    """Yield the lines of a file, each of bounded length."""
    while line := file.readline(_LONGEST_LINE + 1):
        if len(line) > _LONGEST_LINE:
            raise ModelError(f"{path} is not a CSV file: a line has more than {_LONGEST_LINE} characters")
        yield line


def _check_rows(path: Path, rows: int) -> None:
    if rows > MAX_ROWS:
        raise ModelError(f"{path} has more than {MAX_ROWS} rows or messages, the maximum")


def _check_topics(path: Path, topics: Sequence[str], there: set[str]) -> None:
    for topic in topics:
        if topic not in there:
            raise ModelError(f"{path} has no topic {topic!r}; it has {_listed(sorted(there))}")


def _place(path: Path, heading: Sequence[str], column: str) -> int:
    if heading.count(column) == 1:
        return heading.index(column)
    if column in heading:
        message = f"{path} has the column {column!r} {heading.count(column)} times; give each its own name"
    elif not heading:
        message = f"{path} is empty; expected a heading with the columns' names"
    elif len(heading) == 1 and (sign := next((each for each in ";\t|" if each in heading[0]), None)):
        message = (
            f"{path} has {sign!r} between its values, expected commas: its heading is {heading[0][:80]!r}; export it "
            "with commas, and points in the numbers"
        )
    else:
        message = f"{path} has no column {column!r}; it has {_listed(heading)}"
    raise ModelError(message)


def _cell(text: str) -> object:
    text = text.strip()
    if not text:
        return None
    try:
        return float(text)
    except ValueError:
        return text


def _read_bag(path: Path, columns: Sequence[str], tolerance_ns: int) -> Recording:
    """Read a bag with rosbags; the topic of the first column defines the rows."""
    topics: dict[str, list[str]] = {}
    for column in columns:
        topic, colon, _ = column.partition(":")
        if not colon:
            raise ModelError(
                f"the column {column!r} of {path}: in a bag a column is TOPIC:PATH, such as /scan:ranges[3]"
            )
        topics.setdefault(topic, []).append(column)
    times: dict[str, list[int]] = {topic: [] for topic in topics}
    values: dict[str, list[object]] = {column: [] for column in columns}
    for topic, stamp, message in _messages(path, tuple(topics)):
        times[topic].append(stamp)
        for column in topics[topic]:
            values[column].append(_field(message, column.partition(":")[2]))
    base = next(iter(topics))
    found: dict[str, list[object]] = {}
    for topic, names in topics.items():
        nearest = [_nearest(times[topic], stamp, tolerance_ns) for stamp in times[base]]
        for column in names:
            found[column] = [None if at is None else values[column][at] for at in nearest]
    return Recording(path, len(times[base]), found, tuple(times[base]))


def _messages(path: Path, topics: tuple[str, ...]) -> Iterator[tuple[str, int, Any]]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise ModelError(f"{path} is not a CSV file, and bags need rosbags: pip install rosbags") from None
    count = 0
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            _check_topics(path, topics, {connection.topic for connection in reader.connections})
            wanted = [connection for connection in reader.connections if connection.topic in topics]
            for connection, stamp, raw in reader.messages(connections=wanted):
                count += 1
                _check_rows(path, count)
                yield connection.topic, stamp, reader.deserialize(raw, connection.msgtype)
    except ModelError:
        raise
    except Exception as reason:  # rosbags supports many formats, and each fails in its own way
        text = " ".join(str(reason).split())[:200]
        raise ModelError(
            f"{path} cannot be read as a bag, after {count} messages: {text or type(reason).__name__}"
        ) from None


def _field(message: Any, path: str) -> object:
    """Return a field of a message; None for NaN, a missing value, or an index beyond an array."""
    value = message
    for step in path.split("."):
        match = _STEP.fullmatch(step)
        if match is None:
            raise ModelError(f"{path!r} is not a path; expected one such as pose.position.x or ranges[3]")
        if match[1].startswith("_") or match[1] not in getattr(value, "__dataclass_fields__", {}):
            raise ModelError(f"the message has no field {match[1]!r} of {path!r}")
        value = getattr(value, match[1])
        for index in re.findall(r"\d+", match[2]):
            if not hasattr(value, "__len__") or int(index) >= len(value):
                return None
            value = value[int(index)]
    with suppress(AttributeError):
        value = value.item()  # NumPy's scalars
    return None if isinstance(value, float) and math.isnan(value) else value


def _nearest(times: Sequence[int], stamp: int, tolerance: int) -> int | None:
    after = bisect_left(times, stamp)
    near = [at for at in (after - 1, after) if 0 <= at < len(times) and abs(times[at] - stamp) <= tolerance]
    return min(near, key=lambda at: abs(times[at] - stamp), default=None)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")
