"""The path of a fit from recordings to file, and the report on the data behind each table."""

import hashlib
import math
import shlex
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from statistics import fmean, median
from typing import Final

from toolchain.analysis.accuracy.readings import reading_columns
from toolchain.deployment.address import to_address
from toolchain.errors import BuildError, ModelError, ReadingError
from toolchain.flag_values import key_values
from toolchain.learning.fit import LEAST_READINGS, Support, fit_model, locate
from toolchain.learning.fit_options import FitMethod, FitOptions
from toolchain.learning.fitted import Fit, FittedRecording, apply_fit, write_fit
from toolchain.learning.recording import Recording, read_recording
from toolchain.models.case_study import load_model
from toolchain.models.fusion import exact_posterior
from toolchain.models.model import Model, cell_centres

_CHUNK: Final = 1 << 20


def run_fit(
    case: Path,
    recordings: Sequence[Path],
    output: Path,
    settings: Sequence[str],
    options: FitOptions,
    checks: Sequence[Path] = (),
) -> str:
    """Learn the tables of a model, write them, and return a report; `checks` are not used for learning."""
    _check(options, output)
    for path in checks:
        if any(path.resolve() == other.resolve() for other in recordings):
            raise BuildError(
                f"{path} is used for learning, so it cannot show how good the fit is: omit it on one side"
            )
    model = load_model(case, key_values(settings))
    truth_columns = _truth_columns(model, options.truth)
    columns_of_readings = reading_columns([known.name for known in model.known], options.readings)
    columns = list(dict.fromkeys([*columns_of_readings.values(), *truth_columns.values()]))
    read = [read_recording(path, columns, tolerance_s=options.tolerance_s) for path in recordings]
    truth = locate(model, _joined(read, truth_columns), sum(each.rows for each in read))
    fit, supports = fit_model(
        model,
        truth,
        _joined(read, columns_of_readings),
        [FittedRecording(file=each.path.name, sha256=_sha256(each.path), rows=each.rows) for each in read],
        options,
    )
    write_fit(output, fit)
    fitted = apply_fit(model, fit)
    compared = [
        _comparison(
            path,
            model,
            fitted,
            read_recording(path, columns, tolerance_s=options.tolerance_s),
            truth_columns,
            columns_of_readings,
        )
        for path in checks
    ]
    rows = len(truth.rows)
    visited = len(set(truth.lines.tolist()))
    parts = [
        f"Model {model.name}: {rows} rows with a truth inside the searched dimensions, {truth.outside} others. They lie in "
        f"{visited} of {model.lines} cells; {1 - visited / model.lines:.0%} of the cells are empty, and rest on "
        + _empty_cells(options)
        + ".",
        _table(fit, supports, model.lines),
        *compared,
        f"Wrote {output}. {_how_to_load(output)}",
    ]
    return "\n\n".join(parts) + "\n"


def _check(options: FitOptions, output: Path) -> None:
    suffix = ".toml" if options.method is FitMethod.NORMALS else ".npz"
    if output.suffix != suffix:
        raise BuildError(f"-o {output}: the method {options.method} writes a file that ends in {suffix}")
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
    path: Path,
    model: Model,
    fitted: Model,
    recording: Recording,
    truth_columns: Mapping[str, str],
    reading_columns: Mapping[str, str],
) -> str:
    """Return the distances between the mean of the exact posterior and the truth, before and after the fit."""
    truth = locate(model, _joined([recording], truth_columns), recording.rows)
    readings = _joined([recording], reading_columns)
    if not len(truth.rows):
        raise ModelError(f"{path}: no row has a true value inside the searched dimensions")
    centres = cell_centres(*model.searched)
    lines = [f"{path.name}, {len(truth.rows)} rows that nothing was learnt from, exact inference:"]
    for name, each in (("by hand", model), ("fitted", fitted)):
        distances, bits = [], []
        for row, line, within in zip(
            truth.rows.tolist(), truth.lines.tolist(), truth.within.T.tolist(), strict=True
        ):
            posterior = exact_posterior(each, _addresses(each, readings, row))
            away = [
                float(posterior @ centre) - (float(centre[line]) + inside * dimension.step)
                for centre, inside, dimension in zip(centres, within, model.searched, strict=True)
            ]
            distances.append(math.hypot(*away))
            bits.append(-math.log2(max(float(posterior[line]), 2.0**-60)))
        lines.append(
            f"  {name:8} distance of the mean: median {median(distances):.3f}, mean {fmean(distances):.3f}; "
            f"surprise at the true cell {fmean(bits):.2f} bits"
        )
    return "\n".join(lines)


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
    return f"the prior alone: {looks}, worth {options.pseudo_count:g} readings per cell"


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
    heading = "Data behind each table (readings; cells that have some, share that has none, median in those that have):"
    return "\n".join([heading, *rows, *notes])


def _how_to_load(output: Path) -> str:
    return (
        "To use it, return toolchain.learning.fitted.with_fit(model, fit) from model(), where fit is a parameter "
        f"of type Path | None, and build with --set {shlex.quote(f'fit={output}')}."
    )


def _sha256(path: Path) -> str:
    """Return the hash of a file, or of a bag's folder: its files in the order of their names."""
    digest = hashlib.sha256()
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            with file.open("rb") as data:
                while chunk := data.read(_CHUNK):
                    digest.update(chunk)
    return digest.hexdigest()
