"""The `toolchain build` command, which builds a deployment from a model or a network file."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from toolchain.commands.flags import BuildFlags, ModelPath
from toolchain.deployment import Queue

if TYPE_CHECKING:
    from toolchain.building.options import SourcesFile


def build(
    model: ModelPath,
    directory: Annotated[
        Path, typer.Option("--output-dir", "-o", help="Folder of the deployment.", metavar="DIR")
    ],
    flags: BuildFlags,
    uri: Annotated[
        str, typer.Option(help="rosbridge server of the readings.", metavar="ws://HOST:PORT|robot:NAME")
    ] = "",
    topic: Annotated[str, typer.Option(help="Topic of the readings.", metavar="TOPIC")] = "",
    message_type: Annotated[
        str, typer.Option("--type", help="Type of the topic.", metavar="PACKAGE/NAME")
    ] = "",
    sources: Annotated[
        Path | None,
        typer.Option(
            help="Instead of topic and type: a TOML file with several topics on one or more servers.",
            metavar="FILE",
        ),
    ] = None,
    output: Annotated[str, typer.Option(help="Topic of the posteriors.", metavar="TOPIC")] = "/BMresults",
    prior_path: Annotated[
        str | None, typer.Option(help="Path of a written prior in the message.", metavar="PATH")
    ] = None,
    queue: Annotated[
        Queue, typer.Option(help="If readings arrive too fast: keep only the latest, or all in order.")
    ] = Queue.LATEST,
    tolerance: Annotated[
        float,
        typer.Option(
            help="Seconds within which readings from several topics belong together.", metavar="SECONDS"
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
    from toolchain.building.machine import plan_machine
    from toolchain.building.report import REPORT_NAME
    from toolchain.commands.request import build_options, fit_to_device, model_file, read_model, read_named

    options = replace(
        build_options(
            flags,
            uri=uri,
            topic=topic,
            message_type=message_type,
            sources=_sources(sources, uri=uri, topic=topic, message_type=message_type, prior_path=prior_path),
        ),
        output=output,
        prior_path=prior_path,
        queue=queue,
        tolerance_s=tolerance,
    )
    options = read_named(options, flags)
    typer.echo(f"Reading {model_file(model)}", err=True)
    read = read_model(model, flags, flags.bits)
    dated = replace(options, build_date=build_date(model_file(model)))
    plan, why = fit_to_device(plan_machine(read, dated), flags.device)
    typer.echo(f"Quantising {read.name} and writing its images", err=True)
    built = build_deployment(plan, directory, remark=why)
    typer.echo(built.report, nl=False)
    typer.echo(f"Wrote {built.deployment.path} and {directory / REPORT_NAME}", err=True)


def _sources(
    path: Path | None, *, uri: str, topic: str, message_type: str, prior_path: str | None
) -> "SourcesFile | None":
    """Return the file that assigns variables to topics, if there is one; otherwise the flags must name a topic."""
    from toolchain.building.options import read_sources
    from toolchain.errors import BuildError

    target = {"--uri": uri, "--topic": topic, "--type": message_type}
    if path is None:
        missing = [flag for flag, value in target.items() if not value]
        if missing:
            raise BuildError(
                f"{missing[0]} is missing: give the source of the readings with --uri, --topic and --type, or with "
                "--sources FILE for several topics"
            )
        return None
    for flag, value in (*target.items(), ("--prior-path", prior_path)):
        if value and flag != "--uri":
            raise BuildError(f"{flag} {value}: the file of --sources sets that for each topic; omit the flag")
    return read_sources(path, uri or None)
