"""Sweeps over the possible machines of a model: accuracy, cycles and ALMs, stored point by point in a file."""

import hashlib
import itertools
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from machines.bm1 import BM1Machine
from machines.parameters import RngKind, SensorMode
from toolchain.analysis.accuracy import measure
from toolchain.analysis.emulation import EmulatedBoards, one_replica
from toolchain.analysis.logic import Device
from toolchain.analysis.readings import Readings, check_frames, readings_of_lines, sample_readings
from toolchain.analysis.resources import estimate
from toolchain.analysis.results import Point
from toolchain.building.machine import (
    MachinePlan,
    board_layout,
    partition_lines,
    plan_machine,
    split,
    whole_machine,
)
from toolchain.building.options import BuildOptions
from toolchain.building.quantise import quantise
from toolchain.deployment import Scale, Stop
from toolchain.errors import BuildError
from toolchain.models.model import Model

MAX_POINTS: Final = 10_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """The lists that a sweep combines.

    Attributes:
        prob_bits: Widths of codes.
        target_counts: Target counts, each with the narrowest sufficient counter.
        rngs: Kinds of generators.
        scales: Scalings before quantising.
        sensor_modes: Inputs of cells; scale `address` is omitted if cells have their own inputs.
        replicas: Numbers of machines on a board.
        steps_per_clock: Steps of a generator in a cycle; 0 for as many as give fresh bits.
        partitions: Boards.
        stop: When the boards stop.
        max_cycles: Maximum number of cycles.
        banks: Number of seed sets with which every frame is run.
    """

    prob_bits: tuple[int, ...]
    target_counts: tuple[int, ...]
    rngs: tuple[RngKind, ...]
    scales: tuple[Scale, ...]
    steps_per_clock: tuple[int, ...]
    sensor_modes: tuple[SensorMode, ...] = (SensorMode.COLUMN,)
    replicas: tuple[int, ...] = (1,)
    partitions: int
    stop: Stop
    max_cycles: int
    banks: int

    def options(self) -> Iterator[BuildOptions]:
        """Return the options of every machine in order, or raise a BuildError if there are none or too many."""
        lists = (
            self.sensor_modes,
            self.replicas,
            self.scales,
            self.rngs,
            self.steps_per_clock,
            self.prob_bits,
            self.target_counts,
        )
        count = math.prod(map(len, lists))
        if not 0 < count <= MAX_POINTS:
            raise BuildError(f"these lists give {count} machines, expected 1 to {MAX_POINTS}")
        for mode, replicas, scale, rng, steps, prob_bits, target in itertools.product(*lists):
            if target < 1:
                raise BuildError(f"a target count of {target} is too small; expected 1 or more")
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
                sensor_mode=mode,
                replicas=replicas,
            )


@dataclass(frozen=True, slots=True)
class Task:
    """A machine to measure, and the key of its results."""

    plan: MachinePlan
    key: str


class Frames:
    """The readings of a sweep, drawn or recorded; machines with the same sensor mode get the same ones."""

    def __init__(
        self, model: Model, frames: int, *, seed: int, recorded: Callable[[int], Readings] | None = None
    ) -> None:
        self._model = model
        self._frames = frames
        self._seed = seed
        self._recorded = recorded
        self._base: dict[int, Readings] = {}
        self._fingerprints: dict[tuple[int, bool], str] = {}

    def columns(self, replicas: int) -> Readings:
        """Return readings of whole columns for all frames, one for each replica."""
        if replicas not in self._base:
            check_frames(self._frames)
            count = self._frames * replicas
            if self._recorded is not None:
                self._base[replicas] = self._recorded(count)
            else:
                source = f"{self._frames} frames drawn from the model (seed {self._seed})"
                self._base[replicas] = sample_readings(self._model, count, seed=self._seed, source=source)
        return self._base[replicas]

    def of(self, machine: BM1Machine, options: BuildOptions) -> Readings:
        """Return the readings of a machine with these options."""
        base = self.columns(options.replicas)
        if options.sensor_mode is SensorMode.COLUMN:
            return base
        return readings_of_lines(base, self._model, machine, scale=options.scaling, seed=self._seed)

    def fingerprint(self, options: BuildOptions) -> str:
        """Return a hash of the model and of the origin of these machines' readings."""
        if self._recorded is not None and options.sensor_mode is not SensorMode.COLUMN:
            raise BuildError(
                f"a recording's columns are numbers, and with --sensor-modes {options.sensor_mode} readings are arrays, one "
                "number for each line: omit --readings to draw readings"
            )
        # the readings of other lines are drawn too, with the seed; codes follow from the tables
        of_lines = options.sensor_mode is not SensorMode.COLUMN
        if (options.replicas, of_lines) not in self._fingerprints:
            readings, digest = self.columns(options.replicas), hashlib.sha256()
            for known in self._model.known:
                digest.update(known.table.tobytes())
            digest.update(self._model.prior_distribution.tobytes())
            if self._model.prior_select is not None:
                digest.update(self._model.prior_select.table.tobytes())
            digest.update(readings.addresses.tobytes())
            digest.update(readings.prior_addresses.tobytes())
            if of_lines:
                digest.update(self._seed.to_bytes(16, "little"))
            self._fingerprints[options.replicas, of_lines] = digest.hexdigest()
        return self._fingerprints[options.replicas, of_lines]


def tasks(model: Model, sweep: Sweep, frames: Frames, device: Device) -> list[Task]:
    """Return the machines of a sweep that can be built; a BuildError if there are none."""
    found: dict[str, Task] = {}
    refused = ""
    for options in sweep.options():
        try:
            plan = plan_machine(model, options)
            board_layout(plan.parameters, options.partitions, None)
        except BuildError as reason:
            refused = refused or str(reason)
            continue
        words = {
            "inputs": frames.fingerprint(options),
            "parameters": str(plan.parameters),
            "scale": options.scale,
            "target": options.target_count,
            "max_cycles": options.max_cycles,
            "stop": options.stop,
            "partitions": options.partitions,
            "banks": sweep.banks,
            "device": device.name,
        }
        key = hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()
        # 0 steps and the number that this selects are the same machine
        found.setdefault(key, Task(plan, key))
    if not found:
        raise BuildError(f"none of these machines can be built: {refused}")
    return list(found.values())


def run_task(task: Task, frames: Frames, device: Device, banks: int) -> Point:
    """Measure one machine; a ToolchainError if it cannot be built or run."""
    model, options, parameters = task.plan.model, task.plan.options, task.plan.parameters
    quantised = quantise(
        model, prob_bits=options.prob_bits, scale=options.scaling, sensor_mode=options.sensor_mode
    )
    whole = one_replica(whole_machine(task.plan, quantised))
    machines = split(whole, options.partitions)
    boards = EmulatedBoards(
        machines, target_count=task.plan.target_count, max_cycles=options.max_cycles, stop=options.stop
    )
    accuracy = measure(boards, frames.of(whole, options), model, banks=banks, replicas=options.replicas)
    machine, quantising = accuracy.machine, accuracy.quantising
    point = Point(
        key=task.key,
        scale=options.scaling.value,
        sensor_mode=options.sensor_mode.value,
        replicas=options.replicas,
        rng=options.rng.value,
        steps_per_clock=parameters.steps_per_clock,
        prob_bits=parameters.prob_bits,
        target_count=task.plan.target_count,
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
        alms=None,
        blocks=None,
        fits=None,
    )
    return with_resources(task, point, device)


def with_resources(task: Task, point: Point, device: Device) -> Point:
    """Return a point with the current estimate of the resources of its largest board."""
    parameters, options = task.plan.parameters, task.plan.options
    if options.rng is RngKind.IDEAL:
        return point
    lines = partition_lines(parameters.lines, options.partitions)[0].lines
    largest = replace(parameters, lines=lines)
    took = estimate(largest, device)
    update = {"alms": took.alms, "blocks": took.memories.blocks, "fits": took.fits}
    return point.model_copy(update=update)


def run_sweep(
    found: Sequence[Task],
    kept: dict[str, Point],
    measured: Callable[[Task], Point],
    keep: Callable[[Point], None],
    advance: Callable[[Point], None],
) -> None:
    """Measure the machines without a stored result, and store every point before the next one begins."""
    for task in found:
        if task.key not in kept:
            point = measured(task)
            keep(point)
            kept[task.key] = point
        advance(kept[task.key])
