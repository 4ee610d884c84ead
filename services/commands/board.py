"""The command `board`."""

import os
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from pcie_shim.credentials import read_key
from pcie_shim.endpoint import Endpoint
from pcie_shim.link_rate import link_model
from services.boards.hardware import Engine, SimulatedHardware
from services.boards.processes import BoardProcesses, blank_board, serve_one
from services.child import RESTARTS
from services.commands import flags as options
from services.errors import SettingsError
from services.settings import Settings
from services.sockets.reporting import check_metrics
from services.sockets.serving import deployment_for, endpoint_from
from terminal.command_line import CommandLine
from terminal.logs import PARENT_VARIABLE, name_process
from terminal.output import say
from terminal.signals import check_signals

app = CommandLine(
    help="Emulate boards of the mini-cluster. They start blank; pcie-app or the loader programs them.\n\n"
    "`board --listen unix:/tmp/b/board0.sock` runs one board; `board --boards 4 --directory /tmp/b` runs four, "
    "each in its own process; `board -d build/boat --directory /tmp/b` as many as the deployment has."
)


@app.command(help=app.info.help)
@options.with_settings("deployment", "link_rate", "read_results", "key_file", "metrics", "log_format")
def board(
    settings: Settings,
    listen: options.Listen = None,
    engine: Annotated[
        Engine,
        typer.Option(
            help="The machine behind the registers: emulated, or simulated from the VHDL by ghdl or verilator; "
            "rtl is verilator if it is installed, otherwise ghdl."
        ),
    ] = Engine.EMULATED,
    hardware: Annotated[
        Path | None,
        typer.Option(
            help="Folder into which --engine compiles the hardware of each image, once.", metavar="DIR"
        ),
    ] = None,
    index: Annotated[int, typer.Option(min=0, help="Number of the board, for its messages.")] = 0,
    boards: Annotated[
        int | None,
        typer.Option(min=1, max=64, help="Number of boards to run.", show_default="that of the deployment"),
    ] = None,
    directory: Annotated[
        Path | None,
        typer.Option(
            help="Of several boards: folder of their sockets board0.sock, board1.sock, ...", metavar="DIR"
        ),
    ] = None,
    restarts: Annotated[
        int,
        typer.Option(
            min=0, help="Of several boards: maximum number of restarts within BM_RESTART_WINDOW (60 s)."
        ),
    ] = RESTARTS,
    insecure: options.Insecure = False,
) -> int:
    """Emulate boards of the mini-cluster."""
    check_metrics(settings.metrics, insecure=insecure)
    run_directory = settings.run_directory
    # `board -d DIR --directory DIR`: as many as the deployment has
    if boards is None and listen is None and directory is not None:
        boards = len(deployment_for(settings).boards)
    if (listen is None) == (boards is None):
        raise SettingsError(
            "give either --listen ENDPOINT for one board, or --directory DIR for several, with --boards N or a deployment"
        )
    if boards is not None:
        if directory is None:
            raise SettingsError("--boards needs --directory DIR, a folder for the boards' sockets")
        # the sockets in it are the only protection of the boards
        try:
            directory.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            raise SettingsError(
                f"--directory {directory} is not a folder and cannot be created ({error.strerror}); name one for the boards' sockets"
            ) from None
        if directory.stat().st_mode & 0o077:
            raise SettingsError(
                f"--directory {directory} can be entered by other users, who could replace the boards' sockets: run chmod 700 {directory}"
            )
        simulated = _simulated(engine, hardware, settings, range(boards))
        BoardProcesses(directory, boards, restarts, settings, simulated).run()
    name_process(f"board{index}")
    from machines import warm_up

    warm_up()
    check_signals()
    endpoint = _endpoint(listen or "", settings.key_file, insecure=insecure)
    simulated = _simulated(engine, hardware, settings, (index,))

    def on_ready() -> None:
        # a master monitors its boards itself
        if PARENT_VARIABLE not in os.environ:
            say(f"board {index} listens at {endpoint}")

    serve_one(
        endpoint,
        index,
        run_directory,
        board=blank_board(index, settings, simulated),
        link=link_model(settings.link_rate),
        metrics=settings.metrics,
        on_ready=on_ready,
    )


def _simulated(
    engine: Engine, folder: Path | None, settings: Settings, boards: Collection[int]
) -> SimulatedHardware | None:
    """Return the simulated hardware, compiled for the deployment if one is given; None for emulated boards."""
    if engine is Engine.EMULATED:
        return None
    if folder is None:
        raise SettingsError(
            f"--engine {engine} needs --hardware DIR, a folder into which the hardware is compiled"
        )
    from services.boards.deployed import images_of

    images = images_of(deployment_for(settings)) if settings.deployment is not None else []
    return SimulatedHardware(engine, folder, {at: image for at, image in enumerate(images) if at in boards})


def _endpoint(listen: str, key_file: Path | None, *, insecure: bool) -> Endpoint:
    """Return the endpoint of the board, with its key."""
    endpoint = endpoint_from(listen, "--listen")
    if endpoint.host and key_file is not None:
        return replace(endpoint, key=read_key(key_file))
    if not endpoint.is_loopback and not insecure:
        raise SettingsError(
            f"--listen {listen} lets everybody on that network use this board; give --key-file FILE with the key of its "
            "hosts, or --insecure if that is intended"
        )
    return endpoint
