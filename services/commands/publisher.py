"""The command `publisher`."""

from typing import Annotated

import typer

from posteriors.posterior import RESULTS_TOPIC, RESULTS_TYPE
from services.commands import flags as options
from services.errors import SettingsError
from services.pipeline.publisher import Publisher
from services.pipeline.result_topics import ROLE
from services.pipes.arrays import publish_arrays
from services.pipes.lines import require_pipe
from services.pipes.publisher import publish_lines
from services.settings import Settings
from services.sockets.serving import deployment_for, listening
from terminal.command_line import CommandLine
from terminal.signals import run_async

app = CommandLine(
    help="Publish posteriors over rosbridge.\n\n"
    "Alone, it publishes each line of its standard input as one message. A line is a JSON array of numbers, "
    "or numbers separated by spaces or by commas:\n\n"
    "`echo '[0.1, 0.9]' | publisher --uri ws://robot:9090 --topic /BMresults --type std_msgs/Float64MultiArray`\n\n"
    "With `--deployment DIR`, a line is a result of `pcie-app` or an array of probabilities:\n\n"
    "`subscriber -d build/boat | pcie-app -d build/boat --boards ... | publisher -d build/boat --uri ws://robot:9090`\n\n"
    "With `--listen ENDPOINT` it serves a master."
)


@app.command(help=app.info.help)
@options.with_settings(
    *("deployment", "uri", "ca", "ros_version", "connect_timeout", "seen_timeout"),
    *("use_sim_time", "metrics", "log_level", "log_format"),
)
def publisher(
    settings: Settings,
    topic: Annotated[
        str | None,
        typer.Option(help="Without a deployment: topic to publish on.", show_default=RESULTS_TOPIC),
    ] = None,
    type_: Annotated[
        str | None,
        typer.Option("--type", help="Its message type.", show_default=RESULTS_TYPE, metavar="PACKAGE/NAME"),
    ] = None,
    field: Annotated[
        str | None,
        typer.Option(
            help="Path of the array of numbers in a message.", show_default="the only one", metavar="PATH"
        ),
    ] = None,
    listen: options.Listen = None,
    insecure: options.Insecure = False,
) -> int:
    """Publish posteriors over rosbridge."""
    flags = {"--topic": topic, "--type": type_, "--field": field}
    options.refuse_with_deployment(settings, flags)
    if settings.deployment is None and listen is None:
        if settings.uri is None:
            raise SettingsError("give --uri, or --deployment DIR (publisher --help shows examples)")
        source = options.source_of(settings.uri, topic or RESULTS_TOPIC, type_ or RESULTS_TYPE)
        require_pipe(ROLE, "numbers")
        return run_async(publish_arrays(settings, source, field))
    loaded = deployment_for(settings)
    # under a master the results come over the socket, alone over standard input
    if listen is not None:
        link = listening(listen, ROLE, settings, loaded, insecure=insecure)
        return run_async(Publisher(settings, loaded, link).run())
    require_pipe(ROLE, "results")
    return run_async(publish_lines(settings, loaded))
