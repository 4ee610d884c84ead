"""The `toolchain` command (thesis 3.4): its flags; each subcommand's work is in a module of its own."""

import signal
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

# NumPy and what needs it are imported where they are used: --help answers at once.
from machines.parameters import PriorMode, RngKind, RngReset, SensorMode
from terminal.command_line import CommandLine
from terminal.refusals import one_sentence
from toolchain.commands import design, flags, regenerate
from toolchain.deployment import Queue, Stop
from toolchain.learning.fit_options import FitMethod, FitOptions, FitPrior
from toolchain.options import BuildOptions, OnMissing

app = CommandLine(no_args_is_help=True)
app.add_typer(regenerate.app, name="regenerate")
app.add_typer(design.app)


@app.callback()
def toolchain() -> None:
    """From a model, in Python or in a network's file, to everything a Bayesian machine needs."""


@app.command()
def build(
    model: flags.ModelPath,
    directory: Annotated[
        Path, typer.Option("--output-dir", "-o", help="Folder of the deployment.", metavar="DIR")
    ],
    uri: Annotated[
        str | None, typer.Option(help="rosbridge server with the readings, ws://host:port.")
    ] = None,
    topic: Annotated[str | None, typer.Option(help="Topic with the readings.")] = None,
    message_type: Annotated[
        str | None, typer.Option("--type", help="That topic's type, package/Name.")
    ] = None,
    sources: Annotated[
        Path | None,
        typer.Option(
            help="Instead of topic and type: a TOML file with several topics, of one server or more.",
            metavar="FILE",
        ),
    ] = None,
    settings: flags.Settings = None,
    searched: flags.Searched = "",
    known: flags.KnownNames = "",
    given: flags.Given = None,
    prior_select: flags.PriorSelectName = "",
    on_missing: flags.OnMissingFlag = OnMissing.ERROR,
    output: Annotated[str, typer.Option(help="Topic for the posteriors.")] = "/BMresults",
    partitions: flags.Partitions = 1,
    device: flags.DeviceFlag = None,
    interface: flags.Interface = None,
    scale: flags.ScaleFlag = None,
    prob_bits: flags.ProbBits = 8,
    bits: flags.Bits = None,
    prior_mode: flags.PriorModeFlag = PriorMode.TABLE,
    prior_path: Annotated[
        str | None, typer.Option(help="Where in the message a written prior is.", metavar="PATH")
    ] = None,
    counter_bits: flags.CounterBits = 8,
    target_count: flags.TargetCount = None,
    max_cycles: flags.MaxCycles = 2**17,
    stop: flags.StopFlag = Stop.SLICES,
    rng: flags.Rng = RngKind.LFSR32,
    rng_table: flags.RngTable = None,
    rng_banks: flags.RngBanks = 16,
    rng_reset: flags.RngResetFlag = RngReset.BANK,
    shared: flags.Shared = True,
    steps_per_clock: flags.StepsPerClock = 0,
    sensor_mode: flags.SensorModeFlag = SensorMode.COLUMN,
    replicas: flags.Replicas = 1,
    queue: Annotated[
        Queue, typer.Option(help="Frames that come too fast: the newest counts, or all in order.")
    ] = Queue.LATEST,
    tolerance: Annotated[
        float, typer.Option(help="Seconds within which readings from several topics belong together.")
    ] = 0.05,
) -> None:
    """Build a deployment: programming files for the boards, deployment.toml, a report, and a hardware project.

    For example `toolchain build casestudies/boat -o build/boat --partitions 4 --uri ws://localhost:9090
    --topic /boat/sensors --type boat_msgs/Sensors`, or of a network `toolchain build asia.bif --searched bronc
    --known smoke,dysp -o build/asia --uri ws://localhost:9090 --topic /patient --type clinic_msgs/Patient`
    """
    with one_sentence():
        from toolchain.commands.build import run_build
        from toolchain.commands.named_model import NetworkQuestion, Unread

        options = BuildOptions(
            uri=uri or "",
            topic=topic or "",
            type=message_type or "",
            output=output,
            partitions=partitions,
            scale=scale,
            prob_bits=prob_bits,
            prior_mode=prior_mode,
            prior_path=prior_path,
            counter_bits=counter_bits,
            target_count=target_count,
            max_cycles=max_cycles,
            stop=stop,
            rng=rng,
            rng_banks=rng_banks,
            rng_reset=rng_reset,
            shared=shared,
            steps_per_clock=steps_per_clock,
            sensor_mode=sensor_mode,
            replicas=replicas,
            queue=queue,
            tolerance_s=tolerance,
        )
        question = NetworkQuestion.of_flags(searched, known, given, prior_select, on_missing)
        unread = Unread(
            settings=tuple(settings or ()),
            bits=tuple(bits or ()),
            interface=interface,
            rng_table=rng_table,
            sources=sources,
            device=device,
        )
        run_build(model, directory, question, options, unread)


@app.command()
def check(
    context: typer.Context,
    path: Annotated[
        Path,
        typer.Argument(
            help="Folder that holds model.py, a network's file, or a deployment's folder.",
            metavar="MODEL|DIR",
        ),
    ],
    settings: flags.Settings = None,
    searched: flags.Searched = "",
    known: flags.KnownNames = "",
    given: flags.Given = None,
    prior_select: flags.PriorSelectName = "",
    on_missing: flags.OnMissingFlag = OnMissing.ERROR,
    partitions: flags.Partitions = 1,
    device: flags.DeviceFlag = None,
    interface: flags.Interface = None,
    scale: flags.ScaleFlag = None,
    prob_bits: flags.ProbBits = 8,
    bits: flags.Bits = None,
    prior_mode: flags.PriorModeFlag = PriorMode.TABLE,
    counter_bits: flags.CounterBits = 8,
    target_count: flags.TargetCount = None,
    max_cycles: flags.MaxCycles = 2**17,
    stop: flags.StopFlag = Stop.SLICES,
    rng: flags.Rng = RngKind.LFSR32,
    rng_table: flags.RngTable = None,
    rng_banks: flags.RngBanks = 16,
    rng_reset: flags.RngResetFlag = RngReset.BANK,
    shared: flags.Shared = True,
    steps_per_clock: flags.StepsPerClock = 0,
    sensor_mode: flags.SensorModeFlag = SensorMode.COLUMN,
    replicas: flags.Replicas = 1,
    json: Annotated[bool, typer.Option("--json", help="One JSON object a line.")] = False,
) -> None:
    """Say what is wrong before anything runs: of a model as it would be built, or of a deployment.

    For example `toolchain check casestudies/boat --partitions 4`, or `toolchain check build/boat`. Exit code 2 if there
    is an error among the findings, else 0.
    """
    with one_sentence():
        from toolchain.commands.check import UNTOLD_TARGET, run_check
        from toolchain.commands.named_model import NetworkQuestion, Unread

        options = BuildOptions(
            **UNTOLD_TARGET,
            partitions=partitions,
            scale=scale,
            prob_bits=prob_bits,
            prior_mode=prior_mode,
            counter_bits=counter_bits,
            target_count=target_count,
            max_cycles=max_cycles,
            stop=stop,
            rng=rng,
            rng_banks=rng_banks,
            rng_reset=rng_reset,
            shared=shared,
            steps_per_clock=steps_per_clock,
            sensor_mode=sensor_mode,
            replicas=replicas,
        )
        question = NetworkQuestion.of_flags(searched, known, given, prior_select, on_missing)
        unread = Unread(
            settings=tuple(settings or ()),
            bits=tuple(bits or ()),
            interface=interface,
            rng_table=rng_table,
            device=device,
        )
        said = [name for name in context.params if name not in {"path", "json"} and _was_said(context, name)]
        code = run_check(path, question, options, unread, said, json=json)
    raise typer.Exit(code)


@app.command()
def new(
    name: Annotated[Path, typer.Argument(help="The folder to make; its last part names the model.")],
) -> None:
    """Start a model from a template that runs: a robot in a corridor.

    For example `toolchain new mymodel`; it prints how to go on.
    """
    with one_sentence():
        from toolchain.commands.new import new_model

        typer.echo(new_model(name), nl=False)


@app.command()
def fit(
    case: Annotated[
        Path, typer.Argument(help="Folder that holds model.py: its variables are fitted.", metavar="MODEL")
    ],
    recordings: Annotated[
        list[Path],
        typer.Argument(help="CSV, MCAP or bag, with readings and the truth.", metavar="RECORDING"),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="The file to write: .toml of normals, .npz of counts.", metavar="FILE"
        ),
    ],
    truth: Annotated[
        list[str],
        typer.Option(
            help="Where a searched dimension's true value is; one for each.", metavar="LABEL=COLUMN"
        ),
    ],
    readings: flags.ReadingColumns = None,
    settings: flags.Settings = None,
    method: Annotated[
        FitMethod, typer.Option(help="normals: sigma and the outliers' share; counts: whole tables.")
    ] = FitMethod.NORMALS,
    pool: Annotated[
        list[str] | None,
        typer.Option(help="normals: variables with one sigma for all, such as 'range_*'.", metavar="PATTERN"),
    ] = None,
    bias: Annotated[bool, typer.Option("--bias", help="normals: fit a constant error too.")] = False,
    floor: Annotated[
        float,
        typer.Option(help="normals: the least an outlier gets, relative to the peak; codes must hold it."),
    ] = 0.005,
    pseudo_count: Annotated[
        float, typer.Option(help="counts: readings that the Dirichlet prior of a cell is worth.")
    ] = 1.0,
    prior: Annotated[
        FitPrior, typer.Option(help="counts: what the prior looks like: the model's own table, or uniform.")
    ] = FitPrior.MODEL,
    check: Annotated[
        list[Path] | None,
        typer.Option(
            help="A recording to compare the model and the fit on; never learnt from.", metavar="RECORDING"
        ),
    ] = None,
    tolerance: Annotated[
        float, typer.Option(help="bags: seconds between a reading and the truth that belongs to it.")
    ] = 0.1,
) -> None:
    """Learn a model's tables from recordings with ground truth, and say how much data each rests on.

    For example `toolchain fit casestudies/mrclam DATA/ds1_robot3.csv -o fit.toml --set landmarks=DATA/landmarks.csv
    --truth y=ref_y_m --truth x=ref_x_m --reading 'range_*=range_*_m' --reading 'bearing_*=bearing_*_rad'
    --pool 'range_*' --pool 'bearing_*' --check DATA/ds1_robot5.csv`
    """
    with one_sentence():
        from toolchain.commands.fit import run_fit

        options = FitOptions(
            truth=tuple(truth),
            readings=tuple(readings or ()),
            method=method,
            pool=tuple(pool or ()),
            bias=bias,
            floor=floor,
            pseudo_count=pseudo_count,
            prior=prior,
            tolerance_s=tolerance,
        )
        typer.echo(run_fit(case, recordings, output, settings or [], options, check or []), nl=False)


def main() -> None:
    """Entry point of the `toolchain` command; SIGINT ends it with 130 and SIGTERM with 143."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _end)
    app()


def _was_said(context: typer.Context, name: str) -> bool:
    """Whether a flag stood on the command line, rather than being a default."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _end(number: int, _frame: FrameType | None) -> None:
    typer.echo(f"error: ended by {signal.Signals(number).name}; what was asked for is not complete", err=True)
    raise SystemExit(128 + number)
