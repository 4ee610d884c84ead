"""The command `master`, which runs the stack."""

from pathlib import Path
from typing import Annotated

import orjson
import typer

from services.commands import flags as options
from services.errors import SettingsError
from services.master.run import run_master
from services.settings import Settings, endpoint_in, load_settings
from services.sockets.reporting import check_metrics
from services.sockets.serving import board_endpoints, deployment_for
from services.supervision.parent import end_with_parent
from terminal.command_line import CommandLine
from terminal.errors import ExitCode
from terminal.output import say
from terminal.signals import run_async

app = CommandLine(
    help="Move readings to the boards and posteriors back to the robot.\n\n"
    "`master --once -d build/boat --uri ws://robot:9090` computes one frame; `master --loop` runs until Ctrl-C.\n\n"
    "It starts and stops subscriber, publisher, pcie-app and emulated boards that are not running yet. "
    "Exit codes: 0 done, 2 usage or deployment, 3 rosbridge, 4 a variable, 5 a board, 6 a process, 130, 143."
)


@app.command(help=app.info.help)
def master(
    once: Annotated[bool, typer.Option("--once", help="Compute the first complete frame and exit.")] = False,
    loop: Annotated[bool, typer.Option("--loop", help="Run until Ctrl-C, or --count.")] = False,
    count: options.Count = None,
    deployment: options.Deployment = None,
    uri: options.Uri = None,
    ca: options.Ca = None,
    connect: Annotated[
        Path | None,
        typer.Option(
            help="Folder with subscriber.sock, publisher.sock and pcie-app.sock of running services.",
            metavar="DIR",
        ),
    ] = None,
    boards: options.Boards = None,
    queue: options.Queue = None,
    stop: options.Stop = None,
    ros_version: options.RosVersion = None,
    message_bytes: options.MessageBytes = None,
    topic_bytes: options.TopicBytes = None,
    connect_timeout: options.ConnectTimeout = None,
    first_data_timeout: options.FirstDataTimeout = None,
    peer_timeout: options.PeerTimeout = None,
    board_timeout: options.BoardTimeout = None,
    stop_timeout: options.StopTimeout = None,
    key_file: options.KeyFile = None,
    fused: Annotated[
        bool | None,
        options.setting(
            "fused",
            "Run subscriber, publisher and pcie-app inside this process: fewer hops, the same results.",
            "--fused",
        ),
    ] = None,
    metrics: options.Metrics = None,
    insecure: options.Insecure = False,
    log_level: options.LogLevel = None,
    log_format: options.LogFormat = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per result.")] = False,
    plot: Annotated[bool, typer.Option("--plot", help="Draw the newest posterior in the terminal.")] = False,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="Print the resulting settings and exit.")
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Check the settings, the deployment and its images, and exit.")
    ] = False,
) -> int:
    """Move readings to the boards and posteriors back to the robot."""
    end_with_parent()
    connected = {}
    if connect is not None:
        if not connect.is_dir():
            raise SettingsError(
                f"--connect {connect} is not a folder; name the one with the sockets of the running services"
            )
        for name in ("subscriber", "publisher", "pcie-app"):
            connected[name.replace("-", "_")] = str(endpoint_in(connect, name))
    settings = load_settings(
        deployment=deployment,
        uri=uri,
        ca=ca,
        boards=boards,
        queue=queue,
        stop=stop,
        ros_version=ros_version,
        message_bytes=message_bytes,
        topic_bytes=topic_bytes,
        connect_timeout=connect_timeout,
        first_data_timeout=first_data_timeout,
        peer_timeout=peer_timeout,
        board_timeout=board_timeout,
        stop_timeout=stop_timeout,
        key_file=key_file,
        fused=fused,
        metrics=metrics,
        log_level=log_level,
        log_format=log_format,
        **connected,
    )
    if print_config:
        print(orjson.dumps(settings.model_dump(mode="json"), option=orjson.OPT_INDENT_2).decode())
        return ExitCode.DONE
    if check:
        _check(settings)
        return ExitCode.DONE
    if json and plot:
        raise SettingsError("--json and --plot both use standard output: give one of them")
    if once == loop:
        raise SettingsError("choose one of --once and --loop")
    if once and count is not None:
        raise SettingsError("--count requires --loop; --once computes one frame")
    check_metrics(settings.metrics, insecure=insecure)
    loaded = deployment_for(settings)
    return run_async(run_master(settings, loaded, once=once, count=count, json=json, plot=plot))


def _check(settings: Settings) -> None:
    """Print that a run can start with these settings, or raise the error that would end it."""
    loaded = deployment_for(settings, images=True)
    if settings.boards:
        board_endpoints(settings, loaded)
    count = len(loaded.boards)
    say(
        f"{settings.deployment} is deployment {loaded.hash[:12]} for {count} {'board' if count == 1 else 'boards'}"
    )
