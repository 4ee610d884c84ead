"""Frames are read and written as by the library, whatever arrives and however it is cut."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.uri import parse_uri

from bridge.transport import frames
from bridge.transport.frames import UNKNOWN, UNSOUND

SIZES = [0, 1, 125, 126, 127, 65_535, 65_536]
#: Bytes of a message at most, in what is generated here.
LARGEST = 200
URI = parse_uri("ws://localhost:9090")


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [True, False])
def test_a_message_is_found_wherever_it_begins(size, masked):
    payload = b"x" * size
    one = Frame(Opcode.BINARY, payload).serialize(mask=masked)
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
