"""The `toolchain` command: `toolchain build` makes a deployment of a case study's model (thesis 3.4)."""

import signal
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

# NumPy and what needs it are imported where they are used: --help answers at once.
from machines.parameters import RngKind, RngReset
from toolchain.deployment import Queue, Stop, parse_interface
from toolchain.errors import BuildError, ToolchainError
from toolchain.options import BuildOptions, Scale

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback()
def toolchain() -> None:
    """From a model in Python to everything a Bayesian machine needs."""


@app.command()
def build(
    case: Annotated[
        Path, typer.Argument(help="Folder of a case study; it holds model.py.", metavar="CASE_DIR")
    ],
    directory: Annotated[
        Path, typer.Option("--output-dir", "-o", help="Folder of the deployment.", metavar="DIR")
    ],
    uri: Annotated[str, typer.Option(help="rosbridge server with the readings, ws://host:port.")],
    topic: Annotated[str, typer.Option(help="Topic with the readings.")],
    message_type: Annotated[str, typer.Option("--type", help="That topic's type, package/Name.")],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="A parameter of the model; repeat for more.", metavar="KEY=VALUE"),
    ] = None,
    output: Annotated[str, typer.Option(help="Topic for the posteriors.")] = "/BMresults",
    partitions: Annotated[int, typer.Option(help="Boards to split the lines over.")] = 1,
    interface: Annotated[
        str | None,
        typer.Option(
            help="Inputs x results of a board's registers; default 20x1200, or the model's size if larger.",
            metavar="INPUTSxRESULTS",
        ),
    ] = None,
    scale: Annotated[
        Scale, typer.Option(help="What is divided by its maximum before quantising.")
    ] = Scale.ADDRESS,
    prob_bits: Annotated[int, typer.Option(help="Bits of a code, 1 to 16.")] = 8,
    counter_bits: Annotated[int, typer.Option(help="Bits of a line's counter, 1 to 32.")] = 8,
    target_count: Annotated[
        int | None, typer.Option(help="Count that stops a machine; default the counters' largest.")
    ] = None,
    max_cycles: Annotated[int, typer.Option(help="Cycles after which a machine stops anyway.")] = 2**17,
    stop: Annotated[
        Stop, typer.Option(help="slices: all boards soon after the first overflow; own: each at its own.")
    ] = Stop.SLICES,
    rng: Annotated[
        RngKind, typer.Option(help="Random number generators; ideal exists emulated only.")
    ] = RngKind.LFSR32,
    rng_banks: Annotated[int, typer.Option(help="Sets of seeds, used in turn.")] = 16,
    rng_reset: Annotated[
        RngReset, typer.Option(help="bank: a frame restarts the generators; free: never (the thesis).")
    ] = RngReset.BANK,
    queue: Annotated[
        Queue, typer.Option(help="Frames that come too fast: the newest counts, or all in order.")
    ] = Queue.LATEST,
    tolerance: Annotated[
        float, typer.Option(help="Seconds within which readings from several topics belong together.")
    ] = 0.05,
) -> None:
    """Build a deployment: programming files for the boards, deployment.toml and a report.

    For example `toolchain build casestudies/boat -o build/boat --partitions 4 --uri ws://localhost:9090
    --topic /boat/sensors --type boat_msgs/Sensors`
    """
    try:
        options = BuildOptions(
            uri=uri,
            topic=topic,
            type=message_type,
            output=output,
            partitions=partitions,
            interface=None if interface is None else _interface(interface),
            scale=scale,
            prob_bits=prob_bits,
            counter_bits=counter_bits,
            target_count=target_count,
            max_cycles=max_cycles,
            stop=stop,
            rng=rng,
            rng_banks=rng_banks,
            rng_reset=rng_reset,
            queue=queue,
            tolerance_s=tolerance,
        )
        _build(case, directory, _key_values(settings or []), options)
    except ToolchainError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(error.exit_code) from None


def main() -> None:
    """Entry point of the `toolchain` command; SIGINT ends it with 130 and SIGTERM with 143."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _end)
    app()


def _end(number: int, _frame: FrameType | None) -> None:
    typer.echo(f"error: ended by {signal.Signals(number).name}; the deployment is not complete", err=True)
    raise SystemExit(128 + number)


def _build(case: Path, directory: Path, settings: dict[str, str], options: BuildOptions) -> None:
    from dataclasses import replace

    from toolchain.build import REPORT_NAME, build_date, build_deployment
    from toolchain.case_study import FILE_NAME, load_model

    model_file = case / FILE_NAME
    typer.echo(f"Reading {model_file}", err=True)
    model = load_model(case, settings)
    typer.echo(f"Quantising {model.name} and writing its images", err=True)
    options = replace(options, build_date=build_date(model_file))
    built = build_deployment(model, directory, options)
    typer.echo(built.report, nl=False)
    typer.echo(f"Wrote {built.deployment.path} and {directory / REPORT_NAME}", err=True)


def _interface(text: str) -> tuple[int, int]:
    try:
        return parse_interface(text)
    except ValueError as reason:
        message = f"--interface: {reason}"
        raise BuildError(message) from None


def _key_values(settings: list[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        key = key.strip()
        if not equals or not key:
            message = f"--set {setting}: expected KEY=VALUE, such as --set width=64"
            raise BuildError(message)
        if key in found:
            message = f"--set {key} is given twice"
            raise BuildError(message)
        found[key] = value
    return found
