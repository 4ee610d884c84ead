"""What `toolchain inspect` does: explains a deployment, and says how good and how fast it will be and what it takes."""

from __future__ import annotations

import json
import math
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from machines.parameters import SensorMode
from toolchain.analysis.accuracy import measure
from toolchain.analysis.device import device_named
from toolchain.analysis.emulation import EmulatedBoards, joined, one_replica
from toolchain.analysis.energy import ASSUMPTIONS, energy
from toolchain.analysis.readings import (
    check_frames,
    model_of_codes,
    readings_of_lines,
    recorded_readings,
    sample_readings,
)
from toolchain.analysis.resources import Pcie, estimate
from toolchain.analysis.table_memories import Tables
from toolchain.build import REPORT_NAME, many_sentence
from toolchain.commands.named_model import NetworkQuestion, Unread, read_model
from toolchain.deployment import load_deployment
from toolchain.errors import BuildError, DeploymentError
from toolchain.options import Scale
from toolchain.quantise import quantise

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from contextlib import AbstractContextManager
    from pathlib import Path

    from machines.bm1 import BM1Machine
    from toolchain.analysis.accuracy import Accuracy, Difference, Interval
    from toolchain.analysis.energy import Energy
    from toolchain.analysis.readings import Readings
    from toolchain.analysis.resources import Estimate
    from toolchain.deployment import Deployment
    from toolchain.models.model import Model
    from toolchain.quantise import ColumnLoss

    Counting = AbstractContextManager[Callable[[], None]]

CLOCK_MAX_HZ: Final = 1e12
FRAMES: Final = 200
BANKS: Final = 4
SLOW_FRAMES: Final = 20
"""Of machines that run a cycle at a time: one generator a cell, or no LFSRs."""
LEAST_FRAMES: Final = 20
SLOW_LEAST_FRAMES: Final = 3
"""Of replicas, each of which has readings of its own in every frame."""
SLOW_BANKS: Final = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectOptions:
    """What a deployment is looked at with.

    Attributes:
        model: The folder or network that it was built from, or None.
        settings: `KEY=VALUE`s that it was built with.
        bits: `NAME=BITS`s that it was built with.
        question: What a network was asked.
        recording: Recorded readings, or None to draw them.
        columns: `NAME=COLUMN`s of the recording.
        tolerance_s: In a bag, how far from a row another topic's message may be, seconds.
        frames: How many frames at most; None for 200, or 20 of a machine that only the slow kernel runs; with replicas
            for fewer, as each has readings of its own.
        banks: Sets of seeds that each is run with; None for 4, or 1 of such a machine.
        seed: Of the readings that are drawn.
        clock_hz: The clock that times are said at.
        device: What a board has.
        pcie: What the PCIe controllers are made of.
    """

    model: Path | None = None
    settings: tuple[str, ...] = ()
    bits: tuple[str, ...] = ()
    question: NetworkQuestion = field(default_factory=NetworkQuestion)
    recording: Path | None = None
    columns: tuple[str, ...] = ()
    tolerance_s: float = 0.1
    frames: int | None = None
    banks: int | None = None
    seed: int = 1
    clock_hz: float = 100e6
    device: str = "proce-v-d8"
    pcie: Pcie = Pcie.HARD


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """What was found out about a deployment."""

    deployment: Deployment
    machine: BM1Machine
    losses: tuple[ColumnLoss, ...] | None
    reported_losses: str
    readings: Readings
    accuracy: Accuracy
    resources: tuple[Estimate, ...]
    column_resources: Estimate | None
    energy: Energy
    clock_hz: float


@contextmanager
def uncounted(_frames: int) -> Iterator[Callable[[], None]]:
    """Tell nobody how far it is."""
    yield lambda: None


def inspect(
    directory: Path, options: InspectOptions, counting: Callable[[int], Counting] = uncounted
) -> Inspection:
    """Look at a deployment.

    Args:
        directory: The folder that `toolchain build` wrote.
        options: With what.
        counting: Told how many frames there are, it gives what is called after each.

    Raises:
        ToolchainError: No deployment, a model that it was not built from, or options that mean nothing.
    """
    if not 1.0 <= options.clock_hz <= CLOCK_MAX_HZ:
        message = f"--clock is {options.clock_hz:g}, expected hertz from 1 to {CLOCK_MAX_HZ:g}, such as 100e6"
        raise BuildError(message)
    if options.banks is not None and options.banks < 1:
        message = f"--banks is {options.banks}, expected 1 or more"
        raise BuildError(message)
    device = device_named(options.device)
    deployment = load_deployment(directory)
    machines = machines_of(deployment)
    whole = joined(machines)
    model, losses = _model(deployment, whole, options)
    readings = _readings(deployment, whole, model, options)
    section = deployment.machine
    boards = EmulatedBoards(
        [one_replica(machine) for machine in machines],
        target_count=section.target_count,
        max_cycles=section.max_cycles,
        stop=section.stop,
    )
    interface = (section.interface_sensors, section.interface_results)
    resources = tuple(
        estimate(machine.parameters, device, interface=interface, pcie=options.pcie) for machine in machines
    )
    side_by_side = None
    wide = whole.parameters.shared and whole.parameters.sensor_mode is SensorMode.COLUMN
    if wide and max(each.block_share for each in resources) > 0:
        side_by_side = estimate(
            whole.parameters,
            device,
            interface=(interface[0], max(interface[1], section.results)),
            pcie=options.pcie,
            tables=Tables.COLUMN,
        )
    banks = options.banks or (SLOW_BANKS if _is_slow(whole) else BANKS)
    with counting(len(readings)) as advance:
        accuracy = measure(boards, readings, model, banks=banks, replicas=section.replicas, advance=advance)
    return Inspection(
        deployment=deployment,
        machine=whole,
        losses=losses,
        reported_losses=_reported(directory),
        readings=readings,
        accuracy=accuracy,
        resources=resources,
        column_resources=side_by_side,
        energy=energy(machines, readings),
        clock_hz=options.clock_hz,
    )


def machines_of(deployment: Deployment) -> tuple[BM1Machine, ...]:
    """Return the boards' machines from a deployment's programming files.

    Raises:
        DeploymentError: A programming file can't be read.
    """
    from pcie_shim.errors import PcieShimError
    from pcie_shim.programming_file import read_image

    try:
        return tuple(
            read_image(deployment.image_path(board)).machine for board in range(len(deployment.boards))
        )
    except PcieShimError as reason:
        raise DeploymentError(str(reason)) from reason


def _model(
    deployment: Deployment, whole: BM1Machine, options: InspectOptions
) -> tuple[Model | None, tuple[ColumnLoss, ...] | None]:
    """The unquantised model, once its codes are the deployment's, and what quantising it lost."""
    if options.model is None:
        return None, None
    unread = Unread(settings=options.settings, bits=options.bits)
    model = read_model(options.model, options.question, unread)
    if model.lines == deployment.machine.lines and len(model.known) == whole.parameters.sensors:
        scale = Scale(deployment.machine.scale)
        quantised = quantise(
            model,
            prob_bits=whole.parameters.prob_bits,
            scale=scale,
            sensor_mode=deployment.machine.sensor_mode,
        )
        if all(
            np.array_equal(ours, theirs)
            for ours, theirs in zip(
                (quantised.prior, *quantised.tables), (whole.prior, *whole.tables), strict=True
            )
        ):
            return model, quantised.losses
    message = (
        f"{deployment.directory} was not built from {options.model} with these settings: its codes are others; give the "
        "same --set and --bits as to the build, or build it again"
    )
    raise BuildError(message)


def _readings(
    deployment: Deployment, whole: BM1Machine, model: Model | None, options: InspectOptions
) -> Readings:
    replicas = deployment.machine.replicas
    frames = options.frames
    if frames is None:
        slow = _is_slow(whole)
        usual, least = (SLOW_FRAMES, SLOW_LEAST_FRAMES) if slow else (FRAMES, LEAST_FRAMES)
        frames = max(least, usual // replicas)
    check_frames(frames)
    mode = deployment.machine.sensor_mode
    if options.recording is not None and mode is not SensorMode.COLUMN:
        message = (
            f"--readings {options.recording}: a recording's columns are numbers, and this machine's readings are arrays, one "
            "number for each line: leave it out, and readings are drawn"
        )
        raise BuildError(message)
    if options.recording is not None:
        return recorded_readings(
            options.recording,
            deployment.variables,
            options.columns,
            frames=frames * replicas,
            tolerance_s=options.tolerance_s,
        )
    if options.columns:
        message = (
            f"--reading {options.columns[0]} says where in a recording a reading is: add --readings FILE"
        )
        raise BuildError(message)
    if model is None and mode is SensorMode.THRESHOLD:
        message = (
            "this machine's cells are given their probabilities, so it holds no tables that readings could be drawn from: "
            "name the model with --model"
        )
        raise BuildError(message)
    scale = Scale(deployment.machine.scale)
    of_each = f", each with readings for {replicas} replicas" if replicas > 1 else ""
    if model is not None:
        source = f"{frames} frames{of_each} drawn from the model (seed {options.seed})"
        drawn = sample_readings(model, frames * replicas, seed=options.seed, source=source)
        if mode is SensorMode.COLUMN:
            return drawn
        return readings_of_lines(drawn, model, whole, scale=scale, seed=options.seed)
    drawn_from = model_of_codes(deployment.name, deployment.searched, deployment.variables, whole)
    source = f"{frames} frames{of_each} drawn from what the codes say of the model (seed {options.seed})"
    drawn = sample_readings(drawn_from, frames * replicas, seed=options.seed, source=source)
    if mode is SensorMode.COLUMN:
        return drawn
    return readings_of_lines(drawn, drawn_from, whole, scale=scale, seed=options.seed)


def _is_slow(machine: BM1Machine) -> bool:
    return not machine.parameters.shared or machine.parameters.rng.lfsr_bits is None


def _reported(directory: Path) -> str:
    """What the build's report says was lost by quantising; nothing where there is no report."""
    try:
        text = (directory / REPORT_NAME).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
    return next((part for part in text.split("\n\n") if part.startswith("Lost by quantising")), "")


def report(found: Inspection) -> str:
    """Return what was found, in plain sentences and tables."""
    parts = [
        _machine_part(found),
        _loss_part(found),
        f"Readings: {found.readings.source}"
        + ("" if found.accuracy.banks == 1 else f", each with {found.accuracy.banks} sets of seeds")
        + ".",
        _time_part(found),
        _accuracy_part(found),
        _resource_part(found),
        _energy_part(found),
    ]
    return "\n\n".join(parts) + "\n"


def _machine_part(found: Inspection) -> str:
    deployment, p = found.deployment, found.machine.parameters
    machine = deployment.machine
    grid = " x ".join(f"{each.label} {each.size}" for each in deployment.searched)
    boards = len(deployment.boards)
    lines = sorted({board.lines for board in deployment.boards}, reverse=True)
    split = "" if boards == 1 else f" of {' or '.join(map(str, lines))} lines each"
    rows = [
        (
            f"Deployment {deployment.name} ({deployment.hash[:16]}): {machine.lines} lines ({grid}), {p.sensors} sensor "
            f"columns and the prior, on {boards} board{'s' if boards > 1 else ''}{split}."
        ),
        (
            f"Codes of {p.prob_bits} bits (scale = {machine.scale}), counters of {p.counter_bits} "
            f"bits, {p.rng} {'one a column' if p.shared else 'one a cell'} with {p.steps_per_clock} steps a clock and "
            f"{p.rng_banks} bank{'s' if p.rng_banks > 1 else ''}; stops at a count of {machine.target_count} or after "
            f"{machine.max_cycles} cycles, stop = {machine.stop}."
        ),
        *([many] if (many := many_sentence(machine).strip()) else []),
    ]
    names = [variable.name for variable in deployment.sensors]
    width = max([6, *map(len, names)])
    rows.append(f"  {'column':{width}}  address bits  values  codes 0  all ones")
    select = deployment.prior_select
    tables = [("prior", p.prior_bits, select.values if select else 1, found.machine.prior)]
    tables += [
        (variable.name, bits, variable.values, table)
        for variable, bits, table in zip(
            deployment.sensors, p.sensor_bits, found.machine.tables, strict=p.has_tables
        )
    ]
    for name, bits, values, table in tables:
        served = table[:values]
        rows.append(
            f"  {name:{width}}  {bits:12d}  {values:6d}  {(served == 0).mean():7.0%}  {(served == p.ones_code).mean():8.0%}"
        )
    return "\n".join(rows)


def _loss_part(found: Inspection) -> str:
    if found.losses is None:
        return found.reported_losses or "Lost by quantising: unknown here; name the model with --model."
    width = max(6, *(len(loss.name) for loss in found.losses))
    rows = [
        "Lost by quantising (mass: how often the true line has code 0; KL: of the column's own posterior, bits):",
        f"  {'column':{width}}       mass         KL",
    ]
    rows += [f"  {loss.name:{width}}  {loss.mass:9.2e}  {loss.kl_bits:9.2e}" for loss in found.losses]
    return "\n".join(rows)


def _time_part(found: Inspection) -> str:
    cycles = found.accuracy.cycles
    rows = [
        f"Cycles of a frame, and time at {_unit(found.clock_hz, 'Hz')} (the boards' computing alone: no link, no ROS):",
        "            cycles        time",
    ]
    for name, count in (
        ("median", cycles.median.value),
        ("95 %", cycles.percentile_95.value),
        ("worst", float(cycles.worst)),
    ):
        rows.append(f"  {name:6}  {count:10,.0f}  {_unit(count / found.clock_hz, 's'):>10}")
    counted = "posteriors" if found.deployment.machine.replicas > 1 else "frames"
    rows.append(
        f"  {found.accuracy.overflow:.0%} of runs end by a full counter; without a posterior: {found.accuracy.without:.1%} of "
        f"runs (in {found.accuracy.impossible:.1%} of {counted} no line can count)."
    )
    if found.deployment.machine.replicas > 1:
        replicas = found.deployment.machine.replicas
        rows.append(
            f"  A frame is {replicas} posteriors and ends with the last of them: {cycles.median.value / replicas:,.1f} cycles a posterior "
            "in the median."
        )
    return "\n".join(rows)


def _accuracy_part(found: Inspection) -> str:
    accuracy = found.accuracy
    rows = [
        f"Accuracy over {accuracy.frames} frames (means with 95 % intervals; frames are drawn anew, banks within them not):",
        "                                       total variation               KL, bits             same MAP",
    ]
    for name, difference in (
        ("the machine beside the model", accuracy.machine),
        ("  of that, by quantising alone", accuracy.quantising),
        ("the machine beside its own codes", accuracy.sampling),
    ):
        if difference is not None:
            rows.append(f"  {name:34}{_difference(difference)}")
    if accuracy.machine is None:
        rows.append("  Name the model with --model to have the loss by quantising too.")
    if accuracy.z is not None:
        z = accuracy.z
        rows.append(
            f"  z-scores of {z.counts:,} counts from {z.draws:,} draws of random numbers, {z.cycles:,} cycles each, against equation 2.1: root mean square "
            f"{_interval(z.rms, '.2f')} (1 is ideal), mean {_interval(z.mean, '.2f')}, beyond 3: {z.beyond_three:.2%} "
            "(0.27 % is normal)."
        )
    return "\n".join(rows)


def _difference(difference: Difference) -> str:
    return (
        f"{_interval(difference.total_variation, '.4f'):>21}  {_interval(difference.kl_bits, '.4f'):>21}"
        f"  {_interval(difference.map_agreement, '.0%'):>19}"
    )


def _interval(interval: Interval, form: str) -> str:
    return f"{interval.value:{form}} ({interval.low:{form}}..{interval.high:{form}})"


def _resource_part(found: Inspection) -> str:
    largest = max(found.resources, key=lambda each: each.alms)
    device = largest.device
    rows = [
        f"Resources of a board's {device.title}, estimated (calibrated on yosys, never compiled by the vendor's tool):",
        "  part           ALMs  registers",
    ]
    rows += [f"  {part.name:10} {part.alms:8,.0f} {part.registers:10,.0f}" for part in largest.logic.parts]
    memories = largest.memories
    if memories.logic_tables:
        rows.append(
            f"  tables     {memories.alms:8,.0f}             {memories.logic_tables:,} tables in {memories.mlabs:,} memory LABs"
        )
    low, high = largest.pcie_alms
    controller = (
        "hard: no logic; of logic it would take 8,000 to 30,000 logic elements"
        if largest.pcie is Pcie.HARD
        else f"soft: {low:,.0f} to {high:,.0f} ALMs (8,000 to 30,000 logic elements)"
    )
    rows += [
        f"  together   {largest.alms:8,.0f} {largest.logic.registers:10,.0f}   {largest.alm_share:.0%} of {device.alms:,} ALMs",
        (
            f"  Table memories: {memories.table_bits:,} bits in {memories.blocks:,} of {device.blocks:,} M20K blocks "
            f"({largest.block_share:.0%}), one a cell. PCIe controller {controller}."
        ),
        "  It fits: up to 80 % of each can be used."
        if largest.fits
        else f"  It does not fit: {largest.why_not}; use more --partitions.",
    ]
    if found.column_resources is not None:
        wide = found.column_resources
        rows.append(
            f"  With a column's tables side by side in wide memories all {found.machine.parameters.lines} lines would "
            + (
                f"fit one board: {wide.alms:,.0f} ALMs, {wide.memories.blocks:,} blocks."
                if wide.fits
                else "not fit one board either."
            )
        )
    return "\n".join(rows)


def _energy_part(found: Inspection) -> str:
    median = found.accuracy.cycles.median.value
    dynamic, static = found.energy.frame_j(median, found.clock_hz)
    rows = [
        (
            f"Energy of a frame of {median:,.0f} cycles, a toggle-count model, not a measurement: {_unit(dynamic, 'J')} for toggles "
            f"({found.energy.toggles:,.0f} a cycle on all boards) and {_unit(static, 'J')} for leakage while it runs. It assumes:"
        ),
    ]
    rows += [f"  - {assumption}" for assumption in ASSUMPTIONS]
    return "\n".join(rows)


def as_json(found: Inspection) -> str:
    """Return what was found as one JSON object."""
    cycles = found.accuracy.cycles.median.value
    dynamic, static = found.energy.frame_j(cycles, found.clock_hz)
    content = {
        "deployment": found.deployment.name,
        "hash": found.deployment.hash,
        "lines": found.machine.parameters.lines,
        "columns": found.machine.parameters.columns,
        "boards": len(found.deployment.boards),
        "replicas": found.deployment.machine.replicas,
        "readings": found.readings.source,
        "clock_hz": found.clock_hz,
        "losses": None if found.losses is None else [asdict(loss) for loss in found.losses],
        "accuracy": asdict(found.accuracy),
        "resources": [
            {
                "alms": each.alms,
                "registers": each.logic.registers,
                "table_bits": each.memories.table_bits,
                "blocks": each.memories.blocks,
                "memory_labs": each.memories.mlabs,
                "pcie_alms": list(each.pcie_alms),
                "fits": each.fits,
            }
            for each in found.resources
        ],
        "energy_model": {"toggles_a_cycle": found.energy.toggles, "dynamic_j": dynamic, "static_j": static},
    }
    return json.dumps(content) + "\n"


def _unit(value: float, unit: str) -> str:
    """A value with the SI prefix that leaves 1 to 999 before the point."""
    if value <= 0:
        return f"0 {unit}"
    prefixes = ("p", "n", "u", "m", "", "k", "M", "G")
    power = max(-4, min(3, math.floor(math.log10(value) / 3 + 1e-12)))
    return f"{value / 1000.0**power:.3g} {prefixes[power + 4]}{unit}"
