"""The hub reads the same messages whatever frames they arrive in, and however their bytes are cut."""

import asyncio

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode

from tests.bridge.hub.sockets import RawClient, client, running_hub


@given(
    st.lists(
        st.sampled_from(["text", "binary", "pieces", "ping", "pong", "empty", "long"]),
        min_size=1,
        max_size=12,
    ),
    st.lists(st.integers(1, 400), min_size=1, max_size=20),
)
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
async def test_messages_in_any_frames_cut_anywhere_arrive_in_order(kinds, cuts):
    """One connection sends messages in all sorts of frames, in all sorts of chunks; another hears them."""
    data, expected = bytearray(), []
    for number, kind in enumerate(kinds):
        operation = b'{"op":"publish","topic":"/t","type":"a/B","msg":{"i":%d,"x":"%b"}}' % (
            number,
            b"y" * (70_000 if kind == "long" else 0),
        )
        if kind in {"text", "binary", "long"}:
            opcode = Opcode.BINARY if kind == "binary" else Opcode.TEXT
            data += Frame(opcode, operation).serialize(mask=True)
            expected.append(number)
        elif kind == "pieces":
            data += Frame(Opcode.TEXT, operation[:10], fin=False).serialize(mask=True)
            data += Frame(Opcode.PING, b"between").serialize(mask=True)
            data += Frame(Opcode.CONT, operation[10:], fin=True).serialize(mask=True)
            expected.append(number)
        elif kind == "empty":
            data += Frame(Opcode.TEXT, b"").serialize(mask=True)
        else:
            opcode = Opcode.PING if kind == "ping" else Opcode.PONG
            data += Frame(opcode, b"z" * 125).serialize(mask=True)
    async with running_hub() as port, client(port) as ears:
        await ears.send(op="subscribe", topic="/t", type="a/B", queue_length=100)
        await ears.sync()
        raw = await RawClient.connect(port)
        at = 0
        for cut in [*cuts, len(data)]:
            raw.writer.write(bytes(data[at : at + cut]))
            await raw.writer.drain()
            await asyncio.sleep(0)
            at += cut
        heard = [(await ears.receive())["msg"]["i"] for _ in expected]
        assert heard == expected
        raw.cut()


async def test_frames_sent_before_the_handshakes_answer_are_read():
    async with running_hub() as port, client(port) as ears:
        await ears.send(op="subscribe", topic="/t", type="a/B")
        await ears.sync()
        for part in (b"", b"\x81"):  # all of the first frame with the request, or its first byte alone
            raw = await RawClient.connect(port, handshake=False)
            message = Frame(Opcode.TEXT, b'{"op":"publish","topic":"/t","msg":{}}').serialize(mask=True)
            raw.writer.write(
                b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
                + (part or message)
            )
            await raw.reader.readuntil(b"\r\n\r\n")
            raw.writer.write(message[1:] if part else message)
            raw.writer.write(message)
            for _ in range(2 if part else 3):
                assert (await ears.receive())["msg"] == {}
            raw.cut()
