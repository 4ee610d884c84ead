"""Connections of the campaign: proxies between the parts of the stack, and status sockets.

    robot side                                   stack
    PlainClient ─ hub ─ Proxy "rosbridge" ─ subscriber, publisher ─ Proxy ─ master ─ Proxy ─ pcie-app ─ Proxy ─ boards

A proxy delays, holds, cuts, repeats and corrupts data.
"""

import asyncio
import contextlib
import json
import random
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from scripts.running.patience import FACTOR

TOPIC, TYPE = "/campaign/readings", "campaign_msgs/Reading"
CHUNK = 1 << 16
_STAMP = re.compile(rb'"secs":\s*(\d+),\s*"nsecs":\s*(\d+)')
_ANSWER = 1.0 * FACTOR
"""Seconds within which a process must answer with its status."""


@dataclass(slots=True)
class Weather:
    """Settings for the data that passes through a proxy.

    Attributes:
        open: Whether the proxy forwards data. If not, its connections remain open and silent.
        delay: Seconds by which the proxy delays each piece of data.
        rate: Maximum rate in bytes per second, or 0 for no limit.
        spoil: Whether to flip one bit of the next piece.
        repeat: Whether to send the last piece again before the next piece.
        cut_inside: Whether to cut the connection in the middle of the next piece.
        insert: Bytes to send to each client before the client's next message.
    """

    open: asyncio.Event = field(default_factory=asyncio.Event)
    delay: float = 0.0
    rate: float = 0.0
    spoil: bool = False
    repeat: bool = False
    cut_inside: bool = False
    insert: bytes = b""

    def __post_init__(self) -> None:
        self.open.set()


class Proxy:
    """A listener that forwards each connection."""

    def __init__(self, listen: str | int, connect: str | int, rng: random.Random) -> None:
        """Store two addresses, each the path of a Unix socket or a port of this machine."""
        self._listen, self._connect = listen, connect
        self._rng = rng
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self.weather = Weather()
        self.on_reading: Callable[[int], None] | None = None
        """Function to call with the stamp of each reading sent to a client; requires WebSockets."""

    async def start(self) -> None:
        """Start to listen."""
        if isinstance(self._listen, int):
            self._server = await asyncio.start_server(self._serve, "127.0.0.1", self._listen)
        else:
            self._server = await asyncio.start_unix_server(self._serve, self._listen)

    def vanish(self) -> None:
        """Cut all connections, and refuse new ones."""
        if self._server is not None:
            self._server.close()
        self.cut()

    def cut(self) -> None:
        """Cut all connections."""
        for writer in self._writers:
            writer.transport.abort()

    def finish(self) -> None:
        """Close all connections properly, after forwarding all data."""
        for writer in self._writers:
            with contextlib.suppress(OSError, RuntimeError):
                writer.write_eof()

    async def end(self) -> None:
        """Cut all connections and wait for the tasks."""
        self.vanish()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.create_task(self._pass(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        both = {writer}
        pumps: list[asyncio.Task[None]] = []
        try:
            if isinstance(self._connect, int):
                onwards = await asyncio.open_connection("127.0.0.1", self._connect)
            else:
                onwards = await asyncio.open_unix_connection(self._connect)
            both.add(onwards[1])
            self._writers |= both
            pumps.append(asyncio.create_task(self._pump(reader, onwards[1], to_client=False)))
            pumps.append(asyncio.create_task(self._pump(onwards[0], writer, to_client=True)))
            await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
        except OSError:
            writer.transport.abort()
        finally:
            for pump in pumps:
                pump.cancel()
            await asyncio.gather(*pumps, return_exceptions=True)
            self._writers -= both
            for each in both:
                each.close()

    async def _pump(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, to_client: bool
    ) -> None:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            if self.on_reading is not None:
                head = await reader.readuntil(b"\r\n\r\n")
                if not to_client:  # without compression, messages can be read here
                    head = re.sub(rb"(?i)sec-websocket-extensions:[^\r]*\r\n", b"", head)
                writer.write(head)
            former = b""
            while True:
                if to_client and self.on_reading is not None:
                    piece = await _websocket_frame(reader)
                else:
                    piece = await reader.read(CHUNK)
                if not piece or not await self._give(piece, former, writer, to_client=to_client):
                    return
                former = piece

    async def _give(
        self, piece: bytes, former: bytes, writer: asyncio.StreamWriter, *, to_client: bool
    ) -> bool:
        """Forward a piece, treated as `self.weather` says; return whether the connection remains open."""
        weather = self.weather
        if weather.delay:
            await asyncio.sleep(weather.delay)
        await weather.open.wait()
        if to_client and weather.cut_inside and len(piece) > 1:
            weather.cut_inside = False
            writer.write(piece[: len(piece) // 2])
            await writer.drain()
            return False
        if to_client and weather.insert:
            writer.write(weather.insert)
        if weather.spoil:
            weather.spoil = False
            at = self._rng.randrange(len(piece))
            piece = piece[:at] + bytes([piece[at] ^ (1 << self._rng.randrange(8))]) + piece[at + 1 :]
        if weather.repeat:
            weather.repeat = False
            piece = former + piece
        if rate := weather.rate:
            for start in range(0, len(piece), 256):
                writer.write(piece[start : start + 256])
                await asyncio.sleep(256 / rate)
        else:
            writer.write(piece)
        if to_client and self.on_reading is not None and (match := _STAMP.search(piece)):
            self.on_reading(int(match[1]) * 10**9 + int(match[2]))
        await writer.drain()
        return True


async def _websocket_frame(reader: asyncio.StreamReader) -> bytes:
    """Return the next WebSocket frame of a server, including its header."""
    head = await reader.readexactly(2)
    size = head[1] & 0x7F
    if size >= 126:
        extended = await reader.readexactly(2 if size == 126 else 8)
        head += extended
        size = int.from_bytes(extended, "big")
    return head + await reader.readexactly(size)


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
