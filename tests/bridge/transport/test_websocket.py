"""The transport reads and writes what the library alone does, whatever the peer sends and however its bytes are cut."""

import asyncio

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from websockets.client import ClientProtocol
from websockets.frames import DATA_OPCODES, CloseCode, Frame, Opcode
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.uri import parse_uri
from websockets.utils import accept_key

from bridge.client.websocket import Limits, WebSocket
from bridge.transport import frames
from bridge.transport.frames import UNKNOWN, UNSOUND
from bridge.transport.websocket import WebSocketTransport
from tests.bridge.hub.sockets import RawClient, client, running_hub

LARGEST = 200
"""Bytes of a message at most, in what is generated here."""
URI = parse_uri("ws://localhost:9090")


class Ends(asyncio.Transport):
    """A transport that keeps what is written."""

    def __init__(self):
        super().__init__()
        self.written = b""
        self.ended = False
        self.reads = True

    def pause_reading(self):
        self.reads = False

    def resume_reading(self):
        self.reads = True

    def write(self, data):
        self.written += data

    def can_write_eof(self):
        return True

    def write_eof(self):
        self.ended = True

    def set_write_buffer_limits(self, high=None, low=None):
        """All is taken."""

    def is_closing(self):
        return False

    def abort(self):
        self.ended = True


class Library:
    """The library alone, as the reference."""

    def __init__(self, key):
        self.protocol = ClientProtocol(URI, max_size=LARGEST)
        self.protocol.key = key
        self.protocol.send_request(self.protocol.connect())
        self.protocol.data_to_send()
        self.messages = []
        self.written = b""
        self.ended = False
        self._begun = b""

    def take(self, data):
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
def plain(monkeypatch):
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
@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_client_reads_any_stream_as_the_library_does(plain, stream, cuts, idle, apart, closed):
    """After every piece: the same messages, the same answers, the same state, the same reason.

    The handshake's answer is ``apart`` or not, reading starts ``idle`` pieces later, and this side closes the
    connection after piece ``closed``.
    """
    heard = []
    lost = []
    limits = Limits(connect_timeout=1000, max_size=LARGEST, ping_interval=1000, ping_timeout=1000)
    client = WebSocket(URI, limits, heard.extend, lambda _, reason: lost.append(reason))
    ends = Ends()
    client.connection_made(ends)
    ours = client._client_protocol
    ours.send_request(ours.connect())
    ours.data_to_send()
    library = Library(ours.key)
    theirs = library.protocol
    answer = (
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Accept: {accept_key(ours.key)}\r\n\r\n"
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
        if not client.opened and ours.state is State.OPEN:
            if idle == 0 or not part:
                client.begin()
            idle -= 1
        elif not client.opened and ours.state is not State.CONNECTING:
            break  # it came to its end before anybody took it up
        if number == closed and client.opened and theirs.state is State.OPEN:
            client.start_closing(CloseCode.NORMAL_CLOSURE)
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


def parts(data, cuts):
    """Some bytes in pieces, and an empty one for their end."""
    at = 0
    for cut in [*cuts, len(data)]:
        if at < len(data):
            yield data[at : at + cut]
        at += cut
    yield b""


class Postponing(WebSocketTransport):
    """A connection after its handshake that handles each message in the second turn."""

    def __init__(self):
        super().__init__(ServerProtocol(state=State.OPEN), max_size=LARGEST, write_limit=LARGEST)
        self.is_open = self._quick = True
        self._in_handshake = False
        self.seen = []
        self.handled = []

    def messages_received(self, messages):
        new = [message for message in messages if message not in self.seen]
        self.seen += new
        self.handled += messages[: len(messages) - len(new)]
        if new:
            self.postpone(new)


@pytest.mark.parametrize("together", [True, False])
async def test_a_postponed_message_is_handled_before_later_data_is_read(together):
    connection, transport = Postponing(), Ends()
    connection.connection_made(transport)
    one, two = (Frame(Opcode.TEXT, letter).serialize(mask=True) for letter in (b"{one}", b"{two}"))
    connection.data_received(one + two if together else one)
    assert connection.handled == []
    assert not transport.reads
    await asyncio.sleep(0)
    assert connection.handled[0] == b"{one}"
    if not together:
        assert transport.reads
        connection.data_received(two)
    for _ in range(3):
        await asyncio.sleep(0)
    assert connection.handled == [b"{one}", b"{two}"]
    assert transport.reads


async def test_after_a_large_read_others_have_their_turn(monkeypatch):
    connection, transport = Postponing(), Ends()
    connection.connection_made(transport)
    monkeypatch.setattr(Postponing, "turn_bytes", 100)
    monkeypatch.setattr(connection, "messages_received", connection.handled.extend)
    message = Frame(Opcode.TEXT, b"{}").serialize(mask=True)
    connection.data_received(20 * message)
    assert len(connection.handled) == 20
    assert not transport.reads  # uvloop would read on
    await asyncio.sleep(0)
    assert transport.reads


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


SIZES = [0, 1, 125, 126, 127, 65_535, 65_536]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [True, False])
def test_a_message_is_found_wherever_it_begins(size, masked):
    payload = b"x" * size
    one = Frame(Opcode.BINARY, payload).serialize(mask=masked)
    data = b"before" + 3 * one + b"\x81"
    found, at = frames.whole_messages(data, 6, masked=masked, largest=size)
    assert (found, at) == ([payload] * 3, len(data) - 1)
    assert frames.whole_messages(data, 6, masked=masked, largest=size, count=2) == (found[:2], at - len(one))
    assert frames.frame_end(data, 6, masked=masked, largest=size) == 6 + len(one)
    if size:
        assert frames.whole_messages(data, 6, masked=masked, largest=size - 1) == ([], 6)
        assert frames.frame_end(data, 6, masked=masked, largest=size - 1) == UNSOUND


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [True, False])
def test_a_frame_that_is_not_all_there_is_waited_for(size, masked):
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
    ("opcode", "size"), [*((Opcode.TEXT, size) for size in SIZES), (Opcode.CONT, 1), (Opcode.PING, 1)]
)
@pytest.mark.parametrize("masked", [True, False])
def test_one_message_alone_is_found_as_among_others(opcode, size, masked):
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
def test_whatever_comes_means_the_same_alone(rest, masked, length):
    for data in (rest, b"\x81" + rest, b"\x81" + bytes((length,)) + rest[: length + 4]):
        alone = frames.only_message(data, masked=masked, largest=100)
        if alone is not None:
            assert frames.whole_messages(data, 0, masked=masked, largest=100) == ([alone], len(data))


@pytest.mark.parametrize("masked", [True, False])
def test_the_library_handles_everything_but_whole_messages(masked):
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
def test_a_text_as_a_client_writes_it_is_read_by_the_library(size):
    payload = bytes(range(256)) * (size // 256 + 1)
    server = ServerProtocol(state=State.OPEN)
    server.receive_data(b"".join(map(frames.Masker().encode, ([payload[:size]], [payload[:size]] * 2))))
    events = server.events_received()
    assert events == [Frame(Opcode.TEXT, payload[:size])] * 3


def test_keys_are_not_used_twice():
    masker = frames.Masker()
    data = b"".join(masker.encode([b"x"] * count) for count in [1] * 1500 + [2000, 1, 3])
    keys = [data[at + 2 : at + 6] for at in range(0, len(data), len(masker.encode([b"x"])))]
    assert len(keys) == 3504
    assert len(set(keys)) > 3490  # of 2**32: two alike would be a surprise
