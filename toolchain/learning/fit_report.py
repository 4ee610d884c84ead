"""The run of a fit: it reads recordings, learns the tables, writes the file of the fit, and reports on each table."""

import hashlib
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from statistics import fmean, median
from typing import Final

import numpy as np
from numpy.typing import NDArray

from toolchain.deployment.address import to_address
from toolchain.errors import BuildError, ModelError, ReadingError
from toolchain.flags import key_values
from toolchain.learning import FitMethod, FitOptions
from toolchain.learning.fit import LEAST_READINGS, Support, TrueCells, fit_model, locate
from toolchain.learning.fitted import Fit, FittedRecording, apply_fit, write_fit
from toolchain.learning.recording import Recording, read_recording, reading_columns
from toolchain.models.case_study import load_model
from toolchain.models.model import Model, cell_centres, exact_posterior

_CHUNK: Final = 1 << 20
_MOST_BITS: Final = 60
"""Maximum surprise in bits, -log2 of the probability of the true cell; the probability 0 counts as this surprise."""
_MOST_STATES: Final = 12
"""Maximum number of states for which a confusion matrix is shown."""


def run_fit(
    case: Path,
    recordings: Sequence[Path],
    output: Path,
    settings: Sequence[str],
    options: FitOptions,
    checks: Sequence[Path] = (),
) -> str:
    """Learn the tables of a model, write them, and return a report. The recordings in `checks` only test the fit."""
    _check(options, output)
    for path in checks:
        if any(path.resolve() == other.resolve() for other in recordings):
            raise BuildError(
                f"{path} is used for learning, so it cannot show how good the fit is: omit it on one side"
            )
    model = load_model(case, key_values(settings))
    truth_columns = _truth_columns(model, options.truth)
    columns_of_readings = reading_columns([known.name for known in model.known], options.readings or ())
    columns = list(dict.fromkeys([*columns_of_readings.values(), *truth_columns.values()]))
    read = partial(read_recording, columns=columns, tolerance_s=options.tolerance_s)
    learnt = [read(path) for path in recordings]
    truth = locate(model, _joined(learnt, truth_columns), sum(each.rows for each in learnt))
    fit, supports = fit_model(
        model,
        truth,
        _joined(learnt, columns_of_readings),
        [FittedRecording(file=each.path.name, sha256=_sha256(each.path), rows=each.rows) for each in learnt],
        options,
    )
    write_fit(output, fit)
    fitted = apply_fit(model, fit)
    compared = [_comparison(model, fitted, read(path), truth_columns, columns_of_readings) for path in checks]
    rows = len(truth.rows)
    visited = len(set(truth.lines.tolist()))
    parts = [
        f"Model {model.name}: {rows} rows with a truth inside the searched dimensions, {truth.outside} others. They lie in "
        f"{visited} of {model.lines} cells; {1 - visited / model.lines:.0%} of the cells are empty, and rest on "
        + _empty_cells(options)
        + ".",
        _table(fit, supports, model.lines),
        *compared,
        (
            f"Wrote {output}. To use it, return toolchain.learning.fitted.with_fit(model, fit) from model(), where fit is a "
            f"parameter of type Path | None, and build with --set {shlex.quote(f'fit={output}')}."
        ),
    ]
    return "\n\n".join(parts) + "\n"


def _check(options: FitOptions, output: Path) -> None:
    suffix = ".toml" if options.method is FitMethod.NORMALS else ".npz"
    if output.suffix != suffix:
        raise BuildError(f"-o {output}: the method {options.method} writes a file that ends in {suffix}")
    if options.learn_prior and options.method is FitMethod.NORMALS:
        raise BuildError("--learn-prior counts rows: add --method counts")
    if not (0 < options.pseudo_count < math.inf):
        raise BuildError(
            f"--pseudo-count is {options.pseudo_count:g}, expected a number above 0, because an empty cell needs a prior"
        )
    if not 0 <= options.floor < 1:
        raise BuildError(f"--floor is {options.floor:g}, expected a share of the peak from 0")
    if not 0 <= options.tolerance_s <= 3600:
        raise BuildError(f"--tolerance is {options.tolerance_s:g}, expected 0 to 3600 seconds")


def _truth_columns(model: Model, given: Sequence[str]) -> dict[str, str]:
    labels = [dimension.label for dimension in model.searched]
    columns = key_values(given, "--truth", f"{labels[0]}=COLUMN")
    for label in columns:
        if label not in labels:
            raise BuildError(f"--truth {label}: the model searches {', '.join(labels)}")
    for label in labels:
        if label not in columns:
            raise BuildError(
                f"the model searches {label}: give the column of its true value with --truth {label}=COLUMN"
            )
    return columns


def _joined(recordings: Sequence[Recording], columns: Mapping[str, str]) -> dict[str, list[object]]:
    return {
        name: list(chain.from_iterable(recording.columns[column] for recording in recordings))
        for name, column in columns.items()
    }


def _comparison(
    model: Model,
    fitted: Model,
    recording: Recording,
    truth_columns: Mapping[str, str],
    reading_columns: Mapping[str, str],
) -> str:
    """Describe how well the exact posterior finds the truth, before and after the fit."""
    truth = locate(model, _joined([recording], truth_columns), recording.rows)
    readings = _joined([recording], reading_columns)
    if not len(truth.rows):
        raise ModelError(f"{recording.path}: no row has a true value inside the searched dimensions")
    rows = [f"{recording.path.name}, {len(truth.rows)} rows that nothing was learnt from, exact inference:"]
    matrices: list[str] = []
    for name, each in (("by hand", model), ("fitted", fitted)):
        found = _posteriors(each, truth, readings)
        rows.append(f"  {name:8} " + "; ".join(_scores(each, truth, found)))
        matrices += _confusions(name, each, truth, found)
    return "\n".join([*rows, *matrices])


def _posteriors(
    model: Model, truth: TrueCells, readings: Mapping[str, Sequence[object]]
) -> list[NDArray[np.float64] | None]:
    """Return the exact posterior of each row with a true position.

    The posterior is None if the row's readings are impossible in the model.
    """
    found: list[NDArray[np.float64] | None] = []
    for row in truth.rows.tolist():
        try:
            found.append(exact_posterior(model, _addresses(model, readings, row)))
        except ModelError:
            found.append(None)
    return found


def _scores(model: Model, truth: TrueCells, found: Sequence[NDArray[np.float64] | None]) -> Iterator[str]:
    """Yield accuracy, distance and surprise; the distance leaves out dimensions whose values are names."""
    lines = truth.lines.tolist()
    right = sum(
        each is not None and int(each.argmax()) == line for each, line in zip(found, lines, strict=True)
    )
    yield f"accuracy {right / len(lines):.1%} (most probable cell, {right} of {len(lines)})"
    numbers = [
        (centre, dimension, axis)
        for axis, (centre, dimension) in enumerate(
            zip(cell_centres(*model.searched), model.searched, strict=True)
        )
        if not dimension.states
    ]
    there = [(at, each) for at, each in enumerate(found) if each is not None]
    if numbers and there:
        distances = [
            math.hypot(
                *(
                    float(each @ centre)
                    - (float(centre[lines[at]]) + float(truth.within[axis, at]) * dimension.step)
                    for centre, dimension, axis in numbers
                )
            )
            for at, each in there
        ]
        yield f"distance of the mean: median {median(distances):.3f}, mean {fmean(distances):.3f}"
    bits = [
        -math.log2(2.0**-_MOST_BITS if each is None else max(float(each[line]), 2.0**-_MOST_BITS))
        for each, line in zip(found, lines, strict=True)
    ]
    yield f"surprise at the true cell {fmean(bits):.2f} bits"
    if len(there) < len(found):
        yield f"rows impossible in this model, which count as wrong: {len(found) - len(there)}"


def _confusions(
    name: str, model: Model, truth: TrueCells, found: Sequence[NDArray[np.float64] | None]
) -> Iterator[str]:
    """Yield the confusion matrix of each searched dimension with named states."""
    sizes = tuple(dimension.size for dimension in model.searched)
    true = np.unravel_index(truth.lines, sizes)
    for axis, dimension in enumerate(model.searched):
        if not dimension.states or dimension.size > _MOST_STATES:
            continue
        others = tuple(each for each in range(len(sizes)) if each != axis)
        counts = np.zeros((dimension.size, dimension.size + 1), dtype=np.int64)
        for at, each in enumerate(found):
            best = dimension.size if each is None else int(each.reshape(sizes).sum(axis=others).argmax())
            counts[int(true[axis][at]), best] += 1
        headings = [*dimension.states, "none"]
        shown = len(headings) if counts[:, -1].any() else len(headings) - 1
        width = max(5, *map(len, headings))
        yield f"  {name}, {dimension.label}: rows are true states, columns the most probable ones"
        yield "  " + " ".join(f"{each:>{width}}" for each in ["", *headings[:shown]])
        for state, row in zip(dimension.states, counts[:, :shown].tolist(), strict=True):
            yield f"  {state:>{width}} " + " ".join(f"{count:{width}d}" for count in row)


def _addresses(model: Model, readings: Mapping[str, Sequence[object]], row: int) -> list[int | None]:
    addresses: list[int | None] = []
    for known in model.known:
        value = readings[known.name][row] if known.name in readings else None
        try:
            addresses.append(None if value is None else to_address(known.as_variable(), value))
        except ReadingError:
            addresses.append(None)
    return addresses


def _empty_cells(options: FitOptions) -> str:
    if options.method is FitMethod.NORMALS:
        return "the formula of the mean with the numbers below"
    looks = "the model's own table" if options.prior == "model" else "a uniform table"
    unit = "reading" if options.pseudo_count == 1 else "readings"
    return f"the prior alone: {looks}, worth {options.pseudo_count:g} {unit} per cell"


def _table(fit: Fit, supports: Sequence[Support], lines: int) -> str:
    fitted = {variable.name: variable for variable in fit.file.variables}
    normals = fit.file.method == "normals"
    width = max(8, *(len(support.name) for support in supports)) if supports else 8
    rows = [
        f"  {'variable':{width}}  readings  cells  empty  a cell"
        + ("     sigma      bias  outliers" if normals else "")
    ]
    notes = []
    for each in supports:
        row = f"  {each.name:{width}}  {each.readings:8d}  {each.cells:5d}  {1 - each.cells / lines:5.0%}  {each.median:6g}"
        if normals and (variable := fitted.get(each.name)):
            row += f"  {variable.sigma:8.4g}  {variable.bias:8.4g}  {variable.outliers:8.1%}"
        elif normals:
            row += f"  fewer than {LEAST_READINGS}: as set by hand"
        rows.append(row)
        if each.refused:
            notes.append(f"  {each.refused} readings of {each.name} are not values of it and were left out")
    if fit.file.prior_rows:
        notes.append(f"  The prior was counted too, from {fit.file.prior_rows} rows.")
    heading = "Data behind each table (readings; cells that have some, share that has none, median in those that have):"
    return "\n".join([heading, *rows, *notes])


def _sha256(path: Path) -> str:
    """Return the hash of a file, or of a bag's folder: its files in the order of their names."""
    digest = hashlib.sha256()
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            with file.open("rb") as data:
                while chunk := data.read(_CHUNK):
                    digest.update(chunk)
    return digest.hexdigest()
