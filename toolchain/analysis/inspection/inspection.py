"""Inspection of a deployment: its losses, accuracy, cycles, resources and energy."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from machines.bm1 import BM1Machine
from machines.parameters import SensorMode
from toolchain.analysis.accuracy.emulation import EmulatedBoards, joined, one_replica
from toolchain.analysis.accuracy.measurement import Accuracy, measure
from toolchain.analysis.accuracy.readings import (
    Readings,
    check_columns,
    check_frames,
    model_of_codes,
    readings_of_lines,
    recorded_readings,
    sample_readings,
)
from toolchain.analysis.resources.device import Device
from toolchain.analysis.resources.energy import Energy, energy
from toolchain.analysis.resources.estimate import Estimate, Pcie, estimate
from toolchain.building.agreement import read_images
from toolchain.building.quantise import ColumnLoss, quantise
from toolchain.building.report import REPORT_NAME
from toolchain.deployment import Deployment, Scale
from toolchain.errors import BuildError, DeploymentError
from toolchain.models.model import Model
from toolchain.outputs.rng_table import table_length

Progress = Callable[[int], AbstractContextManager[Callable[[str], None]]]

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
    """The readings that a deployment is run on, and the hardware that its costs are estimated for.

    Attributes:
        recording: Recorded readings, or None to draw them.
        columns: `NAME=COLUMN`s of the recording.
        tolerance_s: In a bag, how far from a row another topic's message may be, seconds.
        frames: How many frames at most; None for 200, or 20 of a machine that only the slow kernel runs; with replicas
            for fewer, as each has readings of its own.
        banks: Sets of seeds that each is run with; None for 4, or 1 of such a machine.
        seed: Of the readings that are drawn.
        clock_hz: The boards' clock.
        device: The boards' FPGA.
        pcie: The kind of PCIe controller.
    """

    recording: Path | None
    columns: tuple[str, ...]
    tolerance_s: float
    frames: int | None
    banks: int | None
    seed: int
    clock_hz: float
    device: Device
    pcie: Pcie


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """Results of an inspection."""

    deployment: Deployment
    machine: BM1Machine
    losses: tuple[ColumnLoss, ...] | None
    reported_losses: str
    readings: Readings
    accuracy: Accuracy
    resources: tuple[Estimate, ...]
    energy: Energy
    clock_hz: float


def inspect_deployment(
    deployment: Deployment, model: Model | None, options: InspectOptions, progress: Progress
) -> Inspection:
    """Run a deployment's machine on readings, and estimate its costs; a ToolchainError if something does not fit."""
    machines = machines_of(deployment)
    whole = joined(machines)
    losses = None if model is None else _losses(deployment, whole, model)
    readings = _readings(deployment, whole, model, options)
    section = deployment.machine
    boards = EmulatedBoards(
        [one_replica(machine) for machine in machines],
        target_count=section.target_count,
        max_cycles=section.max_cycles,
        stop=section.stop,
    )
    resources = tuple(
        estimate(
            machine.parameters,
            options.device,
            pcie=options.pcie,
            table_length=table_length(machine),
        )
        for machine in machines
    )
    banks = options.banks or (SLOW_BANKS if _is_slow(whole) else BANKS)
    with progress(len(readings)) as advance:
        accuracy = measure(
            boards,
            readings,
            model,
            banks=banks,
            replicas=section.replicas,
            advance=lambda: advance("frames"),
        )
    return Inspection(
        deployment=deployment,
        machine=whole,
        losses=losses,
        reported_losses=_reported(deployment.directory),
        readings=readings,
        accuracy=accuracy,
        resources=resources,
        energy=energy(machines, readings),
        clock_hz=options.clock_hz,
    )


def machines_of(deployment: Deployment) -> tuple[BM1Machine, ...]:
    """Return the boards' machines from a deployment's programming files."""
    from pcie_shim.errors import PcieShimError

    try:
        return tuple(image.machine for image in read_images(deployment))
    except PcieShimError as reason:
        raise DeploymentError(str(reason)) from reason


def _losses(deployment: Deployment, whole: BM1Machine, model: Model) -> tuple[ColumnLoss, ...]:
    """Return what quantising lost of the model, once its codes are the deployment's."""
    if model.lines == deployment.machine.lines and len(model.known) == whole.parameters.sensors:
        quantised = quantise(
            model,
            prob_bits=whole.parameters.prob_bits,
            scale=Scale(deployment.machine.scale),
            sensor_mode=deployment.machine.sensor_mode,
        )
        pairs = zip((quantised.prior, *quantised.tables), (whole.prior, *whole.tables), strict=True)
        if all(np.array_equal(ours, theirs) for ours, theirs in pairs):
            return quantised.losses
    raise BuildError(
        f"{deployment.directory} was not built from the model {model.name} with these settings, for its codes differ; give "
        "the same --set and --bits as to the build, or build it again"
    )


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
    check_columns(options.recording, options.columns)
    if options.recording is not None:
        if mode is not SensorMode.COLUMN:
            raise BuildError(
                f"--readings {options.recording}: a recording's columns are numbers, and this machine reads arrays of one "
                "number for each line; leave it out, and readings are drawn"
            )
        return recorded_readings(
            options.recording,
            deployment.variables,
            options.columns,
            frames=frames * replicas,
            tolerance_s=options.tolerance_s,
        )
    if model is None and mode is SensorMode.THRESHOLD:
        raise BuildError(
            "this machine's cells are given their probabilities, so it holds no tables that readings could be drawn from; "
            "name the model with --model"
        )
    source = "the model" if model is not None else "what the codes say of the model"
    if model is None:
        model = model_of_codes(deployment.name, deployment.searched, deployment.variables, whole)
    of_each = f" of readings for {replicas} replicas," if replicas > 1 else ""
    drawn = sample_readings(
        model,
        frames * replicas,
        seed=options.seed,
        source=f"{frames} frames{of_each} drawn from {source} (seed {options.seed})",
    )
    if mode is SensorMode.COLUMN:
        return drawn
    return readings_of_lines(drawn, model, whole, scale=Scale(deployment.machine.scale), seed=options.seed)


def _is_slow(machine: BM1Machine) -> bool:
    return not machine.parameters.shared or machine.parameters.rng.lfsr_bits is None


def _reported(directory: Path) -> str:
    try:
        text = (directory / REPORT_NAME).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
    return next((part for part in text.split("\n\n") if part.startswith("Lost by quantising")), "")
