"""WebSocket frames at speed: whole messages in and out; everything else is the library's to judge.

Nearly all that is said over a rosbridge connection is one unfragmented message after another. `whole_messages` finds
these in the bytes of a socket; whatever is anything else (control frames, fragments, broken ones) is handed on to the
sans-I/O protocol of ``websockets`` as it is, which stands between two frames all the time.

Source: RFC 6455, sections 5.2, 5.3 and 10.3.
"""

import os
import sys
from collections.abc import Iterable, Iterator
from functools import lru_cache
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
#: Payloads from these lengths on have a longer header.
_MEDIUM: Final = 126
_LONG: Final = 1 << 16
_MEDIUM_HEADER: Final = Struct("!BBH").pack
_LONG_HEADER: Final = Struct("!BBQ").pack
#: The longest header of the frames that `only_message` takes: less is left to the others.
_LONGEST_QUICK: Final = 8
#: First bytes of frames that a peer may send: an end or not, no reserved bit, an opcode that there is.
_SOUND: Final = frozenset(end | opcode for end in (0, 0x80) for opcode in (0, 1, 2, 8, 9, 10))
#: Keys that are drawn at once.
_KEYS: Final = 1024

#: Instead of a frame's end: not enough of its header has come; it is for the library to refuse.
UNKNOWN: Final = 0
UNSOUND: Final = -1


def whole_messages(
    data: bytes, at: int, *, masked: bool, largest: int, count: int = sys.maxsize, until: int = sys.maxsize
) -> tuple[list[bytes], int]:
    """Take the messages that begin at ``at``, each whole in one frame, up to whatever else there is.

    Args:
        data: what came.
        at: where a frame begins in it.
        masked: whether the peer is a client, which masks its frames, or a server, which does not.
        largest: bytes of one message at most; what is larger is something else.
        count: messages to take at most.
        until: where none is to begin any more.

    Returns:
        The payloads, and where the first frame begins that is something else (`frame_end` tells more of it), or
        is not complete yet; the length of ``data`` if there is none.
    """
    found: list[bytes] = []
    take, unmask = found.append, apply_mask
    size = len(data)
    last = min(size - 1, until)
    bit, key = (_MASKED, 4) if masked else (0, 0)
    while at < last and count > 0:
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
        take(unmask(data[body:end], data[body - 4 : body]) if masked else data[body:end])
        at = end
        count -= 1
    return found, at


def only_message(data: bytes, *, masked: bool, largest: int) -> bytes | None:
    """The payload, if what came is one whole message in one frame and nothing else; it says so quickly.

    Args:
        data: what came.
        masked: whether the peer is a client.
        largest: bytes of the message at most.
    """
    size = len(data)
    if size < _LONGEST_QUICK or data[0] not in _WHOLE:
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
    """Where the frame ends that begins at ``at``: beyond the end of ``data`` while it is not complete.

    Returns:
        The end; `UNKNOWN` while its header is not complete; `UNSOUND` if the peer may send no such frame, or none of
        more than ``largest`` bytes: then the library must see at once all that has come.
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


def unmasked(payloads: Iterable[bytes]) -> bytes:
    """A server's frames of whole messages: text for JSON, binary for CBOR."""
    parts: list[bytes] = []
    for payload in payloads:
        parts += _header(payload[0] == _BRACE, len(payload)), payload
    return b"".join(parts)


@lru_cache(maxsize=4096)
def _header(is_text: bool, length: int) -> bytes:
    """The beginning of an unmasked frame."""
    first = _TEXT if is_text else _BINARY
    if length < _MEDIUM:
        return bytes((first, length))
    if length < _LONG:
        return _MEDIUM_HEADER(first, _MEDIUM, length)
    return _LONG_HEADER(first, _MEDIUM + 1, length)


def masked_text(payload: bytes, key: bytes) -> bytes:
    """A client's frame of a whole text message, masked with ``key``."""
    length = len(payload)
    if length < _MEDIUM:
        begin = bytes((_TEXT, _MASKED | length))
    elif length < _LONG:
        begin = _MEDIUM_HEADER(_TEXT, _MASKED | _MEDIUM, length)
    else:
        begin = _LONG_HEADER(_TEXT, _MASKED | (_MEDIUM + 1), length)
    return b"".join((begin, key, apply_mask(payload, key)))


def mask_keys() -> Iterator[bytes]:
    """Keys for one connection's frames, without end: no one can foresee them, each is used once."""
    while True:
        drawn = os.urandom(4 * _KEYS)
        for at in range(0, len(drawn), 4):
            yield drawn[at : at + 4]
