"""The files that `toolchain fit` writes, and their use in models.

A fit of normal distributions is a `.toml` file. A fit of counted tables is a `.npz` file.
"""

import json
import math
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import tomli_w
from numpy.typing import NDArray
from pydantic import Field

from toolchain.bounded_files import TomlFile, open_regular, whole_file
from toolchain.deployment.sections import Section, Sequence
from toolchain.errors import ModelError
from toolchain.models.conditional import normal_table, wrapped_normal_table
from toolchain.models.model import Known, Model, Normal

FORMAT: Final = 1
MAX_TABLE_BYTES: Final = 1 << 28
MAX_BYTES: Final = 1 << 30
_MAX_META_BYTES: Final = 4 << 20

_HEADER: Final = "# Written by `toolchain fit`; read by toolchain.learning.fitted.with_fit. docs/how-to/models.md has the keys.\n"
_META: Final = "fit.json"
_PRIOR: Final = "prior.npy"
_BAD: Final = (zipfile.BadZipFile, zlib.error, KeyError, ValueError, AttributeError, EOFError, RuntimeError)
"""Errors that NumPy, zipfile and pydantic raise for a damaged file."""


class FittedRecording(Section):
    """A `[[recording]]` of a fit file. The fit was learnt from the recording."""

    file: str
    sha256: str
    rows: int = Field(ge=0)


class FittedVariable(Section):
    """A `[[variable]]` of a fit file.

    With the method `counts`, the fit file has only `name` and `rows`, because the `.npz` file has the table.
    """

    name: str
    rows: int = Field(ge=0)
    sigma: float = Field(default=0.0, ge=0)
    bias: float = 0.0
    outliers: float = Field(default=0.0, ge=0, le=1)


class FitFile(Section):
    """The content of a fit file without the counted tables."""

    format: Literal[1] = FORMAT
    method: Literal["normals", "counts"]
    model: str
    floor: float = Field(default=0.0, ge=0, lt=1)
    prior_rows: int = Field(default=0, ge=0, exclude_if=lambda rows: rows == 0)
    recordings: Sequence[FittedRecording] = Field(
        default=(), validation_alias="recording", serialization_alias="recording"
    )
    variables: Sequence[FittedVariable] = Field(
        default=(), validation_alias="variable", serialization_alias="variable"
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """Learnt parameters or tables."""

    file: FitFile
    tables: Mapping[str, NDArray[np.float64]]
    """P(K | S), float64[values, lines], by the variable's name. Empty unless the method is `counts`."""
    prior: NDArray[np.float64] | None = None
    """P(S), float64[lines], or None if no prior was learnt. Only the method `counts` can learn a prior."""


def with_fit(model: Model, path: Path | None) -> Model:
    """Return the model with tables from the fit file `path`. Without a path, return the model unchanged.

    Raises a ModelError if the fit is for another model. A fit of normal distributions may come from another grid, a
    fit of counts may not.
    """
    return model if path is None else apply_fit(model, read_fit(path), str(path))


def apply_fit(model: Model, fit: Fit, where: str = "the fit") -> Model:
    """Return the model with the learnt tables of a fit, or raise a ModelError. All other tables stay unchanged."""
    known = {each.name: each for each in model.known}
    for variable in fit.file.variables:
        if variable.name not in known:
            raise ModelError(
                f"{where} is of a model with {variable.name}; {model.name} has {', '.join(known) or 'no known variables'}"
            )
        before = known[variable.name]
        if fit.file.method == "normals":
            known[variable.name] = _with_normal(model, before, variable, fit.file.floor, where)
        else:
            table = fit.tables[variable.name]
            if table.shape != before.table.shape:
                raise ModelError(
                    f"{where}: the table of {variable.name} has shape {table.shape}, the model's {before.table.shape}; "
                    "fit again with this model"
                )
            known[variable.name] = replace(before, table=table, floor=0.0, normal=None)
    prior = model.prior
    if fit.prior is not None:
        if model.prior_select is not None or fit.prior.shape != (model.lines,):
            raise ModelError(
                f"{where} has a prior of {fit.prior.size} lines; {model.name} has {model.lines}"
                + (f", and {model.prior_select.name} selects its prior" if model.prior_select else "")
                + "; fit again with this model"
            )
        prior = fit.prior
    return replace(model, known=tuple(known.values()), prior=prior)


def cell_spread(model: Model, known: Known) -> NDArray[np.float64]:
    """Return how much a variable's mean varies within each line's cell, as a standard deviation: float64[lines].

    The mean is assumed linear in the searched values, and the searched values are assumed uniform within the cell.
    """
    slopes = mean_slopes(model, known)
    spread: NDArray[np.float64] = np.sqrt((slopes**2).sum(axis=0) / 12)
    return spread


def normal_of(known: Known) -> Normal:
    """Return the normal distributions behind a variable's table, or raise a ModelError for a table of another kind."""
    if known.normal is None:
        raise ModelError(
            f"{known.name} is not normal around a mean in the model; fit it with --method counts"
        )
    return known.normal


def mean_slopes(model: Model, known: Known) -> NDArray[np.float64]:
    """Return how much a variable's mean changes per cell along each dimension: float64[dimensions, lines]."""
    sizes = tuple(dimension.size for dimension in model.searched)
    mean = normal_of(known).mean.reshape(sizes)
    turn = None if known.period is None else known.period * abs(known.step)
    slopes = []
    for axis, size in enumerate(sizes):
        if size == 1:
            slopes.append(np.zeros(model.lines))
            continue
        steps = np.diff(mean, axis=axis)
        if turn is not None:
            steps = wrapped(steps, turn)
        first, last = np.take(steps, [0], axis=axis), np.take(steps, [-1], axis=axis)
        before, after = np.concatenate([first, steps], axis=axis), np.concatenate([steps, last], axis=axis)
        slopes.append(((before + after) / 2).ravel())
    return np.array(slopes)


def wrapped(away: NDArray[np.float64], turn: float) -> NDArray[np.float64]:
    """Return differences on a circle of length `turn`. Each is taken the shorter way, from -turn / 2 to turn / 2."""
    shorter: NDArray[np.float64] = (away + turn / 2) % turn - turn / 2
    return shorter


def _with_normal(model: Model, known: Known, fitted: FittedVariable, floor: float, where: str) -> Known:
    if not fitted.sigma > 0:
        raise ModelError(f"{where}: sigma of {known.name} is {fitted.sigma:g}, expected a positive number")
    mean = normal_of(known).mean
    shape = Normal(
        mean=mean + fitted.bias,
        sigma=np.hypot(fitted.sigma, cell_spread(model, known)),
        floor=floor,
        outliers=fitted.outliers,
    )
    make = normal_table if known.period is None else wrapped_normal_table
    table = make(known.name, shape, values=known.values, offset=known.offset, step=known.step)
    return replace(known, table=table, floor=floor, normal=replace(shape, mean=mean))


def write_fit(path: Path, fit: Fit) -> None:
    """Write a fit of normal distributions as TOML, or of counted tables as NPZ. Equal fits give equal bytes."""
    suffix = ".toml" if fit.file.method == "normals" else ".npz"
    if path.suffix != suffix:
        raise ModelError(f"{path}: the method {fit.file.method} writes a file that ends in {suffix}")
    with whole_file(path, ModelError) as partial:
        path.parent.mkdir(parents=True, exist_ok=True)
        if fit.file.method == "normals":
            content = fit.file.model_dump(mode="json", by_alias=True)
            partial.write_text(_HEADER + tomli_w.dumps(content), encoding="utf-8")
        else:
            counted = {"variables": {"__all__": {"sigma", "bias", "outliers"}}}  # of normals
            _write_tables(partial, fit.file.model_dump(mode="json", by_alias=True, exclude=counted), fit)


def read_fit(path: Path) -> Fit:
    """Return a fit that `toolchain fit` has written, or raise a ModelError."""
    if path.suffix == ".npz":
        return _read_tables(path)
    file = TomlFile.read(path, ModelError).validated(FitFile)
    if file.method != "normals":
        raise ModelError(f"{path} has method = {file.method!r}, whose tables `toolchain fit` writes as .npz")
    if file.prior_rows:
        raise ModelError(f"{path} has prior_rows, but `toolchain fit` only learns a prior into .npz files")
    return Fit(file=file, tables={})


def _write_tables(path: Path, content: dict[str, Any], fit: Fit) -> None:
    """Write an NPZ file without the time of day, which `writestr` would include."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        entry = zipfile.ZipInfo(_META)
        archive.writestr(entry, json.dumps(content, indent=1, sort_keys=True), zipfile.ZIP_DEFLATED)
        arrays = {
            f"table{number}.npy": fit.tables[variable["name"]]
            for number, variable in enumerate(content["variable"])
        }
        if fit.prior is not None:
            arrays[_PRIOR] = fit.prior[np.newaxis]
        for name, array in arrays.items():
            with archive.open(name, "w", force_zip64=True) as file:
                numbers = np.ascontiguousarray(array, dtype="<f8")
                np.lib.format.write_array(file, numbers, version=(1, 0), allow_pickle=False)


def _read_tables(path: Path) -> Fit:
    try:
        with open_regular(path, ModelError, MAX_BYTES) as packed, zipfile.ZipFile(packed) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
                raise ModelError(f"{path} is larger than {MAX_BYTES} bytes, unpacked; this is the maximum")
            content = json.loads(_member(archive, _META, _MAX_META_BYTES))
            file = FitFile.model_validate(content, by_alias=True, by_name=False)
            counted = file.variables if file.method == "counts" else ()
            tables = {
                variable.name: _array(archive, f"table{number}.npy")
                for number, variable in enumerate(counted)
            }
            (prior,) = _array(archive, _PRIOR) if file.prior_rows else (None,)
    except OSError as reason:
        raise ModelError(f"{path} cannot be read: {reason.strerror or reason}") from None
    except _BAD as reason:
        raise ModelError(
            f"{path} was not written by `toolchain fit`, or is damaged: {type(reason).__name__}"
        ) from None
    if file.method != "counts":
        raise ModelError(f"{path} contains {file.method}, which `toolchain fit` writes as .toml")
    return Fit(file=file, tables=tables, prior=prior)


def _member(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    with archive.open(name) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(name)
    return data


def _array(archive: zipfile.ZipFile, name: str) -> NDArray[np.float64]:
    """Read an array, allocating no more memory than the numbers in the file need."""
    with archive.open(name) as file:
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError(name)
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
        entries = math.prod(shape)
        if fortran or dtype != np.dtype("<f8") or len(shape) != 2 or 8 * entries > MAX_TABLE_BYTES:
            raise ValueError(name)
        data = file.read(8 * entries + 1)
    if len(data) != 8 * entries:
        raise ValueError(name)
    return np.frombuffer(data, dtype="<f8").reshape(shape).astype(np.float64)
