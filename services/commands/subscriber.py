"""The command `subscriber`."""

from typing import Annotated, Final

import typer
from pydantic import ValidationError

from services.commands import flags as options
from services.errors import SettingsError
from services.pipeline.subscriber import ROLE, Subscriber
from services.pipes.subscriber import print_addresses, print_variables
from services.settings import load_settings
from services.sockets.reporting import check_metrics
from services.sockets.serving import deployment_for, listening, own_endpoint
from services.supervision.parent import end_with_parent
from terminal.command_line import CommandLine
from terminal.signals import run_async
from toolchain.deployment import Source

_WITHOUT_DEPLOYMENT: Final = "Without a deployment"

app = CommandLine(
    help="Extract variables from a ROS topic over rosbridge.\n\n"
    "Alone, it prints them, one JSON object per line:\n\n"
    "`subscriber --uri ws://robot:9090 --topic /boat/sensors --type boat_msgs/Sensors --variables D1,B1`\n\n"
    "With `--deployment DIR` it prints addresses in the form for `pcie-app`; "
    "with `--listen ENDPOINT` too, it serves a master."
)


@app.command(help=app.info.help)
def subscriber(
    deployment: options.Deployment = None,
    uri: options.Uri = None,
    ca: options.Ca = None,
    topic: Annotated[
        str | None,
        typer.Option(help="Topic to subscribe to.", metavar="TOPIC", rich_help_panel=_WITHOUT_DEPLOYMENT),
    ] = None,
    type_: Annotated[
        str | None,
        typer.Option(
            "--type", help="Its message type.", metavar="PACKAGE/NAME", rich_help_panel=_WITHOUT_DEPLOYMENT
        ),
    ] = None,
    variables: Annotated[
        str,
        typer.Option(
            help="Names or paths; without it, print whole messages.",
            metavar="NAME,...",
            rich_help_panel=_WITHOUT_DEPLOYMENT,
        ),
    ] = "",
    count: options.Count = None,
    listen: options.Listen = None,
    queue: options.Queue = None,
    ros_version: options.RosVersion = None,
    message_bytes: options.MessageBytes = None,
    topic_bytes: options.TopicBytes = None,
    connect_timeout: options.ConnectTimeout = None,
    first_data_timeout: options.FirstDataTimeout = None,
    insecure: options.Insecure = False,
    metrics: options.Metrics = None,
    log_level: options.LogLevel = None,
    log_format: options.LogFormat = None,
) -> int:
    """Extract variables from a ROS topic over rosbridge."""
    end_with_parent()
    settings = load_settings(
        deployment=deployment,
        uri=uri,
        ca=ca,
        queue=queue,
        ros_version=ros_version,
        message_bytes=message_bytes,
        topic_bytes=topic_bytes,
        connect_timeout=connect_timeout,
        first_data_timeout=first_data_timeout,
        metrics=metrics,
        log_level=log_level,
        log_format=log_format,
    )
    if settings.deployment is not None and (value := topic or type_ or variables):
        flag = "--topic" if topic else "--type" if type_ else "--variables"
        raise SettingsError(
            f"{flag} {value} cannot be combined with a deployment; {settings.deployment} has its own: omit one of them"
        )
    if listen is not None:
        check_metrics(settings.metrics, insecure=insecure)
        loaded = deployment_for(settings)
        link = listening(own_endpoint(listen, insecure=insecure), ROLE, loaded)
        return run_async(Subscriber(settings, loaded, link).run())
    if settings.deployment is not None:
        loaded = deployment_for(settings)
        return run_async(print_addresses(settings, loaded, count))
    if settings.uri is None or topic is None or type_ is None:
        raise SettingsError(
            "give --uri, --topic and --type, or --deployment DIR (subscriber --help shows examples)"
        )
    names = [name.strip() for name in variables.split(",") if name.strip()]
    try:
        source = Source(uri=settings.uri, topic=topic, type=type_)
    except ValidationError as error:
        first = error.errors()[0]
        raise SettingsError(
            f"--{first['loc'][0]}: {str(first['msg']).removeprefix('Value error, ')}"
        ) from error
    return run_async(print_variables(settings, source, names, count))
