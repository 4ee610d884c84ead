"""A rosbridge client that uses only `websockets` and `json`, to judge the stack without its own client."""

import asyncio
import contextlib
import json
from collections.abc import Callable
from typing import Any, Final

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

from scripts.running.patience import FACTOR

RESULTS, REPORTS = "/BMresults", "/bm/frame"
OUTPUT_TYPES: Final = {REPORTS: "diagnostic_msgs/DiagnosticArray", RESULTS: "std_msgs/Float64MultiArray"}
_QUEUE: Final = 1000
_AGAIN: Final = 0.05
"""Seconds between two attempts to connect."""


class PlainClient:
    """A client that publishes readings and receives results, and reconnects whenever its connection is lost."""

    def __init__(
        self,
        port: int,
        readings: tuple[str, str],
        take: Callable[[str, Any], None],
        lost: Callable[[], None] = lambda: None,
    ) -> None:
        """Store the arguments: `take` gets the topic and content of each message, `lost` is called after each loss."""
        self._uri = f"ws://127.0.0.1:{port}"
        self._topic, self._type = readings
        self._take, self._lost = take, lost
        self._connection: ClientConnection | None = None
        self._task: asyncio.Task[None] | None = None
        self.connected = asyncio.Event()
        self.refused: list[str] = []
        """The server's messages about operations that it refused."""

    async def start(self) -> None:
        """Start to connect."""
        self._task = asyncio.create_task(self._keep())

    async def end(self) -> None:
        """Disconnect."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def publish(self, message: dict[str, Any]) -> None:
        """Publish a reading if there is a connection; otherwise drop it."""
        if self._connection is not None:
            operation = {"op": "publish", "topic": self._topic, "msg": message}
            with contextlib.suppress(OSError, WebSocketException):
                await self._connection.send(json.dumps(operation))

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
            operations: list[dict[str, object]] = [
                {"op": "advertise", "topic": self._topic, "type": self._type}
            ]
            for topic, kind in OUTPUT_TYPES.items():
                # without a given queue length, a server over DDS keeps ten messages
                operations.append({"op": "subscribe", "topic": topic, "type": kind, "queue_length": _QUEUE})
            for operation in operations:
                await connection.send(json.dumps(operation))
            self._connection = connection
            self.connected.set()
            async for text in connection:
                operation = json.loads(text)
                if operation.get("op") == "publish":
                    self._take(operation["topic"], operation["msg"])
                elif operation.get("op") == "status":
                    self.refused.append(str(operation["msg"]))
