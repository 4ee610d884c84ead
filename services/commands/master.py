"""The command `master`, which runs the stack."""

from pathlib import Path
from typing import Annotated

import orjson
import typer

from services.commands import flags as options
from services.errors import SettingsError
from services.master.run import Master
from services.settings import Settings, endpoint_in
from services.sockets.reporting import check_metrics
from services.sockets.serving import board_endpoints, deployment_for
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
@options.with_settings(
    *("deployment", "uri", "ca", "boards", "queue", "stop", "ros_version", "message_bytes", "topic_bytes"),
    *("connect_timeout", "first_data_timeout", "peer_timeout", "board_timeout", "stop_timeout", "key_file"),
    *(
        "link_rate",
        "read_results",
        "use_sim_time",
        "fused",
        "run_directory",
        "metrics",
        "log_level",
        "log_format",
    ),
)
def master(
    settings: Settings,
    once: Annotated[bool, typer.Option("--once", help="Compute the first complete frame and exit.")] = False,
    loop: Annotated[bool, typer.Option("--loop", help="Run until Ctrl-C, or --count.")] = False,
    count: options.Count = None,
    start_each_message: Annotated[
        bool,
        typer.Option(
            "--start-each-message",
            help="Start subscriber and publisher for every message, as the thesis probably did, to see what that costs.",
        ),
    ] = False,
    connect: Annotated[
        Path | None,
        typer.Option(
            help="Folder with subscriber.sock, publisher.sock and pcie-app.sock of running services.",
            metavar="DIR",
        ),
    ] = None,
    insecure: options.Insecure = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per result.")] = False,
    plot: Annotated[bool, typer.Option("--plot", help="Draw the newest posterior in the terminal.")] = False,
    dashboard: Annotated[
        bool, typer.Option("--dashboard", help="Start the page in the browser too (see `dashboard`).")
    ] = False,
    page_port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the page; 0 selects a free one.")
    ] = 8080,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="Print the resulting settings and exit.")
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Check the settings, the deployment and its images, and exit.")
    ] = False,
) -> int:
    """Move readings to the boards and posteriors back to the robot."""
    if connect is not None:
        if not connect.is_dir():
            raise SettingsError(
                f"--connect {connect} is not a folder; name the one with the sockets of the running services"
            )
        # a flag, so it replaces the variables of the three endpoints
        services = {"subscriber": "subscriber", "publisher": "publisher", "pcie_app": "pcie-app"}
        settings = settings.model_copy(
            update={setting: str(endpoint_in(connect, name)) for setting, name in services.items()}
        )
    # both before the checks of a run: they are for settings that do not work yet
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
    if once and start_each_message:
        raise SettingsError("--start-each-message requires --loop; --once starts each service once anyway")
    if once and dashboard:
        raise SettingsError("--dashboard requires --loop; --once ends with the first frame")
    check_metrics(settings.metrics, insecure=insecure)
    # loaded before processes start, so that a damaged folder is reported at once
    loaded = deployment_for(settings)

    async def run() -> int:
        master = Master(
            settings,
            loaded,
            once=once,
            count=count,
            json=json,
            plot=plot,
            page_port=page_port if dashboard else None,
            start_each_message=start_each_message,
        )
        return await master.run()

    return run_async(run())


def _check(settings: Settings) -> None:
    """Check that a run can start with these settings, and say so, or raise the error that would end the run."""
    loaded = deployment_for(settings, images=True)
    # a run would notice only after its processes have started
    if settings.boards:
        board_endpoints(settings, loaded)
    count = len(loaded.boards)
    say(
        f"{settings.deployment} is deployment {loaded.hash[:12]} for {count} {'board' if count == 1 else 'boards'}"
    )
