"""The hub as a command: the embedded rosbridge server, where no robot runs one."""

from __future__ import annotations

import asyncio
import logging
import sys
from typing import Annotated

import typer

from bridge.hub.server import serve_hub
from services.command_line import ends_well, make_app, run_async
from services.errors import SettingsError
from services.logs import say
from services.settings import load_settings
from services.status_socket import ProcessStatus, status_served
from services.supervision import end_with_parent

app = make_app(
    "Serve rosbridge without ROS: topics, services between clients, and rosapi.\n\n`hub --port 9090`\n\n"
    "It knows no passwords: on another address than this machine's own, whoever reaches it may publish."
)


@app.command(help=app.info.help)
@ends_well
def hub(
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes any free one.")] = 9090,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Say that another address than loopback is meant.")
    ] = False,
) -> int:
    """Serve rosbridge without ROS."""
    end_with_parent()
    if host not in {"127.0.0.1", "::1", "localhost"} and not insecure:
        msg = f"--host {host} lets everybody on that network publish to your robot, and the hub knows no passwords; add --insecure if that is meant"
        raise SettingsError(msg)

    # a refusal gets no word to its client (as at the reference server): the log is where it is seen
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="hub: %(message)s")

    listening: list[str] = []

    def ready(at: int) -> None:
        shown = f"[{host}]" if ":" in host else host
        listening.append(f"listening on ws://{shown}:{at}")
        say(f"hub: {listening[0]}")

    def tell() -> ProcessStatus:
        return ProcessStatus(ready=bool(listening), why=listening[0] if listening else "not listening yet")

    async def serve() -> int:
        async with status_served(load_settings().run_directory, "hub", tell):
            await serve_hub(host, port, on_ready=ready, stop=asyncio.Event())
        return 0

    return run_async(serve())


def main() -> None:
    """Entry point of the command `hub`."""
    app()
