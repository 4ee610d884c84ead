"""The command `publisher`."""

from services.commands import flags as options
from services.pipeline.publisher import Publisher
from services.pipeline.result_topics import ROLE
from services.pipes.lines import require_pipe
from services.pipes.publisher import publish_lines
from services.settings import Settings
from services.sockets.serving import deployment_for, listening
from terminal.command_line import CommandLine
from terminal.signals import run_async

app = CommandLine(
    help="Publish posteriors over rosbridge.\n\n"
    "Alone, it publishes its standard input, one JSON value per line (output of `pcie-app`, or arrays of probabilities):\n\n"
    "`subscriber -d build/boat | pcie-app -d build/boat --boards ... | publisher -d build/boat --uri ws://robot:9090`\n\n"
    "With `--listen ENDPOINT` it serves a master."
)


@app.command(help=app.info.help)
@options.with_settings(
    *("deployment", "uri", "ca", "ros_version", "connect_timeout", "seen_timeout"),
    *("use_sim_time", "metrics", "log_level", "log_format"),
)
def publisher(settings: Settings, listen: options.Listen = None, insecure: options.Insecure = False) -> int:
    """Publish posteriors over rosbridge."""
    loaded = deployment_for(settings)
    # under a master the results come over the socket, alone over standard input
    if listen is not None:
        link = listening(listen, ROLE, settings, loaded, insecure=insecure)
        return run_async(Publisher(settings, loaded, link).run())
    require_pipe(ROLE, "results")
    return run_async(publish_lines(settings, loaded))
