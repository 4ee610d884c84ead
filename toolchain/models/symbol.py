"""Symbols: variables of a joint distribution, each with a type that defines its values, as in ProBT."""

import math
import re
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from toolchain.errors import ModelError
from toolchain.models.model import MAX_ENTRIES, check_size

_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?")
_NO_AND_YES: Final = ({"false", "true"}, {"no", "yes"}, {"off", "on"})
_YES: Final = {"true", "yes", "on"}


def _is_whole(number: object) -> bool:
    """Return whether a value is a Python or NumPy integer, because a user's file is not type-checked."""
    return isinstance(number, int | np.integer)


@dataclass(frozen=True, slots=True)
class IntegerType:
    """The whole numbers `low` to `high`; with `wraps` they are on a circle, and `high` is adjacent to `low`."""

    low: int
    high: int
    wraps: bool = False
    unit: str = ""
    step: ClassVar[float] = 1.0
    labels: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        if not (_is_whole(self.low) and _is_whole(self.high)):
            raise ModelError(f"an integer type from {self.low!r} to {self.high!r}: expected whole numbers")
        if self.high < self.low:
            raise ModelError(f"an integer type from {self.low} to {self.high} has no values")

    @property
    def size(self) -> int:
        """The number of values."""
        return self.high - self.low + 1

    @property
    def offset(self) -> float:
        """The first value."""
        return float(self.low)


@dataclass(frozen=True, slots=True)
class IntervalType:
    """The real numbers from `low` to `high`, divided into equal intervals, each represented by its centre.

    With `wraps` they are on a circle: `high` equals `low`, as for a bearing from 0 to 360.
    """

    low: float
    high: float
    intervals: int
    wraps: bool = False
    unit: str = ""
    labels: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        if not _is_whole(self.intervals):
            raise ModelError(
                f"[{self.low:g}, {self.high:g}] cannot be cut into {self.intervals!r} intervals: expected a whole number"
            )
        if self.intervals < 1 or not (math.isfinite(self.low) and self.low < self.high < math.inf):
            raise ModelError(f"[{self.low:g}, {self.high:g}] cannot be cut into {self.intervals} intervals")

    @property
    def size(self) -> int:
        """The number of values."""
        return self.intervals

    @property
    def offset(self) -> float:
        """The centre of the first interval."""
        return self.low + self.step / 2

    @property
    def step(self) -> float:
        """The width of an interval."""
        return (self.high - self.low) / self.intervals


@dataclass(frozen=True, slots=True, init=False)
class LabelType:
    """Named values. Their numbers are 0, 1, 2 ... in order, with two exceptions.

    Names that are equally spaced numbers (`10`, `20`, `30`) have these numbers. `false`, `no` and `off` are
    0, and `true`, `yes` and `on` are 1, regardless of the order, as in a ROS bool.
    """

    labels: tuple[str, ...]
    wraps: ClassVar[bool] = False  # named values are never on a circle
    unit: ClassVar[str] = ""

    def __init__(self, *labels: str) -> None:
        if not labels or not all(labels) or len(set(labels)) < len(labels):
            raise ModelError(
                f"a label type needs names that differ, not {', '.join(map(repr, labels)) or 'none'}"
            )
        object.__setattr__(self, "labels", labels)

    @property
    def size(self) -> int:
        """The number of values."""
        return len(self.labels)

    @property
    def offset(self) -> float:
        """The number of the first name."""
        return self._numbers()[0]

    @property
    def step(self) -> float:
        """Difference between the numbers of adjacent names."""
        return self._numbers()[1]

    def _numbers(self) -> tuple[float, float]:
        if {label.lower() for label in self.labels} in _NO_AND_YES:
            return (1.0, -1.0) if self.labels[0].lower() in _YES else (0.0, 1.0)
        if len(self.labels) > 1 and all(_NUMBER.fullmatch(label) for label in self.labels):
            values = [float(label) for label in self.labels]
            step = values[1] - values[0]
            slack = 1e-9 * max(map(abs, values))
            if step and all(abs(after - before - step) <= slack for before, after in pairwise(values)):
                return values[0], step
        return 0.0, 1.0


Type: TypeAlias = IntegerType | IntervalType | LabelType


@dataclass(frozen=True, slots=True)
class Symbol:
    """A variable: its name, its type, and the source of its readings if it is known."""

    name: str
    """Its name, which is also the field in the message unless `path` is given."""
    type: Type
    """Its values."""
    path: str = ""
    """Its path in the message; empty to search the message for the name."""
    bits: int = 0
    """Address bits of its column; 0 for the minimum."""
    on_range: Literal["error", "clamp", "missing"] = "error"
    """Treatment of a reading out of range: an error, the nearest end, or a missing reading."""
    on_missing: Literal["error", "missing"] = "error"
    """`missing` if a reading may be missing."""

    def __post_init__(self) -> None:
        if not self.name:
            raise ModelError("a symbol needs a name")
        check_size(f"the symbol {self.name!r}", self.type.size, MAX_ENTRIES)

    @property
    def size(self) -> int:
        """The number of values."""
        return self.type.size

    @property
    def period(self) -> int | None:
        """The number of values after which they repeat; None if they don't."""
        return self.type.size if self.type.wraps else None

    def values(self) -> NDArray[np.float64]:
        """Return its values as numbers, float64[size]."""
        values: NDArray[np.float64] = self.type.offset + np.arange(self.size) * np.float64(self.type.step)
        return values

    def index(self, label: str) -> int:
        """Return the index of the value with this label or number, or raise a ModelError."""
        if label in self.type.labels:
            return self.type.labels.index(label)
        if not self.type.labels and _NUMBER.fullmatch(label):
            place = (float(label) - self.type.offset) / self.type.step
            at = math.floor(place + 0.5)
            if 0 <= at < self.size:
                return at
        last = self.type.offset + (self.size - 1) * self.type.step
        expected = ", ".join(self.type.labels[:20]) or f"{self.type.offset:g} to {last:g}"
        raise ModelError(f"{self.name} is never {label!r}; expected {expected}")
