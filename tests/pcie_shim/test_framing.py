"""Frames: they survive any split of the stream, and other bytes are an error."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcie_shim import framing
from pcie_shim.errors import CrcError, FramingError
from pcie_shim.framing import FrameDecoder, ProgramBegin, encode

words32 = st.integers(0, 0xFFFFFFFF)
payloads = st.binary(max_size=400).map(lambda data: data[: len(data) // 4 * 4])
with_payload = st.tuples(
    st.sampled_from(
        [
            (framing.READ, framing.REPLY),
            (framing.WRITE, 0),
            (framing.WRITE, framing.POSTED),
            (framing.IRQ, 0),
            (framing.ERROR, framing.REPLY),
            (framing.PROGRAM, framing.BEGIN),
        ]
    ),
    words32,
    words32,
    payloads,
).map(lambda made: (*made[0], made[1], made[2], len(made[3]) // 4, made[3]))
without_payload = st.tuples(
    st.sampled_from([(framing.READ, 0), (framing.WRITE, framing.REPLY), (framing.PROGRAM, framing.REPLY)]),
    words32,
    words32,
    st.integers(0, framing.MAX_PAYLOAD_WORDS),
).map(lambda made: (*made[0], *made[1:], b""))
frames = st.lists(with_payload | without_payload, max_size=8)


def decode(stream, cuts):
    """All frames in a stream that arrives in pieces."""
    decoder = FrameDecoder()
    found = []
    edges = sorted({0, len(stream), *(cut % (len(stream) + 1) for cut in cuts)})
    for start, end in itertools.pairwise(edges):
        rest = stream[start:end]
        while rest:
            room = decoder.room()
            piece, rest = rest[: len(room)], rest[len(room) :]
            room[: len(piece)] = piece
            decoder.received(len(piece))
            while (frame := decoder.next_frame()) is not None:
                found.append((*frame[:-1], bytes(frame.payload)))
    return found


@given(frames, st.lists(st.integers(0, 10_000), max_size=12))
def test_frames_survive_any_split(sent, cuts):
    assert decode(b"".join(encode(*frame) for frame in sent), cuts) == sent


def test_long_streams_do_not_outgrow_the_buffer():
    longest = (framing.WRITE, 0, 1, 0, framing.MAX_PAYLOAD_WORDS, bytes(4 * framing.MAX_PAYLOAD_WORDS))
    short = (framing.READ, 0, 1, 0, 1, b"")
    sent = [short, *[longest] * 9, short]
    # no piece ends with a frame: the decoder never finds its buffer empty
    pieces = list(range(32_000, 300_000, 30_011))
    assert decode(b"".join(encode(*frame) for frame in sent), pieces) == sent


@given(st.binary(max_size=3000), st.lists(st.integers(0, 3000), max_size=5))
def test_any_bytes_give_frames_or_a_framing_error(stream, cuts):
    try:
        found = decode(stream, cuts)
    except FramingError:
        return
    assert found == [] or stream.startswith(b"BM")


@given(with_payload, st.integers(0, 8 * 419), st.binary(max_size=40))
def test_a_flipped_bit_is_never_taken_for_a_frame(sent, position, after):
    stream = bytearray(encode(*sent))
    position %= 8 * len(stream)
    stream[position // 8] ^= 1 << position % 8
    try:
        assert decode(bytes(stream) + after, [])[:1] != [sent]
    except FramingError:
        return
    # only a longer length can leave the decoder waiting for more
    assert 12 * 8 <= position < 16 * 8


def test_a_wrong_crc_and_an_excessive_length_have_different_errors():
    stream = bytearray(encode(framing.WRITE, 0, 1, 0, 1, b"1234"))
    stream[-1] ^= 1
    with pytest.raises(CrcError):
        decode(bytes(stream), [])
    with pytest.raises(FramingError):
        decode(encode(framing.READ, 0, 1, 0, framing.MAX_PAYLOAD_WORDS + 1), [])


@pytest.mark.parametrize("payload", [b"", b"x" * 96])
def test_other_frames_are_not_a_greeting(payload):
    (frame,) = _frames(encode(framing.GREET, 0, 0, 0, len(payload) // 4, payload))
    with pytest.raises(FramingError):
        framing.decode_greeting(frame)


def test_an_error_comes_back_and_short_payloads_are_refused():
    (frame,) = _frames(framing.encode_error(9, 0x100, 5, "beschäftigt"))
    assert (frame.sequence, frame.address, *framing.decode_error(frame)) == (9, 0x100, 5, "beschäftigt")
    (frame,) = _frames(encode(framing.ERROR, framing.REPLY, 1, 0, 0))
    with pytest.raises(FramingError):
        framing.decode_error(frame)
    with pytest.raises(FramingError):
        ProgramBegin.decode(memoryview(b"123"))


def _frames(stream):
    decoder = FrameDecoder()
    decoder.room()[: len(stream)] = stream
    decoder.received(len(stream))
    frame = decoder.next_frame()
    assert frame is not None
    return [frame]
