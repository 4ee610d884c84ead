"""A hub on a real socket for tests, WebSocket clients of it, and a raw TCP one that can misbehave."""

import asyncio
import base64
import contextlib
import json
import os
import socket
import struct
from contextlib import asynccontextmanager
from typing import ClassVar

from websockets.asyncio.client import connect
from websockets.frames import Frame, Opcode

from bridge.hub.server import serve_hub
from tests.patience import PATIENCE


class Client:
    """A WebSocket client that sends and receives operations."""

    def __init__(self, websocket):
        self.websocket = websocket

    async def send(self, **operation):
        await self.websocket.send(json.dumps(operation))

    async def receive(self):
        async with asyncio.timeout(PATIENCE):
            return json.loads(await self.websocket.recv())

    async def ask(self, service, **args):
        await self.send(op="call_service", service=service, args=args, id="ask")
        answer = await self.receive()
        assert (answer["op"], answer["id"]) == ("service_response", "ask"), answer
        return answer["values"]

    async def wait_for(self, service, accepts, **args):
        """Repeat a call until its one value is accepted."""
        async with asyncio.timeout(PATIENCE):
            while not accepts(next(iter((await self.ask(service, **args)).values()))):
                await asyncio.sleep(0.01)

    async def sync(self):
        """Wait until the hub has performed everything that was sent before."""
        await self.ask("/rosapi/get_time")

    async def closed(self):
        """Wait for the hub to end the connection, and return the close code."""
        async with asyncio.timeout(PATIENCE):
            await self.websocket.wait_closed()
        code = self.websocket.close_code
        assert code is not None
        return code


@asynccontextmanager
async def running_hub(*, port=0, limits=None, access=None, ros_version=1):
    """Run a hub on a port of this machine, 0 for any free one, and yield its port."""
    stop = asyncio.Event()
    ready = asyncio.get_running_loop().create_future()
    served = asyncio.create_task(
        serve_hub(
            "127.0.0.1",
            port,
            limits=limits,
            access=access,
            ros_version=ros_version,
            on_ready=ready.set_result,
            stop=stop,
        )
    )
    try:
        async with asyncio.timeout(PATIENCE):
            yield await ready
    finally:
        stop.set()
        await asyncio.wait_for(served, PATIENCE)
        while RawClient.connected:
            await RawClient.connected.pop().close()


@asynccontextmanager
async def client(port, **options):
    async with connect(f"ws://127.0.0.1:{port}", **options) as websocket:
        yield Client(websocket)


class RawClient:
    """A WebSocket client that does nothing by itself: it answers no pings and reads on demand.

    `running_hub` closes those that have not ended when the hub has.
    """

    connected: ClassVar[set["RawClient"]] = set()

    def __init__(self, reader, writer):
        self.reader = reader
        self.writer = writer
        self.connected.add(self)

    @classmethod
    async def connect(cls, port, *, handshake=True, receive_buffer=0):
        sock = socket.socket()
        if receive_buffer:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        sock.setblocking(False)
        await asyncio.get_running_loop().sock_connect(sock, ("127.0.0.1", port))
        # A small limit keeps the stream from reading ahead of the test.
        raw = cls(*await asyncio.open_connection(sock=sock, limit=1024))
        if handshake:
            await raw.request()
        return raw

    async def request(self, *headers, path="/", host="localhost"):
        """Request a WebSocket, and return the status line of the answer."""
        key = base64.b64encode(os.urandom(16)).decode()
        lines = [
            f"GET {path} HTTP/1.1",
            f"Host: {host}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}",
            "Sec-WebSocket-Version: 13",
            *headers,
        ]
        self.writer.write(("\r\n".join(lines) + "\r\n\r\n").encode())
        answer = await self.reader.readuntil(b"\r\n\r\n")
        return answer.split(b"\r\n")[0].decode()

    def send(self, data, *, opcode=Opcode.TEXT, fin=True):
        self.writer.write(Frame(opcode, data, fin).serialize(mask=True))

    def send_operation(self, **operation):
        self.send(json.dumps(operation).encode())

    async def frame(self):
        """Return the next frame's opcode and payload."""
        first, length = await self.reader.readexactly(2)
        if length == 126:
            (length,) = struct.unpack("!H", await self.reader.readexactly(2))
        elif length == 127:
            (length,) = struct.unpack("!Q", await self.reader.readexactly(8))
        return first & 15, await self.reader.readexactly(length)

    async def message(self):
        """Return the next message's payload, skipping pings."""
        async with asyncio.timeout(PATIENCE):
            while True:
                opcode, payload = await self.frame()
                if opcode in {Opcode.TEXT, Opcode.BINARY}:
                    return payload

    async def ended(self):
        """Wait until the hub ends the connection, and return everything before that."""
        self.connected.discard(self)
        async with asyncio.timeout(PATIENCE):
            data = b""
            try:
                while chunk := await self.reader.read(65536):
                    data += chunk
            except ConnectionResetError:
                pass
            await self.close()
            return data

    async def close(self):
        self.writer.transport.abort()
        with contextlib.suppress(OSError):
            await self.writer.wait_closed()

    def cut(self):
        """Leave without a word: TCP reset."""
        sock = self.writer.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.writer.transport.abort()


async def until(condition):
    """Wait for what will become true."""
    async with asyncio.timeout(PATIENCE):
        while not condition():
            await asyncio.sleep(0.01)
