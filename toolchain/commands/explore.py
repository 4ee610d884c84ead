"""The analysis commands: `inspect` explains a deployment, and `advise` and `explore` compare machines."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from toolchain.analysis import AdviceOptions, InspectOptions, ReadingOptions, Sweep
from toolchain.bounded_files import file_errors
from toolchain.cluster import SchedulerOptions, runner
from toolchain.commands.request import ModelFlags, ModelPath, read_model, read_source
from toolchain.errors import BuildError, NotFusionError, counted
from toolchain.flags import Bits

RESULTS = Path("build/explore.jsonl")
"""The default file of results. It is in `build`, because Git ignores this folder."""


@contextmanager
def progress(total: int | None) -> Iterator[Callable[[str], None]]:
    """Show a progress bar if standard error is a terminal. Yield a function to call after each step.

    The function takes a text to show. Without a `total`, the bar does not show the share of done steps.
    """
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), transient=True) as shown:
        bar = shown.add_task("", total=total)
        yield lambda words: shown.update(bar, advance=1, description=words)


def inspect(
    directory: Annotated[Path, typer.Argument(help="Folder of a deployment.", metavar="DIR")],
    flags: ModelFlags,
    options: InspectOptions,
    where: SchedulerOptions,
    bits: Bits = None,
    model: Annotated[
        Path | None,
        typer.Option(
            help="The model from which it was built, folder or network file: accuracy is then compared with the "
            "model, not only with its codes.",
            metavar="MODEL",
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
) -> None:
    """Explain a deployment: machine, quantisation loss, cycles, accuracy, resources and energy.

    For example `toolchain inspect build/boat --model casestudies/boat --clock 100e6`. With recorded readings, for
    example `toolchain inspect build/mrclam --readings DATA/ds1_robot3.csv --reading 'range_*=range_*_m' --reading
    'bearing_*=bearing_*_rad'`
    """
    from toolchain.analysis.inspection import as_json, inspect_deployment, inspection_report
    from toolchain.deployment import load_deployment

    deployment = load_deployment(directory)
    flags = flags.over(deployment.model)
    if not deployment.machine.is_divided:
        from toolchain.analysis.chain_inspection import inspect_chain
        from toolchain.building.choice import network_for

        network = None if model is None else network_for(read_source(model, flags))
        with runner(where) as run:
            chain = inspect_chain(deployment, network, options, progress, run)
        typer.echo(chain.as_json() if json else chain.report(), nl=False)
        return
    read = None if model is None else read_model(model, flags, bits or deployment.model.bits)
    with runner(where) as run:
        found = inspect_deployment(deployment, read, options, progress, run)
    typer.echo(as_json(found) if json else inspection_report(found), nl=False)


def advise(
    model: ModelPath,
    flags: ModelFlags,
    options: AdviceOptions,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
) -> None:
    """Compare a BM1, a BM2 and exact inference on this host for a model, at the same accuracy, and recommend one.

    For example `toolchain advise asia.bif --searched bronc --known smoke,dysp --accuracy 0.01`
    """
    from toolchain.analysis.advice import advise as compare

    with progress(None) as begun:
        found = compare(read_source(model, flags), options, begun)
    typer.echo(found.as_json() if json else found.report(), nl=False)


def explore(
    model: ModelPath,
    flags: ModelFlags,
    sweep: Sweep,
    readings: ReadingOptions,
    where: SchedulerOptions,
    bits: Bits = None,
    frames: Annotated[int, typer.Option(help="Maximum number of frames.")] = 50,
    results: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="File of results, from which a sweep is resumed.", metavar="FILE"
        ),
    ] = RESULTS,
    plot: Annotated[
        Path | None, typer.Option(help="Picture of accuracy against cycles.", metavar="PNG")
    ] = None,
) -> None:
    """Sweep over machines for a model: accuracy against cycles and ALMs, with the Pareto front.

    For example `toolchain explore casestudies/boat --partitions 4 --prob-bits 6,8 --plot boat.png`. If you repeat the
    command after Ctrl-C, the sweep continues after the points in the results file.
    """
    from toolchain.analysis import sweep as sweeps
    from toolchain.analysis.logic import device_named
    from toolchain.analysis.readings import recorded_readings, sample_readings

    if plot is not None:
        sweeps.check_plot(plot)
    device = device_named(readings.device)
    try:
        read = read_model(model, flags, bits)
    except NotFusionError as reason:
        raise BuildError(
            f"explore is for a BM1, but {reason.why}; 'toolchain advise' also tries a BM2"
        ) from None
    if readings.readings is None:
        drawn = sample_readings(read, frames, seed=readings.seed)
    else:
        drawn = recorded_readings(readings.readings, read.variables, readings.reading or (), frames=frames)
    # only the default folder is created: another one that does not exist may be a typing error
    if results == RESULTS:
        with file_errors(results, "written", BuildError, "; name another file with -o"):
            results.parent.mkdir(exist_ok=True)
    kept = sweeps.Results(results)
    found = sweeps.tasks(read, sweep, drawn, device)
    kept.check_writable()
    there = sum(task.key in kept.points for task in found)
    typer.echo(
        f"{counted(len(found), 'machine')} of {read.name} over {drawn.source}"
        + (f"; {there} of them are in {results}" if there else ""),
        err=True,
    )
    try:
        with runner(where) as run, progress(len(found)) as advance:
            sweeps.run_sweep(
                sweeps.SweepJob(found, drawn, device, sweep.banks),
                run,
                kept,
                lambda point: advance(
                    f"{point.rng}, codes of {point.prob_bits} bits, target {point.target_count}, scale {point.scale}"
                ),
            )
    finally:
        # Ctrl-C may arrive between the write of a point and its return, so read the file.
        kept = sweeps.Results(results)
        points = [
            sweeps.with_resources(task, kept.points[task.key], device)
            for task in found
            if task.key in kept.points
        ]
        if points:
            front = sweeps.pareto(points)
            typer.echo(sweeps.table(points, front), nl=False)
            typer.echo(f"{len(points)} of {len(found)} machines are in {results}", err=True)
            if plot is not None:
                sweeps.draw_sweep(plot, read.name, points, front)
                typer.echo(f"Wrote {plot}", err=True)
