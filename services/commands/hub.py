"""The hub as a command: the embedded rosbridge server, where no robot runs one."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine, Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from bridge.codecs.json_codec import MAX_SIZE
from bridge.hub.access import AccessPolicy, is_loopback, read_tokens, tls_context
from bridge.hub.graph import Graph
from bridge.hub.limits import HubLimits
from bridge.hub.server import serve_hub
from services.errors import SettingsError
from services.settings import load_settings
from services.sockets.status import HubStatus, ProcessStatus, status_served
from services.supervision.parent import end_with_parent
from terminal.command_line import CommandLine
from terminal.logs import log_libraries
from terminal.one_line import shown
from terminal.output import say
from terminal.signals import run_async

app = CommandLine(
    help="Serve rosbridge without ROS: topics, services, actions, parameters and rosapi.\n\n`hub --port 9090`\n\n"
    "On another address than this machine's own it wants TLS and tokens:\n\n"
    "`hub --host 0.0.0.0 --tls-cert cert.pem --tls-key key.pem --token-file tokens.txt`"
)


@app.command(help=app.info.help)
def hub(
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes any free one.")] = 9090,
    ros_version: Annotated[
        Literal["1", "2"], typer.Option(help="Which ROS it plays: how types are written, what rosapi says.")
    ] = "1",
    tls_cert: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Its certificate (PEM); then it serves wss://.")
    ] = None,
    tls_key: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The certificate's private key (PEM).")
    ] = None,
    token_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Tokens that clients must show, one a line.")
    ] = None,
    origin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ORIGIN",
            help="Web page that may connect, such as https://robot.example, besides this machine's; repeatable.",
        ),
    ] = None,
    message_bytes: Annotated[
        int,
        typer.Option(
            min=1 << 10, max=1 << 28, help="Largest message, both ways; a larger one closes its sender."
        ),
    ] = MAX_SIZE,
    announce: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Announce it on the network under this name (see `discover`)."),
    ] = None,
    insecure: Annotated[
        bool,
        typer.Option("--insecure", help="Say that another address without TLS and tokens is meant."),
    ] = False,
) -> int:
    """Serve rosbridge without ROS."""
    end_with_parent()
    access = _access_policy(tls_cert, tls_key, token_file, origin or [])
    if not is_loopback(host) and not insecure and (access.tls is None or not access.tokens):
        missing = " and ".join(
            flags
            for flags, there in (("--tls-cert and --tls-key", access.tls), ("--token-file", access.tokens))
            if not there
        )
        msg = f"--host {shown(host)} lets everybody on that network publish to your robot; give {missing}, or --insecure if that is meant"
        raise SettingsError(msg)

    # a refusal gets no word to its client (as at the reference server): the log is where it is seen
    log_libraries(logging.WARNING, "hub: %(message)s")

    listening: list[str] = []
    graphs: list[Graph] = []

    def ready(at: int) -> None:
        address = f"[{host}]" if ":" in host else host
        listening.append(f"listening on {'wss' if access.tls else 'ws'}://{address}:{at}")
        say(f"hub: {listening[0]}")

    def tell() -> ProcessStatus:
        graph = graphs[0] if graphs else None
        counts = (
            None if graph is None else HubStatus(len(graph.clients), len(graph.topics), len(graph.services))
        )
        return ProcessStatus(
            ready=bool(listening), why=listening[0] if listening else "not listening yet", hub=counts
        )

    ros: Literal[1, 2] = 2 if ros_version == "2" else 1

    async def serve() -> int:
        listens: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        def on_ready(at: int) -> None:
            ready(at)
            listens.set_result(at)

        run_directory = load_settings().run_directory  # before anything is begun that would have to be ended
        work = [
            serve_hub(
                host,
                port,
                access=access,
                limits=HubLimits(message_bytes=message_bytes, client_bytes=4 * max(message_bytes, MAX_SIZE)),
                ros_version=ros,
                on_ready=on_ready,
                on_graph=graphs.append,
                stop=asyncio.Event(),
            )
        ]
        if announce is not None:
            work.append(_announce(announce, host, listens, ros, access))
        async with status_served(run_directory, "hub", tell):
            await _all_of(work)
        return 0

    return run_async(serve())


async def _announce(
    name: str, host: str, listens: asyncio.Future[int], ros_version: Literal[1, 2], access: AccessPolicy
) -> None:
    """Announce the hub once it listens, until this is cancelled."""
    from bridge.discovery import announced

    port = await listens
    async with announced(
        name, host, port, ros_version=ros_version, tls=access.tls is not None, token=bool(access.tokens)
    ):
        say(f"hub: announced as robot:{name}")
        await asyncio.Event().wait()


async def _all_of(work: Sequence[Coroutine[None, None, None]]) -> None:
    """Do all of it until one ends, which ends the others; its error is the one."""
    tasks = [asyncio.ensure_future(each) for each in work]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _access_policy(
    certificate: Path | None, key: Path | None, tokens: Path | None, origins: list[str]
) -> AccessPolicy:
    """Who may come in, of the flags that say so."""
    if (certificate is None) != (key is None):
        msg = "TLS needs both the certificate and its key: give --tls-cert FILE and --tls-key FILE"
        raise SettingsError(msg)
    for page in origins:
        if not page.startswith(("http://", "https://")) or page.count("/") != 2:
            msg = f"--origin {shown(page)} is no web page's origin: expected for example https://robot.example:8000"
            raise SettingsError(msg)
    return AccessPolicy(
        tls=tls_context(certificate, key) if certificate is not None and key is not None else None,
        tokens=read_tokens(tokens) if tokens is not None else (),
        origins=tuple(origins),
    )
