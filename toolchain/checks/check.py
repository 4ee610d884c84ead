"""Says what is wrong with a machine before anything runs, in the model's own names (thesis 3.4).

A model is checked with what it would be built with, a deployment with what its images hold. Whatever is said of
codes is exact: a reading that is called impossible ends a frame as `impossible` on the machine, and a line that is
called dead never counts.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

import numpy as np

from machines.errors import MachineError
from machines.parameters import PriorMode, SensorMode
from pcie_shim.errors import PcieShimError
from toolchain.building.agreement import check_agreement, read_images
from toolchain.building.board_layout import board_layout
from toolchain.building.build import assemble
from toolchain.building.machine import machine_parameters
from toolchain.building.partition import partition_lines
from toolchain.checks.checked_machine import CheckedMachine
from toolchain.checks.finding import Finding, Severity
from toolchain.checks.generators import generator_findings
from toolchain.deployment import Scale, load_deployment
from toolchain.errors import ToolchainError
from toolchain.outputs.output_files import Change, compare_files, memory_files, quartus_files

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pcie_shim.programming_file import Image
    from toolchain.building.options import BuildOptions
    from toolchain.building.quantise import Quantised
    from toolchain.deployment import Deployment, Dimension, Variable
    from toolchain.models.model import Model

_MOST_RANGES: Final = 4
_LOST_OFTEN: Final = 0.02


def check_model(model: Model, options: BuildOptions) -> list[Finding]:
    """Return what there is to say about a model and the machine that would be built of it, the worst first."""
    try:
        built = assemble(model, options)
    except ToolchainError as reason:
        return _refusals(model, options, reason)
    machine = _machine(built.deployment, built.images, model)
    return _sorted([*_check(machine), *_quantising(built.quantised, options)])


def check_deployment(directory: Path) -> list[Finding]:
    """Return what there is to say about a deployment: its files, and the machine that its images hold."""
    try:
        deployment = load_deployment(directory)
        images = read_images(deployment)
        check_agreement(deployment, images)
    except (ToolchainError, PcieShimError) as reason:
        return [refusal(reason, "the deployment")]
    return _sorted([*_files(directory, deployment, images), *_check(_machine(deployment, images, None))])


def refusal(reason: Exception, about: str) -> Finding:
    """Return what can't be built or read as a finding."""
    return Finding(
        severity=Severity.ERROR, check="cannot-be-built", about=about, what=str(reason).rstrip(".")
    )


def reading(variable: Variable, address: int) -> str:
    """Return a value of a variable as a user knows it: `3.5`, `open`, or `a missing reading`."""
    if address >= variable.values:
        return "a missing reading"
    if variable.states:
        return variable.states[address]
    return f"{variable.offset + address * variable.step:g}"


def line_name(searched: Sequence[Dimension], line: int) -> str:
    """Return a line by the values of the searched variables: `y = 1.5, x = 3`."""
    places = np.unravel_index(line, [dimension.size for dimension in searched])
    return ", ".join(
        f"{dimension.label} = {dimension.states[at] if dimension.states else f'{dimension.value(float(at)):g}'}"
        for dimension, at in zip(searched, places, strict=True)
    )


def _refusals(model: Model, options: BuildOptions, first: ToolchainError) -> list[Finding]:
    """Return why a model can't be built: each part is tried by itself, so that one mistake hides no other."""
    tries: list[tuple[str, Callable[[], object]]] = [
        ("the partitions", lambda: partition_lines(model.lines, options.partitions)),
        ("the machine", lambda: machine_parameters(model, options)),
        (
            "the interface",
            lambda: board_layout(machine_parameters(model, options), options.partitions, options.interface),
        ),
    ]
    found: dict[str, Finding] = {}
    for about, attempt in tries:
        try:
            attempt()
        except (ToolchainError, MachineError) as reason:
            finding = refusal(reason, about)
            found.setdefault(finding.what, finding)
    finding = refusal(first, "the machine")
    found.setdefault(finding.what, finding)
    return list(found.values())


def _machine(deployment: Deployment, images: Sequence[Image], model: Model | None) -> CheckedMachine:
    machines = [image.machine for image in images]
    return CheckedMachine(
        deployment=deployment,
        board=machines[0],
        prior=np.hstack([machine.prior for machine in machines]),
        tables=tuple(
            np.hstack(tables) for tables in zip(*(machine.tables for machine in machines), strict=True)
        ),
        model=model,
    )


def _check(machine: CheckedMachine) -> Iterator[Finding]:
    yield from _lines(machine)
    yield from _readings(machine)
    yield from _columns(machine)
    yield from _ranges(machine.deployment)
    yield from _stopping(machine)
    yield from generator_findings(machine)


def _alive(machine: CheckedMachine) -> NDArray[np.bool_]:
    """Return which lines can count for at least some readings: bool[lines]."""
    alive = np.ones(machine.prior.shape[1], dtype=np.bool_)
    if machine.parameters.prior_mode is PriorMode.TABLE:  # what the host writes is not known here
        alive &= machine.prior_rows().any(axis=0)
    for column in range(len(machine.tables)):
        alive &= machine.served(column).any(axis=0)
    return alive


def _lines(machine: CheckedMachine) -> Iterator[Finding]:
    """Lines that can never count, whatever is read."""
    deployment = machine.deployment
    dead = ~_alive(machine)
    if dead.all():
        yield Finding(
            severity=Severity.ERROR,
            check="dead-lines",
            about="the machine",
            what="no line can ever count, whatever is read: each has code 0 in the prior or in some whole column",
            advice=_wider(machine),
        )
        return
    if machine.parameters.prior_mode is PriorMode.TABLE:
        yield from _dead_prior(machine)
    for column, variable in enumerate(deployment.sensors[: len(machine.tables)]):
        lines = np.flatnonzero(~machine.served(column).any(axis=0))
        if lines.size:
            yield Finding(
                severity=Severity.WARNING,
                check="dead-lines",
                about=variable.name,
                what=f"every value of it has code 0 at {_some_lines(deployment, lines)}, which can never count",
                advice=_wider(machine),
            )
    for index, board in enumerate(deployment.boards):
        if dead[board.line_offset : board.line_offset + board.lines].all():
            yield Finding(
                severity=Severity.WARNING,
                check="dead-board",
                about=f"board {index}",
                what="none of its lines can ever count, whatever is read",
                advice="use fewer --partitions, or a model that searches what is possible",
            )


def _dead_prior(machine: CheckedMachine) -> Iterator[Finding]:
    deployment, model = machine.deployment, machine.model
    dead = ~machine.prior_rows().any(axis=0)
    meant = np.zeros_like(dead)
    if model is not None:
        meant = model.prior_distribution == 0
        if model.prior_select is not None:
            meant &= ~model.prior_select.table.any(axis=0)
    if (lines := np.flatnonzero(dead & meant)).size:
        yield Finding(
            severity=Severity.NOTE,
            check="dead-lines",
            about="the prior",
            what=f"the model says that {_some_lines(deployment, lines)} is never the case, so it never counts",
        )
    if (lines := np.flatnonzero(dead & ~meant)).size:
        yield Finding(
            severity=Severity.WARNING,
            check="dead-lines",
            about="the prior",
            what=f"it has code 0 at {_some_lines(deployment, lines)}, which can never count",
            advice="" if model is None else _wider(machine),
        )


def _readings(machine: CheckedMachine) -> Iterator[Finding]:
    """Readings for which every line has a 0 code: a frame with one ends as `impossible`."""
    deployment, model = machine.deployment, machine.model
    alive = _alive(machine)
    if not alive.any() or machine.parameters.sensor_mode is not SensorMode.COLUMN:
        return  # where each line has a reading of its own, a value says nothing of the other lines
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
            yield Finding(
                severity=Severity.WARNING,
                check="impossible-readings",
                about=variable.name,
                what=(
                    f"{addresses.size} of its {variable.values} values ({_values(variable, addresses)}{often}) have code "
                    "0 on every line that can count, so such a frame gives no posterior"
                ),
                advice=_wider(machine),
            )
        if (addresses := np.flatnonzero(impossible & ~possible)).size:
            yield Finding(
                severity=Severity.NOTE,
                check="impossible-readings",
                about=variable.name,
                what=(
                    f"the model says that {addresses.size} of its {variable.values} values "
                    f"({_values(variable, addresses)}) never occur; a frame with one gives no posterior"
                ),
                advice="a floor for outliers would let such a reading pass",
            )


def _columns(machine: CheckedMachine) -> Iterator[Finding]:
    """Columns that say nothing, and two that read the same."""
    of_columns = machine.parameters.sensor_mode is SensorMode.COLUMN
    for variable, table in zip(
        machine.deployment.sensors, machine.tables if of_columns else (), strict=of_columns
    ):
        served = table[: variable.values]
        if served.shape[1] > 1 and (served == served[:, :1]).all():
            yield Finding(
                severity=Severity.NOTE,
                check="column-without-effect",
                about=variable.name,
                what="each of its values has the same code on every line, so its readings change nothing",
                advice="leave it out, or use more --prob-bits",
            )
    # A bare name as a path is searched for like the name itself.
    paths = Counter(
        (variable.source, variable.path or variable.name) for variable in machine.deployment.variables
    )
    for (source, path), count in paths.items():
        if count > 1:
            names = [
                variable.name
                for variable in machine.deployment.variables
                if (variable.source, variable.path or variable.name) == (source, path)
            ]
            yield Finding(
                severity=Severity.WARNING,
                check="same-reading",
                about=" and ".join(names),
                what=f"they are all read from {path}",
                advice="give each a path of its own, in the model or with 'toolchain regenerate deployment --path'",
            )


def _ranges(deployment: Deployment) -> Iterator[Finding]:
    """Ranges of readings that don't fit the addresses."""
    for variable in deployment.variables:
        needed = variable.values.bit_length()
        if needed < variable.bits:
            yield Finding(
                severity=Severity.NOTE,
                check="address-bits",
                about=variable.name,
                what=(
                    f"its {variable.values} values and the missing reading fit {needed} address bits, and it has "
                    f"{variable.bits}: its memory is {2 ** (variable.bits - needed)} times as deep as need be"
                ),
                advice=f"use --bits {variable.name}={needed}",
            )
        if variable.period is not None and variable.period > variable.values:
            yield Finding(
                severity=Severity.WARNING,
                check="range",
                about=variable.name,
                what=(
                    f"its readings go round in {variable.period} steps, but only {variable.values} are served: those from "
                    f"{variable.offset + variable.values * variable.step:g} on are out of range"
                ),
                advice=f"give it {variable.period} values, or a period of {variable.values}",
            )
        if variable.period is not None and variable.period < variable.values:
            yield Finding(
                severity=Severity.WARNING,
                check="range",
                about=variable.name,
                what=(
                    f"its readings go round in {variable.period} steps, so that the last "
                    f"{variable.values - variable.period} of its {variable.values} values never occur"
                ),
                advice=f"give it {variable.period} values, or a period of {variable.values}",
            )
        if variable.on_range == "missing" and variable.on_missing == "error":
            yield Finding(
                severity=Severity.WARNING,
                check="range",
                about=variable.name,
                what="a reading out of range is a missing one (on_range), and a missing one is an error (on_missing)",
                advice='say on_missing="missing", or on_range="clamp" or "error"',
            )


def _stopping(machine: CheckedMachine) -> Iterator[Finding]:
    limits = machine.deployment.machine
    if limits.target_count > limits.max_cycles:
        yield Finding(
            severity=Severity.WARNING,
            check="stopping",
            about="the machine",
            what=(
                f"no counter can reach {limits.target_count} in {limits.max_cycles} cycles, so every frame takes all of "
                "them"
            ),
            advice=f"use --max-cycles above {limits.target_count}, or a smaller --target-count",
        )


def _quantising(quantised: Quantised, options: BuildOptions) -> Iterator[Finding]:
    """What the codes lose of the probabilities."""
    for floor in quantised.floors:
        yield Finding(
            severity=Severity.WARNING,
            check="vanished-floor",
            about=floor.name,
            what=floor.what,
            advice=floor.advice,
        )
    mass = sum(loss.mass for loss in quantised.losses)
    if mass > _LOST_OFTEN:
        worst = max(quantised.losses, key=lambda loss: loss.mass)
        yield Finding(
            severity=Severity.WARNING,
            check="lost-mass",
            about="the codes",
            what=(
                f"in up to {min(mass, 1):.1%} of the model's own frames some reading has code 0 on the true line, most "
                f"often one of {worst.name} ({worst.mass:.1%})"
            ),
            advice="use more --prob-bits"
            + (
                ""
                if options.scaling is Scale.ADDRESS or options.sensor_mode is not SensorMode.COLUMN
                else " or --scale address"
            )
            + ", or a floor for outliers",
        )


def _files(directory: Path, deployment: Deployment, images: Sequence[Image]) -> Iterator[Finding]:
    """Files of the hardware project that are not what follows from the images."""
    words = {
        Change.NEW: "is not there",
        Change.CHANGED: "says something else than the images and deployment.toml",
        Change.REMOVED: "is left from before",
    }
    for part, files in (
        ("memories", memory_files(deployment, images)),
        ("project", quartus_files(deployment, images)),
    ):
        wrong = [
            (name, change)
            for name, change in compare_files(directory, files)
            if change is not Change.UNCHANGED
        ]
        if wrong:
            name, change = wrong[0]
            more = f", and {len(wrong) - 1} more files" if len(wrong) > 1 else ""
            yield Finding(
                severity=Severity.WARNING,
                check="files",
                about=name,
                what=f"{words[change]}{more}",
                advice=f"use 'toolchain regenerate {part} {directory}'",
            )


def _wider(machine: CheckedMachine) -> str:
    scale = "" if machine.deployment.machine.scale == "address" else "--scale address or "
    return f"use {scale}more --prob-bits"


def _some_lines(deployment: Deployment, lines: NDArray[np.int64]) -> str:
    first = line_name(deployment.searched, int(lines[0]))
    if len(lines) == 1:
        return first
    return f"{len(lines)} of {deployment.machine.lines} lines ({first} and others)"


def _values(variable: Variable, addresses: NDArray[np.int64]) -> str:
    """Return addresses as values, neighbours as ranges."""
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


def _sorted(findings: Iterable[Finding]) -> list[Finding]:
    order = list(Severity)
    return sorted(findings, key=lambda finding: order.index(finding.severity))
