"""What `toolchain inspect` does: explains a deployment, and says how good and how fast it will be and what it takes."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from machines.parameters import SensorMode
from toolchain.analysis.accuracy import measure
from toolchain.analysis.device import device_named
from toolchain.analysis.emulation import EmulatedBoards, joined, one_replica
from toolchain.analysis.energy import energy
from toolchain.analysis.readings import (
    check_frames,
    model_of_codes,
    readings_of_lines,
    recorded_readings,
    sample_readings,
)
from toolchain.analysis.resources import Pcie, estimate
from toolchain.analysis.table_memories import Tables
from toolchain.commands.named_model import NetworkQuestion, Unread, read_model
from toolchain.deployment import load_deployment
from toolchain.errors import BuildError, DeploymentError
from toolchain.options import Scale
from toolchain.outputs.rng_table import table_length
from toolchain.quantise import quantise
from toolchain.report import REPORT_NAME

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from contextlib import AbstractContextManager
    from pathlib import Path

    from machines.bm1 import BM1Machine
    from toolchain.analysis.accuracy import Accuracy
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
        estimate(
            machine.parameters,
            device,
            interface=interface,
            pcie=options.pcie,
            table_length=table_length(machine),
        )
        for machine in machines
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
            table_length=table_length(whole),
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
    of_each = f" of readings for {replicas} replicas," if replicas > 1 else ""
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
