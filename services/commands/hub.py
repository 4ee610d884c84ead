"""The command `hub`: the embedded rosbridge server, with a status socket, metrics and a network announcement."""

import asyncio
import logging
from pathlib import Path
from typing import Annotated, Literal

import typer

from bridge.codecs.json_codec import MAX_SIZE
from bridge.hub.access import AccessPolicy, is_loopback, read_tokens, tls_context
from bridge.hub.graph import Graph
from bridge.hub.limits import HubLimits
from bridge.hub.server import serve_hub
from services.commands import flags as options
from services.errors import SettingsError
from services.settings import Settings
from services.sockets.reporting import check_metrics, serve_status
from services.sockets.status import HubStatus, ProcessStatus
from terminal.command_line import CommandLine
from terminal.logs import log_libraries
from terminal.one_line import shown
from terminal.output import say
from terminal.run_directory import status_directory
from terminal.signals import run_async, until_one_ends

app = CommandLine(
    help="Serve rosbridge without ROS: topics, services, actions, parameters and rosapi.\n\n`hub --port 9090`\n\n"
    "On a non-loopback address it requires TLS and tokens:\n\n"
    "`hub --host 0.0.0.0 --tls-cert cert.pem --tls-key key.pem --token-file tokens.txt`"
)


@app.command(help=app.info.help)
@options.with_settings("run_directory", "metrics", "log_format")
def hub(
    settings: Settings,
    host: Annotated[str, typer.Option(help="Address to listen on.", metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 selects a free one.")] = 9090,
    ros_version: Annotated[
        Literal["1", "2"], typer.Option(help="Emulated ROS version: spelling of types, answers of rosapi.")
    ] = "1",
    tls_cert: options.TlsCert = None,
    tls_key: options.TlsKey = None,
    token_file: options.TokenFile = None,
    origin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ORIGIN",
            help="Web page that may connect, such as https://robot.example, in addition to those of this machine ('null': pages opened from a file); repeat for more.",
        ),
    ] = None,
    message_bytes: Annotated[
        int,
        typer.Option(
            min=1 << 10,
            max=1 << 28,
            help="Maximum message size in bytes, both ways; a client that exceeds it is disconnected.",
        ),
    ] = MAX_SIZE,
    clients: Annotated[
        int, typer.Option(min=1, max=4096, help="Clients at the same time; a further one is refused.")
    ] = HubLimits().clients,
    announce: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Announce the hub on the network under this name (see `discover`)."
        ),
    ] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Permit a non-loopback address without TLS and tokens.")
    ] = False,
) -> int:
    """Serve rosbridge without ROS."""
    check_metrics(settings.metrics, insecure=insecure)
    # read before anything listens: a wrong file must not open a hub without its protection
    access = access_policy(
        host,
        (tls_cert, tls_key, token_file),
        origin or [],
        insecure=insecure,
        danger="lets everybody on that network publish to your robot",
    )

    return run_async(
        _serve(
            host,
            port,
            access=access,
            # room for several of the largest messages to a client that reads slowly
            limits=HubLimits(
                message_bytes=message_bytes, clients=clients, client_bytes=4 * max(message_bytes, MAX_SIZE)
            ),
            ros_version=2 if ros_version == "2" else 1,
            announce=announce,
            settings=settings,
        )
    )


def access_policy(
    host: str,
    files: tuple[Path | None, Path | None, Path | None],
    origins: list[str],
    *,
    insecure: bool,
    danger: str,
) -> AccessPolicy:
    """Return the access policy of the flags, or raise a SettingsError or a HubError.

    `files` are the files of the certificate, the key and the tokens. Unless `insecure` is set, a `host` beyond
    loopback needs all three files.
    """
    certificate, key, tokens = files
    if (certificate is None) != (key is None):
        raise SettingsError(
            "TLS needs both the certificate and its key: give --tls-cert FILE and --tls-key FILE"
        )
    # a path would never match, since browsers send only scheme, host and port
    for page in origins:
        if page != "null" and (not page.startswith(("http://", "https://")) or page.count("/") != 2):
            raise SettingsError(
                f"--origin {shown(page)} is not a web page's origin: expected for example https://robot.example:8000"
            )
    policy = AccessPolicy(
        tls=tls_context(certificate, key) if certificate is not None and key is not None else None,
        tokens=read_tokens(tokens) if tokens is not None else (),
        origins=tuple(origins),
    )
    if not is_loopback(host) and not insecure and (policy.tls is None or not policy.tokens):
        # TLS without tokens lets everybody in, and tokens without TLS can be read on the way
        missing = " and ".join(
            flags
            for flags, there in (("--tls-cert and --tls-key", policy.tls), ("--token-file", policy.tokens))
            if not there
        )
        raise SettingsError(
            f"--host {shown(host)} {danger}; give {missing}, or --insecure if that is intended"
        )
    return policy


async def _serve(
    host: str,
    port: int,
    *,
    access: AccessPolicy,
    limits: HubLimits,
    ros_version: Literal[1, 2],
    announce: str | None,
    settings: Settings,
) -> int:
    """Serve rosbridge until cancelled; `port` 0 selects a free port, `announce` is the hub's name on the network."""
    # a refused client gets no explanation, as from the reference server; the reason is only in the log
    log_libraries(logging.WARNING, "hub: %(message)s")
    # The port, once the hub listens; and the hub's graph, which exists from then on.
    listening = asyncio.get_running_loop().create_future()
    graphs: list[Graph] = []
    scheme, address = "wss" if access.tls else "ws", f"[{host}]" if ":" in host else host

    def where() -> str:
        return f"listening on {scheme}://{address}:{listening.result()}"

    def on_ready(at: int) -> None:
        listening.set_result(at)
        say(f"hub: {where()}")

    def status() -> ProcessStatus:
        at = listening.result() if listening.done() else 0
        counts = [HubStatus(len(each.clients), len(each.topics), len(each.services), at) for each in graphs]
        why = where() if at else "not listening yet"
        return ProcessStatus(ready=listening.done(), why=why, hub=counts[0] if counts else None)

    async def announce_once_ready(name: str) -> None:
        from bridge.discovery import announced

        # not before the hub listens: whoever sees the announcement connects at once
        tls, token = access.tls is not None, bool(access.tokens)
        async with announced(name, host, await listening, ros_version=ros_version, tls=tls, token=token):
            say(f"hub: announced as robot:{name}")
            await asyncio.Event().wait()

    directory = status_directory(settings.run_directory, "hub")
    async with serve_status(directory, "hub", status, metrics=settings.metrics):
        hub = serve_hub(
            host,
            port,
            access=access,
            limits=limits,
            ros_version=ros_version,
            on_ready=on_ready,
            on_graph=graphs.append,
            stop=asyncio.Event(),
        )
        # an announcement that fails ends the hub, since its users would wait in vain
        await until_one_ends(hub, *([announce_once_ready(announce)] if announce is not None else []))
    return 0
