"""Inspection of a deployment: losses, accuracy, cycles, resources and energy."""

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
from toolchain.building.build import read_images
from toolchain.building.quantise import ColumnLoss, quantise
from toolchain.deployment import Deployment, Scale
from toolchain.errors import BuildError, DeploymentError
from toolchain.models.model import Model
from toolchain.outputs.mif import table_length

Progress = Callable[[int], AbstractContextManager[Callable[[str], None]]]

FRAMES: Final = 200
BANKS: Final = 4
SLOW_FRAMES: Final = 20
"""Number of frames for slow machines: with one generator per cell, or without LFSRs."""
LEAST_FRAMES: Final = 20
SLOW_LEAST_FRAMES: Final = 3
"""Minimum number of frames of slow machines with replicas."""
SLOW_BANKS: Final = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectOptions:
    """The readings for a deployment, and the hardware for the estimate of its costs.

    Attributes:
        recording: Recorded readings, or None to draw them.
        columns: `NAME=COLUMN`s of the recording.
        tolerance_s: Maximum time in seconds between a row and messages of other topics in a bag.
        frames: Maximum number of frames; None for 200, or 20 if only the slow kernel supports the machine;
            fewer with replicas.
        banks: Number of seed sets for each frame; None for 4, or 1 for a slow machine.
        seed: Seed of drawn readings.
        clock_hz: Clock frequency of the boards.
        device: FPGA of the boards.
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
    readings: Readings
    accuracy: Accuracy
    resources: tuple[Estimate, ...]
    energy: Energy
    clock_hz: float


def inspect_deployment(
    deployment: Deployment, model: Model | None, options: InspectOptions, progress: Progress
) -> Inspection:
    """Run the machine of a deployment on readings, and estimate its costs, or raise a ToolchainError."""
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
        readings=readings,
        accuracy=accuracy,
        resources=resources,
        energy=energy(machines, readings),
        clock_hz=options.clock_hz,
    )


def machines_of(deployment: Deployment) -> tuple[BM1Machine, ...]:
    """Return the machines in the programming files of a deployment."""
    from pcie_shim.errors import PcieShimError

    try:
        return tuple(image.machine for image in read_images(deployment))
    except PcieShimError as reason:
        raise DeploymentError(str(reason)) from reason


def _losses(deployment: Deployment, whole: BM1Machine, model: Model) -> tuple[ColumnLoss, ...]:
    """Return the quantisation loss of the model, after checking that its codes are those of the deployment."""
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
        f"{deployment.directory} was not built from the model {model.name} with these settings: its codes differ; give "
        "the same --set and --bits as for the build, or build it again"
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
                "number per line; omit it to draw readings"
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
            "the inputs of this machine are probabilities, so it has no tables for drawing readings; give the model "
            "with --model"
        )
    source = "the model" if model is not None else "the codes"
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
