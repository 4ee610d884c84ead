"""The command `board`."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from pcie_shim.board.misbehaviour import Misbehaviour
from services.commands import flags as options
from services.errors import SettingsError
from services.pipeline.board_processes import BoardProcesses, serve_one
from services.settings import load_settings
from services.sockets.serving import endpoint_from
from services.supervision.child import RESTARTS
from services.supervision.parent import end_with_parent, leave_private_directory
from terminal.command_line import CommandLine
from terminal.ending import PARENT_VARIABLE
from terminal.output import say
from terminal.signals import check_signals, stopped_by

app = CommandLine(
    help="Emulate boards of the mini-cluster. They start blank; pcie-app or the loader programs them.\n\n"
    "`board --listen unix:/tmp/b/board0.sock` is one board; `board --boards 4 --directory /tmp/b` is four, "
    "each a process of its own."
)


@app.command(help=app.info.help)
def board(
    listen: options.Listen = None,
    index: Annotated[int, typer.Option(min=0, help="The board's number, for its messages.")] = 0,
    boards: Annotated[int | None, typer.Option(min=1, max=64, help="Start this many boards.")] = None,
    directory: Annotated[
        Path | None, typer.Option(help="Where their sockets go: board0.sock, board1.sock, ...")
    ] = None,
    restarts: Annotated[
        int, typer.Option(min=0, help="Restarts of boards within 60 s before it gives up.")
    ] = RESTARTS,
    misbehave: Annotated[
        str, typer.Option(help="For tests: one of the misbehaviours listed in docs/reference/boards.md.")
    ] = "",
) -> int:
    """Emulate boards of the mini-cluster."""
    end_with_parent()
    run_directory = load_settings().run_directory
    if (listen is None) == (boards is None):
        raise SettingsError(
            "give either --listen ENDPOINT for one board, or --boards N --directory DIR for several"
        )
    if boards is not None:
        if misbehave:
            raise SettingsError("--misbehave belongs to a single board: start it with --listen ENDPOINT")
        if directory is None:
            raise SettingsError("--boards needs --directory DIR, a folder for the boards' sockets")
        if not directory.is_dir():
            raise SettingsError(f"--directory {directory} is not a folder; name one for the boards' sockets")
        BoardProcesses(directory, boards, restarts, run_directory).run()
    from machines.kernel import warm_up

    warm_up()
    check_signals()
    endpoint = endpoint_from(listen or "", "--listen")

    def on_ready() -> None:
        if PARENT_VARIABLE not in os.environ:  # a master watches its boards itself
            say(f"board {index} listens at {endpoint}")

    fault = Misbehaviour.parse(misbehave) if misbehave else None
    ended_by = serve_one(endpoint, index, fault, run_directory, on_ready=on_ready)
    if ended_by:
        raise stopped_by(ended_by)
    return 0


def main() -> None:
    """Run the command and exit at once: unloading the compiled kernels in order takes half a second."""
    try:
        app()
    except SystemExit as end:
        leave_private_directory()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(end.code if isinstance(end.code, int) else int(end.code is not None))
