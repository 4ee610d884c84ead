"""Files of posteriors. JSON and CSV lines are appended to a file; a NumPy archive is always replaced as a whole."""

import contextlib
import csv
import io
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import IO, Any, Final

import orjson

from posteriors.axes import Axis
from posteriors.frame_report import FrameReport
from posteriors.pairing import FrameOutcome
from posteriors.posterior import Posterior
from services.errors import SettingsError

MOST_NUMBERS: Final = 1 << 26
"""Maximum number of probabilities in an archive (512 MiB), because they all stay in memory during the run."""
_EVERY: Final = 5.0
"""Minimum number of seconds between two writes of an archive."""
_SHARE: Final = 20
"""Minimum ratio of the pause after writing an archive to the duration of the writing."""
_NOT_KNOWN: Final = -1


class ResultFile(ABC):
    """A file of posteriors."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @abstractmethod
    def add(self, frame: FrameOutcome, axes: list[Axis]) -> None:
        """Save one frame, or raise a SettingsError if the file is unwritable or has posteriors of another shape."""

    @abstractmethod
    def close(self) -> None:
        """Write the frames that are not yet in the file. No frame may follow."""

    def _error(self, why: str | OSError) -> SettingsError:
        if isinstance(why, OSError):
            why = f"it cannot be written: {why.strerror or why}"
        return SettingsError(f"--save {self._path}: {why}")


def open_result_file(path: Path) -> ResultFile:
    """Open a result file, or raise a SettingsError if the ending of the name is unknown.

    The ending selects the format. An existing `.jsonl` or `.csv` file is appended to; a `.npz` file is overwritten.
    """
    kinds: dict[str, Callable[[Path], ResultFile]] = {
        ".jsonl": _JsonLines,
        ".csv": _CsvLines,
        ".npz": _Archive,
    }
    kind = kinds.get(path.suffix)
    if kind is None:
        raise SettingsError(
            f"--save {path}: the name must end with {', '.join(kinds)}, which selects the format"
        )
    return kind(path)


def record(frame: FrameOutcome, axes: list[Axis]) -> dict[str, Any]:
    """Return a frame as the JSON object for `--json` and `.jsonl` files.

    Indices count from 0. The object has `best_value` and `mean_value` only if a deployment maps indices to values.
    """
    known: dict[str, Any] = {"frame": frame.number, "stamp_ns": frame.stamp_ns, "cycles": frame.cycles}
    report = frame.report if isinstance(frame, Posterior) else frame
    if report is not None:
        readings = {name: reading._asdict() for name, reading in report.readings.items()}
        known |= {"missing": report.missing, "readings": readings}
    if not isinstance(frame, Posterior):
        return known | {"outcome": frame.outcome}
    # names of states have no mean, and without a deployment there are only indices
    best, mean = frame.best(), frame.mean()
    values: dict[str, Any] = {}
    if any(axis.dimension for axis in axes):
        values["best_value"] = {axis.label: axis.value(best[axis.label]) for axis in axes}
        values["mean_value"] = {
            axis.label: axis.value(mean[axis.label]) for axis in axes if not axis.has_states
        }
    if frame.details:
        values["details"] = frame.details
    return known | {
        "latency_us": frame.latency_us,
        "probability": frame.probability,
        "best": best,
        "mean": mean,
        **values,
        "labels": frame.labels,
        "sizes": frame.sizes,
        "probabilities": frame.probabilities,
    }


def cell_names(labels: Sequence[str], sizes: Sequence[int]) -> list[str]:
    """Return the names of all cells of a posterior, such as `y=1 x=2`, in the order of the probabilities."""
    cells = product(*(range(size) for size in sizes))
    return [" ".join(f"{label}={at}" for label, at in zip(labels, cell, strict=True)) for cell in cells]


def write_archive(
    file: IO[bytes], frames: Sequence[FrameReport | Posterior | None], axes: Sequence[Axis], **arrays: Any
) -> None:
    """Write an archive for `numpy.load`.

    The archive contains `arrays` and the values of the axes, and the number, the stamp and the cycles of each frame.
    """
    import numpy as np

    for name in ("frame", "stamp_ns", "cycles"):
        numbers = [getattr(each, "number" if name == "frame" else name, None) for each in frames]
        arrays[name] = [_NOT_KNOWN if number is None else number for number in numbers]
    for at, axis in enumerate(axes):
        arrays[f"axis{at}"] = [axis.value(index) for index in range(axis.size)]
    np.savez(file, **arrays)


class _Lines(ResultFile):
    """A file to which whole lines are appended, so that an interruption never leaves an incomplete line."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        # A descriptor instead of a file of Python, whose buffer would be written in parts. Readable, to look at what is
        # there already: the last byte, and the columns of a table.
        try:
            self._file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
            size = os.fstat(self._file).st_size
            if size and os.pread(self._file, 1, size - 1) != b"\n":
                os.close(self._file)
                raise self._error(
                    "its last line is incomplete, so nothing can be appended; give another name"
                )
        except OSError as error:
            raise self._error(error) from error

    def _write(self, line: bytes) -> None:
        written = 0
        try:
            # a full disk takes a part of a line, and only then refuses
            while written < len(line):
                written += os.write(self._file, line[written:])
        except OSError as error:
            self._take_back(written)
            raise self._error(error) from error

    def _take_back(self, written: int) -> None:
        """Remove an incompletely written line, unless another process has appended to the file since."""
        with contextlib.suppress(OSError):
            # after an append the position is behind our own bytes, whatever others have appended before
            end = os.lseek(self._file, 0, os.SEEK_CUR)
            if written and os.fstat(self._file).st_size == end:
                os.ftruncate(self._file, end - written)

    def close(self) -> None:
        """Close the file; everything is already written."""
        os.close(self._file)


class _JsonLines(_Lines):
    def add(self, frame: FrameOutcome, axes: list[Axis]) -> None:
        """Append one frame as a JSON object."""
        self._write(orjson.dumps(record(frame, axes)) + b"\n")


class _CsvLines(_Lines):
    """One row per posterior: frame number, times, the most probable cell, and a column for every cell."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        # Of the rows written so far; None before the first one, which writes them or compares them with the file.
        self._columns: list[str] | None = None

    def add(self, frame: FrameOutcome, axes: list[Axis]) -> None:
        """Append one row, except for a frame without a posterior."""
        if not isinstance(frame, Posterior):
            return
        # compared at every row: a stack that was started again may have another model
        columns = [
            *("frame", "stamp_ns", "cycles", "latency_us"),
            *(axis.label for axis in axes),
            "probability",
            *cell_names([axis.label for axis in axes], [axis.size for axis in axes]),
        ]
        if columns != self._columns:
            self._begin(columns)
        best = frame.best()
        self._row(
            [
                *(frame.number, frame.stamp_ns, frame.cycles, frame.latency_us),
                *(axis.value(best[axis.label]) for axis in axes),
                frame.probability,
                *frame.probabilities,
            ]
        )

    def _begin(self, columns: list[str]) -> None:
        # columns go only into an empty file; rows of the same shape may be appended on another day
        if self._columns is None and not os.fstat(self._file).st_size:
            self._row(columns)
        else:
            with self._path.open(newline="", encoding="utf-8") as file:
                there = next(csv.reader(file), [])
            if there != columns:
                raise self._error("it has columns of another posterior; give another name")
        self._columns = columns

    def _row(self, cells: list[Any]) -> None:
        row = io.StringIO(newline="")
        csv.writer(row, lineterminator="\n").writerow(cells)
        self._write(row.getvalue().encode())


class _Archive(ResultFile):
    """An archive for `numpy.load`, replaced by a complete new one every few seconds and at the end."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        # All posteriors so far, which have one shape and the axes of the first: an archive cannot be appended to.
        self._posteriors: list[Posterior] = []
        self._axes: list[Axis] = []
        # How many of them the archive on disk has, and when it is written again (monotonic, s).
        self._written = 0
        self._next = time.monotonic() + _EVERY
        # checked now, and not at the first write, some seconds into a run that may not be repeatable
        if not os.access(path.parent, os.W_OK):
            raise self._error("it cannot be written: the folder is not writable")

    def add(self, frame: FrameOutcome, axes: list[Axis]) -> None:
        """Add the posterior of the frame, if it has one."""
        if not isinstance(frame, Posterior):
            return
        if not self._axes:
            self._axes = axes
        elif axes != self._axes:
            raise self._error("a posterior of another shape arrived, which does not fit; .jsonl supports it")
        if (len(self._posteriors) + 1) * len(frame.probabilities) > MOST_NUMBERS:
            raise self._error(
                f"it is full with {len(self._posteriors)} posteriors, {MOST_NUMBERS} probabilities; .jsonl has no limit"
            )
        self._posteriors.append(frame)
        if time.monotonic() >= self._next:
            # the whole archive is written each time, so large ones are written less often
            begun = time.monotonic()
            self.close()
            ended = time.monotonic()
            self._next = ended + max(_EVERY, _SHARE * (ended - begun))

    def close(self) -> None:
        """Write the posteriors that are not yet in the archive."""
        if self._written == len(self._posteriors):
            return
        import numpy as np

        posteriors = self._posteriors
        values = np.array([each.probabilities for each in posteriors])
        # a reader, or an interrupted run, finds either the last archive or this one
        partial = self._path.with_name(f".{self._path.name}.part")
        try:
            with partial.open("wb") as file:
                write_archive(
                    file,
                    posteriors,
                    self._axes,
                    probabilities=values.reshape(-1, *posteriors[0].sizes),
                    latency_us=np.array([each.latency_us for each in posteriors], np.float64),
                    labels=[axis.label for axis in self._axes],
                )
            partial.replace(self._path)
        except OSError as error:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
            raise self._error(error) from error
        self._written = len(posteriors)
