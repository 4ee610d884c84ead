"""Encoding and decoding of frames of the link, without sockets. docs/reference/boards.md has the wire format.

All numbers are little-endian. The CRC covers the payload and the other 16 bytes of the header. Read requests and
replies to writes have a count of words, but no payload. The framing corresponds to the data link layer of thesis 2.3:
it adds sequence numbers and CRCs to read and write requests.
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple, TypeAlias
from zlib import crc32

from pcie_shim.errors import CrcError, FramingError

Octets: TypeAlias = bytes | bytearray | memoryview

# Plain integers, because members of an enumeration cost a look-up and a conversion in every frame.
GREET: Final = 1
"""Board to host: the `Greeting`, when a link opens."""
READ: Final = 2
"""Host to board: read `count` words, starting at `address`. The reply contains the words."""
WRITE: Final = 3
"""Host to board: write the payload, starting at `address`. The board acknowledges a WRITE without the flag POSTED."""
IRQ: Final = 4
"""Board to host: the machine has stopped.

The payload contains the registers from DONE to COMPUTE_NS. If `CAP_LINK.SENDS_RESULTS` is 1, the result blocks follow.
"""
ERROR: Final = 5
"""Board to host: the board refused the request that has this sequence number (`encode_error`)."""
PROGRAM: Final = 6
"""Loader to the programming port: a part of a programming file. `address` is the part's offset in bytes."""
AUTHENTICATE: Final = 7
"""Before GREET, the board sends a challenge. The host answers with a nonce and a proof. The board sends its proof."""

REPLY: Final = 1
"""Flag: the frame answers the request that has the same sequence number."""
POSTED: Final = 2
"""Flag: the request gets no acknowledgement. A refused request still gets an ERROR."""
BEGIN: Final = 4
"""Flag of PROGRAM: the payload is a `ProgramBegin`, which announces the file."""
END: Final = 8
"""Flag of PROGRAM: the file is complete. The board replies after it has loaded the file."""

PROTOCOL_VERSION: Final = 1
MAX_PAYLOAD_WORDS: Final = 8448
"""Maximum payload in words. It is enough for INPUTS, the longest block, and for RESULTS and STREAM together."""

_MAGIC: Final = 0x4D42
_HEAD: Final = struct.Struct("<HBBIII")
_CRC: Final = struct.Struct("<I")
_HEADER: Final = struct.Struct("<HBBIIII")
HEADER_BYTES: Final = _HEADER.size
_MAX_FRAME: Final = HEADER_BYTES + 4 * MAX_PAYLOAD_WORDS
_WITHOUT_PAYLOAD: Final = frozenset({(READ, 0), (WRITE, REPLY), (PROGRAM, REPLY)})
_OPERATIONS: Final = (GREET, READ, WRITE, IRQ, ERROR, PROGRAM, AUTHENTICATE)


class Frame(NamedTuple):
    """One frame as received.

    Attributes:
        operation: One of the operations of this module.
        flags: Sum of flags of this module.
        sequence: Number of the request, from 1, modulo 2^32. An answer has the number of its request.
        address: Offset in the register map, in bytes.
        words: Number of words in the payload, or number of requested words in a READ request.
        payload: The words as bytes in the decoder's buffer. They are valid until the decoder receives more bytes.
    """

    operation: int
    flags: int
    sequence: int
    address: int
    words: int
    payload: memoryview


def encode(
    operation: int, flags: int, sequence: int, address: int, count: int, payload: Octets = b""
) -> bytes:
    """Return the bytes of a frame. If the frame has a payload, the payload has `count` words."""
    head = _HEAD.pack(_MAGIC, operation, flags, sequence, address, count)
    return b"".join((head, _CRC.pack(crc32(payload, crc32(head))), payload))


class FrameDecoder:
    """Decoder of a stream of bytes into frames. It uses the same buffer until the link is closed.

    Receive bytes into `room`, and pass their number to `received`. Then call `next_frame` until it returns None.
    After an error, the decoder is unusable.
    """

    def __init__(self) -> None:
        # Received bytes that were not returned yet are in [start, end). Twice the longest frame, so that bytes are
        # moved to the beginning once in a while instead of after each frame.
        self._buffer = memoryview(bytearray(2 * _MAX_FRAME))
        self._start = 0
        self._end = 0

    @property
    def inside_frame(self) -> bool:
        """True while the buffer contains an incomplete frame."""
        return self._end > self._start

    def room(self) -> memoryview:
        """Return the buffer for the next bytes. Payloads that were returned before become invalid."""
        if self._start == self._end:
            # the usual case: all frames were taken, and nothing has to be moved
            self._start = self._end = 0
        elif self._start > _MAX_FRAME:
            rest = self._end - self._start
            self._buffer[:rest] = self._buffer[self._start : self._end]
            self._start, self._end = 0, rest
        return self._buffer[self._end :]

    def received(self, count: int) -> None:
        """Record that `count` bytes were received at the beginning of `room`."""
        self._end += count

    def next_frame(self) -> Frame | None:
        """Return the next complete frame, or None if more bytes are needed.

        Raises:
            FramingError: The bytes are not a frame.
            CrcError: A frame's CRC is wrong.
        """
        # decoded in place: payloads of 8,192 words are not copied
        start = self._start
        if self._end - start < HEADER_BYTES:
            return None
        magic, operation, flags, sequence, address, count, crc = _HEADER.unpack_from(self._buffer, start)
        if magic != _MAGIC or operation not in _OPERATIONS or flags > 15:
            raise FramingError("the bytes received are not a frame of the link")
        # before anything waits for them: a wrong count must not become a wait for megabytes
        if count > MAX_PAYLOAD_WORDS:
            raise FramingError(f"a frame has {count} words; the maximum is {MAX_PAYLOAD_WORDS}")
        payload_start = start + HEADER_BYTES
        end = payload_start if (operation, flags & REPLY) in _WITHOUT_PAYLOAD else payload_start + 4 * count
        if self._end < end:
            return None
        payload = self._buffer[payload_start:end]
        if crc32(payload, crc32(self._buffer[start : start + _HEAD.size])) != crc:
            raise CrcError("a frame's CRC-32 is wrong")
        self._start = end
        return Frame(operation, flags, sequence, address, count, payload)


_GREETING: Final = struct.Struct("<8sIII32s32s8s")
_LINK_MAGIC: Final = b"ROSBAYES"


class Greeting(NamedTuple):
    """The identity of a board, sent when a link opens.

    Attributes:
        protocol_version: Version of the wire format.
        bar_size: Size of the register map, in bytes.
        board: Index of the board, given to the board's server when it is started.
        map_hash: SHA-256 (hex) of the register map's definition.
        image_hash: SHA-256 (hex) of the loaded image. A blank board sends zeros.
        token: Token of this link. A loader sends the token to the programming port, to prove that it holds the link.
    """

    protocol_version: int
    bar_size: int
    board: int
    map_hash: str
    image_hash: str
    token: bytes


def encode_greeting(greeting: Greeting) -> bytes:
    """Return the greeting's frame."""
    *numbers, map_hash, image_hash, token = greeting
    payload = _GREETING.pack(_LINK_MAGIC, *numbers, bytes.fromhex(map_hash), bytes.fromhex(image_hash), token)
    return encode(GREET, 0, 0, 0, len(payload) // 4, payload)


def decode_greeting(frame: Frame) -> Greeting:
    """Decode the greeting in a frame, or raise a FramingError."""
    if frame.operation != GREET or len(frame.payload) < _GREETING.size:
        raise FramingError("the link does not begin with a board's greeting")
    magic, version, size, board, map_hash, image_hash, token = _GREETING.unpack_from(frame.payload)
    if magic != _LINK_MAGIC:
        raise FramingError("the link does not begin with a board's greeting")
    return Greeting(version, size, board, map_hash.hex(), image_hash.hex(), token)


def encode_error(sequence: int, address: int, code: int, detail: str) -> bytes:
    """Return an ERROR frame. Its payload is a word with the code, and then a sentence in UTF-8, padded with zeros."""
    words = detail.encode()[:1024]
    payload = _CRC.pack(code) + words + bytes(-len(words) % 4)
    return encode(ERROR, REPLY, sequence, address, len(payload) // 4, payload)


def decode_error(frame: Frame) -> tuple[int, str]:
    """Return the code and the sentence of an ERROR frame, or raise a FramingError if the frame has no code."""
    if frame.words < 1:
        raise FramingError("an ERROR without a code came")
    (code,) = _CRC.unpack_from(frame.payload)
    return code, bytes(frame.payload[4:]).rstrip(b"\0").decode(errors="replace")


_PROGRAM_BEGIN: Final = struct.Struct("<Q32s8s")
NO_TOKEN: Final = bytes(8)
"""Eight bytes that stand for no token. A loader sends them if its host does not hold the board's register port."""


class ProgramBegin(NamedTuple):
    """A loader's announcement of a file of `size` bytes. `token` is the token of the host's link, or `NO_TOKEN`."""

    size: int
    sha256: bytes
    token: bytes

    def encode(self) -> bytes:
        """Return the payload of a PROGRAM frame with the flag BEGIN."""
        return _PROGRAM_BEGIN.pack(*self)

    @classmethod
    def decode(cls, payload: memoryview) -> ProgramBegin:
        """Decode a frame's payload, or raise a FramingError if the payload is too short."""
        if len(payload) < _PROGRAM_BEGIN.size:
            raise FramingError("a PROGRAM frame with BEGIN is too short")
        return cls(*_PROGRAM_BEGIN.unpack_from(payload))
