"""The command `loader`, which programs boards through their programming ports (thesis 3.4, SofLoader)."""

from pathlib import Path
from typing import Annotated

import typer

from pcie_shim.errors import PcieShimError
from pcie_shim.host.loader import program
from services.commands import flags as options
from services.errors import SettingsError
from services.settings import Settings
from services.sockets.serving import board_endpoint, board_endpoints, deployment_for
from terminal.command_line import CommandLine
from terminal.output import say, say_error, say_if_slow, warn

app = CommandLine(
    help="Program boards with images written by `toolchain build`.\n\n"
    "One board, or all boards of a deployment:\n\n"
    "`loader build/boat/boards/board0.bm unix:/tmp/b/board0.sock`\n\n"
    "`loader -d build/boat --boards unix:/tmp/b/`\n\n"
    "It fails while pcie-app holds a board."
)


@app.command(help=app.info.help)
@options.with_settings("deployment", "boards", "peer_timeout", "key_file", "log_format")
def loader(
    context: typer.Context,
    settings: Settings,
    image: Annotated[
        Path | None, typer.Argument(help="Programming file (boards/*.bm of a deployment).")
    ] = None,
    endpoint: Annotated[str | None, typer.Argument(help="The board's endpoint.", metavar="ENDPOINT")] = None,
) -> int:
    """Program one board, or all boards of a deployment."""
    if image is None:
        loaded = deployment_for(settings, images=True)
        images = [loaded.image_path(index) for index in range(len(loaded.boards))]
        endpoints = board_endpoints(settings, loaded)
        # the second image would replace the first, and pcie-app would refuse the board later
        if twice := next((each for at, each in enumerate(endpoints) if each in endpoints[:at]), None):
            raise SettingsError(f"{twice} is named twice, and a board holds one image: name each board once")
    elif context.params["deployment"] is not None or context.params["boards"] is not None:  # as flags
        raise SettingsError("-d and --boards program all boards of a deployment: omit them, or the image")
    elif endpoint is None:
        raise SettingsError(
            f"the endpoint of the board for {image} is missing, such as unix:/tmp/b/board0.sock"
        )
    else:
        images, endpoints = [image], [board_endpoint(endpoint, "ENDPOINT", settings)]
    failed: dict[int, PcieShimError] = {}
    for at, (path, board) in enumerate(zip(images, endpoints, strict=True)):
        try:
            with say_if_slow(f"waiting for the board at {board}"):
                image_hash = program(board, path, timeout=settings.peer_timeout)
            say(f"{board} holds image {image_hash[:16]} now")
        except PcieShimError as error:
            if len(images) == 1:
                raise
            # the other boards are programmed nevertheless, so that only this one is left for a second run
            failed[at] = error
            warn(f"{board} is not programmed: {error}")
    if failed:
        names = ", ".join(f"board {at}" for at in failed)
        say_error(
            f"{len(failed)} of {len(images)} boards {'is' if len(failed) == 1 else 'are'} not programmed: {names}"
        )
        return next(iter(failed.values())).exit_code
    return 0
