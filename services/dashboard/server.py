"""The web server of the dashboard. It runs in the event loop of this process, and handles no signals."""

import asyncio
import contextlib
import logging
import os
import socket
from collections.abc import Iterator
from typing import Final

# the framework would look for stored settings below the current folder; the page stores nothing
os.environ.setdefault("NICEGUI_STORAGE_PATH", os.devnull)

import uvicorn

from bridge.hub.access import AccessPolicy
from services.dashboard.doors import Doors
from services.dashboard.feed import Feed
from services.dashboard.page import Dashboard
from services.dashboard.robot import WatchedRobot

_SHUTDOWN_S: Final = 1
_MESSAGE_BYTES: Final = 1 << 20
_LOOK_EVERY: Final = 0.05


class _Server(uvicorn.Server):
    """A server that handles no signals."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


class PageServer:
    """The web server of the dashboard's page, on a listening socket.

    Attributes:
        ready: Event that is set when browsers can open the page.
    """

    def __init__(
        self,
        feed: Feed,
        robot: WatchedRobot,
        listener: socket.socket,
        policy: AccessPolicy,
        *,
        loopback: bool,
    ) -> None:
        self.ready = asyncio.Event()
        self._listener = listener
        tls = policy.tls
        config = uvicorn.Config(
            Doors(Dashboard(feed, robot).application(), policy, loopback=loopback),
            log_config=None,
            log_level=logging.WARNING,
            access_log=False,
            lifespan="on",
            proxy_headers=False,
            server_header=False,
            ws="websockets-sansio",
            ws_max_size=_MESSAGE_BYTES,
            ws_per_message_deflate=False,  # it would take longer than the loopback's bytes
            timeout_graceful_shutdown=_SHUTDOWN_S,
            ssl_context_factory=(lambda *_: tls) if tls is not None else None,
        )
        self._server = _Server(config)

    async def run(self) -> None:
        """Serve until cancelled."""
        serving = asyncio.create_task(self._server.serve([self._listener]))
        try:
            while not self._server.started and not serving.done():
                await asyncio.sleep(_LOOK_EVERY)
            self.ready.set()
            await asyncio.shield(serving)
        finally:
            # the server would report with a traceback that an open request of a page has to end
            logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
            self._server.should_exit = True
            await asyncio.gather(serving, return_exceptions=True)
