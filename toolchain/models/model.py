"""The model for a BM1: a searched variable S on a grid, and known variables that depend on S (thesis 2.1.2).

The machine computes P(S | k_1 ... k_N), proportional to P(S) P(k_1 | S) ... P(k_N | S) (equation 2.2). A
model consists of the prior P(S) and a table P(K_i | S) for each known variable, in the order of the columns.
`exact_posterior` computes the posterior in float64, as the reference for a machine.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from toolchain.deployment import Dimension, Variable
from toolchain.deployment.filter import Transition
from toolchain.deployment.sections import NAME_MAX
from toolchain.errors import ModelError

MAX_LINES: Final = 2**24
"""Maximum number of values of the searched variable: 4,096 boards with the register map's maximum number of lines."""
MAX_VALUES: Final = 2**16 - 1
"""Maximum number of values of a known variable: all addresses of 16 bits, except the top one for a missing reading."""
MAX_ENTRIES: Final = 2**24
"""Maximum number of entries of a factor of a joint distribution (128 MiB as float64)."""
MAX_TABLE_ENTRIES: Final = 2**26
"""Maximum number of entries of a known variable's table (512 MiB as float64)."""
MAX_MODEL_ENTRIES: Final = 2**28
"""Maximum total number of entries in the tables of a question's known variables."""


def check_size(what: str, entries: int, most: int, advice: str = "") -> None:
    """Raise a ModelError about `what` if `entries` exceeds `most`."""
    if entries > most:
        raise ModelError(f"{what} would have {entries} entries; the maximum is {most}{advice}")


_SUM_TOLERANCE: Final = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Normal:
    """The normal distributions from which a table is computed. `toolchain fit` can learn some of the parameters."""

    mean: NDArray[np.float64]
    """float64[lines], in the reading's unit."""
    sigma: ArrayLike
    """Standard deviation in the unit of the reading: one number for all lines, or float64[lines]."""
    floor: float = 0.0
    """Probability added to each bin, as a fraction of the probability of a bin centred at the mean.

    With a floor, outliers remain possible.
    """
    outliers: float = 0.0
    """Share of readings that do not depend on S."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TabulatedVariable:
    """A variable that is read in each frame, with its table and the conversion of its readings to addresses."""

    name: str
    """The variable's name. Without `path`, it is also the name of the field in the message."""
    table: NDArray[np.float64] = field(repr=False)
    """float64[values, lines]. Row k belongs to the reading with address k."""
    bits: int = 0
    """Number of address bits. 0 selects the smallest sufficient number.

    Each value needs an address, and a missing reading needs the top address.
    """
    offset: float = 0.0
    """The reading with address 0, in the unit of the variable."""
    step: float = 1.0
    """Difference between readings of adjacent addresses, in the unit of the variable."""
    unit: str = ""
    """The unit of the variable's readings, such as `m`, for display."""
    period: int | None = None
    """Number of addresses in one turn of a cyclic reading, such as a bearing, or None for other readings."""
    on_range: Literal["error", "clamp", "missing"] = "error"
    """Treatment of a reading out of range: as an error, as the nearest value in range (`clamp`), or as missing."""
    on_missing: Literal["error", "missing"] = "error"
    """If a reading is missing, `error` rejects the frame, and `missing` computes the frame without the reading."""
    path: str = ""
    """Path of the variable in the message. If the path is empty, the message is searched for the name."""
    states: tuple[str, ...] = ()
    """Names of the values, or () without names. A reading may be a name."""

    def _keep_table(self, what: str) -> None:
        """Store a read-only copy of the table, and choose the number of address bits if it is 0."""
        given = np.asarray(self.table)
        if given.ndim != 2 or 0 in given.shape:
            raise ModelError(f"{what} has shape {given.shape}, expected (values, lines)")
        check_table(what, *given.shape)
        table = np.array(given, dtype=np.float64)
        table.flags.writeable = False
        object.__setattr__(self, "table", table)
        object.__setattr__(self, "bits", self.bits or len(table).bit_length())
        self.as_variable()

    @property
    def values(self) -> int:
        """The number of values."""
        return len(self.table)

    def as_variable(self) -> Variable:
        """Return the variable's entry in `deployment.toml`, or raise a ModelError if the entry would be invalid."""
        own = {each.name for each in fields(self)}
        rule = {key: getattr(self, key) for key in Variable.model_fields if key in own}
        kind = "sensor" if isinstance(self, Known) else "prior_select"
        return checked_variable(kind=kind, values=self.values, **rule)


def checked_variable(*, name: str, **rule: Any) -> Variable:
    """Return the variable's entry in `deployment.toml`, or raise a ModelError if the entry is invalid.

    `rule` has the other keys of the entry and their values.
    """
    try:
        return Variable(name=name, **rule)
    except ValidationError as reason:
        raise ModelError(f"variable {name!r}: {_first(reason)}") from None


@dataclass(frozen=True, kw_only=True, eq=False)
class Known(TabulatedVariable):
    """A known variable K, which has a column in the machine. Its table P(K | S) sums to 1 on each line."""

    floor: float = 0.0
    """Lower bound of the table's probabilities, as a fraction of the likelihood's peak; 0 means no bound.

    Quantising warns if the bound is so low that a probability gets the code 0.
    """
    normal: Normal | None = field(default=None, repr=False)
    """The normal distributions from which the table was computed, or None."""

    def __post_init__(self) -> None:
        what = f"P({self.name} | S)"
        self._keep_table(what)
        _check_distribution(what, self.table)


@dataclass(frozen=True, kw_only=True, eq=False)
class PriorSelect(TabulatedVariable):
    """A known variable A that selects the prior (thesis 2.1.2). Its table is P(S | A), and each row sums to 1.

    In the machine, the last row of the prior's table is the prior that applies while A is missing.
    """

    def __post_init__(self) -> None:
        what = f"P(S | {self.name})"
        self._keep_table(what)
        for address, row in enumerate(self.table):
            _check_distribution(f"{what} of address {address}", row)


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A naive Bayesian fusion, computed by a BM1."""

    name: str
    """Name of the deployment."""
    searched: tuple[Dimension, ...]
    """The searched variable's dimensions, the slowest-varying first. For (y, x), the line is y * width + x."""
    known: tuple[Known, ...]
    """The known variables in the order of the machine's columns, 1 to N."""
    prior: NDArray[np.float64] | None = None
    """P(S), float64[lines] summing to 1.

    If None is given, the prior is computed. With a filter, it is the prediction for the first frame. With
    `prior_select`, it is the mean of the rows of `prior_select.table`. Otherwise it is uniform.
    """
    prior_select: PriorSelect | None = None
    """The variable that selects the prior, or None. While its reading is missing, `prior` applies."""
    transition: Transition | None = None
    """The transition of the searched variable between frames, or None without a filter.

    With a filter, `prior` is the prediction for the first frame.
    """

    def __post_init__(self) -> None:
        name = self.name if isinstance(self.name, str) else ""  # a user's file is not type-checked
        if not (0 < len(name) <= NAME_MAX and name.isprintable()):
            raise ModelError(
                f"the model's name is {str(self.name)[:NAME_MAX]!r}, expected 1 to {NAME_MAX} printable characters"
            )
        if not self.searched:
            raise ModelError(f"model {self.name!r} has no searched dimension: it needs at least one")
        if self.lines > MAX_LINES:
            sizes = " x ".join(str(each.size) for each in self.searched)
            raise ModelError(
                f"model {self.name!r} searches {sizes} = {self.lines} values; the maximum is {MAX_LINES}"
            )
        for kind, names in (
            ("known variable", [known.name for known in self._all_known()]),
            ("searched dimension", [dimension.label for dimension in self.searched]),
        ):
            twice = [name for name, count in Counter(names).items() if count > 1]
            if twice:
                raise ModelError(f"model {self.name!r} has the {kind} {twice[0]!r} twice")
        for known in self.known:
            if known.table.shape[1] != self.lines:
                raise ModelError(
                    f"P({known.name} | S) has {known.table.shape[1]} lines, but the searched dimensions "
                    f"({' x '.join(str(d.size) for d in self.searched)}) have {self.lines} cells"
                )
        if self.transition is not None and self.prior_select is not None:
            raise ModelError(
                f"model {self.name!r} has a transition, so {self.prior_select.name} cannot select its prior"
            )
        if self.transition is not None and self.transition.start.shape != (self.lines,):
            raise ModelError(
                f"the transition has {self.transition.start.size} lines, but the searched dimensions have {self.lines} cells"
            )
        if self.prior is not None and np.shape(self.prior) != (self.lines,):
            raise ModelError(f"the prior P(S) has shape {np.shape(self.prior)}, expected ({self.lines},)")
        prior = self._default_prior() if self.prior is None else np.array(self.prior, float)
        _check_distribution("the prior P(S)", prior)
        if self.transition is not None and not np.array_equal(prior, self._default_prior()):
            raise ModelError(
                f"the prior of model {self.name!r} is predicted from its transition: leave out another one"
            )
        if self.prior_select is not None:
            self._default_prior()  # checks that its rows have the lines of this model
        prior.flags.writeable = False
        object.__setattr__(self, "prior", prior)

    def __repr__(self) -> str:
        searched = ", ".join(f"{dimension.label}[{dimension.size}]" for dimension in self.searched)
        known = ", ".join(each.name for each in self._all_known())
        return (
            f"Model({self.name!r}, P({searched} | {known}))"
            if known
            else f"Model({self.name!r}, P({searched}))"
        )

    def with_bits(self, bits: Mapping[str, int]) -> Self:
        """Return a copy of the model with other numbers of address bits, or raise a ModelError.

        `bits` has the numbers for some variables, by name. The numbers of the other variables do not change.
        """
        select = self.prior_select
        return replace(
            self,
            known=tuple(replace(known, bits=bits.get(known.name, known.bits)) for known in self.known),
            prior_select=select and replace(select, bits=bits.get(select.name, select.bits)),
        )

    def _all_known(self) -> tuple[Known | PriorSelect, ...]:
        return self.known if self.prior_select is None else (*self.known, self.prior_select)

    def _default_prior(self) -> NDArray[np.float64]:
        if self.transition is not None:
            return self.transition.after(self.transition.start)
        if self.prior_select is None:
            return np.full(self.lines, 1 / self.lines)
        rows = self.prior_select.table
        if rows.shape[1] != self.lines:
            raise ModelError(
                f"P(S | {self.prior_select.name}) has {rows.shape[1]} lines, but the searched dimensions have "
                f"{self.lines} cells"
            )
        mean: NDArray[np.float64] = rows.mean(axis=0)
        return mean

    @property
    def variables(self) -> tuple[Variable, ...]:
        """The `deployment.toml` entries of all known variables. The variable that selects the prior comes last."""
        return tuple(known.as_variable() for known in self._all_known())

    @property
    def lines(self) -> int:
        """The number of values of the searched variable (M of thesis 2.1.2)."""
        return math.prod(dimension.size for dimension in self.searched)

    @property
    def prior_distribution(self) -> NDArray[np.float64]:
        """P(S), float64[lines]."""
        return self._default_prior() if self.prior is None else self.prior


def dimension(
    label: str,
    *,
    size: int,
    offset: float = 0.0,
    step: float = 1.0,
    unit: str = "",
    states: tuple[str, ...] = (),
) -> Dimension:
    """Return a searched dimension: `size` cells with centres at `offset`, `offset + step` and so on.

    `unit` is the unit of `offset` and `step`, such as m. `states` are the names of the cells, or () without names.

    Raises:
        ModelError: There are no cells or too many, the name is empty, or the step is 0. It is also raised if the
            number of states is not the number of cells.
    """
    check_size(f"searched dimension {str(label)[:NAME_MAX]!r}", size, MAX_LINES)
    try:
        return Dimension(label=label, size=size, offset=offset, step=step, unit=unit, states=states)
    except ValidationError as reason:
        raise ModelError(f"searched dimension {label!r}: {_first(reason)}") from None


def cell_centres(*searched: Dimension) -> tuple[NDArray[np.float64], ...]:
    """Return for each dimension its values at the centres of all cells: float64[lines]."""
    check_size("the grid of cells", math.prod(each.size for each in searched), MAX_LINES)
    axes = [d.offset + np.arange(d.size) * d.step for d in searched]
    return tuple(axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))


def check_table(what: str, values: int, lines: int) -> None:
    """Raise a ModelError if a known variable's table of this size would be too large."""
    if values > MAX_VALUES:
        raise ModelError(
            f"{what} has {values} values; a column supports at most {MAX_VALUES}: use a larger step"
        )
    check_size(what, values * lines, MAX_TABLE_ENTRIES, ": use larger steps or fewer lines")


def _check_distribution(what: str, table: NDArray[np.float64]) -> None:
    if not np.all(np.isfinite(table)) or np.any(table < 0):
        raise ModelError(f"{what} contains a number that is not a probability: negative, infinite or NaN")
    sums = np.atleast_1d(table.sum(axis=0))
    wrong = np.abs(sums - 1) > _SUM_TOLERANCE
    if np.any(wrong):
        line = int(np.argmax(wrong))
        where = f" over its values on line {line}" if table.ndim == 2 else ""
        raise ModelError(f"{what} sums to {sums[line]:.9g}{where}; a distribution sums to 1")


def _first(reason: ValidationError) -> str:
    detail = reason.errors(include_url=False)[0]
    if detail["type"] == "value_error":
        return str(detail["ctx"]["error"])
    what = detail["msg"].removeprefix("Input should be ").removeprefix("String should have ")
    return f"{detail['loc'][0]} = {detail['input']!r}, expected {what}"


def exact_posterior(
    model: Model,
    addresses: Sequence[int | NDArray[np.int64] | None],
    *,
    prior_address: int | None = None,
    prior: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return P(S | readings) of the unquantised model, float64[lines].

    `addresses` has one address per known variable, in the order of the columns. The address of a missing reading is
    None. If each line has its own reading (`sensor_mode = cell`), an address is int64[lines]. `prior_address` is the
    row of the selected prior, or None if the model selects no prior. `prior` replaces the prior of the model.

    Raises:
        ModelError: The number of addresses is wrong, an address is not a row of the table, or the readings are
            impossible on every line.
    """
    if len(addresses) != len(model.known):
        raise ModelError(
            f"{len(addresses)} readings for the {len(model.known)} known variables of {model.name!r}"
        )
    factors = []
    for known, address in zip(model.known, addresses, strict=True):
        if address is None:
            continue
        if isinstance(address, np.ndarray):
            factors.append(known.table[address, np.arange(model.lines)])
            continue
        if not 0 <= address < known.values:
            raise ModelError(f"variable {known.name}: address {address} is not one of its {known.values}")
        factors.append(known.table[address])
    if prior_address is None:
        return fuse(model.prior_distribution if prior is None else prior, factors)
    rows = None if model.prior_select is None else model.prior_select.table
    if rows is None or not 0 <= prior_address < len(rows):
        raise ModelError(f"model {model.name!r} has no prior of address {prior_address}")
    return fuse(rows[prior_address], factors)


def fuse(prior: NDArray[np.float64], likelihoods: Iterable[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the normalised product of a prior and likelihoods, float64[lines]. The factors may have any scale.

    The product is computed as a sum of logarithms, so that many small likelihoods don't underflow. Raises a ModelError
    if the product is 0 on every line.
    """
    with np.errstate(divide="ignore"):  # log 0 = -inf is an impossible line
        logarithm = np.log(prior)
        for likelihood in likelihoods:
            logarithm = logarithm + np.log(likelihood)
    largest = logarithm.max()
    if largest == -np.inf:
        raise ModelError("these readings are impossible on every line: there is no posterior")
    weights = np.exp(logarithm - largest)
    posterior: NDArray[np.float64] = weights / weights.sum()
    return posterior
