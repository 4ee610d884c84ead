"""Frames found and written here are the library's: whatever comes, cut wherever, means the same by both ways."""

import asyncio
from collections.abc import Iterator
from itertools import islice
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from websockets.client import ClientProtocol
from websockets.frames import DATA_OPCODES, Frame, Opcode
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.uri import parse_uri
from websockets.utils import accept_key

from bridge.client.websocket import WebSocket
from bridge.transport import frames
from bridge.transport.frames import UNKNOWN, UNSOUND

SIZES = [0, 1, 125, 126, 127, 65_535, 65_536]
#: Bytes of a message at most, in what is generated here.
LARGEST = 200
URI = parse_uri("ws://localhost:9090")

# --- finding and writing


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("opcode", [Opcode.TEXT, Opcode.BINARY])
def test_a_message_is_found_wherever_it_begins(size: int, masked: bool, opcode: Opcode) -> None:
    payload = b"x" * size
    one = Frame(opcode, payload).serialize(mask=masked)
    data = b"before" + 3 * one + b"\x81"
    found, at = frames.whole_messages(data, 6, masked=masked, largest=size)
    assert (found, at) == ([payload] * 3, len(data) - 1)
    assert frames.whole_messages(data, 6, masked=masked, largest=size, count=2) == (found[:2], at - len(one))
    until = 7 + len(one)  # the second begins before it
    assert frames.whole_messages(data, 6, masked=masked, largest=size, until=until)[0] == found[:2]
    assert frames.frame_end(data, 6, masked=masked, largest=size) == 6 + len(one)
    if size:
        assert frames.whole_messages(data, 6, masked=masked, largest=size - 1) == ([], 6)
        assert frames.frame_end(data, 6, masked=masked, largest=size - 1) == UNSOUND


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [True, False])
def test_a_frame_that_is_not_all_there_is_waited_for(size: int, masked: bool) -> None:
    data = Frame(Opcode.TEXT, b"x" * size).serialize(mask=masked)
    header = len(data) - size
    for known in {*range(header + 1), len(data) - 1}:
        part = data[:known]
        assert frames.whole_messages(part, 0, masked=masked, largest=1 << 20)[0] == [b""] * (
            known == len(data)
        )
        assert frames.frame_end(part, 0, masked=masked, largest=1 << 20) in {UNKNOWN, len(data)}
    assert frames.frame_end(data[:header], 0, masked=masked, largest=1 << 20) == len(data)


@pytest.mark.parametrize(
    ("opcode", "size"),
    [(opcode, size) for opcode in Opcode for size in SIZES if size < 126 or opcode < Opcode.CLOSE],
)
@pytest.mark.parametrize("masked", [True, False])
def test_one_message_alone_is_found_as_among_others(opcode: Opcode, size: int, masked: bool) -> None:
    one = Frame(opcode, b"x" * size).serialize(mask=masked)
    found = frames.whole_messages(one, 0, masked=masked, largest=size)[0]
    alone = frames.only_message(one, masked=masked, largest=size)
    assert alone is None or [alone] == found
    assert (alone is None) is (not found or size > 65_535 or len(one) < 8)
    assert frames.only_message(one, masked=masked, largest=size - 1) is None
    assert frames.only_message(one, masked=not masked, largest=size) is None
    for other in (one[:-1], one + b"\x81", 2 * one):
        assert frames.only_message(other, masked=masked, largest=1 << 20) is None


@given(st.binary(max_size=200), st.booleans(), st.integers(0, 200))
def test_whatever_comes_means_the_same_alone(rest: bytes, masked: bool, length: int) -> None:
    for data in (rest, b"\x81" + rest, b"\x81" + bytes((length,)) + rest[: length + 4]):
        alone = frames.only_message(data, masked=masked, largest=100)
        if alone is not None:
            assert frames.whole_messages(data, 0, masked=masked, largest=100) == ([alone], len(data))


@pytest.mark.parametrize("masked", [True, False])
def test_what_is_no_whole_message_is_the_librarys(masked: bool) -> None:
    for opcode in (Opcode.PING, Opcode.PONG, Opcode.CLOSE, Opcode.CONT):
        data = Frame(opcode, b"xx").serialize(mask=masked)
        assert frames.whole_messages(data, 0, masked=masked, largest=9) == ([], 0)
        assert frames.frame_end(data, 0, masked=masked, largest=9) == len(data)
    text = Frame(Opcode.TEXT, b"xx").serialize(mask=masked)
    piece = Frame(Opcode.TEXT, b"xx", fin=False).serialize(mask=masked)
    assert frames.whole_messages(piece, 0, masked=masked, largest=9) == ([], 0)
    assert frames.frame_end(piece, 0, masked=masked, largest=9) == len(piece)
    for broken in (
        b"\xc1" + text[1:],
        b"\x83" + text[1:],
        Frame(Opcode.TEXT, b"x").serialize(mask=not masked),
    ):
        assert frames.whole_messages(broken, 0, masked=masked, largest=9) == ([], 0)
        assert frames.frame_end(broken, 0, masked=masked, largest=9) == UNSOUND


@pytest.mark.parametrize("size", SIZES)
def test_a_text_as_a_client_writes_it_is_read_by_the_library(size: int) -> None:
    payload = bytes(range(256)) * (size // 256 + 1)
    server = ServerProtocol(state=State.OPEN)
    keys = frames.mask_keys()
    for _ in range(2):
        server.receive_data(frames.masked_text(payload[:size], next(keys)))
    events = server.events_received()
    assert events == [Frame(Opcode.TEXT, payload[:size])] * 2


def test_keys_are_not_used_twice() -> None:
    keys = list(islice(frames.mask_keys(), 3000))
    assert all(len(key) == 4 for key in keys)
    assert len(set(keys)) > 2990  # of 2**32: two alike would be a surprise


# --- the client's connection beside the library alone


class Ends(asyncio.Transport):
    """A transport that keeps what is written."""

    def __init__(self) -> None:
        super().__init__()
        self.written = b""
        self.ended = False

    def write(self, data: Any) -> None:
        self.written += data

    def can_write_eof(self) -> bool:
        return True

    def write_eof(self) -> None:
        self.ended = True

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """All is taken."""

    def is_closing(self) -> bool:
        return False

    def abort(self) -> None:
        self.ended = True


class Library:
    """The library alone, as the reference."""

    def __init__(self, key: str) -> None:
        self.protocol = ClientProtocol(URI, max_size=LARGEST)
        self.protocol.key = key
        self.protocol.send_request(self.protocol.connect())
        self.protocol.data_to_send()
        self.messages: list[bytes] = []
        self.written = b""
        self.ended = False
        self._begun = b""

    def take(self, data: bytes) -> None:
        """Read, and do what the connection does of it."""
        if data:
            self.protocol.receive_data(data)
        else:
            self.protocol.receive_eof()
        for event in self.protocol.events_received():
            if isinstance(event, Frame) and event.opcode in DATA_OPCODES:
                self._begun += event.data
                if event.fin:
                    self.messages.append(self._begun)
                    self._begun = b""
        for answer in self.protocol.data_to_send():
            self.written += answer
            self.ended = self.ended or not answer


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """The library's masks are all zeros, so that what it writes can be compared."""
    monkeypatch.setattr("websockets.frames.secrets.token_bytes", bytes)


sound = st.builds(
    lambda opcode, size, fin: Frame(opcode, b"p" * size, fin=fin).serialize(mask=False),
    st.sampled_from([Opcode.TEXT, Opcode.BINARY]),
    st.integers(0, LARGEST),
    st.just(True),
)
pieces = st.lists(st.integers(0, LARGEST // 2), min_size=2, max_size=4).map(
    lambda sizes: b"".join(
        Frame(Opcode.CONT if at else Opcode.TEXT, b"f" * size, fin=at == len(sizes) - 1).serialize(mask=False)
        for at, size in enumerate(sizes)
    )
)
control = st.builds(
    lambda opcode, size: Frame(opcode, b"c" * size).serialize(mask=False),
    st.sampled_from([Opcode.PING, Opcode.PONG]),
    st.integers(0, 125),
)
closing = st.sampled_from(
    [b"\x88\x00", b"\x88\x02\x03\xe8", b"\x88\x01\x03", b"\x88\x02\x00\x00", b"\x88\x03\x03\xe8\xff"]
)
odd = st.builds(
    lambda first, second, rest: bytes((first, second)) + rest,
    st.integers(0, 255),
    st.integers(0, 255),
    st.binary(max_size=20),
)
#: Lengths written in more bytes than they need, and lengths that nobody takes.
long_winded = st.builds(
    lambda first, size, wide: (
        bytes((first, 127 if wide else 126))
        + size.to_bytes(8 if wide else 2, "big")
        + b"l" * min(size, LARGEST)
    ),
    st.sampled_from([0x81, 0x82, 0x01, 0x80, 0x89]),
    st.sampled_from([0, 5, 125, 126, LARGEST, LARGEST + 1, 65_535]),
    st.booleans(),
)
streams = st.lists(
    st.one_of(
        sound, sound, sound, pieces, control, st.one_of(closing, odd, long_winded, st.binary(max_size=6))
    ),
    max_size=10,
).map(b"".join)
cuts = st.lists(st.integers(1, 300) | st.integers(1, 5), max_size=60)


@given(
    stream=streams,
    cuts=cuts,
    idle=st.sampled_from([0, 0, 0, 1, 2, 3]),
    apart=st.sampled_from([True, True, False]),
    closed=st.integers(0, 8),
)
@example(stream=b"\x81\x01a\x88\x00\x81\x01b", cuts=[500], idle=0, apart=True, closed=0)
@example(stream=b"\x88\x00\x81\x01b", cuts=[2], idle=0, apart=True, closed=0)
@example(stream=b"\x01\x01a\x81\x01b", cuts=[500], idle=0, apart=True, closed=0)
@example(stream=b"\x81\x7e\x00\xc9" + b"a" * 201, cuts=[500], idle=0, apart=True, closed=0)
@example(
    stream=b"\x01\x64" + b"a" * 100 + b"\x80\x7e\x00\x65" + b"b" * 101,
    cuts=[1] * 300,
    idle=0,
    apart=True,
    closed=0,
)
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
async def test_whatever_comes_cut_anywhere_means_what_it_means_to_the_library(
    plain: None, stream: bytes, cuts: list[int], idle: int, apart: bool, closed: int
) -> None:
    """After every piece: the same messages, the same answers, the same state, the same reason.

    The handshake's answer is ``apart`` or not, the connection is taken up ``idle`` pieces later, and is closed from this
    side after the piece number ``closed``.
    """
    heard: list[bytes] = []
    lost: list[str] = []
    client = WebSocket(
        ClientProtocol(URI, max_size=LARGEST),
        ping_interval=1000,
        ping_timeout=1000,
        on_messages=heard.extend,
        on_lost=lambda _, reason: lost.append(reason),
    )
    ends = Ends()
    client.connection_made(ends)
    client.protocol.send_request(client.protocol.connect())
    client.protocol.data_to_send()
    library = Library(client.protocol.key)
    answer = (
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Accept: {accept_key(client.protocol.key)}\r\n\r\n"
    )
    pieces_of_it = parts(answer.encode() + stream, [len(answer), *cuts] if apart else cuts)
    for number, part in enumerate(pieces_of_it, start=1):
        if library.protocol.state is State.CLOSED:
            break
        library.take(part)
        if part:
            client.data_received(part)
        else:
            client.eof_received()
        if not client.opened and client.protocol.state is State.OPEN:
            if idle == 0 or not part:
                client.begin()
            idle -= 1
        elif not client.opened and client.protocol.state is not State.CONNECTING:
            break  # it came to its end before anybody took it up
        theirs, ours = library.protocol, client.protocol
        if number == closed and client.opened and theirs.state is State.OPEN:
            ours.send_close(1000)
            client.send_data()
            theirs.send_close(1000)
            library.written += b"".join(theirs.data_to_send())
        if client.opened:
            assert heard == library.messages
        assert (ends.written, ends.ended) == (library.written, library.ended)
        assert (ours.state, ours.close_rcvd, ours.close_sent) == (
            theirs.state,
            theirs.close_rcvd,
            theirs.close_sent,
        )
        assert repr(ours.parser_exc) == repr(theirs.parser_exc)
    client.connection_lost(None)
    assert len(lost) == client.opened


def parts(data: bytes, cuts: list[int]) -> Iterator[bytes]:
    """Some bytes in pieces, and an empty one for their end."""
    at = 0
    for cut in [*cuts, len(data)]:
        if at < len(data):
            yield data[at : at + cut]
        at += cut
    yield b""
