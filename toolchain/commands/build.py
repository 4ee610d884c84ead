"""The `toolchain build` command, which builds a deployment from a model or a network file."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from toolchain.building.options import BuildOptions
from toolchain.commands.flags import MESSAGES, BuildFlags, ModelPath
from toolchain.deployment import Queue


def build(
    model: ModelPath,
    directory: Annotated[
        Path, typer.Option("--output-dir", "-o", help="Folder of the deployment.", metavar="DIR")
    ],
    flags: BuildFlags,
    uri: Annotated[
        str,
        typer.Option(
            help="rosbridge server of the readings.",
            metavar="ws://HOST:PORT|robot:NAME",
            rich_help_panel=MESSAGES,
        ),
    ] = "",
    topic: Annotated[
        str, typer.Option(help="Topic of the readings.", metavar="TOPIC", rich_help_panel=MESSAGES)
    ] = "",
    message_type: Annotated[
        str,
        typer.Option("--type", help="Type of the topic.", metavar="PACKAGE/NAME", rich_help_panel=MESSAGES),
    ] = "",
    sources: Annotated[
        Path | None,
        typer.Option(
            help="Instead of topic and type: a TOML file with several topics on one or more servers.",
            metavar="FILE",
            rich_help_panel=MESSAGES,
        ),
    ] = None,
    output: Annotated[
        str, typer.Option(help="Topic of the posteriors.", metavar="TOPIC", rich_help_panel=MESSAGES)
    ] = "/BMresults",
    prior_path: Annotated[
        str | None,
        typer.Option(
            help="Path of a written prior in the message.", metavar="PATH", rich_help_panel=MESSAGES
        ),
    ] = None,
    queue: Annotated[
        Queue,
        typer.Option(
            help="If readings arrive too fast: keep only the latest, or all in order.",
            rich_help_panel=MESSAGES,
        ),
    ] = Queue.LATEST,
    tolerance: Annotated[
        float,
        typer.Option(
            help="Seconds within which readings from several topics belong together.",
            metavar="SECONDS",
            rich_help_panel=MESSAGES,
        ),
    ] = 0.05,
) -> None:
    """Build a deployment: programming files, deployment.toml, a report, and a hardware project.

    `toolchain build casestudies/boat -o build/boat --partitions 4 --uri ws://localhost:9090
    --topic /boat/sensors --type boat_msgs/Sensors`

    Of a network:

    `toolchain build asia.bif --searched bronc --known smoke,dysp -o build/asia --uri ws://localhost:9090
    --topic /patient --type clinic_msgs/Patient`
    """
    from toolchain.building.build import build_date, build_deployment
    from toolchain.building.options import check_options
    from toolchain.building.report import REPORT_NAME
    from toolchain.commands.request import build_options, fit_to_device, model_file, read_model, read_named

    options = _with_sources(
        replace(
            build_options(flags, uri=uri, topic=topic, message_type=message_type),
            output=output,
            prior_path=prior_path,
            queue=queue,
            tolerance_s=tolerance,
        ),
        sources,
    )
    check_options(options)
    options = read_named(options, flags)
    typer.echo(f"Reading {model_file(model)}", err=True)
    read = read_model(model, flags, flags.bits)
    options, why = fit_to_device(options, read, flags.device)
    typer.echo(f"Quantising {read.name} and writing its images", err=True)
    dated = replace(options, build_date=build_date(model_file(model)))
    built = build_deployment(read, directory, dated, remark=why)
    typer.echo(built.report, nl=False)
    typer.echo(f"Wrote {built.deployment.path} and {directory / REPORT_NAME}", err=True)


def _with_sources(options: "BuildOptions", path: Path | None) -> "BuildOptions":
    """Return the options with the file that assigns variables to topics, if there is one."""
    from toolchain.building.sources_file import read_sources
    from toolchain.errors import BuildError

    target = {"--uri": options.uri, "--topic": options.topic, "--type": options.type}
    if path is None:
        missing = [flag for flag, value in target.items() if not value]
        if missing:
            raise BuildError(
                f"{missing[0]} is missing: give the source of the readings with --uri, --topic and --type, or with "
                "--sources FILE for several topics"
            )
        return options
    for flag, value in (*target.items(), ("--prior-path", options.prior_path)):
        if value and flag != "--uri":
            raise BuildError(f"{flag} {value}: the file of --sources sets that for each topic; omit the flag")
    return replace(options, sources=read_sources(path, options.uri or None))
