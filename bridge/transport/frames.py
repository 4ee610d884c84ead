"""Fast reading and writing of WebSocket frames that each contain a whole message.

`whole_messages` finds whole messages in the bytes of a socket. The sans-I/O protocol of `websockets` handles all other
frames: control frames, fragments and malformed frames.

Source: RFC 6455, sections 5.2, 5.3 and 10.3.
"""

import os
import sys
from collections.abc import Sequence
from struct import Struct
from typing import Final

try:
    from websockets.speedups import apply_mask
except ImportError:  # a build of websockets without its C extension
    from websockets.utils import apply_mask

_TEXT: Final = 0x81
_BINARY: Final = 0x82
_WHOLE: Final = frozenset((_TEXT, _BINARY))
_MASKED: Final = 0x80
_BRACE: Final = ord("{")
_MEDIUM: Final = 126
# Payload lengths from which on headers are longer.
_LONG: Final = 1 << 16
_MEDIUM_HEADER: Final = Struct("!BBH").pack
_LONG_HEADER: Final = Struct("!BBQ").pack
# Length in bytes of the longest header that `only_message` reads; shorter data is left to the other functions.
_LONGEST_HEADER: Final = 8
# First bytes of valid frames: with or without FIN, no reserved bit, a defined opcode.
_SOUND: Final = frozenset(end | opcode for end in (0, 0x80) for opcode in (0, 1, 2, 8, 9, 10))
_KEPT_HEADERS: Final = 4096
# Number of masking keys generated at once.
_KEYS: Final = 1024

UNKNOWN: Final = 0
"""Result of `frame_end` for a frame whose header is incomplete."""
UNSOUND: Final = -1
"""Result of `frame_end` for an invalid or too large frame, which `websockets` must refuse."""


def whole_messages(
    data: bytes, at: int, *, masked: bool, largest: int, count: int = sys.maxsize
) -> tuple[list[bytes], int]:
    """Read consecutive single-frame messages, up to the first frame that is incomplete or of another kind.

    Args:
        data: bytes from the socket.
        at: index in `data` at which a frame begins.
        masked: whether the peer is a client. Clients mask their frames.
        largest: maximum size of a message in bytes. Reading stops at a larger message.
        count: maximum number of messages to read.

    Returns:
        The payloads, and the index at which the reading ended. `frame_end` can examine the frame at this index.
    """
    found: list[bytes] = []
    take, unmask = found.append, apply_mask
    size = len(data)
    bit, key = (_MASKED, 4) if masked else (0, 0)
    while at < size - 1 and count > 0:
        # A wrong mask bit makes the length 128 or more, which ends the loop below.
        length = data[at + 1] ^ bit
        if data[at] not in _WHOLE or length >= _MASKED:
            break
        if length < _MEDIUM:
            body = at + 2 + key
        elif length == _MEDIUM:
            body = at + 4 + key
            if body > size:
                break
            length = data[at + 2] << 8 | data[at + 3]
        else:
            body = at + 10 + key
            if body > size:
                break
            length = int.from_bytes(data[at + 2 : at + 10], "big")
        end = body + length
        if end > size or length > largest:
            break
        # The masking key is in the four bytes before the payload.
        take(unmask(data[body:end], data[body - 4 : body]) if masked else data[body:end])
        at = end
        count -= 1
    return found, at


def only_message(data: bytes, *, masked: bool, largest: int) -> bytes | None:
    """Return the payload if the data is exactly one single-frame message of usual size, otherwise None.

    The function is faster than `whole_messages`. It reads no messages of 64 KiB or more, and no data of less than
    8 bytes.
    """
    size = len(data)
    if size < _LONGEST_HEADER or data[0] not in _WHOLE:
        return None
    length, body = data[1] ^ _MASKED if masked else data[1], 2
    if length == _MEDIUM:
        length, body = data[2] << 8 | data[3], 4
    elif length > _MEDIUM:
        return None
    if masked:
        body += 4
    if body + length != size or length > largest:
        return None
    return apply_mask(data[body:], data[body - 4 : body]) if masked else data[body:]


def frame_end(data: bytes, at: int, *, masked: bool, largest: int) -> int:
    """Find the end of the frame that begins at `at`.

    Returns:
        The index after the frame. If the frame is incomplete, this index is beyond `data`. The result is `UNKNOWN`
        if the frame's header is incomplete. The result is `UNSOUND` if the frame is invalid, or if its payload has
        more than `largest` bytes. Pass an unsound frame to `websockets` at once, even if the frame is incomplete. The
        library then refuses the frame.
    """
    size = len(data)
    if size < at + 2:
        return UNKNOWN
    second = data[at + 1]
    if data[at] not in _SOUND or (second >= _MASKED) is not masked:
        return UNSOUND
    length, body = second & 0x7F, at + 2
    if length >= _MEDIUM:
        body += 2 if length == _MEDIUM else 8
        if body > size:
            return UNKNOWN
        length = int.from_bytes(data[at + 2 : body], "big")
    if length > largest:
        return UNSOUND
    return body + (4 if masked else 0) + length


def unmasked(payloads: Sequence[bytes]) -> bytes:
    """Return a server's unmasked frames, one for each message: text frames for JSON objects, binary frames for CBOR."""
    parts: list[bytes] = []
    for payload in payloads:
        headers = _TEXT_HEADERS if payload[0] == _BRACE else _BINARY_HEADERS
        parts += headers[len(payload)], payload
    return b"".join(parts)


class Masker:
    """Encoder of a client's frames. Each frame contains a whole text message, and is masked with a new key."""

    def __init__(self) -> None:
        self._keys: list[bytes] = []

    def encode(self, payloads: Sequence[bytes]) -> bytes:
        """Return the frames of the messages."""
        keys = self._keys
        # One system call for many keys: each takes longer than masking a small message.
        if len(keys) < len(payloads):
            keys += mask_keys(max(_KEYS, len(payloads)))
        if len(payloads) == 1:  # in half the time
            payload, key = payloads[0], keys.pop()
            return _MASKED_HEADERS[len(payload)] + key + apply_mask(payload, key)
        parts: list[bytes] = []
        for payload in payloads:
            key = keys.pop()
            parts += _MASKED_HEADERS[len(payload)], key, apply_mask(payload, key)
        return b"".join(parts)


def mask_keys(count: int) -> list[bytes]:
    """Return new unpredictable masking keys."""
    drawn = os.urandom(4 * count)
    return [drawn[at : at + 4] for at in range(0, 4 * count, 4)]


class _Headers(dict[int, bytes]):
    """The headers of frames, without the masking key, by the lengths of the payloads."""

    def __init__(self, first: int, mask_bit: int) -> None:
        super().__init__()
        self._first = first
        self._mask_bit = mask_bit

    def __missing__(self, length: int) -> bytes:
        if length < _MEDIUM:
            header = bytes((self._first, self._mask_bit | length))
        elif length < _LONG:
            header = _MEDIUM_HEADER(self._first, self._mask_bit | _MEDIUM, length)
        else:
            header = _LONG_HEADER(self._first, self._mask_bit | (_MEDIUM + 1), length)
        if len(self) < _KEPT_HEADERS:
            self[length] = header
        return header


_TEXT_HEADERS: Final = _Headers(_TEXT, 0)
_BINARY_HEADERS: Final = _Headers(_BINARY, 0)
_MASKED_HEADERS: Final = _Headers(_TEXT, _MASKED)


def is_impossible(header: bytes) -> bool:
    """Return whether a frame's length is 2**63 or more, which RFC 6455 (5.2) forbids."""
    return len(header) > 2 and header[1] & ~_MASKED == _MEDIUM + 1 and header[2] >= 0x80
