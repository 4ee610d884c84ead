"""A sweep over a model's possible machines: accuracy against cycles and ALMs, kept point by point in a file."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from machines.bm1 import BM1Machine
from machines.errors import MachineError
from machines.parameters import RngKind
from toolchain.analysis.accuracy import measure
from toolchain.analysis.emulation import EmulatedBoards, split
from toolchain.analysis.resources import Pcie, estimate
from toolchain.build import DEFAULT_INTERFACE, machine_parameters
from toolchain.errors import BuildError
from toolchain.options import BuildOptions, Scale
from toolchain.outputs.rng_table import random_table
from toolchain.quantise import quantise

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from toolchain.analysis.device import Device
    from toolchain.analysis.readings import Readings
    from toolchain.deployment import Stop
    from toolchain.models.model import Model

MAX_POINTS: Final = 10_000
MAX_FILE_BYTES: Final = 1 << 28

_BEGIN: Final = b'{"key":"'
"""How every line of results begins."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """What is combined with what.

    Attributes:
        prob_bits: Widths of codes.
        target_counts: Counts that stop a machine; each with the narrowest counter that holds it.
        rngs: Kinds of generators.
        scales: What is divided by its maximum before quantising.
        steps_per_clock: Steps of a generator in a cycle; 0 for as many as give fresh bits.
        partitions: Boards.
        stop: When boards stop.
        max_cycles: After how many cycles a machine stops anyway.
        banks: Sets of seeds that every frame is run with.
    """

    prob_bits: tuple[int, ...]
    target_counts: tuple[int, ...]
    rngs: tuple[RngKind, ...]
    scales: tuple[Scale, ...]
    steps_per_clock: tuple[int, ...]
    partitions: int
    stop: Stop
    max_cycles: int
    banks: int

    def options(self) -> Iterator[BuildOptions]:
        """Return the options of every machine, in order.

        Raises:
            BuildError: Nothing to combine, or too many machines.
        """
        lists = (self.scales, self.rngs, self.steps_per_clock, self.prob_bits, self.target_counts)
        count = math.prod(map(len, lists))
        if not 0 < count <= MAX_POINTS:
            message = f"these lists combine to {count} machines, expected 1 to {MAX_POINTS}"
            raise BuildError(message)
        for scale, rng, steps, prob_bits, target in itertools.product(*lists):
            if target < 1:
                message = f"a target count of {target} stops nothing: expected 1 or more"
                raise BuildError(message)
            yield BuildOptions(
                uri="ws://nowhere:9090",  # a sweep has no robot
                topic="/readings",
                type="std_msgs/Float64",
                partitions=self.partitions,
                scale=scale,
                prob_bits=prob_bits,
                counter_bits=target.bit_length(),
                target_count=target,
                max_cycles=self.max_cycles,
                stop=self.stop,
                rng=rng,
                steps_per_clock=steps,
            )


class Point(BaseModel):
    """One machine of a sweep, measured: a line of the results' file.

    Attributes:
        key: SHA-256 of all that its figures depend on.
        total_variation: Beside the model, mean over frames; None where no frame had a posterior.
        total_variation_low: Its 95 % interval's ends.
        total_variation_high: Its 95 % interval's ends.
        quantising: The same of exact inference on the codes.
        kl_bits: KL(machine || model).
        map_agreement: Share of frames with the same most probable line.
        z_rms: Root mean square of z-scores; 1 is ideal.
        without: Share of runs without a posterior.
        cycles_median: Cycles of a frame.
        cycles_95: Their 95th percentile.
        alms: Of the largest board; None for generators that no FPGA has.
        blocks: Memory blocks of the largest board.
        fits: Whether that fits the device.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    key: str = Field(pattern="[0-9a-f]{64}")
    scale: Literal["address", "column", "none"]
    rng: Literal["lfsr8", "lfsr16", "lfsr24", "lfsr32", "table", "ideal"]
    steps_per_clock: int
    prob_bits: int
    target_count: int
    counter_bits: int
    partitions: int
    frames: int
    total_variation: float | None
    total_variation_low: float | None
    total_variation_high: float | None
    quantising: float | None
    kl_bits: float | None
    map_agreement: float | None
    z_rms: float | None
    without: float
    cycles_median: float
    cycles_95: float
    alms: float | None
    blocks: int | None
    fits: bool | None


@dataclass(frozen=True, slots=True)
class Task:
    """A machine that is to be measured, and the key that its results are kept by."""

    options: BuildOptions
    key: str


def tasks(model: Model, sweep: Sweep, readings: Readings, device: Device) -> list[Task]:
    """Return every machine of a sweep that can be built; what an LFSR is too narrow for is left out.

    Raises:
        BuildError: Nothing is left, or nothing was there.
    """
    found, refused = [], ""
    inputs = _fingerprint(model, readings)
    for options in sweep.options():
        try:
            parameters = machine_parameters(model, options)
        except MachineError as reason:
            refused = refused or str(reason)
            continue
        words = {
            "inputs": inputs,
            "parameters": str(parameters),
            "scale": options.scale,
            "target": options.target_count,
            "max_cycles": options.max_cycles,
            "stop": options.stop,
            "partitions": options.partitions,
            "banks": sweep.banks,
            "device": device.name,
        }
        found.append(Task(options, hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()))
    if not found:
        message = f"none of these machines can be built: {refused}"
        raise BuildError(message)
    return found


def _fingerprint(model: Model, readings: Readings) -> str:
    digest = hashlib.sha256()
    for known in model.known:
        digest.update(known.table.tobytes())
    digest.update(model.prior_distribution.tobytes())
    if model.prior_select is not None:
        digest.update(model.prior_select.table.tobytes())
    digest.update(readings.addresses.tobytes())
    digest.update(readings.prior_addresses.tobytes())
    return digest.hexdigest()


def run_task(model: Model, task: Task, readings: Readings, device: Device, banks: int) -> Point:
    """Measure one machine.

    Raises:
        ToolchainError: It can't be built or run.
    """
    options = task.options
    try:
        parameters = machine_parameters(model, options)
        quantised = quantise(model, prob_bits=options.prob_bits, scale=options.scaling)
        table = random_table(options.prob_bits) if options.rng is RngKind.TABLE else None
        whole = BM1Machine(parameters, quantised.prior, quantised.tables, table)
    except MachineError as reason:
        raise BuildError(str(reason)) from reason
    machines = split(whole, options.partitions)
    target = options.target_count or parameters.target_count_max
    boards = EmulatedBoards(machines, target_count=target, max_cycles=options.max_cycles, stop=options.stop)
    accuracy = measure(boards, readings, model, banks=banks)
    largest = machines[0].parameters
    took = None
    if parameters.rng is not RngKind.IDEAL:
        took = estimate(largest, device, interface=DEFAULT_INTERFACE, pcie=Pcie.HARD)
    machine, quantising = accuracy.machine, accuracy.quantising
    return Point(
        key=task.key,
        scale=options.scaling.value,
        rng=options.rng.value,
        steps_per_clock=parameters.steps_per_clock,
        prob_bits=parameters.prob_bits,
        target_count=target,
        counter_bits=parameters.counter_bits,
        partitions=options.partitions,
        frames=accuracy.frames,
        total_variation=None if machine is None else machine.total_variation.value,
        total_variation_low=None if machine is None else machine.total_variation.low,
        total_variation_high=None if machine is None else machine.total_variation.high,
        quantising=None if quantising is None else quantising.total_variation.value,
        kl_bits=None if machine is None else machine.kl_bits.value,
        map_agreement=None if machine is None else machine.map_agreement.value,
        z_rms=None if accuracy.z is None else accuracy.z.rms.value,
        without=accuracy.without,
        cycles_median=accuracy.cycles.median.value,
        cycles_95=accuracy.cycles.percentile_95.value,
        alms=None if took is None else took.alms,
        blocks=None if took is None else took.memories.blocks,
        fits=None if took is None else took.fits,
    )


def explore(
    found: Sequence[Task],
    kept: dict[str, Point],
    measured: Callable[[Task], Point],
    keep: Callable[[Point], None],
    advance: Callable[[Point], None],
) -> None:
    """Measure what is not there yet; every point is kept before the next one begins."""
    for task in found:
        if task.key not in kept:
            point = measured(task)
            keep(point)
            kept[task.key] = point
        advance(kept[task.key])


class Results:
    """The results' file: one JSON object a line, appended whole, so that an interrupted sweep goes on where it was.

    Args:
        path: The file; made if it is not there.

    Raises:
        BuildError: It can't be read or written, or it holds something else.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.points: dict[str, Point] = {}
        content = b""
        try:
            with suppress(FileNotFoundError), path.open("rb") as file:
                content = file.read(MAX_FILE_BYTES + 1)
        except OSError as reason:
            message = f"{path} can't be read: {reason.strerror or reason}"
            raise BuildError(message) from None
        if len(content) > MAX_FILE_BYTES:
            message = f"{path} has more than {MAX_FILE_BYTES} bytes: it is no file of results"
            raise BuildError(message)
        lines = content.split(b"\n")
        # A power cut in the middle of a line leaves a last line without its end: that point is measured again.
        torn = lines.pop()
        if torn and not torn.startswith(_BEGIN[: len(torn)]):
            lines.append(torn)
        self._torn_at = len(content) - len(torn) if torn else None
        for number, line in enumerate(lines, start=1):
            try:
                point = Point.model_validate_json(line)
            except ValidationError:
                message = f"{path}, line {number}, is no result of a sweep: name another file with -o"
                raise BuildError(message) from None
            self.points[point.key] = point

    def append(self, point: Point) -> None:
        """Add a point: one write, and it is on the disk.

        Raises:
            BuildError: The file can't be written.
        """
        line = point.model_dump_json() + "\n"
        try:
            if self._torn_at is not None:
                os.truncate(self.path, self._torn_at)
                self._torn_at = None
            descriptor = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            try:
                written = os.write(descriptor, line.encode())
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        except OSError as reason:
            message = f"{self.path} can't be written: {reason.strerror or reason}"
            raise BuildError(message) from None
        if written != len(line):
            message = f"{self.path} can't be written: the disk is full"
            raise BuildError(message)


def pareto(points: Sequence[Point]) -> list[Point]:
    """Return the points that no other one is better than: in total variation, cycles, ALMs and runs without a posterior."""
    judged = [(point, figures) for point in points if (figures := _figures(point)) is not None]
    return [
        point
        for point, own in judged
        if not any(
            other != own and all(a <= b for a, b in zip(other, own, strict=True)) for _, other in judged
        )
    ]


def _figures(point: Point) -> tuple[float, ...] | None:
    if point.total_variation is None:
        return None
    alms = math.inf if point.alms is None else point.alms
    return (point.total_variation, point.cycles_median, alms, point.without)
