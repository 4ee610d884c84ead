"""Readings for runs of emulated boards. They are drawn from a model, or recorded."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import BM1Machine
from machines.encode import decode_code
from toolchain.analysis.emulation import Inputs
from toolchain.deployment import Dimension, Scale, Variable
from toolchain.deployment.address import to_address
from toolchain.deployment.address_array import written_codes
from toolchain.errors import BuildError, ModelError, ReadingError
from toolchain.learning.recording import Recording, read_recording, reading_columns
from toolchain.models.model import Known, Model, PriorSelect

MISSING: Final = -1
MOST_FRAMES: Final = 100_000
"""Maximum number of frames. Memory holds all frames, and for each frame a row of every column's table."""

_WEIGHT_STEPS: Final = 500


@dataclass(frozen=True, eq=False)
class Readings:
    """Frames of readings.

    Attributes:
        source: Origin of the readings, as a clause.
        addresses: int64[frames, sensors], in the order of the columns, or int64[frames, sensors, lines] if lines have
            their own readings. A missing reading is `MISSING`.
        prior_addresses: int64[frames], the row of the prior for each frame, or `MISSING` if no row is selected.
        codes: uint16[frames, sensors, lines], the codes of the readings' likelihoods, for a machine without tables
            (`sensor_mode = threshold`). For other machines, `codes` is None.
        lines: int64[frames], the true line of each frame, or None if it is unknown.
    """

    source: str
    addresses: NDArray[np.int64]
    prior_addresses: NDArray[np.int64]
    codes: NDArray[np.uint16] | None = None
    lines: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.addresses)

    def of_model(self, frame: int) -> tuple[tuple[int | NDArray[np.int64] | None, ...], int | None]:
        """Return a frame's addresses and its row of the prior, for `toolchain.models.model.exact_posterior`."""
        row, addresses = int(self.prior_addresses[frame]), tuple(self.addresses[frame])
        if self.addresses.ndim == 2:
            addresses = tuple(None if at == MISSING else int(at) for at in addresses)
        return addresses, None if row == MISSING else row

    def of_machine(self, frame: int, machine: BM1Machine) -> tuple[Inputs, int]:
        """Return the inputs of a frame for a machine, and the number of the row that is the frame's prior.

        A missing reading becomes the top address of the column. If each line has readings of its own, the readings of
        all lines are returned, even if the machine has only some of the lines.
        """
        parameters = machine.parameters
        row = int(self.prior_addresses[frame])
        prior_row = parameters.prior_addresses - 1 if row == MISSING else row
        if self.codes is not None:
            return self.codes[frame].astype(np.int64), prior_row
        if self.addresses.ndim > 2:
            return self.addresses[frame], prior_row
        addresses = tuple(
            parameters.missing_address(column) if at == MISSING else at
            for column, at in enumerate(self.addresses[frame].tolist(), start=1)
        )
        return addresses, prior_row


def check_frames(frames: int) -> None:
    """Raise a BuildError if `frames` is not from 1 to `MOST_FRAMES`."""
    if not 1 <= frames <= MOST_FRAMES:
        raise BuildError(f"--frames is {frames}, expected 1 to {MOST_FRAMES}")


def sample_readings(
    model: Model, frames: int, *, seed: int, source: str = "", in_sequence: bool = False
) -> Readings:
    """Draw the true line of each frame, and then the frame's readings given this line.

    If a variable selects the prior, its values are equally probable. With `in_sequence`, the line of a frame is
    drawn given the line of the previous frame, if the model has a transition.
    """
    check_frames(frames)
    random = np.random.default_rng(seed)
    rows = np.full(frames, MISSING, dtype=np.int64)
    if in_sequence and model.transition is not None:
        line, drawn_lines = random.choice(model.lines, p=_distribution(model.transition.start)), []
        for _ in range(frames):
            line = random.choice(model.lines, p=_distribution(model.transition.table[line]))
            drawn_lines.append(line)
        lines = np.array(drawn_lines)
    elif model.prior_select is None:
        lines = random.choice(model.lines, size=frames, p=_distribution(model.prior_distribution))
    else:
        rows = random.integers(0, model.prior_select.values, frames)
        lines = np.array(
            [random.choice(model.lines, p=_distribution(model.prior_select.table[row])) for row in rows]
        )
    addresses = np.empty((frames, len(model.known)), dtype=np.int64)
    for column, known in enumerate(model.known):
        cumulative = np.cumsum(known.table[:, lines], axis=0)
        drawn = random.random(frames) * cumulative[-1]
        addresses[:, column] = (cumulative <= drawn).sum(axis=0)
    origin = source or f"{frames} frames drawn from the model (seed {seed})"
    return Readings(origin, addresses, rows, lines=lines)


def readings_of_lines(
    drawn: Readings, model: Model, machine: BM1Machine, *, scale: Scale, seed: int
) -> Readings:
    """Convert drawn readings for a machine whose lines have their own readings.

    The cell of the true line reads the drawn value. The model does not define the readings of the other lines. These
    readings are drawn from P(K), the distribution of the reading without a known line. With sensor_mode `threshold`,
    the result also contains the likelihoods as codes.

    Raises:
        BuildError: The true lines of `drawn` are unknown, because its readings were not drawn from a model.
    """
    if drawn.lines is None:
        raise BuildError("the true line is known only for drawn readings")
    frames = len(drawn)
    shape = (frames, len(model.known), model.lines)
    random = np.random.default_rng((seed, 1))
    addresses = np.empty(shape, dtype=np.int64)
    for column, known in enumerate(model.known):
        mean = np.cumsum(known.table @ _distribution(model.prior_distribution))
        others = np.searchsorted(mean, random.random((frames, model.lines)) * mean[-1], side="right")
        addresses[:, column] = np.minimum(others, known.values - 1)
    addresses[np.arange(frames), :, drawn.lines] = drawn.addresses
    if machine.parameters.has_tables:
        return replace(drawn, addresses=addresses)
    codes = np.empty(shape, dtype=np.uint16)
    for column, known in enumerate(model.known):
        likelihoods = known.table[addresses[:, column], np.arange(model.lines)]
        codes[:, column] = written_codes(likelihoods, prob_bits=machine.parameters.prob_bits, scale=scale)
    return replace(drawn, addresses=addresses, codes=codes)


def model_of_codes(
    name: str, searched: Sequence[Dimension], variables: Sequence[Variable], machine: BM1Machine
) -> Model:
    """Reconstruct a model from the codes of a machine, for drawing readings without the original model.

    A table has a row for each value of a reading, and a probability for each line in the row. The build divided each
    row by the row's maximum, so the codes do not contain the maxima. Expectation maximisation estimates the maxima. It
    uses the fact that the probabilities of all values sum to 1 for every line.
    """
    width = machine.parameters.prob_bits
    known = []
    sensors = [variable for variable in variables if variable.kind == "sensor"]
    for variable, table in zip(sensors, machine.tables, strict=True):
        codes = decode_code(table[: variable.values], width)
        known.append(Known(name=variable.name, table=_conditional(codes), bits=variable.bits))
    prior = decode_code(machine.prior, width)
    model = Model(name=name, searched=tuple(searched), known=tuple(known), prior=_distribution(prior[-1]))
    select = next((variable for variable in variables if variable.kind == "prior_select"), None)
    if select is None:
        return model
    rows = np.stack([_distribution(row) for row in prior[: select.values]])
    return replace(model, prior_select=PriorSelect(name=select.name, table=rows, bits=select.bits))


def _conditional(codes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale the rows of a table so that each column sums to about 1, then normalise each column.

    A column of zeros becomes uniform.
    """
    codes = np.where(codes.sum(axis=0) > 0, codes, 1.0)
    served = codes.sum(axis=1) > 0
    weights = served / max(int(served.sum()), 1)
    for _ in range(_WEIGHT_STEPS):
        back = codes @ (1.0 / (weights @ codes))
        weights = np.divide(weights * back, codes.sum(axis=1), out=np.zeros_like(weights), where=served)
    table = weights[:, np.newaxis] * codes
    scaled: NDArray[np.float64] = table / table.sum(axis=0)
    return scaled


def _distribution(ratios: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ratios, normalised to the sum 1, because even a model's probabilities have it only within 1e-6."""
    total = ratios.sum()
    return ratios / total if total > 0 else np.full(ratios.shape, 1 / ratios.size)


def recorded_readings(
    path: Path,
    variables: Sequence[Variable],
    given: Sequence[str],
    *,
    frames: int,
    tolerance_s: float = 0.1,
    in_sequence: bool = False,
) -> Readings:
    """Return at most `frames` readings of a recording (CSV, MCAP or bag).

    Without `in_sequence`, the rows are spread over the recording. A row that does not fit the machine is left out. With
    `in_sequence`, the readings come from the first `frames` rows. A row that does not fit the machine then counts as a
    row without readings.

    If `given` is empty, each variable reads the column of its own name. Otherwise, `given` has NAME=COLUMN for each
    variable that has a column. The readings of all other variables are missing. A `*` in COLUMN stands for the text
    that matches the `*` in NAME. In a bag with several topics, the messages of one row may be up to `tolerance_s`
    apart.

    Raises:
        ModelError: The recording or a column does not exist, or no row fits the machine.
        BuildError: A variable in `given` is unknown, or `frames` is out of range.
    """
    check_frames(frames)
    columns = reading_columns([variable.name for variable in variables], given)
    recording = read_recording(path, columns.values(), tolerance_s=tolerance_s)
    count = min(frames, recording.rows)
    spread = np.unique(np.linspace(0, recording.rows - 1, count).astype(int)).tolist()
    found = _rows_of(recording, variables, columns, range(count) if in_sequence else spread)
    refused = int((~found.fits).sum())
    left_out = f", without {refused} that do not fit ({found.why})" if refused else ""
    kept, all_rows = found.fits | in_sequence, found.readings
    source = f"{kept.sum()} of {recording.rows} rows of {path.name}{left_out}"
    return Readings(source, all_rows.addresses[kept], all_rows.prior_addresses[kept])


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Rows of a recording.

    Attributes:
        readings: The readings of all rows. If a row does not fit the machine, all its readings are missing.
        fits: bool[rows], whether the machine takes all values of the row. A row that does not fit gets no posterior.
        stamps: int64[rows], in nanoseconds, from a bag's messages or a CSV file's column of stamps. If there are no
            stamps, the rows' indices 0, 1, 2, ...
        why: The error of the first row that does not fit, or an empty string if all rows fit.
    """

    readings: Readings
    fits: NDArray[np.bool_]
    stamps: NDArray[np.int64]
    why: str = ""

    def __len__(self) -> int:
        return len(self.readings)


def recorded_frames(
    path: Path, variables: Sequence[Variable], given: Sequence[str], *, tolerance_s: float = 0.1
) -> Frames:
    """Return all rows of a recording. `recorded_readings` describes the arguments.

    Raises:
        BuildError: A name in `given` is unknown, or a variable that must have a reading has no column.
        ModelError: The recording is missing or damaged, lacks a column, or has no row that fits the machine.
    """
    columns = reading_columns([each.name for each in variables], given)
    unnamed = [each.name for each in variables if each.name not in columns and each.on_missing == "error"]
    if unnamed:
        raise BuildError(f"{', '.join(unnamed)}: no column; add --reading {unnamed[0]}=COLUMN")
    recording = read_recording(path, columns.values(), tolerance_s=tolerance_s, stamped=True)
    return _rows_of(recording, variables, columns, range(recording.rows))


def _rows_of(
    recording: Recording, variables: Sequence[Variable], columns: dict[str, str], rows: Sequence[int]
) -> Frames:
    addresses = np.full((len(rows), len(variables)), MISSING, dtype=np.int64)
    fits, why = np.ones(len(rows), bool), ""
    for at, row in enumerate(rows):
        try:
            found = [
                to_address(each, recording.columns[columns[each.name]][row] if each.name in columns else None)
                for each in variables
            ]
        except ReadingError as error:
            fits[at], why = False, why or f"row {row}: {error}"
        else:
            addresses[at] = [MISSING if address is None else address for address in found]
    if not fits.any():
        raise ModelError(f"{recording.path} has no row that fits this machine" + (f": {why}" if why else ""))
    sensors = [at for at, variable in enumerate(variables) if variable.kind == "sensor"]
    selects = [at for at, variable in enumerate(variables) if variable.kind == "prior_select"]
    prior = addresses[:, selects[0]] if selects else np.full(len(rows), MISSING, dtype=np.int64)
    stamps = np.array(recording.stamps or range(recording.rows), np.int64)[list(rows)]
    return Frames(Readings("", addresses[:, sensors], prior), fits, stamps, why)
