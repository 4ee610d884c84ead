"""The campaign's rosbridge client for readings and results, which uses only `websockets` and `json`."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable
from typing import Any

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

from scripts.running.patience import FACTOR

TOPIC, TYPE = "/campaign/readings", "campaign_msgs/Reading"
RESULTS, REPORTS = "/BMresults", "/bm/frame"
QUEUE = 1000
_ANSWER = 1.0 * FACTOR
"""Seconds within which a process must answer with its status."""
_AGAIN = 0.05
"""Seconds between two attempts to connect."""


class Client:
    """A connection to the hub that is restored whenever it is lost."""

    def __init__(self, port: int, take: Callable[[str, Any], None], lost: Callable[[], None]) -> None:
        """Store functions to call with messages, by topic, and at the loss of a connection."""
        self._uri = f"ws://127.0.0.1:{port}"
        self._take, self._lost = take, lost
        self._connection: ClientConnection | None = None
        self._task: asyncio.Task[None] | None = None
        self.connected = asyncio.Event()

    async def start(self) -> None:
        """Start to connect."""
        self._task = asyncio.create_task(self._keep())

    async def end(self) -> None:
        """Disconnect."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def publish(self, stamp: int, values: dict[str, object]) -> bool:
        """Publish a reading, and return whether it was written to a connection."""
        secs, nsecs = divmod(stamp, 10**9)
        message = {"header": {"stamp": {"secs": secs, "nsecs": nsecs}, "frame_id": ""}, **values}
        if self._connection is None:
            return False
        try:
            await self._connection.send(json.dumps({"op": "publish", "topic": TOPIC, "msg": message}))
        except (OSError, WebSocketException):
            return False
        return True

    async def _keep(self) -> None:
        while True:
            with contextlib.suppress(OSError, WebSocketException, TimeoutError):
                await self._converse()
            self._connection = None
            self.connected.clear()
            self._lost()
            await asyncio.sleep(_AGAIN)

    async def _converse(self) -> None:
        async with connect(
            self._uri, compression=None, ping_interval=None, open_timeout=20 * FACTOR, max_size=1 << 24
        ) as connection:
            for operation in (
                {"op": "advertise", "topic": TOPIC, "type": TYPE},
                {"op": "subscribe", "topic": REPORTS, "queue_length": QUEUE},
                {"op": "subscribe", "topic": RESULTS, "queue_length": QUEUE},
            ):
                types = {REPORTS: "diagnostic_msgs/DiagnosticArray", RESULTS: "std_msgs/Float64MultiArray"}
                await connection.send(
                    json.dumps({"type": types.get(str(operation["topic"]), TYPE), **operation})
                )
            self._connection = connection
            self.connected.set()
            async for text in connection:
                operation = json.loads(text)
                if operation.get("op") == "publish":
                    self._take(operation["topic"], operation["msg"])


async def process_status(path: str) -> dict[str, Any] | None:
    """Return the JSON object from a process's status socket, or None without an answer."""
    try:
        async with asyncio.timeout(_ANSWER):
            reader, writer = await asyncio.open_unix_connection(path)
            try:
                data = await reader.read()
            finally:
                writer.close()
        status: dict[str, Any] = json.loads(data)
    except (OSError, TimeoutError, ValueError):
        return None
    return status


def now() -> float:
    """Return the campaign's clock in seconds."""
    return time.monotonic()
