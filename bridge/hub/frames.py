"""WebSocket frames at the speed of the hub: whole messages in and out; everything else is the library's to judge.

Nearly all that clients send is one unfragmented, masked message after another. `next_frame` finds these in the bytes of
a socket; whatever is anything else (control frames, fragments, broken ones) is handed on as it is.

Source: RFC 6455, sections 5.2 and 5.3.
"""

from typing import Final, NamedTuple

try:
    from websockets.speedups import apply_mask
except ImportError:  # a build of websockets without its C extension
    from websockets.utils import apply_mask

__all__ = ["Frame", "apply_mask", "header", "next_frame"]

_TEXT: Final = 0x81
_BINARY: Final = 0x82
_DATA: Final = (_TEXT, _BINARY)
_MASKED: Final = 0x80
_BRACE: Final = ord("{")
#: Payloads from these lengths on have a longer header.
_MEDIUM: Final = 126
_LONG: Final = 1 << 16


class Frame(NamedTuple):
    """Where a frame is in some bytes.

    Attributes:
        body: where its payload begins.
        end: where it ends; more than the bytes are long while it is not complete. 0 while its header is not.
        plain: whether it is a whole message, masked as it must be.
    """

    body: int
    end: int
    plain: bool


def next_frame(data: bytes | bytearray, at: int) -> Frame:
    """Find the frame that begins at ``at``."""
    size = len(data)
    if size - at < 2:
        return Frame(0, 0, False)
    first, second = data[at], data[at + 1]
    body = at + 2
    length = second & 0x7F
    if length == _MEDIUM:
        if size < at + 4:
            return Frame(0, 0, False)
        length = data[at + 2] << 8 | data[at + 3]
        body = at + 4
    elif length == _MEDIUM + 1:
        if size < at + 10:
            return Frame(0, 0, False)
        length = int.from_bytes(data[at + 2 : at + 10], "big")
        body = at + 10
    if second & _MASKED:
        body += 4
    return Frame(body, body + length, second & _MASKED != 0 and first in _DATA)


def header(payload: bytes) -> bytes:
    """The beginning of an unmasked frame of a whole message: text for JSON, binary for CBOR."""
    first = _TEXT if payload[0] == _BRACE else _BINARY
    length = len(payload)
    if length < _MEDIUM:
        return bytes((first, length))
    if length < _LONG:
        return bytes((first, _MEDIUM)) + length.to_bytes(2, "big")
    return bytes((first, _MEDIUM + 1)) + length.to_bytes(8, "big")
