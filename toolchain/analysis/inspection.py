"""Inspection of a BM1's deployment: quantisation losses, accuracy, cycles, resources and energy, as text or JSON."""

import json
from dataclasses import asdict, dataclass, replace
from typing import Final

import numpy as np

from machines.bm1 import BM1Machine
from machines.parameters import SensorMode
from toolchain.analysis import InspectOptions, Progress, with_unit
from toolchain.analysis.accuracy import Accuracy, Interval, measure
from toolchain.analysis.emulation import EmulatedBoards, joined, one_replica
from toolchain.analysis.logic import device_named
from toolchain.analysis.readings import (
    Readings,
    check_frames,
    model_of_codes,
    readings_of_lines,
    recorded_readings,
    sample_readings,
)
from toolchain.analysis.resources import ASSUMPTIONS, Energy, Estimate, energy, estimate
from toolchain.building.build import read_images
from toolchain.building.quantise import ColumnLoss, quantise
from toolchain.building.report import edited_sentence, loss_heading, many_sentence
from toolchain.cluster import Run
from toolchain.deployment import Deployment, Scale, Stop
from toolchain.errors import BuildError, counted
from toolchain.models.model import Model
from toolchain.outputs.mif import table_length

FRAMES: Final = 200
BANKS: Final = 4
SLOW_FRAMES: Final = 20
"""Default number of frames for a slow machine: a machine with one generator per cell, or without LFSRs."""
LEAST_FRAMES: Final = 20
SLOW_LEAST_FRAMES: Final = 3
"""Fewest frames that a slow machine with replicas runs by default.

By default, the number of frames is `SLOW_FRAMES` divided by the number of replicas, or this value if it is larger.
"""
SLOW_BANKS: Final = 1


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
    deployment: Deployment, model: Model | None, options: InspectOptions, progress: Progress, run: Run
) -> Inspection:
    """Emulate a deployment's machine on readings, and estimate its resources and energy, or raise a ToolchainError."""
    device = device_named(options.device)
    machines = tuple(image.machine for image in read_images(deployment))
    whole = joined(machines)
    losses = None if model is None else losses_of(deployment, whole, model)
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
            machine.parameters, device, table_length=table_length(machine), inputs=section.interface_sensors
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
            own=deployment.new_filter(),
            advance=lambda: advance("frames"),
            run=run,
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


def losses_of(deployment: Deployment, whole: BM1Machine, model: Model) -> tuple[ColumnLoss, ...] | None:
    """Return the quantisation loss of the model, or None if the codes were edited since the build.

    Raises:
        BuildError: The codes were built from another model or with other settings.
    """
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
        if deployment.edited_boards:
            return None
    raise BuildError(
        f"{deployment.directory} was not built from the model {model.name} with these settings: its codes differ; give "
        "the same --set and --bits as for the build, or build it again"
    )


def _readings(
    deployment: Deployment, whole: BM1Machine, model: Model | None, options: InspectOptions
) -> Readings:
    replicas, own = deployment.machine.replicas, deployment.new_filter()
    frames = options.frames
    if frames is None:
        slow = _is_slow(whole)
        usual, least = (SLOW_FRAMES, SLOW_LEAST_FRAMES) if slow else (FRAMES, LEAST_FRAMES)
        frames = max(least, usual // replicas)
    check_frames(frames)
    mode = deployment.machine.sensor_mode
    if options.readings is not None:
        if mode is not SensorMode.COLUMN:
            raise BuildError(
                f"--readings {options.readings}: a recording's columns are numbers, and this machine reads arrays of one "
                "number per line; omit it to draw readings"
            )
        return recorded_readings(
            options.readings,
            deployment.variables,
            options.reading or (),
            frames=frames * replicas,
            tolerance_s=options.tolerance_s,
            in_sequence=own is not None,
        )
    if model is None and mode is SensorMode.THRESHOLD:
        raise BuildError(
            "the inputs of this machine are probabilities, so it has no tables for drawing readings; give the model "
            "with --model"
        )
    source = "the model" if model is not None else "the codes"
    if model is None:
        model = model_of_codes(deployment.name, deployment.searched, deployment.variables, whole)
    if own is not None:
        if model.transition is not None and model.transition.content() != own.transition.content():
            raise BuildError(
                f"{deployment.directory} was not built from the model {model.name}: its transition differs; build it again"
            )
        model = replace(model, prior=None, transition=own.transition)
    of_each = f" of readings for {replicas} replicas," if replicas > 1 else ""
    drawn = sample_readings(
        model,
        frames * replicas,
        seed=options.seed,
        source=f"{frames} frames{of_each}{'' if own is None else ' in sequence,'} drawn from {source} (seed {options.seed})",
        in_sequence=own is not None,
    )
    if mode is SensorMode.COLUMN:
        return drawn
    return readings_of_lines(drawn, model, whole, scale=Scale(deployment.machine.scale), seed=options.seed)


def _is_slow(machine: BM1Machine) -> bool:
    return not machine.parameters.shared or machine.parameters.rng.lfsr_bits is None


def inspection_report(found: Inspection) -> str:
    """Return the inspection as sentences and tables."""
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
            f"columns and the prior, on {counted(boards, 'board')}{split}."
        ),
        (
            f"Codes of {p.prob_bits} bits (scale = {machine.scale}), counters of {p.counter_bits} "
            f"bits, {p.rng} {'one per column' if p.shared else 'one per cell'} with {counted(p.steps_per_clock, 'step')} per clock and "
            f"{counted(p.rng_banks, 'bank')}; stops at a count of {machine.target_count} or after "
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
    if found.deployment.edited_boards and found.losses is None:
        return edited_sentence(found.deployment)
    if found.losses is None:
        return "Lost by quantising: as report.txt says, which the build wrote; give the model with --model to compare."
    width = max(6, *(len(loss.name) for loss in found.losses))
    rows = [loss_heading(found.machine.parameters.sensor_mode), f"  {'column':{width}}       mass         KL"]
    rows += [f"  {loss.name:{width}}  {loss.mass:9.2e}  {loss.kl_bits:9.2e}" for loss in found.losses]
    return "\n".join(rows)


def _time_part(found: Inspection) -> str:
    accuracy, machine = found.accuracy, found.deployment.machine
    cycles = accuracy.cycles
    rows = [
        f"Cycles of a frame, and time at {with_unit(found.clock_hz, 'Hz')} (the boards' computing alone: no link, no ROS):",
        "            cycles        time   95 % interval, cycles",
    ]
    for name, count, interval in (
        ("median", cycles.median.value, cycles.median),
        ("95 %", cycles.percentile_95.value, cycles.percentile_95),
        ("worst", float(cycles.worst), None),
    ):
        row = f"  {name:6}  {count:10,.0f}  {with_unit(count / found.clock_hz, 's'):>10}"
        rows.append(row + (f"   {interval.low:,.0f}..{interval.high:,.0f}" if interval else ""))
    kept = "posteriors" if machine.replicas > 1 else "frames"
    if machine.stop is Stop.OWN and len(found.deployment.boards) > 1:
        rule = (
            f"stops that board alone (stop = own); boards without one end after {machine.max_cycles} cycles"
        )
    else:
        rule = f"is the stop rule; the other runs end after {machine.max_cycles} cycles"
    rows += [
        f"  In {accuracy.overflow:.0%} of runs a count reaches {machine.target_count}: this overflow {rule}.",
        f"  Without a posterior: {accuracy.without:.1%} of runs (in {accuracy.impossible:.1%} of {kept} no line can count).",
    ]
    if machine.replicas > 1:
        rows.append(
            f"  A frame has {machine.replicas} posteriors and ends with the last of them: {cycles.median.value / machine.replicas:,.1f} "
            "cycles per posterior in the median."
        )
    return "\n".join(rows)


def _accuracy_part(found: Inspection) -> str:
    accuracy = found.accuracy
    names = [
        "the machine against the model",
        "  of that, by quantising alone",
        "the machine against its codes",
    ]
    if found.deployment.filter is not None:
        names[:2] = ["machine against the exact filter", "  of that, codes, earlier frames"]
    every = (accuracy.machine, accuracy.quantising, accuracy.sampling)
    alone = tuple(each and each.alone for each in every)
    rows = []
    title = (
        f"Accuracy over all {accuracy.frames} frames (means with 95 % intervals; frames are resampled, banks within them are "
        "not). Without a posterior, the total variation is 1 and the MAP is wrong:"
    )
    for heading, differences in (
        (title, every),
        (f"Over the {1 - accuracy.without:.1%} of runs with a posterior alone:", alone),
    ):
        rows += [heading, f"{'total variation':>57}{'same MAP':>21}"]
        for name, each in zip(names, differences, strict=True):
            if each is not None:
                row = f"  {name:34}{_shown_interval(each.total_variation, '.4f'):>21}"
                row += f"{_shown_interval(each.map_agreement, '.0%'):>21}"
                rows.append(
                    row + (f"   KL {_shown_interval(each.kl_bits, '.4f')} bits" if each.kl_bits else "")
                )
    if accuracy.machine is None:
        rows.append("  Give the model with --model for the quantisation loss.")
    if accuracy.z is not None:
        z = accuracy.z
        rows.append(
            f"  z-scores of {z.counts:,} counts from {z.draws:,} draws of random numbers, {z.cycles:,} cycles each, against equation 2.1: root mean square "
            f"{_shown_interval(z.rms, '.2f')} (1 is ideal), mean {_shown_interval(z.mean, '.2f')}, beyond 3: {z.beyond_three:.2%} "
            "(0.27 % is normal)."
        )
    return "\n".join(rows)


def _shown_interval(interval: Interval, form: str) -> str:
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
    rows += [
        f"  together   {largest.alms:8,.0f} {largest.logic.registers:10,.0f}   {largest.alm_share:.0%} of {device.alms:,} ALMs",
        (
            f"  Table memories: {memories.table_bits:,} bits in {memories.blocks:,} of {device.blocks:,} M20K blocks "
            f"({largest.block_share:.0%}). The PCIe controller is a block of the device."
        ),
        "  It fits: up to 80 % of each can be used."
        if largest.fits
        else f"  It does not fit: {largest.why_not}; use more --partitions.",
    ]
    return "\n".join(rows)


def _energy_part(found: Inspection) -> str:
    median = found.accuracy.cycles.median.value
    dynamic, static = found.energy.frame_j(median, found.clock_hz)
    rows = [
        (
            f"Energy of a frame of {median:,.0f} cycles, a toggle-count model, not a measurement: {with_unit(dynamic, 'J')} for toggles "
            f"({found.energy.toggles:,.0f} per cycle on all boards) and {with_unit(static, 'J')} for leakage while it runs. It assumes:"
        )
    ]
    rows += [f"  - {assumption}" for assumption in ASSUMPTIONS]
    return "\n".join(rows)


def as_json(found: Inspection) -> str:
    """Return the inspection as one JSON object."""
    cycles = found.accuracy.cycles.median.value
    dynamic, static = found.energy.frame_j(cycles, found.clock_hz)
    content = {
        "deployment": found.deployment.name,
        "hash": found.deployment.hash,
        "lines": found.machine.parameters.lines,
        "columns": found.machine.parameters.columns,
        "boards": len(found.deployment.boards),
        "edited_boards": found.deployment.edited_boards,
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
                "fits": each.fits,
            }
            for each in found.resources
        ],
        "energy_model": {"toggles_a_cycle": found.energy.toggles, "dynamic_j": dynamic, "static_j": static},
    }
    return json.dumps(content) + "\n"
