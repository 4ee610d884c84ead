"""Findings of checks. The checks in this module search the codes of a BM1, for example for lines that never count."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import BM1Machine
from machines.parameters import PROB_BITS_MAX, BM1Parameters, PriorMode, SensorMode
from toolchain.building.options import BuildOptions
from toolchain.building.quantise import Quantised
from toolchain.deployment import Deployment, Dimension, Scale, Variable
from toolchain.models.model import Model


class Severity(StrEnum):
    """The severity of a finding."""

    ERROR = "error"
    """The model cannot be built, or computes wrong results."""
    WARNING = "warning"
    """Some readings get no posterior or a wrong posterior, or resources are wasted."""
    NOTE = "note"
    """The finding may be intended. If so, nothing is wrong."""


class Check(StrEnum):
    """The names of checks in `toolchain check --json`. docs/reference/toolchain.md describes each check."""

    CANNOT_BE_BUILT = "cannot-be-built"
    DEAD_LINES = "dead-lines"
    DEAD_BOARD = "dead-board"
    IMPOSSIBLE_READINGS = "impossible-readings"
    LOST_FRAMES = "lost-frames"
    COLUMN_WITHOUT_EFFECT = "column-without-effect"
    SAME_READING = "same-reading"
    ADDRESS_BITS = "address-bits"
    RANGE = "range"
    STATES = "ambiguous-states"
    PAIRING = "pairing"
    STOPPING = "stopping"
    VANISHED_FLOOR = "vanished-floor"
    LOST_MASS = "lost-mass"
    FILES = "files"
    EDITED = "edited"
    RNG = "rng"
    RNG_BANKS = "rng-banks"
    RNG_STEPS = "rng-steps"
    RNG_PERIOD = "rng-period"
    RNG_RELATION = "rng-relation"
    RNG_TABLE = "rng-table"
    CLIPPED = "clipped-factors"
    CODES_ERROR = "codes-error"
    MIXING = "mixing"
    OPPOSITE_CLIPS = "opposite-clips"
    CONNECTION = "unconnected-states"
    WIDE_FACTOR = "wide-factor"


@dataclass(frozen=True, slots=True)
class Finding:
    """A finding of a check about a part of a model or machine. If the user can change something, `advice` says what."""

    severity: Severity
    check: Check
    about: str
    what: str
    advice: str = ""

    @property
    def sentence(self) -> str:
        """The finding as one line for a user."""
        return f"{self.severity}: {self.about}: {self.what}{f'; {self.advice}' if self.advice else ''}"


error: Final = partial(Finding, Severity.ERROR)
warning: Final = partial(Finding, Severity.WARNING)
note: Final = partial(Finding, Severity.NOTE)


@dataclass(frozen=True, slots=True, eq=False)
class CheckedMachine:
    """A BM1 to check, with the lines of all its boards.

    Attributes:
        deployment: The machine's deployment, with variables, lines and limits.
        board: The machine of the first board. All boards have its parameters and random numbers.
        prior: uint16[rows, lines], the prior's codes for the lines of all boards.
        tables: uint16[2**bits, lines] for each column, the column's codes for the lines of all boards.
        model: The model with the probabilities, or None if only the codes are known.
    """

    deployment: Deployment
    board: BM1Machine
    prior: NDArray[np.uint16]
    tables: tuple[NDArray[np.uint16], ...]
    model: Model | None

    @property
    def parameters(self) -> BM1Parameters:
        """The parameters of the first board. The other boards differ only in their lines."""
        return self.board.parameters

    @property
    def names(self) -> list[str]:
        """The columns' names, the prior first."""
        return ["the prior", *(variable.name for variable in self.deployment.sensors)]

    def addressable_rows(self, column: int) -> NDArray[np.uint16]:
        """Return the rows of a sensor's table that readings can select.

        If readings may be missing, the last row is the row for missing readings.
        """
        return _addressable(self.deployment.sensors[column], self.tables[column])

    def prior_rows(self) -> NDArray[np.uint16]:
        """Return the rows of the prior that a reading can select. If no variable selects the prior, return all rows."""
        select = self.deployment.prior_select
        return self.prior if select is None else _addressable(select, self.prior)


def _addressable(variable: Variable, rows: NDArray[np.uint16]) -> NDArray[np.uint16]:
    served = rows[: variable.values]
    return np.vstack([served, rows[-1:]]) if variable.on_missing == "missing" else served


_MOST_RANGES: Final = 4
_LOST_OFTEN: Final = 0.02


def code_findings(machine: CheckedMachine) -> Iterator[Finding]:
    """Find lines that never count, impossible readings, columns without effect, and an unreachable target count."""
    yield from _lines(machine)
    yield from _readings(machine)
    yield from _columns(machine)
    yield from _stopping(machine)


def loss_findings(quantised: Quantised, options: BuildOptions) -> Iterator[Finding]:
    """Find outlier floors (minimum likelihoods) that become code 0, and models that often give the true line code 0.

    The true line is the line of the true value in a frame drawn from the model.
    """
    for floor in quantised.floors:
        yield warning(Check.VANISHED_FLOOR, floor.name, floor.what, floor.advice)
    mass = sum(loss.mass for loss in quantised.losses)
    if mass > _LOST_OFTEN:
        worst = max(quantised.losses, key=lambda loss: loss.mass)
        what = f"in up to {min(mass, 1):.1%} of the model's own frames some reading has code 0 on the true line, most "
        what += f"often one of {worst.name} ({worst.mass:.1%})"
        may_scale = options.scaling is not Scale.ADDRESS and options.sensor_mode is SensorMode.COLUMN
        advice = f"use more --prob-bits{' or --scale address' if may_scale else ''}, or a floor for outliers"
        yield warning(Check.LOST_MASS, "the codes", what, advice)


def line_name(searched: Sequence[Dimension], line: int) -> str:
    """Return a line as text, with the value of each searched variable: `y = 1.5, x = 3`."""
    places = np.unravel_index(line, [dimension.size for dimension in searched])
    return ", ".join(
        f"{dimension.label} = {dimension.states[at] if dimension.states else f'{dimension.value(float(at)):g}'}"
        for dimension, at in zip(searched, places, strict=True)
    )


def reading(variable: Variable, address: int) -> str:
    """Return the reading at an address as text for the user: `3.5`, `open`, or `a missing reading`."""
    if address >= variable.values:
        return "a missing reading"
    if variable.states:
        return variable.states[address]
    return f"{variable.offset + address * variable.step:g}"


def _alive(machine: CheckedMachine) -> NDArray[np.bool_]:
    """Return which lines can count for at least some readings: bool[lines]."""
    alive = np.ones(machine.prior.shape[1], dtype=np.bool_)
    if machine.parameters.prior_mode is PriorMode.TABLE:  # a written prior is not known before a frame
        alive &= machine.prior_rows().any(axis=0)
    for column in range(len(machine.tables)):
        alive &= machine.addressable_rows(column).any(axis=0)
    return alive


def _lines(machine: CheckedMachine) -> Iterator[Finding]:
    """Find lines that can never count, regardless of the readings."""
    deployment = machine.deployment
    dead = ~_alive(machine)
    if dead.all():
        what = "no line can ever count, regardless of the readings: each has code 0 in the prior or in a whole column"
        yield error(Check.DEAD_LINES, "the machine", what, _wider(machine))
        return
    if machine.parameters.prior_mode is PriorMode.TABLE:
        yield from _dead_prior(machine)
    for column, variable in enumerate(deployment.sensors[: len(machine.tables)]):
        lines = np.flatnonzero(~machine.addressable_rows(column).any(axis=0))
        if lines.size:
            what = f"every value of it has code 0 at {_some_lines(deployment, lines)}, which can never count"
            yield warning(Check.DEAD_LINES, variable.name, what, _wider(machine))
    for index, board in enumerate(deployment.boards):
        if dead[board.line_offset : board.line_offset + board.lines].all():
            what = "none of its lines can ever count, regardless of the readings"
            advice = "use fewer --partitions, or a model that searches only possible values"
            yield warning(Check.DEAD_BOARD, f"board {index}", what, advice)


def _dead_prior(machine: CheckedMachine) -> Iterator[Finding]:
    deployment, model = machine.deployment, machine.model
    dead = ~machine.prior_rows().any(axis=0)
    meant = np.zeros_like(dead)
    if model is not None:
        meant = model.prior_distribution == 0
        if model.prior_select is not None:
            meant &= ~model.prior_select.table.any(axis=0)
    if (lines := np.flatnonzero(dead & meant)).size:
        what = f"the model says that {_some_lines(deployment, lines)} is impossible, so it never counts"
        yield note(Check.DEAD_LINES, "the prior", what)
    if (lines := np.flatnonzero(dead & ~meant)).size:
        what = f"it has code 0 at {_some_lines(deployment, lines)}, which can never count"
        yield warning(Check.DEAD_LINES, "the prior", what, "" if model is None else _wider(machine))


def _readings(machine: CheckedMachine) -> Iterator[Finding]:
    """Find readings with code 0 on every line. A frame with one of these readings ends as `impossible`."""
    deployment, model = machine.deployment, machine.model
    alive = _alive(machine)
    if not alive.any() or machine.parameters.sensor_mode is not SensorMode.COLUMN:
        return  # if each line has its own reading, a value does not affect the other lines
    rows: list[tuple[Variable, NDArray[np.uint16], NDArray[np.float64] | None]] = [
        (variable, table, None if model is None else model.known[column].table @ model.prior_distribution)
        for column, (variable, table) in enumerate(zip(deployment.sensors, machine.tables, strict=True))
    ]
    if deployment.prior_select is not None:
        rows.append((deployment.prior_select, machine.prior, None))
    for variable, table, probabilities in rows:
        impossible = ~table[: variable.values, alive].any(axis=1)
        possible = np.ones_like(impossible) if probabilities is None else probabilities > 0
        if (addresses := np.flatnonzero(impossible & possible)).size:
            often = "" if probabilities is None else f", {probabilities[addresses].sum():.2g} of all readings"
            what = f"{addresses.size} of its {variable.values} values ({_values(variable, addresses)}{often}) have code "
            what += "0 on every line that can count, so such a frame gives no posterior"
            yield warning(Check.IMPOSSIBLE_READINGS, variable.name, what, _wider(machine))
        if (addresses := np.flatnonzero(impossible & ~possible)).size:
            what = f"the model says that {addresses.size} of its {variable.values} values ({_values(variable, addresses)}) "
            what += "are impossible; a frame with one gives no posterior"
            advice = "an outlier floor would accept such a reading"
            yield note(Check.IMPOSSIBLE_READINGS, variable.name, what, advice)


def _columns(machine: CheckedMachine) -> Iterator[Finding]:
    """Find columns whose readings have no effect on the posterior."""
    if machine.parameters.sensor_mode is not SensorMode.COLUMN:
        return
    more = ", or use more --prob-bits" if machine.parameters.prob_bits < PROB_BITS_MAX else ""
    for variable, table in zip(machine.deployment.sensors, machine.tables, strict=True):
        served = table[: variable.values]
        if served.shape[1] > 1 and (served == served[:, :1]).all():
            what = "each of its values has the same code on every line, so its readings have no effect"
            yield note(Check.COLUMN_WITHOUT_EFFECT, variable.name, what, f"omit it{more}")


def _stopping(machine: CheckedMachine) -> Iterator[Finding]:
    limits = machine.deployment.machine
    if limits.target_count > limits.max_cycles:
        what = f"no counter can reach {limits.target_count} in {limits.max_cycles} cycles, so every frame takes all of them"
        advice = f"use --max-cycles above {limits.target_count}, or a smaller --target-count"
        yield warning(Check.STOPPING, "the machine", what, advice)


def _wider(machine: CheckedMachine) -> str:
    ways = ["--scale address"] if machine.deployment.machine.scale != "address" else []
    ways += ["more --prob-bits"] if machine.parameters.prob_bits < PROB_BITS_MAX else []
    return f"use {' or '.join(ways)}" if ways else ""


def _some_lines(deployment: Deployment, lines: NDArray[np.int64]) -> str:
    first = line_name(deployment.searched, int(lines[0]))
    if len(lines) == 1:
        return first
    return f"{len(lines)} of {deployment.machine.lines} lines ({first} and others)"


def _values(variable: Variable, addresses: NDArray[np.int64]) -> str:
    """Return addresses as text: the values that they stand for, with adjacent ones as ranges."""
    ranges: list[list[int]] = []
    for address in addresses.tolist():
        if ranges and address == ranges[-1][1] + 1:
            ranges[-1][1] = address
        else:
            ranges.append([address, address])
    shown = [
        reading(variable, low) if low == high else f"{reading(variable, low)} to {reading(variable, high)}"
        for low, high in ranges[:_MOST_RANGES]
    ]
    return ", ".join(shown) + (" and others" if len(ranges) > _MOST_RANGES else "")
