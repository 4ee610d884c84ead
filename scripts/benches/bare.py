"""A WebSocket client that costs almost nothing: frames are encoded once, and only counted when received."""

import asyncio
import base64
import json
import os
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any, TypeVar, cast

from services.errors import StackError

Result = TypeVar("Result")

TYPE = "std_msgs/Float64MultiArray"
LIMIT = 30.0
"""Seconds to wait for an action that a server or client performs at once."""


class Bare(asyncio.Protocol):
    """The client; `on_frames` is called with the number of received frames, and the payload of the last one."""

    def __init__(self) -> None:
        self.ready: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.count = 0
        self.on_frames: Callable[[int, bytes], None] | None = None
        self._rest = b""
        self.transport: asyncio.Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Request a WebSocket."""
        self.transport = cast("asyncio.Transport", transport)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = ["GET / HTTP/1.1", "Host: localhost", "Upgrade: websocket", "Connection: Upgrade"]
        lines += [f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13", "", ""]
        self.transport.write("\r\n".join(lines).encode())

    def data_received(self, data: bytes) -> None:
        """Count whole frames."""
        data = self._rest + data
        if not self.ready.done():
            head, separator, data = data.partition(b"\r\n\r\n")
            if not separator:
                self._rest = head
                return
            self.ready.set_result(None)
        at = came = 0
        last = b""
        while len(data) - at >= 2:
            length, body = data[at + 1], at + 2
            if length >= 126:
                body += 2 if length == 126 else 8
                length = int.from_bytes(data[at + 2 : body], "big") if body <= len(data) else len(data)
            if body + length > len(data):
                break
            if data[at] & 15 in {1, 2}:
                came += 1
                last = data[body : body + length]
            at = body + length
        self._rest = data[at:]
        self.count += came
        if came and self.on_frames is not None:
            self.on_frames(came, last)

    def send(self, frames: bytes) -> None:
        """Send encoded frames."""
        self.transport.write(frames)


async def soon(awaited: Awaitable[Result], what: str) -> Result:
    """Wait for an awaitable, or raise a StackError if the awaitable does not complete within `LIMIT` seconds."""
    try:
        async with asyncio.timeout(LIMIT):
            return await awaited
    except TimeoutError:
        raise StackError(f"{what} did not come within {LIMIT:.0f} s") from None


def frame(operation: dict[str, Any] | bytes) -> bytes:
    """Return a masked frame (with a mask of zeros) of an operation, or of its encoded form."""
    encoded = (
        operation if isinstance(operation, bytes) else json.dumps(operation, separators=(",", ":")).encode()
    )
    size = len(encoded)
    if size < 126:
        header = bytes((0x81, 0x80 | size))
    elif size < 1 << 16:
        header = b"\x81\xfe" + size.to_bytes(2, "big")
    else:
        header = b"\x81\xff" + size.to_bytes(8, "big")
    return header + bytes(4) + encoded


def advertise(topic: str, kind: str = TYPE) -> bytes:
    """Return the frame that advertises a topic."""
    return frame({"op": "advertise", "topic": topic, "type": kind})


def subscribe(topic: str, **options: Any) -> bytes:
    """Return the frame that subscribes to a topic."""
    return frame({"op": "subscribe", "topic": topic, "type": TYPE, **options})


def publish(topic: str, data: Any) -> bytes:
    """Return the frame that publishes numbers."""
    return frame({"op": "publish", "topic": topic, "msg": {"data": data}})


@asynccontextmanager
async def bare(uri: str) -> AsyncIterator[Bare]:
    """Connect a bare client to a server."""
    host, _, port = uri.removeprefix("ws://").rpartition(":")
    _, client = await asyncio.get_running_loop().create_connection(Bare, host, int(port))
    try:
        await soon(client.ready, f"the connection to {uri}")
        yield client
    finally:
        client.transport.abort()


async def settled(client: Bare) -> None:
    """Return when the server has processed everything that this client sent."""
    answered: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    client.on_frames = lambda _count, _last: None if answered.done() else answered.set_result(None)
    client.send(frame({"op": "call_service", "id": "s", "service": "/rosapi/get_time", "args": {}}))
    await soon(answered, "the answer to a call")
    client.on_frames = None
