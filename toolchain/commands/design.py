"""The subcommands `inspect` and `explore`: what a machine will do, before it is built or bought; their flags."""

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from terminal.refusals import one_sentence
from toolchain.commands import flags
from toolchain.deployment import Stop
from toolchain.errors import BuildError
from toolchain.options import OnMissing

app = typer.Typer()

_Readings: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--readings", help="Recorded readings: CSV, MCAP or bag; else they are drawn.", metavar="RECORDING"
    ),
]
_Tolerance: TypeAlias = Annotated[
    float, typer.Option(help="bags: seconds between readings that belong together.")
]
_Frames: TypeAlias = Annotated[int, typer.Option(help="Frames of readings at most.")]
_Banks: TypeAlias = Annotated[int, typer.Option(help="Sets of seeds that each frame is run with.")]
_Seed: TypeAlias = Annotated[int, typer.Option(help="Of the readings that are drawn.", min=0)]
_Device: TypeAlias = Annotated[str, typer.Option(help="What the boards have: proce-v-d8.")]


@app.command("inspect")
def inspect_(
    directory: Annotated[Path, typer.Argument(help="Folder of a deployment.", metavar="DIR")],
    model: Annotated[
        Path | None,
        typer.Option(
            help="The model that it was built from, folder or network: accuracy is then told beside the model, not "
            "only beside its codes.",
            metavar="MODEL",
        ),
    ] = None,
    settings: flags.Settings = None,
    bits: flags.Bits = None,
    searched: flags.Searched = "",
    known: flags.KnownNames = "",
    given: flags.Given = None,
    prior_select: flags.PriorSelectName = "",
    on_missing: flags.OnMissingFlag = OnMissing.ERROR,
    readings: _Readings = None,
    reading: flags.ReadingColumns = None,
    tolerance: _Tolerance = 0.1,
    frames: Annotated[
        int | None,
        typer.Option(
            help="Frames of readings at most; default 200, or 20 of a machine that is slow to emulate; with replicas fewer."
        ),
    ] = None,
    banks: Annotated[
        int | None,
        typer.Option(help="Sets of seeds that each frame is run with; default 4, or 1 of such a machine."),
    ] = None,
    seed: _Seed = 1,
    clock: Annotated[float, typer.Option(help="The boards' clock, hertz.")] = 100e6,
    device: _Device = "proce-v-d8",
    soft_pcie: Annotated[
        bool, typer.Option("--soft-pcie", help="PCIe controllers of logic; else the device's own.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="One JSON object instead of words.")] = False,
) -> None:
    """Explain a deployment: its machine, what quantising lost, cycles, accuracy, resources and energy.

    For example `toolchain inspect build/boat --model casestudies/boat --clock 100e6`, or over recorded readings
    `toolchain inspect build/mrclam --readings DATA/ds1_robot3.csv --reading 'range_*=range_*_m' --reading
    'bearing_*=bearing_*_rad'`
    """
    with one_sentence():
        from toolchain.analysis.resources import Pcie
        from toolchain.commands.explore import counting
        from toolchain.commands.inspect import InspectOptions, inspect
        from toolchain.commands.inspection_report import as_json, report
        from toolchain.commands.named_model import NetworkQuestion

        options = InspectOptions(
            model=model,
            settings=tuple(settings or ()),
            bits=tuple(bits or ()),
            question=NetworkQuestion.of_flags(searched, known, given, prior_select, on_missing),
            recording=readings,
            columns=tuple(reading or ()),
            tolerance_s=tolerance,
            frames=frames,
            banks=banks,
            seed=seed,
            clock_hz=clock,
            device=device,
            pcie=Pcie.SOFT if soft_pcie else Pcie.HARD,
        )
        found = inspect(directory, options, counting)
        typer.echo(as_json(found) if json else report(found), nl=False)


@app.command()
def explore(
    model: Annotated[
        Path | None,
        typer.Argument(
            help="Folder that holds model.py, or a network: .bif, .xmlbif, .uai, .net.", metavar="[MODEL]"
        ),
    ] = None,
    settings: flags.Settings = None,
    bits: flags.Bits = None,
    searched: flags.Searched = "",
    known: flags.KnownNames = "",
    given: flags.Given = None,
    prior_select: flags.PriorSelectName = "",
    on_missing: flags.OnMissingFlag = OnMissing.ERROR,
    prob_bits: Annotated[str, typer.Option(help="Bits of a code, with commas.", metavar="LIST")] = "4,6,8,10",
    targets: Annotated[
        str, typer.Option(help="Target counts, each in the narrowest counter.", metavar="LIST")
    ] = "63,255,1023",
    rngs: Annotated[str, typer.Option(help="Generators.", metavar="LIST")] = "lfsr16,lfsr32",
    scales: Annotated[
        str, typer.Option(help="What is divided by its maximum before quantising.", metavar="LIST")
    ] = "address,column",
    sensor_modes: Annotated[
        str,
        typer.Option(
            help="What a cell is given: its column's reading, its own (cell), or its probability (threshold).",
            metavar="LIST",
        ),
    ] = "column",
    replicas: Annotated[
        str, typer.Option(help="Machines on a board, around the same generators.", metavar="LIST")
    ] = "1",
    steps: Annotated[
        str, typer.Option(help="Steps of a generator in a cycle; 0: fresh bits.", metavar="LIST")
    ] = "0",
    partitions: flags.Partitions = 1,
    stop: flags.StopFlag = Stop.SLICES,
    max_cycles: flags.MaxCycles = 2**17,
    readings: _Readings = None,
    reading: flags.ReadingColumns = None,
    frames: _Frames = 50,
    banks: _Banks = 2,
    seed: _Seed = 1,
    device: _Device = "proce-v-d8",
    results: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="File of results: kept point by point, and gone on with.", metavar="FILE"
        ),
    ] = Path("explore.jsonl"),
    plot: Annotated[
        Path | None, typer.Option(help="Picture of accuracy against cycles.", metavar="PNG")
    ] = None,
    claims: Annotated[
        Path | None,
        typer.Option(
            help="Instead of a sweep: the thesis's claims as experiments, figures and a picture in this folder.",
            metavar="DIR",
        ),
    ] = None,
) -> None:
    """Sweep over machines of a model: accuracy against cycles and ALMs, with the Pareto front.

    For example `toolchain explore casestudies/boat --partitions 4 --prob-bits 6,8 --plot boat.png`; Ctrl-C keeps what is
    done, and the same command goes on. `toolchain explore --claims out/claims` makes the thesis's claims.
    """
    with one_sentence():
        from toolchain.commands.explore import ExploreOptions, run_claims_command, run_explore
        from toolchain.commands.named_model import NetworkQuestion

        if claims is not None:
            if model is not None:
                message = f"--claims has a model of its own: leave {model} out"
                raise BuildError(message)
            run_claims_command(claims, frames=frames, seed=seed)
            return
        if model is None:
            message = "name a model to explore, such as 'toolchain explore casestudies/boat', or --claims DIR"
            raise BuildError(message)
        options = ExploreOptions(
            settings=tuple(settings or ()),
            bits=tuple(bits or ()),
            question=NetworkQuestion.of_flags(searched, known, given, prior_select, on_missing),
            prob_bits=prob_bits,
            targets=targets,
            rngs=rngs,
            scales=scales,
            sensor_modes=sensor_modes,
            replicas=replicas,
            steps=steps,
            partitions=partitions,
            stop=stop,
            max_cycles=max_cycles,
            recording=readings,
            columns=tuple(reading or ()),
            frames=frames,
            banks=banks,
            seed=seed,
            device=device,
        )
        run_explore(model, results, plot, options)
