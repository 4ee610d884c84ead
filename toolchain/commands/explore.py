"""The `toolchain explore` command: a sweep over machines for a model, or the thesis's claims as experiments."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from machines.parameters import RngKind
from toolchain.commands.flags import Bits, MaxCycles, ModelFlags, Partitions, ReadingFlags, StopWhen
from toolchain.commands.progress import progress
from toolchain.deployment import Scale, Stop
from toolchain.errors import BuildError

if TYPE_CHECKING:
    from toolchain.analysis.results import Point
    from toolchain.analysis.sweep import Sweep

Kind = TypeVar("Kind", bound=StrEnum)


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepFlags(ModelFlags):
    """Flags of a sweep: comma-separated lists are combined, the rest is the same for all machines."""

    bits: Bits = None
    prob_bits: Annotated[str, typer.Option(help="Bits of a code, comma-separated.", metavar="LIST")] = (
        "4,6,8,10"
    )
    targets: Annotated[
        str, typer.Option(help="Target counts, each with the narrowest counter.", metavar="LIST")
    ] = "63,255,1023"
    rngs: Annotated[str, typer.Option(help="Generators.", metavar="LIST")] = "lfsr16,lfsr32"
    scales: Annotated[
        str,
        typer.Option(
            help="Part of a table that is divided by its maximum before quantising.", metavar="LIST"
        ),
    ] = "address,column"
    steps: Annotated[
        str, typer.Option(help="Steps of a generator per cycle; 0: fresh bits.", metavar="LIST")
    ] = "0"
    partitions: Partitions = 1
    stop: StopWhen = Stop.SLICES
    max_cycles: MaxCycles = 2**17
    banks: Annotated[int, typer.Option(help="Number of seed sets for each frame.")] = 2


def explore(
    flags: SweepFlags,
    readings: ReadingFlags,
    model: Annotated[
        Path | None,
        typer.Argument(
            help="Folder with model.py, or a network file: .bif, .xmlbif, .uai, .net, .xdsl (.gz).",
            metavar="[MODEL]",
        ),
    ] = None,
    frames: Annotated[int, typer.Option(help="Maximum number of frames.")] = 50,
    results: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="File of results, from which a sweep is resumed.", metavar="FILE"
        ),
    ] = Path("explore.jsonl"),
    plot: Annotated[
        Path | None, typer.Option(help="Picture of accuracy against cycles.", metavar="PNG")
    ] = None,
    claims: Annotated[
        Path | None,
        typer.Option(
            help="Instead of a sweep: the thesis's claims as experiments, with numbers and a picture in this folder.",
            metavar="DIR",
        ),
    ] = None,
) -> None:
    """Sweep over machines for a model: accuracy against cycles and ALMs, with the Pareto front.

    For example `toolchain explore casestudies/boat --partitions 4 --prob-bits 6,8 --plot boat.png`; after
    Ctrl-C, the same command resumes the sweep, whose points are in the results file. `toolchain explore
    --claims out/claims` tests the thesis's claims.
    """
    if claims is not None:
        if model is not None:
            raise BuildError(f"--claims has its own model: omit {model}")
        _run_claims(claims, frames=frames, seed=readings.seed)
        return
    if model is None:
        raise BuildError(
            "name a model to explore, such as 'toolchain explore casestudies/boat', or --claims DIR"
        )
    from toolchain.analysis.logic import device_named
    from toolchain.analysis.readings import check_columns, recorded_readings, sample_readings
    from toolchain.analysis.results import Results, check_pictures_possible, draw_sweep, pareto, table
    from toolchain.analysis.sweep import run_sweep, run_task, tasks, with_resources
    from toolchain.commands.request import read_model

    if plot is not None:
        check_pictures_possible(plot)
    device = device_named(readings.device)
    sweep = _sweep(flags)
    read = read_model(model, flags, flags.bits)
    check_columns(readings.readings, readings.reading)
    if readings.readings is None:
        drawn = sample_readings(read, frames, seed=readings.seed)
    else:
        drawn = recorded_readings(readings.readings, read.variables, readings.reading or (), frames=frames)
    kept = Results(results)
    found = tasks(read, sweep, drawn, device)
    kept.check_writable()
    there = sum(task.key in kept.points for task in found)
    typer.echo(
        f"{len(found)} machine{'s' if len(found) != 1 else ''} of {read.name} over {drawn.source}"
        + (f"; {there} of them are in {results}" if there else ""),
        err=True,
    )
    try:
        with progress(len(found)) as advance:
            run_sweep(
                found,
                kept.points,
                lambda task: run_task(task, drawn, device, sweep.banks),
                kept.append,
                lambda point: advance(_name_of(point)),
            )
    finally:
        # Ctrl-C may arrive between the write of a point and its return, so read the file.
        kept = Results(results)
        points = [
            with_resources(task, kept.points[task.key], device) for task in found if task.key in kept.points
        ]
        if points:
            front = pareto(points)
            typer.echo(table(points, front), nl=False)
            typer.echo(f"{len(points)} of {len(found)} machines are in {results}", err=True)
            if plot is not None:
                draw_sweep(plot, read.name, points, front)
                typer.echo(f"Wrote {plot}", err=True)


def _sweep(flags: SweepFlags) -> "Sweep":
    from toolchain.analysis.sweep import Sweep

    if flags.partitions < 1 or flags.max_cycles < 1 or flags.banks < 1:
        raise BuildError("--partitions, --max-cycles and --banks are numbers from 1")
    return Sweep(
        prob_bits=_numbers("--prob-bits", flags.prob_bits),
        target_counts=_numbers("--targets", flags.targets),
        rngs=_members("--rngs", flags.rngs, RngKind),
        scales=_members("--scales", flags.scales, Scale),
        steps_per_clock=_numbers("--steps", flags.steps),
        partitions=flags.partitions,
        stop=flags.stop,
        max_cycles=flags.max_cycles,
        banks=flags.banks,
    )


def _numbers(flag: str, text: str) -> tuple[int, ...]:
    try:
        return tuple(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        raise BuildError(
            f"{flag} {text}: expected comma-separated whole numbers, such as {flag} 4,8"
        ) from None


def _members(flag: str, text: str, kind: type[Kind]) -> tuple[Kind, ...]:
    try:
        return tuple(dict.fromkeys(kind(part.strip()) for part in text.split(",")))
    except ValueError:
        raise BuildError(
            f"{flag} {text}: expected some of {', '.join(kind)}, with commas between them"
        ) from None


def _name_of(point: "Point") -> str:
    return f"{point.rng}, codes of {point.prob_bits} bits, target {point.target_count}, scale {point.scale}"


def _run_claims(directory: Path, *, frames: int, seed: int) -> None:
    from toolchain.analysis.claims import draw_claims, experiments, run_claims
    from toolchain.analysis.readings import check_frames
    from toolchain.analysis.results import check_pictures_possible

    figures, picture = directory / "claims.json", directory / "claims.png"
    check_pictures_possible()
    check_frames(frames)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        check_pictures_possible(picture)
        with progress(experiments()) as advance:
            claims = run_claims(frames=frames, seed=seed, advance=advance)
        typer.echo(claims.as_text(), nl=False)
        figures.write_text(claims.as_json(), encoding="utf-8")
    except OSError as reason:
        raise BuildError(f"{figures} cannot be written: {reason.strerror or reason}") from None
    draw_claims(picture, claims)
    typer.echo(f"Wrote {figures} and {picture}", err=True)
