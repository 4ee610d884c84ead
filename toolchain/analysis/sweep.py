"""Sweeps over the possible machines of a model: accuracy, cycles and ALMs, stored point by point in a file."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from machines.parameters import RngKind
from toolchain.analysis import Sweep
from toolchain.analysis.accuracy import measure
from toolchain.analysis.emulation import EmulatedBoards
from toolchain.analysis.logic import Device
from toolchain.analysis.readings import Readings
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
from toolchain.building.quantise import quantise
from toolchain.errors import BuildError
from toolchain.models.model import Model


@dataclass(frozen=True, slots=True)
class Task:
    """A machine to measure, and the key of its results."""

    plan: MachinePlan
    key: str


def _fingerprint(model: Model, readings: Readings) -> str:
    """Return a hash of the model and of the readings."""
    digest = hashlib.sha256()
    for known in model.known:
        digest.update(known.table.tobytes())
    digest.update(model.prior_distribution.tobytes())
    if model.prior_select is not None:
        digest.update(model.prior_select.table.tobytes())
    digest.update(readings.addresses.tobytes())
    digest.update(readings.prior_addresses.tobytes())
    return digest.hexdigest()


def tasks(model: Model, sweep: Sweep, readings: Readings, device: Device) -> list[Task]:
    """Return the machines of a sweep that can be built, or raise a BuildError if there are none."""
    found: dict[str, Task] = {}
    refused, inputs = "", _fingerprint(model, readings)
    for options in sweep.options():
        try:
            plan = plan_machine(model, options)
            board_layout(plan.parameters, options.partitions, None)
        except BuildError as reason:
            refused = refused or str(reason)
            continue
        words = {
            "inputs": inputs,
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


def run_task(task: Task, readings: Readings, device: Device, banks: int) -> Point:
    """Measure one machine, or raise a ToolchainError if it cannot be built or run."""
    model, options, parameters = task.plan.model, task.plan.options, task.plan.parameters
    quantised = quantise(model, prob_bits=options.prob_bits, scale=options.scaling)
    machines = split(whole_machine(task.plan, quantised), options.partitions)
    boards = EmulatedBoards(
        machines, target_count=task.plan.target_count, max_cycles=options.max_cycles, stop=options.stop
    )
    accuracy = measure(boards, readings, model, banks=banks)
    machine, quantising = accuracy.machine, accuracy.quantising
    point = Point(
        key=task.key,
        scale=options.scaling.value,
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
    """Return a point with resources of its largest board from the current estimate."""
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
