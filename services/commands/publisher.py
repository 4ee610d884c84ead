"""The command `publisher`."""

from typing import Annotated

from services.commands import flags as options
from services.pipeline.publisher import Publisher
from services.pipeline.result_topics import ROLE
from services.pipes.lines import require_pipe
from services.pipes.publisher import publish_lines
from services.settings import load_settings
from services.sockets.reporting import check_metrics
from services.sockets.serving import deployment_for, listening, own_endpoint
from services.supervision.parent import end_with_parent
from terminal.command_line import CommandLine
from terminal.signals import run_async

app = CommandLine(
    help="Publish posteriors over rosbridge.\n\n"
    "Alone, it publishes its standard input, one JSON value per line (output of `pcie-app`, or arrays of probabilities):\n\n"
    "`subscriber -d build/boat | pcie-app -d build/boat --boards ... | publisher -d build/boat --uri ws://robot:9090`\n\n"
    "With `--listen ENDPOINT` it serves a master."
)


@app.command(help=app.info.help)
def publisher(
    deployment: options.Deployment = None,
    uri: options.Uri = None,
    ca: options.Ca = None,
    listen: options.Listen = None,
    ros_version: options.RosVersion = None,
    connect_timeout: options.ConnectTimeout = None,
    seen_timeout: Annotated[
        float | None, options.seconds("seen_timeout", "Until a result must be seen on the wire.")
    ] = None,
    insecure: options.Insecure = False,
    metrics: options.Metrics = None,
    log_level: options.LogLevel = None,
    log_format: options.LogFormat = None,
) -> int:
    """Publish posteriors over rosbridge."""
    end_with_parent()
    settings = load_settings(
        deployment=deployment,
        uri=uri,
        ca=ca,
        ros_version=ros_version,
        connect_timeout=connect_timeout,
        seen_timeout=seen_timeout,
        metrics=metrics,
        log_level=log_level,
        log_format=log_format,
    )
    loaded = deployment_for(settings)
    if listen is not None:
        check_metrics(settings.metrics, insecure=insecure)
        link = listening(own_endpoint(listen, insecure=insecure), ROLE, loaded)
        return run_async(Publisher(settings, loaded, link).run())
    require_pipe(ROLE, "results")
    return run_async(publish_lines(settings, loaded))
