"""The process of the hub: the embedded rosbridge server with status socket and announcement."""

import asyncio
import logging
from typing import Literal

from bridge.codecs.json_codec import MAX_SIZE
from bridge.hub.access import AccessPolicy
from bridge.hub.graph import Graph
from bridge.hub.limits import HubLimits
from bridge.hub.server import serve_hub
from services.settings import Settings
from services.sockets.reporting import serve_status
from services.sockets.status import HubStatus, ProcessStatus
from terminal.logs import log_libraries
from terminal.output import say
from terminal.run_directory import status_directory


async def serve(
    host: str,
    port: int,
    *,
    access: AccessPolicy,
    message_bytes: int,
    clients: int,
    ros_version: Literal[1, 2],
    announce: str | None,
    settings: Settings,
) -> int:
    """Serve rosbridge until cancelled; `port` 0 selects a free one, `announce` is the name on the network."""
    # a refused client gets no explanation, as from the reference server; the reason is only in the log
    log_libraries(logging.WARNING, "hub: %(message)s")
    listening = asyncio.get_running_loop().create_future()
    graphs: list[Graph] = []
    scheme, address = "wss" if access.tls else "ws", f"[{host}]" if ":" in host else host

    def where() -> str:
        return f"listening on {scheme}://{address}:{listening.result()}"

    def on_ready(at: int) -> None:
        listening.set_result(at)
        say(f"hub: {where()}")

    def status() -> ProcessStatus:
        counts = [HubStatus(len(each.clients), len(each.topics), len(each.services)) for each in graphs]
        why = where() if listening.done() else "not listening yet"
        return ProcessStatus(ready=listening.done(), why=why, hub=counts[0] if counts else None)

    async def announce_once_ready(name: str) -> None:
        from bridge.discovery import announced

        tls, token = access.tls is not None, bool(access.tokens)
        async with announced(name, host, await listening, ros_version=ros_version, tls=tls, token=token):
            say(f"hub: announced as robot:{name}")
            await asyncio.Event().wait()

    hub = serve_hub(
        host,
        port,
        access=access,
        limits=HubLimits(
            message_bytes=message_bytes, clients=clients, client_bytes=4 * max(message_bytes, MAX_SIZE)
        ),
        ros_version=ros_version,
        on_ready=on_ready,
        on_graph=graphs.append,
        stop=asyncio.Event(),
    )
    directory = status_directory(settings.run_directory, "hub")
    async with serve_status(directory, "hub", status, metrics=settings.metrics):
        announcing = None if announce is None else asyncio.ensure_future(announce_once_ready(announce))
        tasks = [asyncio.ensure_future(hub), *([announcing] if announcing else [])]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
    return 0
