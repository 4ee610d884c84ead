"""The command `loader`, which programs a board through its programming port (thesis 3.4, SofLoader)."""

from pathlib import Path
from typing import Annotated

import typer

from pcie_shim.host.loader import program
from services.commands import flags as options
from services.settings import load_settings
from services.sockets.serving import board_endpoint
from services.supervision.parent import end_with_parent
from terminal.command_line import CommandLine
from terminal.output import say, say_if_slow

app = CommandLine(
    help="Program a board with an image written by `toolchain build`.\n\n"
    "`loader build/boat/boards/board0.bm unix:/tmp/b/board0.sock`\n\n"
    "It fails while pcie-app holds the board."
)


@app.command(help=app.info.help)
def loader(
    image: Annotated[Path, typer.Argument(help="Programming file (boards/*.bm of a deployment).")],
    endpoint: Annotated[str, typer.Argument(help="The board's endpoint.", metavar="ENDPOINT")],
    peer_timeout: options.PeerTimeout = None,
    key_file: options.KeyFile = None,
    board_ca: options.BoardCa = None,
) -> int:
    """Program a board with an image written by `toolchain build`."""
    end_with_parent()
    settings = load_settings(peer_timeout=peer_timeout, key_file=key_file, board_ca=board_ca)
    board = board_endpoint(endpoint, "ENDPOINT", settings)
    with say_if_slow(f"waiting for the board at {board}"):
        image_hash = program(board, image, timeout=settings.peer_timeout)
    say(f"{endpoint} holds image {image_hash[:16]} now")
    return 0
