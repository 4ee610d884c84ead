"""Posteriors in a file: JSON or CSV lines that are appended, or one NumPy archive that is always whole."""

from __future__ import annotations

import contextlib
import csv
import io
import os
import time
from itertools import product
from pathlib import Path
from typing import Any, Final, Protocol

import orjson

from posteriors.pairing import FrameOutcome
from posteriors.posterior import Posterior
from services.errors import SettingsError
from services.output.posterior_picture import Axis

MOST_NUMBERS: Final = 1 << 26
"""Probabilities that an archive may hold (512 MiB): it is in memory until it is written."""
_EVERY: Final = 5.0
"""Seconds after which an archive is written again."""
_SHARE: Final = 20
"""An archive is written so rarely that writing takes at most one in so many parts of the time."""
_NOT_KNOWN: Final = -1


class ResultFile(Protocol):
    """Where posteriors are saved."""

    def add(self, heard: FrameOutcome, axes: list[Axis]) -> None:
        """Save one frame.

        Raises:
            SettingsError: it cannot be written, or is of another form than what the file holds.
        """

    def close(self) -> None:
        """Have everything in the file."""


def open_result_file(path: Path) -> ResultFile:
    """The file of a name: `.jsonl` and `.csv` go on where they ended, `.npz` is made anew.

    Raises:
        SettingsError: another ending, or the file cannot be written.
    """
    kinds: dict[str, type[_JsonLines | _CsvLines | _Archive]] = {
        ".jsonl": _JsonLines,
        ".csv": _CsvLines,
        ".npz": _Archive,
    }
    kind = kinds.get(path.suffix)
    if kind is None:
        msg = f"--save {path}: the name must end with {', '.join(kinds)}, which says the form"
        raise SettingsError(msg)
    return kind(path)


def record(heard: FrameOutcome, axes: list[Axis]) -> dict[str, Any]:
    """A frame as a JSON object: what `--json` prints and a `.jsonl` file holds.

    Indices count from 0; `best_value` and `mean_value` are there where a deployment says what they stand for.
    """
    if not isinstance(heard, Posterior):
        return {
            "frame": heard.number,
            "stamp_ns": heard.stamp_ns,
            "cycles": heard.cycles,
            "outcome": heard.outcome,
        }
    best, mean = heard.best(), heard.mean()
    known: dict[str, Any] = {}
    if any(axis.dimension for axis in axes):
        known["best_value"] = {axis.label: axis.value(best[axis.label]) for axis in axes}
        known["mean_value"] = {
            axis.label: axis.value(mean[axis.label]) for axis in axes if not axis.has_states
        }
    return {
        "frame": heard.number,
        "stamp_ns": heard.stamp_ns,
        "cycles": heard.cycles,
        "latency_us": heard.latency_us,
        "probability": heard.probability,
        "best": best,
        "mean": mean,
        **known,
        "labels": heard.labels,
        "sizes": heard.sizes,
        "probabilities": heard.probabilities,
    }


class _Lines:
    """A file to which whole lines are appended: what ends the process ends it between two lines."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
            size = os.fstat(self._file).st_size
            if size and os.pread(self._file, 1, size - 1) != b"\n":
                os.close(self._file)
                msg = f"--save {path}: its last line has no end, so nothing can be added; give another name"
                raise SettingsError(msg)
        except OSError as error:
            raise _not_writable(path, error) from error

    def _write(self, line: bytes) -> None:
        written = 0
        try:
            while written < len(line):
                written += os.write(self._file, line[written:])
        except OSError as error:
            self._take_back(written)
            raise _not_writable(self._path, error) from error

    def _take_back(self, written: int) -> None:
        """Cut off the line that was begun, so that others can be added when there is room, unless another process wrote since."""
        with contextlib.suppress(OSError):
            end = os.lseek(self._file, 0, os.SEEK_CUR)
            if written and os.fstat(self._file).st_size == end:
                os.ftruncate(self._file, end - written)

    def close(self) -> None:
        """Everything is in the file already."""
        os.close(self._file)


class _JsonLines(_Lines):
    def add(self, heard: FrameOutcome, axes: list[Axis]) -> None:
        """Append one object."""
        self._write(orjson.dumps(record(heard, axes)) + b"\n")


class _CsvLines(_Lines):
    """A row a posterior: number, times, the most probable cell, and a column for every cell."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._columns: list[str] | None = None

    def add(self, heard: FrameOutcome, axes: list[Axis]) -> None:
        """Append one row; a frame without a posterior has none."""
        if not isinstance(heard, Posterior):
            return
        columns = [
            *("frame", "stamp_ns", "cycles", "latency_us"),
            *(axis.label for axis in axes),
            "probability",
            *(
                " ".join(f"{axis.label}={at}" for axis, at in zip(axes, cell, strict=True))
                for cell in product(*(range(axis.size) for axis in axes))
            ),
        ]
        if columns != self._columns:
            self._begin(columns)
        best = heard.best()
        self._row(
            [
                *(heard.number, heard.stamp_ns, heard.cycles, heard.latency_us),
                *(axis.value(best[axis.label]) for axis in axes),
                heard.probability,
                *heard.probabilities,
            ]
        )

    def _begin(self, columns: list[str]) -> None:
        if self._columns is None and not os.fstat(self._file).st_size:
            self._row(columns)
        else:
            with self._path.open(newline="", encoding="utf-8") as file:
                there = next(csv.reader(file), [])
            if there != columns:
                msg = f"--save {self._path}: it has columns of another posterior; give another name"
                raise SettingsError(msg)
        self._columns = columns

    def _row(self, cells: list[Any]) -> None:
        row = io.StringIO(newline="")
        csv.writer(row, lineterminator="\n").writerow(cells)
        self._write(row.getvalue().encode())


class _Archive:
    """An archive for `numpy.load`, written anew every few seconds and at the end, under another name until it is whole."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._heard: list[Posterior] = []
        self._axes: list[Axis] = []
        self._written = 0
        self._next = time.monotonic() + _EVERY
        if not os.access(path.parent, os.W_OK):
            raise _not_writable(path, FileNotFoundError(2, "no folder there that can be written"))

    def add(self, heard: FrameOutcome, axes: list[Axis]) -> None:
        """Keep one; a frame without a posterior has none."""
        if not isinstance(heard, Posterior):
            return
        if not self._axes:
            self._axes = axes
        elif axes != self._axes:
            msg = f"--save {self._path}: a posterior of another form came, which one array cannot hold; .jsonl can"
            raise SettingsError(msg)
        if (len(self._heard) + 1) * len(heard.probabilities) > MOST_NUMBERS:
            msg = f"--save {self._path}: it is full with {len(self._heard)} posteriors, {MOST_NUMBERS} probabilities; .jsonl has no limit"
            raise SettingsError(msg)
        self._heard.append(heard)
        if time.monotonic() >= self._next:
            begun = time.monotonic()
            self.close()
            ended = time.monotonic()
            self._next = ended + max(_EVERY, _SHARE * (ended - begun))

    def close(self) -> None:
        """Write what is not written yet."""
        if self._written == len(self._heard):
            return
        import numpy as np

        heard = self._heard
        arrays: dict[str, Any] = {
            "probabilities": np.array([each.probabilities for each in heard]).reshape(-1, *heard[0].sizes),
            "frame": np.array([_NOT_KNOWN if each.number is None else each.number for each in heard]),
            "stamp_ns": np.array([_NOT_KNOWN if each.stamp_ns is None else each.stamp_ns for each in heard]),
            "cycles": np.array([_NOT_KNOWN if each.cycles is None else each.cycles for each in heard]),
            "latency_us": np.array([each.latency_us for each in heard], np.float64),
            "labels": np.array([axis.label for axis in self._axes]),
        }
        for at, axis in enumerate(self._axes):
            arrays[f"axis{at}"] = np.array([axis.value(index) for index in range(axis.size)])
        partial = self._path.with_name(f".{self._path.name}.part")
        try:
            with partial.open("wb") as file:
                np.savez(file, **arrays)
            partial.replace(self._path)
        except OSError as error:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
            raise _not_writable(self._path, error) from error
        self._written = len(heard)


def _not_writable(path: Path, error: OSError) -> SettingsError:
    return SettingsError(f"--save {path}: it cannot be written: {error.strerror or error}")
