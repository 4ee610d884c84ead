"""The command `subscriber`."""

from typing import Annotated

import typer

from services.commands import flags as options
from services.errors import SettingsError
from services.pipeline.subscriber import ROLE, Subscriber
from services.pipes.subscriber import print_addresses, print_variables
from services.settings import Settings
from services.sockets.serving import deployment_for, listening
from terminal.command_line import CommandLine
from terminal.signals import run_async

app = CommandLine(
    help="Extract variables from a ROS topic over rosbridge.\n\n"
    "Alone, it prints them, one JSON object per line:\n\n"
    "`subscriber --uri ws://robot:9090 --topic /boat/sensors --type boat_msgs/Sensors --variables D1,B1`\n\n"
    "With `--deployment DIR` it prints addresses in the form for `pcie-app`; "
    "with `--listen ENDPOINT` too, it serves a master."
)


@app.command(help=app.info.help)
@options.with_settings(
    *("deployment", "uri", "ca", "queue", "ros_version", "message_bytes", "topic_bytes"),
    *("connect_timeout", "first_data_timeout", "use_sim_time", "metrics", "log_level", "log_format"),
)
def subscriber(
    settings: Settings,
    topic: Annotated[
        str | None, typer.Option(help="Without a deployment: topic to subscribe to.", metavar="TOPIC")
    ] = None,
    type_: Annotated[
        str | None, typer.Option("--type", help="Its message type.", metavar="PACKAGE/NAME")
    ] = None,
    variables: Annotated[
        str, typer.Option(help="Names or paths; without it, print whole messages.", metavar="NAME,...")
    ] = "",
    count: options.Count = None,
    listen: options.Listen = None,
    insecure: options.Insecure = False,
) -> int:
    """Extract variables from a ROS topic over rosbridge."""
    flags = {"--topic": topic, "--type": type_, "--variables": variables}
    options.refuse_with_deployment(settings, flags)
    if listen is not None:
        loaded = deployment_for(settings)
        link = listening(listen, ROLE, settings, loaded, insecure=insecure)
        return run_async(Subscriber(settings, loaded, link).run())
    if settings.use_sim_time:
        raise SettingsError("--use-sim-time needs a master: alone, a subscriber does not follow /clock")
    if settings.deployment is not None:
        loaded = deployment_for(settings)
        return run_async(print_addresses(settings, loaded, count))
    if settings.uri is None or topic is None or type_ is None:
        raise SettingsError(
            "give --uri, --topic and --type, or --deployment DIR (subscriber --help shows examples)"
        )
    names = [name.strip() for name in variables.split(",") if name.strip()]
    source = options.source_of(settings.uri, topic, type_)
    return run_async(print_variables(settings, source, names, count))
