"""Learning of tables from recordings with ground truth: normals with a share of outliers, or counts.

**Normals.** A reading is `mean(S) + bias + noise` with noise N(0, sigma^2). A share of the readings are outliers, which
are uniform over the range of the variable. Expectation maximisation estimates bias, sigma and share from the residuals
at the true position. A residual is reading minus mean, and the mean is assumed linear within a cell. A pool of
variables may share sigma and bias. Every variable has its own share of outliers. The estimate of the share counts one
additional outlier and one additional good reading (the mode with a Beta(2, 2) prior).

**Counts.** P(k | s) = (n(k, s) + a q(k | s)) / (n(s) + a). This is the mean with a Dirichlet prior that has the weight
of `a` readings in every cell, where q is the model's table or a uniform table. For M cells, P(s) is estimated likewise
as (n(s) + a M q(s)) / (n + a M).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Final

import numpy as np
from numpy.typing import NDArray

from toolchain.deployment import Dimension
from toolchain.deployment.address import to_address
from toolchain.errors import ModelError, ReadingError
from toolchain.learning import FitMethod, FitOptions, FitPrior
from toolchain.learning.fitted import (
    Fit,
    FitFile,
    FittedRecording,
    FittedVariable,
    mean_slopes,
    normal_of,
    wrapped,
)
from toolchain.models.model import Known, Model

LEAST_READINGS: Final = 10
"""Minimum number of readings of a pool of variables. A pool with fewer readings keeps the values of the model."""

_ROUNDS: Final = 1000
_SETTLED: Final = 1e-10
_LEAST_SIGMA: Final = 0.05
"""Minimum sigma in steps, because recordings that are rounded or simulated without noise have no variance."""
_TO_SIGMA: Final = 1.4826
"""Ratio of a normal's sigma to its median absolute deviation."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrueCells:
    """The true position in each usable row."""

    rows: NDArray[np.int64]
    """int64[n], the indices of the usable rows. In a usable row, all true values exist and are inside the grid."""
    lines: NDArray[np.int64]
    """int64[n], for each usable row, the line of the model's grid that contains the true position."""
    within: NDArray[np.float64]
    """float64[dimensions, n], the offset of the true position from the centre of its cell, in cells: -0.5 to 0.5."""
    outside: int
    """The number of rows that are not usable."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Support:
    """The amount of data behind a table."""

    name: str
    """Name of the variable."""
    readings: int
    """Number of the variable's readings in rows with a true position."""
    cells: int
    """Number of lines of the model with at least one reading of the variable."""
    median: float
    """Median number of the variable's readings per line, over the lines with at least one reading."""
    refused: int
    """Number of readings that are not values of the variable."""


def locate(model: Model, columns: Mapping[str, Sequence[object]], rows: int) -> TrueCells:
    """Find the rows whose true position is on the grid, and these positions.

    `columns` has, by label, a column of true values for each searched dimension. `rows` is the number of rows.
    """
    places = np.array(
        [[_position(dimension, value) for value in columns[dimension.label]] for dimension in model.searched]
    ).reshape(len(model.searched), rows)
    sizes = np.array([dimension.size for dimension in model.searched])[:, np.newaxis]
    with np.errstate(invalid="ignore"):  # NaN is not a position
        cells = np.floor(places + 0.5)
        inside = np.all((cells >= 0) & (cells < sizes), axis=0)
    cells = cells[:, inside].astype(np.int64)
    lines = np.ravel_multi_index(tuple(cells), tuple(int(size) for size in sizes[:, 0]))
    return TrueCells(
        rows=np.flatnonzero(inside),
        lines=np.asarray(lines, dtype=np.int64),
        within=places[:, inside] - cells,
        outside=rows - int(inside.sum()),
    )


def fit_model(
    model: Model,
    truth: TrueCells,
    readings: Mapping[str, Sequence[object]],
    recordings: Sequence[FittedRecording],
    options: FitOptions,
) -> tuple[Fit, tuple[Support, ...]]:
    """Learn the tables from the rows with a true position. Return the fit, and the amount of data for each table."""
    if not len(truth.rows):
        raise ModelError(
            "no row has a true value inside the searched dimensions: is --truth right, and in the model's unit?"
        )
    known = {each.name: each for each in model.known}
    if options.method is FitMethod.NORMALS:
        supports, variables = _normals(
            model, truth, {name: (known[name], readings[name]) for name in readings}, options
        )
        tables: dict[str, NDArray[np.float64]] = {}
    else:
        supports, variables, tables = [], [], {}
        for name, values in readings.items():
            tables[name], support = _counted(known[name], truth, values, options)
            supports.append(support)
            variables.append(FittedVariable(name=name, rows=support.readings))
    prior = _counted_prior(model, truth, options) if options.learn_prior else None
    file = FitFile(
        method=options.method.value,
        prior_rows=0 if prior is None else len(truth.rows),
        model=model.name,
        floor=options.floor if options.method is FitMethod.NORMALS else 0.0,
        recordings=tuple(recordings),
        variables=tuple(variables),
    )
    return Fit(file=file, tables=tables, prior=prior), tuple(supports)


def _position(dimension: Dimension, value: object) -> float:
    """Return a true value as a position along a dimension, in cells.

    If `value` is neither a state of the dimension nor a number, the position is NaN.
    """
    if isinstance(value, str) and value in dimension.states:
        return float(dimension.states.index(value))
    if isinstance(value, str) or not isinstance(value, int | float):
        return math.nan
    return (float(value) - dimension.offset) / dimension.step


def _normals(
    model: Model,
    truth: TrueCells,
    readings: Mapping[str, tuple[Known, Sequence[object]]],
    options: FitOptions,
) -> tuple[list[Support], list[FittedVariable]]:
    residuals: dict[str, NDArray[np.float64]] = {}
    widths: dict[str, float] = {}
    supports = []
    for name, (known, values) in readings.items():
        residuals[name], support = _residuals(model, known, truth, values)
        widths[name] = known.values * known.step
        supports.append(support)
    fitted: dict[str, FittedVariable] = {}
    for pool in _pools(list(readings), options.pool or ()):
        if sum(len(residuals[name]) for name in pool) < LEAST_READINGS:
            continue
        least = _LEAST_SIGMA * min(readings[name][0].step for name in pool)
        bias, sigma, shares = mixture(
            [residuals[name] for name in pool],
            [widths[name] for name in pool],
            bias=options.bias,
            least_sigma=least,
        )
        for name, share in zip(pool, shares, strict=True):
            fitted[name] = FittedVariable(
                name=name, rows=len(residuals[name]), sigma=sigma, bias=bias, outliers=share
            )
    return supports, [fitted[name] for name in readings if name in fitted]


def mixture(
    residuals: Sequence[NDArray[np.float64]], widths: Sequence[float], *, bias: bool, least_sigma: float
) -> tuple[float, float, list[float]]:
    """Fit one normal to all variables together, and a share of outliers to each variable.

    `residuals` has each variable's readings minus their expected values. Outliers are uniform over the variable's
    range; `widths` has the ranges' widths. If `bias` is False, the normal's mean is 0. Returns the normal's mean, its
    standard deviation, and the shares.
    """
    everything = np.concatenate(residuals)
    mean = float(np.median(everything)) if bias else 0.0
    sigma = max(_TO_SIGMA * float(np.median(np.abs(everything - mean))), least_sigma)
    shares = [0.1] * len(residuals)
    for _ in range(_ROUNDS):
        weights = []
        for number, (away, width) in enumerate(zip(residuals, widths, strict=True)):
            good = (
                (1 - shares[number])
                * np.exp(-0.5 * ((away - mean) / sigma) ** 2)
                / (math.sqrt(2 * math.pi) * sigma)
            )
            weights.append(good / (good + shares[number] / width))
            shares[number] = 1 - (float(weights[-1].sum()) + 1) / (len(away) + 2)
        weight = np.concatenate(weights)
        total = float(weight.sum())
        if not total > 0:
            break
        before = (mean, sigma)
        mean = float(weight @ everything) / total if bias else 0.0
        sigma = max(math.sqrt(float(weight @ (everything - mean) ** 2) / total), least_sigma)
        if abs(sigma - before[1]) <= _SETTLED * sigma and abs(mean - before[0]) <= _SETTLED * sigma:
            break
    return mean, sigma, shares


def _residuals(
    model: Model, known: Known, truth: TrueCells, values: Sequence[object]
) -> tuple[NDArray[np.float64], Support]:
    """Return reading minus mean at the true position, for every row with a reading, and the amount of data."""
    slopes = mean_slopes(model, known)
    expected = normal_of(known).mean[truth.lines] + (slopes[:, truth.lines] * truth.within).sum(axis=0)
    given = [values[row] for row in truth.rows]
    numbers = np.array([float(each) if isinstance(each, int | float) else math.nan for each in given])
    there = np.isfinite(numbers)
    away = numbers[there] - expected[there]
    if known.period is not None:
        away = wrapped(away, known.period * abs(known.step))
    refused = sum(values[row] is not None for row in truth.rows) - int(there.sum())
    return away, _support(known.name, truth.lines[there], refused)


def _counted(
    known: Known, truth: TrueCells, values: Sequence[object], options: FitOptions
) -> tuple[NDArray[np.float64], Support]:
    variable = known.as_variable().model_copy(update={"on_missing": "missing"})
    counts = np.zeros(known.table.shape)
    used, refused = [], 0
    for row, line in zip(truth.rows.tolist(), truth.lines.tolist(), strict=True):
        if values[row] is None:
            continue
        try:
            address = to_address(variable, values[row])
        except ReadingError:
            address = None
        if address is None:
            refused += 1
        else:
            counts[address, line] += 1
            used.append(line)
    base = known.table if options.prior is FitPrior.MODEL else np.full_like(known.table, 1 / known.values)
    worth = options.pseudo_count
    table: NDArray[np.float64] = (counts + worth * base) / (counts.sum(axis=0) + worth)
    return table, _support(known.name, np.array(used, dtype=np.int64), refused)


def _counted_prior(model: Model, truth: TrueCells, options: FitOptions) -> NDArray[np.float64]:
    """Return P(S), float64[lines], from the number of rows in each cell."""
    if model.prior_select is not None or model.transition is not None:
        how = f"selected by {model.prior_select.name}" if model.prior_select else "predicted by its filter"
        raise ModelError(f"--learn-prior: the prior of {model.name} is {how}; omit the flag")
    counts = np.bincount(truth.lines, minlength=model.lines)
    base = (
        model.prior_distribution if options.prior is FitPrior.MODEL else np.full(model.lines, 1 / model.lines)
    )
    weight = options.pseudo_count * model.lines
    prior: NDArray[np.float64] = (counts + weight * base) / (len(truth.lines) + weight)
    return prior


def _support(name: str, lines: NDArray[np.int64], refused: int) -> Support:
    _, counts = np.unique(lines, return_counts=True)
    return Support(
        name=name,
        readings=len(lines),
        cells=len(counts),
        median=float(np.median(counts)) if len(counts) else 0.0,
        refused=refused,
    )


def _pools(names: Sequence[str], patterns: Sequence[str]) -> list[list[str]]:
    """Return the groups of variables that share a normal: one per pattern, and every other variable alone."""
    left = list(names)
    pools = []
    for pattern in patterns:
        pool = [name for name in left if fnmatchcase(name, pattern)]
        if not pool:
            raise ModelError(
                f"--pool {pattern} is none of the variables that are fitted; they are {', '.join(names[:20])}"
            )
        pools.append(pool)
        left = [name for name in left if name not in pool]
    return pools + [[name] for name in left]
