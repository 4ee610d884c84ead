"""Arbitrary bytes after the handshake: the client survives, reports why it lost the connection, and can be closed.

Ros ──handshake──▶ a bare TCP server ──frames, parts of frames, noise──▶ Ros
"""

import asyncio
import base64
import contextlib
import hashlib
import random
import struct

import pytest

from bridge.client import State, connect
from tests.bridge.client.stand_ins import tcp_service

_GUID = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"


def frame(opcode, payload, *, fin=True, reserved=0, size=None):
    """A frame as a server writes it, or one that lies about its size."""
    size = len(payload) if size is None else size
    first = bytes([(0x80 if fin else 0) | reserved << 4 | opcode])
    if size < 126:
        return first + bytes([size]) + payload
    if size < 65536:
        return first + b"\x7e" + struct.pack(">H", size) + payload
    return first + b"\x7f" + struct.pack(">Q", size) + payload


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    """The server answers no farewell, so that it need not be waited for."""
    monkeypatch.setattr("bridge.client.websocket.CLOSE_TIMEOUT", 0.02)


@contextlib.asynccontextmanager
async def says(data, at_once=b""):
    """A server that does the handshake, says this once it may, and reads on: its port, and when it may."""
    go = asyncio.Event()

    async def serve(reader, writer):
        head = await reader.readuntil(b"\r\n\r\n")
        key = next(line[19:] for line in head.split(b"\r\n") if line.startswith(b"Sec-WebSocket-Key: "))
        accept = base64.b64encode(hashlib.sha1(key + _GUID, usedforsecurity=False).digest())
        writer.write(
            b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Accept: " + accept + b"\r\n\r\n" + at_once
        )
        await go.wait()
        writer.write(data)
        await writer.drain()
        while await reader.read(65536):
            pass

    async with tcp_service(serve) as port:
        yield port, go


async def hears(data, **options):
    """Return the client's last error and its number of unusable messages after a server has sent these bytes."""
    problems = []
    asyncio.get_running_loop().set_exception_handler(lambda _loop, context: problems.append(context))
    async with says(data) as (port, go), connect(f"ws://127.0.0.1:{port}", **options) as ros:
        ros.subscribe("/a", "p/T", compression="cbor")
        go.set()
        for _ in range(5):
            await asyncio.sleep(0.005)
        found = ros.last_error, ros.unusable
    assert ros.state is State.CLOSED
    assert not problems
    return found


PUBLISH = b'{"op":"publish","topic":"/a","msg":{}}'
FRAMES = [
    frame(1, PUBLISH),
    frame(2, PUBLISH),
    frame(1, b"\xff\xfe"),
    frame(2, b"\xa1\x61a"),
    frame(1, b""),
    frame(1, b"{", fin=False),
    frame(0, b"}"),
    frame(9, b"ping"),
    frame(10, b""),
    frame(9, b"x" * 126),
    frame(8, b""),
    frame(8, b"\x03"),
    frame(8, b"\x03\xe8bye"),
    frame(8, b"\xff\xff\xff"),
    frame(3, b"x"),
    frame(11, b"x"),
    frame(1, b"x", reserved=4),
    frame(1, b"", size=1 << 40),
    frame(1, b"", size=1 << 63),
    frame(9, b"", fin=False),
    frame(1, b"abc", size=100),
]


@pytest.mark.parametrize("before", [b"", FRAMES[5]], ids=["first", "in a message"])
async def test_each_frame(before):
    for number, each in enumerate(FRAMES):
        print(number, each)  # for a failure
        await hears(before + each + FRAMES[6 if before else 0])
        await hears(before + each)


async def test_what_comes_in_one_piece_with_the_handshake_is_heard():
    status = frame(1, b'{"op":"status","level":"error","msg":"welcome"}')
    again = frame(1, b'{"op":"st', fin=False) + frame(0, b'atus","msg":"again"}')
    async with says(b"", status + again) as (port, go):
        go.set()
        async with connect(f"ws://127.0.0.1:{port}") as ros:
            assert [said.text for said in ros.statuses] == ["welcome", "again"]


@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_noise():
    chance = random.Random(20261121)
    for _ in range(60):
        data = b"".join(chance.choices(FRAMES, k=chance.randrange(4))) + chance.randbytes(
            chance.randrange(40)
        )
        cut = data[: chance.randrange(len(data) + 1)]
        await hears(cut, max_size=1000)
