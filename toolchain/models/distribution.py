"""Joint distributions as in the library ProBT, made of symbols and factors.

A factor is a table, a normal distribution, a function or a potential. Every factor becomes a table. For a normal
distribution, each value of the symbol stands for an interval. The entry of the value is the integral of the normal
distribution over this interval. For a function, the entry of the function's value is 1, and all other entries are 0.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolchain.bounded_files import nearest_name
from toolchain.deployment import Dimension
from toolchain.errors import ModelError
from toolchain.models.conditional import normal_table, wrapped_normal_table
from toolchain.models.model import MAX_ENTRIES, Normal, check_size, dimension

NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?")
_NO_AND_YES: Final = ({"false", "true"}, {"no", "yes"}, {"off", "on"})
NO: Final = frozenset({"false", "no", "off"})
YES: Final = frozenset({"true", "yes", "on"})


def _is_whole(number: object) -> bool:
    """Return whether a value is a Python or NumPy integer; a user's file is not type-checked."""
    return isinstance(number, int | np.integer)


@dataclass(frozen=True, slots=True)
class IntegerType:
    """The whole numbers from `low` to `high`, each times `scale`. A reading between two values counts as the nearer.

    With `wraps`, the values are on a circle, where `high` is adjacent to `low`.
    """

    low: int
    high: int
    wraps: bool = False
    unit: str = ""
    scale: float = 1.0
    labels: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        if not (_is_whole(self.low) and _is_whole(self.high)):
            raise ModelError(f"an integer type from {self.low!r} to {self.high!r}: expected whole numbers")
        if self.high < self.low:
            raise ModelError(f"an integer type from {self.low} to {self.high} has no values")
        if not 0 < self.scale < math.inf:
            raise ModelError(f"an integer type with a scale of {self.scale:g}: expected a positive number")

    @property
    def size(self) -> int:
        """The number of values."""
        return self.high - self.low + 1

    @property
    def offset(self) -> float:
        """The first value."""
        return self.low * self.scale

    @property
    def step(self) -> float:
        """Difference between adjacent values."""
        return self.scale


@dataclass(frozen=True, slots=True)
class IntervalType:
    """The real numbers from `low` to `high`, divided into equal intervals. Each interval is represented by its centre.

    With `wraps`, the numbers are on a circle, where `high` and `low` are one point. An example is a bearing from 0
    to 360 degrees.
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
                f"[{self.low:g}, {self.high:g}] cannot be cut into {self.intervals!r} intervals: "
                "expected a whole number"
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
    """Named values. The names stand for the numbers 0, 1, 2 ... in order, with two exceptions.

    If the names are equally spaced numbers (`10`, `20`, `30`), each name stands for its number. If the two names are
    `false` and `true`, `no` and `yes`, or `off` and `on`, then `false`, `no` or `off` stands for 0 and the second name
    of the pair for 1, also if the type lists the names in the opposite order. A ROS bool has the same numbers.
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
        """The number that stands for the first name."""
        return self._numbers()[0]

    @property
    def step(self) -> float:
        """The difference from each name's number to the next name's number. It is negative if the numbers fall."""
        return self._numbers()[1]

    def _numbers(self) -> tuple[float, float]:
        if {label.lower() for label in self.labels} in _NO_AND_YES:
            return (1.0, -1.0) if self.labels[0].lower() in YES else (0.0, 1.0)
        if len(self.labels) > 1 and all(NUMBER.fullmatch(label) for label in self.labels):
            values = [float(label) for label in self.labels]
            step = values[1] - values[0]
            slack = 1e-9 * max(map(abs, values))
            if step and all(abs(after - before - step) <= slack for before, after in pairwise(values)):
                return values[0], step
        return 0.0, 1.0


Type: TypeAlias = IntegerType | IntervalType | LabelType


@dataclass(frozen=True, slots=True)
class Symbol:
    """A variable with its name and type. For a known variable, `path` is the place of its readings in the message."""

    name: str
    """Name of the symbol. If `path` is empty, the symbol's field in the message also has this name."""
    type: Type
    """The type, which defines the symbol's values."""
    path: str = ""
    """Path of the symbol's field in the message. If the path is empty, the message is searched for the name."""
    bits: int = 0
    """Number of address bits of the symbol's column in the machine. 0 means the fewest bits that suffice."""
    on_range: Literal["error", "clamp", "missing"] = "error"
    """Treatment of a reading out of range: as an error, as the nearest value in range (`clamp`), or as missing."""
    on_missing: Literal["error", "missing"] = "error"
    """Treatment of a message that lacks the symbol's reading: as an error, or as a missing reading (`missing`)."""

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
        """The number of values in a full turn if the symbol's type wraps, or None if it does not."""
        return self.type.size if self.type.wraps else None

    def values(self) -> NDArray[np.float64]:
        """Return the symbol's values as numbers, float64[size]."""
        values: NDArray[np.float64] = self.type.offset + np.arange(self.size) * np.float64(self.type.step)
        return values

    def shown(self, at: int) -> str:
        """Return the value with the index `at` as its label or number."""
        return self.type.labels[at] if self.type.labels else f"{self.values()[at]:g}"

    @property
    def reading(self) -> dict[str, Any]:
        """Keyword arguments of `Known` and `PriorSelect` that describe the symbol. The caller adds the table."""
        return {
            "name": self.name,
            "bits": self.bits,
            "offset": self.type.offset,
            "step": self.type.step,
            "unit": self.type.unit,
            "period": self.period,
            "on_range": self.on_range,
            "on_missing": self.on_missing,
            "path": self.path,
            "states": self.type.labels,
        }

    def dimension(self) -> Dimension:
        """Return the symbol as a searched dimension, or raise a ModelError."""
        return dimension(
            self.name,
            size=self.size,
            offset=self.type.offset,
            step=self.type.step,
            unit=self.type.unit,
            states=self.type.labels,
        )

    def index(self, label: str) -> int:
        """Return the index of the value with this label or number, or raise a ModelError if there is none."""
        if label in self.type.labels:
            return self.type.labels.index(label)
        if not self.type.labels and NUMBER.fullmatch(label):
            place = (float(label) - self.type.offset) / self.type.step
            at = math.floor(place + 0.5)
            if 0 <= at < self.size:
                return at
        last = self.type.offset + (self.size - 1) * self.type.step
        expected = f"expected {self.type.offset:g} to {last:g}"
        if self.type.labels:
            expected = nearest_name(label, self.type.labels, cutoff=0.6)
        if "," in label and "=" in label:
            expected += "; repeat --given for each variable"
        raise ModelError(f"{self.name} is never {label!r}; {expected}")


Formula: TypeAlias = Callable[..., ArrayLike] | ArrayLike
"""Constant numbers, or a function. The function gets the values of each parent as float64 arrays of equal shape."""

_SUM_TOLERANCE: Final = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Distribution:
    """P(symbol | given) as a table."""

    symbol: Symbol
    """The symbol of the distribution."""
    given: tuple[Symbol, ...]
    """The parents: the symbols on which `symbol` depends."""
    table: NDArray[np.float64]
    """float64[size of the symbol, size of each parent]. The sum over the first axis is 1."""
    normal: Normal | None = None
    """The normal distributions from which the table was computed, or None. Their arrays have an entry for each
    combination of the parents' values. The last parent varies fastest.
    """

    @property
    def scope(self) -> tuple[Symbol, ...]:
        """The symbols of the table's axes, in order."""
        return (self.symbol, *self.given)

    @property
    def title(self) -> str:
        """The distribution as text: P(A | B, C)."""
        return _title(self.symbol, self.given)

    def __repr__(self) -> str:
        return f"Distribution({self.title}, {_sizes(self.table)})"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Potential:
    """A factor of the joint distribution that need not be a distribution: a non-negative function of some symbols."""

    scope: tuple[Symbol, ...]
    """The symbols of the table's axes, in order."""
    table: NDArray[np.float64]
    """float64[size of each symbol], each number at least 0."""

    @property
    def title(self) -> str:
        """The potential as text."""
        return f"the potential of {', '.join(each.name for each in self.scope)}"

    def __repr__(self) -> str:
        return f"Potential({', '.join(each.name for each in self.scope)}, {_sizes(self.table)})"


Factor: TypeAlias = Distribution | Potential


def table(symbol: Symbol, values: ArrayLike, *, given: Sequence[Symbol] = ()) -> Distribution:
    """Return P(symbol | given) from numbers, float64[size of the symbol, size of each parent in `given`].

    Raises:
        ModelError: The shape is wrong, a number is not a probability, or the sum over the symbol's values is not 1.
    """
    given = tuple(given)
    scope = _scope(symbol, given)
    numbers = _numbers(_title(symbol, given), values, scope)
    sums = numbers.sum(axis=0)
    wrong = np.argwhere(np.abs(sums - 1) > _SUM_TOLERANCE)
    if len(wrong):
        place = tuple(wrong[0])
        where = ", ".join(f"{each.name} = {each.shown(at)}" for each, at in zip(given, place, strict=True))
        raise ModelError(
            f"{_title(symbol, given)} sums to {float(sums[place]):.9g}"
            + (f" for {where}" if where else "")
            + "; a distribution sums to 1"
        )
    return Distribution(symbol=symbol, given=given, table=numbers)


def uniform(symbol: Symbol) -> Distribution:
    """Return the uniform P(symbol)."""
    _scope(symbol, ())
    return table(symbol, np.full(symbol.size, 1 / symbol.size))


def conditional_normal(
    symbol: Symbol,
    given: Sequence[Symbol],
    *,
    mean: Formula,
    sigma: Formula,
    floor: float = 0.0,
    outliers: float = 0.0,
) -> Distribution:
    """Return P(symbol | given), a normal distribution around a function of the parents.

    If the symbol's type wraps, the normal distribution wraps too.

    Args:
        symbol: An integer or interval symbol. Each value gets the integral of the normal over the value's interval.
        given: The parents of `symbol`, or () for a normal without parents.
        mean: A function of the parents' values, or numbers that broadcast to the parents' sizes.
        sigma: The standard deviation, in either form of `mean`.
        floor: The minimum probability of a value, relative to the peak.
        outliers: Share of readings that do not depend on the parents.

    Raises:
        ModelError: The symbol has named values, the mean or sigma has another shape, or sigma is not
            positive.
    """
    given = tuple(given)
    scope = _scope(symbol, given)
    title = _title(symbol, given)
    if symbol.type.labels:
        raise ModelError(f"{title}: a normal is over numbers, and {symbol.name} has named values")
    shape = Normal(
        mean=_evaluated(title, "mean", mean, given),
        sigma=_evaluated(title, "sigma", sigma, given),
        floor=floor,
        outliers=outliers,
    )
    make = wrapped_normal_table if symbol.type.wraps else normal_table
    flat = make(symbol.name, shape, values=symbol.size, offset=symbol.type.offset, step=symbol.type.step)
    flat.flags.writeable = False
    sizes = tuple(each.size for each in scope)
    return Distribution(symbol=symbol, given=given, table=flat.reshape(sizes), normal=shape)


def function(symbol: Symbol, given: Sequence[Symbol], value: Formula) -> Distribution:
    """Return P(symbol | given) for the function `value` of the parents: 1 at the function's value, 0 elsewhere.

    The function gets the parents' values as numbers. If the symbol has `on_range = clamp`, a result out of range
    becomes the nearest value in range.

    Raises:
        ModelError: The function returns a value that is out of the symbol's range or not finite.
    """
    given = tuple(given)
    scope = _scope(symbol, given)
    title = _title(symbol, given)
    numbers = _evaluated(title, "the function", value, given)
    if not np.all(np.isfinite(numbers)):
        raise ModelError(f"{title}: the function gives {numbers[~np.isfinite(numbers)][0]}")
    place = np.floor((numbers - symbol.type.offset) / symbol.type.step + 0.5)
    if symbol.type.wraps:
        place %= symbol.size
    elif symbol.on_range == "clamp":
        place = np.clip(place, 0, symbol.size - 1)
    outside = (place < 0) | (place >= symbol.size)
    if np.any(outside):
        last = symbol.type.offset + (symbol.size - 1) * symbol.type.step
        raise ModelError(
            f"{title}: the function gives {numbers[outside][0]:g}, but {symbol.name} is {symbol.type.offset:g} to "
            f"{last:g}; widen its type, or give it on_range = clamp"
        )
    flat = (np.arange(symbol.size)[:, np.newaxis] == place).astype(np.float64)
    flat.flags.writeable = False
    return Distribution(symbol=symbol, given=given, table=flat.reshape(tuple(each.size for each in scope)))


def potential(symbols: Sequence[Symbol], values: ArrayLike) -> Potential:
    """Return a factor that need not be a distribution, as the factors of a Markov network.

    `values` are float64[size of each symbol], each at least 0.

    Raises:
        ModelError: The shape is wrong, or a number is negative, infinite or NaN.
    """
    scope = _scope(symbols[0], tuple(symbols[1:])) if symbols else ()
    title = f"the potential of {', '.join(each.name for each in scope)}"
    return Potential(scope=scope, table=_numbers(title, values, scope))


def _numbers(title: str, values: ArrayLike, scope: tuple[Symbol, ...]) -> NDArray[np.float64]:
    numbers = np.array(values, dtype=np.float64)
    shape = tuple(each.size for each in scope)
    if numbers.shape != shape:
        raise ModelError(f"{title} has shape {numbers.shape}, expected {shape}")
    if not np.all(np.isfinite(numbers)) or np.any(numbers < 0):
        raise ModelError(f"{title} holds a number that is negative, infinite or NaN")
    numbers.flags.writeable = False
    return numbers


def _scope(symbol: Symbol, given: tuple[Symbol, ...]) -> tuple[Symbol, ...]:
    scope = (symbol, *given)
    if len({each.name for each in scope}) < len(scope):
        raise ModelError(f"{_title(symbol, given)} names a symbol twice")
    check_size(_title(symbol, given), math.prod(each.size for each in scope), MAX_ENTRIES)
    return scope


def _evaluated(title: str, what: str, formula: Formula, given: tuple[Symbol, ...]) -> NDArray[np.float64]:
    """Return a formula's value for each combination of the parents' values, float64[product of the parents' sizes]."""
    grids = np.meshgrid(*(each.values() for each in given), indexing="ij") if given else []
    values = formula(*grids) if callable(formula) else formula
    sizes = tuple(each.size for each in given)
    try:
        numbers = np.broadcast_to(np.asarray(values, dtype=np.float64), sizes)
    except (TypeError, ValueError):
        raise ModelError(f"{title}: {what} has shape {np.shape(values)}, expected {sizes}") from None
    return numbers.ravel().copy()


def _title(symbol: Symbol, given: tuple[Symbol, ...]) -> str:
    names = ", ".join(each.name for each in given)
    return f"P({symbol.name} | {names})" if names else f"P({symbol.name})"


def _sizes(table: NDArray[np.float64]) -> str:
    return " x ".join(map(str, table.shape))
