"""A proxy between two parts of the stack, which delays, holds, cuts, repeats and corrupts data."""

from __future__ import annotations

import asyncio
import contextlib
import random
import re
from collections.abc import Callable
from dataclasses import dataclass, field

CHUNK = 1 << 16
_STAMP = re.compile(rb'"secs":\s*(\d+),\s*"nsecs":\s*(\d+)')


@dataclass(slots=True)
class Weather:
    """The treatment of data by a proxy.

    Attributes:
        open: Whether data is forwarded; otherwise connections remain open and silent.
        delay: Seconds by which each piece is delayed.
        rate: Bytes per second; 0 for no limit.
        spoil: Number of next pieces in which a byte is changed.
        repeat: Number of pieces to send again before the next one.
        cut_inside: Whether the next piece is cut in its middle, and its connection with it.
        insert: Bytes to send to each client before its next message.
    """

    open: asyncio.Event = field(default_factory=asyncio.Event)
    delay: float = 0.0
    rate: float = 0.0
    spoil: int = 0
    repeat: int = 0
    cut_inside: bool = False
    insert: bytes = b""


class Proxy:
    """A listener that forwards each connection; `to_client` may inspect the stream from the server."""

    def __init__(self, listen: str | int, connect: str | int, rng: random.Random) -> None:
        """Store two addresses, each the path of a Unix socket or a port of this machine."""
        self._listen, self._connect = listen, connect
        self.host = "127.0.0.1"
        """Address to listen on, if `listen` is a port."""
        self._rng = rng
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self.weather = Weather()
        self.weather.open.set()
        self.on_reading: Callable[[int], None] | None = None
        """Function to call with the stamp of each reading sent to a client; requires WebSockets."""

    async def start(self) -> None:
        """Start to listen."""
        if isinstance(self._listen, int):
            self._server = await asyncio.start_server(self._serve, self.host, self._listen)
        else:
            self._server = await asyncio.start_unix_server(self._serve, self._listen)

    def vanish(self) -> None:
        """Cut all connections, and refuse others."""
        if self._server is not None:
            self._server.close()
        self.cut()

    def cut(self) -> None:
        """Cut all connections."""
        for writer in self._writers:
            writer.transport.abort()

    def finish(self) -> None:
        """Close all connections properly, after all their data."""
        for writer in self._writers:
            with contextlib.suppress(OSError, RuntimeError):
                writer.write_eof()

    async def end(self) -> None:
        """Cut all connections and wait for the tasks."""
        self.vanish()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        try:
            await self._pass(reader, writer)
        except asyncio.CancelledError:
            writer.transport.abort()

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            if isinstance(self._connect, int):
                onwards = await asyncio.open_connection("127.0.0.1", self._connect)
            else:
                onwards = await asyncio.open_unix_connection(self._connect)
        except OSError:
            writer.transport.abort()
            return
        both = {writer, onwards[1]}
        self._writers |= both
        try:
            pumps = {
                asyncio.ensure_future(self._pump(reader, onwards[1], to_client=False)),
                asyncio.ensure_future(self._pump(onwards[0], writer, to_client=True)),
            }
            try:
                await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for pump in pumps:
                    pump.cancel()
                await asyncio.gather(*pumps, return_exceptions=True)
        finally:
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
                if not piece:
                    return
                if not await self._give(piece, former, writer, to_client=to_client):
                    return
                former = piece

    async def _give(
        self, piece: bytes, former: bytes, writer: asyncio.StreamWriter, *, to_client: bool
    ) -> bool:
        """Forward a piece according to the weather, and return whether the connection remains."""
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
            weather.spoil -= 1
            at = self._rng.randrange(len(piece))
            piece = piece[:at] + bytes([piece[at] ^ (1 << self._rng.randrange(8))]) + piece[at + 1 :]
        if weather.repeat:
            weather.repeat -= 1
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
