"""Frames found here are the frames that the library finds, however the bytes are cut."""

import asyncio
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode

from bridge.hub import frames
from tests.bridge.hub.sockets import Bare, client, running_hub

SIZES = [0, 1, 125, 126, 127, 65_535, 65_536]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("mask", [True, False])
@pytest.mark.parametrize("opcode", [Opcode.TEXT, Opcode.BINARY, Opcode.CONT])
def test_a_frame_is_found_wherever_it_begins(size: int, mask: bool, opcode: Opcode) -> None:
    payload = b"x" * size
    data = b"before" + Frame(opcode, payload).serialize(mask=mask) + b"after"
    found = frames.next_frame(data, 6)
    assert found.end == len(data) - 5
    assert found.end - found.body == size
    assert found.plain is (mask and opcode in {Opcode.TEXT, Opcode.BINARY})
    if mask:
        body = found.body
        assert frames.apply_mask(data[body : found.end], data[body - 4 : body]) == payload


@pytest.mark.parametrize("opcode", [Opcode.PING, Opcode.PONG, Opcode.CLOSE])
def test_control_frames_are_the_librarys(opcode: Opcode) -> None:
    data = Frame(opcode, b"xx").serialize(mask=True)
    assert frames.next_frame(data, 0) == (6, len(data), False)
    assert not frames.next_frame(Frame(Opcode.TEXT, b"xx", fin=False).serialize(mask=True), 0).plain
    assert not frames.next_frame(b"\xc1" + Frame(Opcode.TEXT, b"xx").serialize(mask=True)[1:], 0).plain


@pytest.mark.parametrize("size", SIZES)
def test_a_frame_whose_beginning_is_not_all_there_has_no_end(size: int) -> None:
    data = Frame(Opcode.TEXT, b"x" * size).serialize(mask=True)
    header = len(data) - size
    for known in range(header + 1):
        end = frames.next_frame(data[:known], 0).end
        assert end in {0, len(data)}
    assert frames.next_frame(data[:header], 0).end == len(data)


@given(
    st.lists(
        st.sampled_from(["text", "binary", "pieces", "ping", "pong", "empty", "long"]),
        min_size=1,
        max_size=12,
    ),
    st.lists(st.integers(1, 400), min_size=1, max_size=20),
)
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
async def test_messages_in_any_frames_cut_anywhere_arrive_in_order(kinds: list[str], cuts: list[int]) -> None:
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
        await ears.settle()
        bare = await Bare.connect(port)
        at = 0
        for cut in [*cuts, len(data)]:
            bare.writer.write(bytes(data[at : at + cut]))
            await bare.writer.drain()
            await asyncio.sleep(0)
            at += cut
        heard: list[Any] = [(await ears.hear())["msg"]["i"] for _ in expected]
        assert heard == expected
        bare.hang_up()


async def test_who_sends_before_the_answer_is_served_too() -> None:
    async with running_hub() as port, client(port) as ears:
        await ears.send(op="subscribe", topic="/t", type="a/B")
        await ears.settle()
        for part in (b"", b"\x81"):  # all of the first frame with the request, or its first byte alone
            bare = await Bare.connect(port, handshake=False)
            message = Frame(Opcode.TEXT, b'{"op":"publish","topic":"/t","msg":{}}').serialize(mask=True)
            bare.writer.write(
                b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
                + (part or message)
            )
            await bare.reader.readuntil(b"\r\n\r\n")
            bare.writer.write(message[1:] if part else message)
            bare.writer.write(message)
            for _ in range(2 if part else 3):
                assert (await ears.hear())["msg"] == {}
            bare.hang_up()
