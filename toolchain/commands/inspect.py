"""The `toolchain inspect` command, which explains a deployment: accuracy, time, resources and energy."""

from pathlib import Path
from typing import Annotated, Final

import typer

from toolchain.commands.flags import Bits, ModelFlags, ReadingFlags
from toolchain.commands.progress import progress
from toolchain.errors import BuildError

CLOCK_MAX_HZ: Final = 1e12


def inspect(
    directory: Annotated[Path, typer.Argument(help="Folder of a deployment.", metavar="DIR")],
    flags: ModelFlags,
    readings: ReadingFlags,
    bits: Bits = None,
    model: Annotated[
        Path | None,
        typer.Option(
            help="The model from which it was built, folder or network file: accuracy is then compared with the "
            "model, not only with its codes.",
            metavar="MODEL",
        ),
    ] = None,
    tolerance: Annotated[
        float,
        typer.Option(help="bags: maximum time between readings that belong together.", metavar="SECONDS"),
    ] = 0.1,
    frames: Annotated[
        int | None,
        typer.Option(
            help="Maximum number of frames; fewer with replicas.",
            show_default="200, or 20 for a slow machine",
        ),
    ] = None,
    banks: Annotated[
        int | None,
        typer.Option(help="Number of seed sets for each frame.", show_default="4, or 1 for a slow machine"),
    ] = None,
    clock: Annotated[float, typer.Option(help="Clock frequency of the boards.", metavar="HERTZ")] = 100e6,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
) -> None:
    """Explain a deployment: machine, quantisation loss, cycles, accuracy, resources and energy.

    For example `toolchain inspect build/boat --model casestudies/boat --clock 100e6`, or over recorded readings
    `toolchain inspect build/mrclam --readings DATA/ds1_robot3.csv --reading 'range_*=range_*_m' --reading
    'bearing_*=bearing_*_rad'`
    """
    from toolchain.analysis.inspection import InspectOptions, as_json, inspect_deployment, inspection_report
    from toolchain.analysis.logic import device_named
    from toolchain.commands.request import read_model
    from toolchain.deployment import load_deployment

    if not 1.0 <= clock <= CLOCK_MAX_HZ:
        raise BuildError(f"--clock is {clock:g}, expected hertz from 1 to {CLOCK_MAX_HZ:g}, such as 100e6")
    if banks is not None and banks < 1:
        raise BuildError(f"--banks is {banks}, expected 1 or more")
    options = InspectOptions(
        recording=readings.readings,
        columns=tuple(readings.reading or ()),
        tolerance_s=tolerance,
        frames=frames,
        banks=banks,
        seed=readings.seed,
        clock_hz=clock,
        device=device_named(readings.device),
    )
    deployment = load_deployment(directory)
    read = None if model is None else read_model(model, flags, bits)
    found = inspect_deployment(deployment, read, options, progress)
    typer.echo(as_json(found) if json else inspection_report(found), nl=False)
