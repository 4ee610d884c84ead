"""What `toolchain explore` does: a sweep's table, plot and Pareto front, or the thesis's claims as experiments."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

import typer

from machines.parameters import RngKind, SensorMode
from toolchain.analysis.device import device_named
from toolchain.analysis.explore import Frames, Sweep, explore, run_task, tasks, with_resources
from toolchain.analysis.readings import check_frames, recorded_readings
from toolchain.analysis.sweep_results import Results, pareto
from toolchain.commands.named_model import NetworkQuestion, Unread, read_model
from toolchain.errors import BuildError
from toolchain.options import Scale

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from enum import StrEnum
    from pathlib import Path

    from toolchain.analysis.claims import Course
    from toolchain.analysis.readings import Readings
    from toolchain.analysis.sweep_results import Point
    from toolchain.deployment import Stop
    from toolchain.models.model import Model

    Kind = TypeVar("Kind", bound=StrEnum)

CLAIMS_NAME: Final = "claims.json"
CLAIMS_PICTURE: Final = "claims.png"
CLAIM_FRAMES: Final = 100
"""Frames at each rate of flipped bits, at most: they run cycle by cycle."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExploreOptions:
    """A sweep as a user writes it: lists with commas between their parts.

    Attributes:
        settings: `KEY=VALUE`s for the model.
        bits: `NAME=BITS`s for the model.
        question: What a network is asked.
        prob_bits: Widths of codes.
        targets: Target counts.
        rngs: Kinds of generators.
        scales: Kinds of scaling.
        sensor_modes: What cells are given.
        replicas: Machines on a board.
        steps: Steps a clock.
        partitions: Boards.
        stop: When boards stop.
        max_cycles: After how many cycles a machine stops anyway.
        recording: Recorded readings, or None to draw them.
        columns: `NAME=COLUMN`s of the recording.
        frames: How many frames at most.
        banks: Sets of seeds that each is run with.
        seed: Of the readings that are drawn.
        device: What a board has.
    """

    settings: tuple[str, ...]
    bits: tuple[str, ...]
    question: NetworkQuestion
    prob_bits: str
    targets: str
    rngs: str
    scales: str
    sensor_modes: str
    replicas: str
    steps: str
    partitions: int
    stop: Stop
    max_cycles: int
    recording: Path | None
    columns: tuple[str, ...]
    frames: int
    banks: int
    seed: int
    device: str


def run_explore(path: Path, results: Path, plot: Path | None, options: ExploreOptions) -> None:
    """Sweep, keeping every point in the results' file, and print what there is, also when it is interrupted.

    Raises:
        ToolchainError: Anything that is wrong with the model, the lists or the files.
    """
    if plot is not None:
        from toolchain.analysis.pictures import check_pictures_possible

        check_pictures_possible(plot)
    device = device_named(options.device)
    sweep = _sweep(options)
    model = read_model(path, options.question, Unread(settings=options.settings, bits=options.bits))
    if options.recording is None and options.columns:
        message = (
            f"--reading {options.columns[0]} says where in a recording a reading is: add --readings FILE"
        )
        raise BuildError(message)
    frames = Frames(model, options.frames, seed=options.seed, recorded=_recorded(model, options))
    kept = Results(results)
    found = tasks(model, sweep, frames, device)
    kept.check_writable()
    there = sum(task.key in kept.points for task in found)
    typer.echo(
        f"{len(found)} machines of {model.name} over {frames.columns(found[0].options.replicas).source}"
        + (f"; {there} of them are in {results}" if there else ""),
        err=True,
    )
    try:
        with _progress(len(found)) as advance:
            explore(
                found,
                kept.points,
                lambda task: run_task(model, task, frames, device, sweep.banks),
                kept.append,
                lambda point: advance(_named(point)),
            )
    finally:
        # Ctrl-C too, also between the writing of a point and the knowing of it: what is in the file is shown.
        kept = Results(results)
        points = [
            with_resources(model, task, kept.points[task.key], device)
            for task in found
            if task.key in kept.points
        ]
        if points:
            front = pareto(points)
            typer.echo(table(points, front), nl=False)
            typer.echo(f"{len(points)} of {len(found)} machines are in {results}", err=True)
            if plot is not None:
                from toolchain.analysis.pictures import draw_sweep

                draw_sweep(plot, model.name, points, front)
                typer.echo(f"Wrote {plot}", err=True)


def _recorded(model: Model, options: ExploreOptions) -> Callable[[int], Readings] | None:
    """Reads so many rows of the recording, where there is one."""
    path = options.recording
    if path is None:
        return None
    return lambda frames: recorded_readings(path, model.variables, options.columns, frames=frames)


def _sweep(options: ExploreOptions) -> Sweep:
    if options.partitions < 1 or options.max_cycles < 1 or options.banks < 1:
        message = "--partitions, --max-cycles and --banks are numbers from 1"
        raise BuildError(message)
    return Sweep(
        prob_bits=_numbers("--prob-bits", options.prob_bits),
        target_counts=_numbers("--targets", options.targets),
        rngs=_members("--rngs", options.rngs, RngKind),
        scales=_members("--scales", options.scales, Scale),
        sensor_modes=_members("--sensor-modes", options.sensor_modes, SensorMode),
        replicas=_numbers("--replicas", options.replicas),
        steps_per_clock=_numbers("--steps", options.steps),
        partitions=options.partitions,
        stop=options.stop,
        max_cycles=options.max_cycles,
        banks=options.banks,
    )


def _numbers(flag: str, text: str) -> tuple[int, ...]:
    try:
        return tuple(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        message = f"{flag} {text}: expected whole numbers with commas between them, such as {flag} 4,8"
        raise BuildError(message) from None


def _members(flag: str, text: str, kind: type[Kind]) -> tuple[Kind, ...]:
    try:
        return tuple(dict.fromkeys(kind(part.strip()) for part in text.split(",")))
    except ValueError:
        message = f"{flag} {text}: expected some of {', '.join(kind)}, with commas between them"
        raise BuildError(message) from None


def table(points: Sequence[Point], front: Sequence[Point]) -> str:
    """Return the sweep as text; the Pareto front's points have a star.

    Sensor modes and replicas are columns only where there are others than readings of columns and single machines.
    """
    keys = {point.key for point in front}
    several = any(point.replicas > 1 for point in points)
    modes = any(point.sensor_mode != "column" for point in points)
    rows = [
        "  "
        + ("cells      " if modes else "")
        + ("replicas  " if several else "")
        + "scale    rng     steps  codes  target  total variation (95 %)     by codes    KL bits  same MAP   z rms  without   cycles"
        "      95 %" + ("  a posterior" if several else "") + "     ALMs  blocks  fits"
    ]
    for point in sorted(points, key=lambda each: (each.cycles_a_posterior, each.total_variation or 1.0)):
        variation = (
            f"{point.total_variation:7.4f} ({point.total_variation_low:.4f}..{point.total_variation_high:.4f})"
            if point.total_variation is not None
            else "-"
        )
        rows.append(
            ("* " if point.key in keys else "  ")
            + (f"{point.sensor_mode:9}  " if modes else "")
            + (f"{point.replicas:8d}  " if several else "")
            + f"{point.scale:8} {point.rng:7} {point.steps_per_clock:5d}  {point.prob_bits:5d}  "
            f"{point.target_count:6d}  {variation:>24}  {_cell(point.quantising, '.4f'):>9}  {_cell(point.kl_bits, '.4f'):>9}  "
            f"{_cell(point.map_agreement, '.0%'):>8}  {_cell(point.z_rms, '.2f'):>6}  {point.without:7.1%}  "
            f"{point.cycles_median:7,.0f}  {point.cycles_95:8,.0f}  "
            + (f"{point.cycles_a_posterior:11,.1f}  " if several else "")
            + f"{_cell(point.alms, ',.0f'):>7}  {_cell(point.blocks, ','):>6}  "
            f"{'-' if point.fits is None else 'yes' if point.fits else 'no':>4}"
        )
    cycles = "cycles a posterior" if several else "cycles"
    rows.append(
        f"* nothing else here is better in one of total variation, {cycles}, ALMs and frames without a posterior, and as good "
        "in the others"
    )
    return "\n".join(rows) + "\n"


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


def _named(point: Point) -> str:
    said = f"{point.rng}, codes of {point.prob_bits} bits, target {point.target_count}, scale {point.scale}"
    said += "" if point.sensor_mode == "column" else f", {point.sensor_mode}"
    return said if point.replicas == 1 else f"{said}, {point.replicas} replicas"


def run_claims_command(directory: Path, *, frames: int, seed: int) -> None:
    """Run the thesis's claims as experiments, print their figures and draw them.

    Raises:
        BuildError: No matplotlib, a folder that can't be written, no frames, or too many.
    """
    from toolchain.analysis.claims import experiments, run_claims
    from toolchain.analysis.pictures import check_pictures_possible, draw_claims

    check_pictures_possible()
    check_frames(frames)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as reason:
        message = f"{directory} can't be made: {reason.strerror or reason}"
        raise BuildError(message) from None
    check_pictures_possible(directory / CLAIMS_PICTURE)
    with _progress(experiments()) as advance:
        claims = run_claims(frames=frames, fault_frames=min(frames, CLAIM_FRAMES), seed=seed, advance=advance)
    for heading, courses in (
        ("Cycles by the number of lines (4 sensors, target 255):", claims.lines),
        ("Cycles by the number of sensors (256 lines, target 255):", claims.sensors),
        ("Cycles by the target count (256 lines, 4 sensors):", claims.targets),
    ):
        typer.echo(_courses(heading, courses), nl=False)
    typer.echo(f"Total variation by the share of flipped bits ({claims.fault_frames} frames):")
    for name, faults in claims.faults.items():
        typer.echo(
            f"  {name:31} " + "  ".join(f"{fault.rate:g}: {fault.total_variation:.3f}" for fault in faults)
        )
    try:
        (directory / CLAIMS_NAME).write_text(claims.as_json(), encoding="utf-8")
    except OSError as reason:
        message = f"{directory / CLAIMS_NAME} can't be written: {reason.strerror or reason}"
        raise BuildError(message) from None
    draw_claims(directory / CLAIMS_PICTURE, claims)
    typer.echo(f"Wrote {directory / CLAIMS_NAME} and {directory / CLAIMS_PICTURE}", err=True)


def _courses(heading: str, courses: Sequence[Course]) -> str:
    rows = [heading, "          median   quartiles"]
    rows += [
        f"  {each.x:6,.0f}  {each.median:7,.0f}   {each.low:,.0f} to {each.high:,.0f}" for each in courses
    ]
    return "\n".join(rows) + "\n"


@contextmanager
def _progress(total: int) -> Iterator[Callable[[str], None]]:
    """A bar on a terminal, nothing elsewhere; what is under way, or was last done, stands beside it."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task("", total=total)
        yield lambda what: progress.update(bar, advance=1, description=what)


@contextmanager
def counting(total: int) -> Iterator[Callable[[], None]]:
    """The same for frames, which have no names."""
    with _progress(total) as advance:
        yield lambda: advance("frames")
