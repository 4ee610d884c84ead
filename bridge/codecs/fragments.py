r"""Fragments of large messages: splitting and reassembly.

    {"op":"fragment","id":"7","data":"{\"op\":\"publ","num":0,"total":2}
    {"op":"fragment","id":"7","data":"ish\",...}","num":1,"total":2}

A message's JSON is the `data` of its fragments, concatenated in the order of `num`. This module accepts the
different forms that servers send (`docs/reference/rosbridge-differences.md`):

- `num` counts from 0 or from 1.
- `total` is an integer, or a float that may have a fraction.
- `num` and `total` may be strings.
- An id is a string or an integer. Servers reuse ids.

Fragments that cannot form a message are refused. Limits bound the number of incomplete messages, their bytes
and their age.
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import orjson

from bridge.codecs.json_codec import MAX_SIZE
from bridge.errors import DecodeError

MAX_SETS: Final = 16
"""Maximum number of incomplete messages. A further message replaces the oldest."""
MAX_FRAGMENTS: Final = 1 << 16
"""Maximum number of fragments in a message."""
MAX_AGE: Final = 10.0
"""An incomplete message is discarded if no fragment of it arrives for this many seconds."""
OVERHEAD: Final = 128
"""Number of bytes added to the size of each stored fragment, so that empty fragments count too."""
_LONGEST_ID: Final = 1024
# Value and mask of UTF-8 bytes inside a character.
_CONTINUATION: Final = 0x80, 0xC0

_DIGITS = re.compile(r"[0-9]{1,9}(?:\.[0-9]{0,9})?")

FragmentId = str | int


@dataclass(slots=True)
class _Set:
    """The fragments of one incomplete message."""

    total: int
    # Time of its last fragment.
    touched: float
    # By number, as the sender counts, from 0 or from 1.
    parts: dict[int, bytes] = field(default_factory=dict)
    # Number of bytes in `parts`.
    size: int = 0

    @property
    def charged(self) -> int:
        """Number of bytes that the fragments occupy, with `OVERHEAD` for each."""
        return self.size + OVERHEAD * len(self.parts)


class Reassembler:
    """Reassembly of the fragmented messages of one connection. Callers pass the current time."""

    def __init__(self, *, max_size: int = MAX_SIZE) -> None:
        """Start without fragments.

        `max_size` is the maximum size of a complete message in bytes. All incomplete messages together may occupy about
        four times as many bytes. Each fragment counts with its size plus `OVERHEAD` bytes.
        """
        self.waiting_bytes = 0
        """Number of bytes that all incomplete messages occupy, with `OVERHEAD` for each fragment."""
        self._max_size = max_size
        self._sets: dict[FragmentId, _Set] = {}  # in the order of their first fragments

    def __len__(self) -> int:
        """Return the number of incomplete messages."""
        return len(self._sets)

    @property
    def deadline(self) -> float:
        """Time at which to call `expire`, or infinity if no message is incomplete."""
        return min((begun.touched for begun in self._sets.values()), default=math.inf) + MAX_AGE

    def take(self, fragment: Mapping[str, Any], now: float) -> bytes | None:
        """Add one fragment at the time `now`, in seconds of any monotonic clock.

        Returns the complete message, or None if fragments are missing or `fragment` is a duplicate.

        Raises:
            DecodeError: `fragment` is malformed, or its message is too large or inconsistent and was discarded.
        """
        key, data, number, total = _read(fragment)
        self.expire(now)
        begun = self._sets.get(key)
        if begun is not None and (begun.total != total or begun.parts.get(number, data) != data):
            self._forget(key)  # the id was reused: the previous message will never be complete
            begun = None
        if begun is None:
            if total == 1:
                return self._checked(data)
            # The oldest is dropped, so that a restarted client is not locked out by messages that it never completed.
            while len(self._sets) >= MAX_SETS:
                self._forget(next(iter(self._sets)))
            begun = self._sets[key] = _Set(total, now)
        # A duplicate counts too: it shows that the sender has not given up.
        begun.touched = now
        if number in begun.parts:
            return None
        begun.parts[number] = data
        begun.size += len(data)
        self.waiting_bytes += len(data) + OVERHEAD
        if begun.size > self._max_size:
            self._forget(key)
        self._checked(data, begun.size)
        if len(begun.parts) == total:
            return self._join(key, begun)
        # The message itself may be the oldest, if its fragments are so small that their overhead exceeds the bound.
        while self.waiting_bytes > 4 * (self._max_size + OVERHEAD):
            oldest = next(iter(self._sets))
            self._forget(oldest)
            if oldest == key:
                raise DecodeError("a message arrived in too many small fragments")
        return None

    def expire(self, now: float) -> None:
        """Discard each message that has not received a fragment for `MAX_AGE` seconds."""
        for key in [key for key, begun in self._sets.items() if begun.touched + MAX_AGE <= now]:
            self._forget(key)

    def clear(self) -> None:
        """Drop everything, because the connection is lost."""
        self._sets.clear()
        self.waiting_bytes = 0

    def _join(self, key: FragmentId, begun: _Set) -> bytes:
        # Servers number from 0 or from 1; as many parts as `total` are complete in one of the two ways.
        first = 0 if 0 in begun.parts else 1
        self._forget(key)
        try:
            return b"".join([begun.parts[number] for number in range(first, first + begun.total)])
        except KeyError:
            raise DecodeError(
                f"fragments arrived that are not numbered from 0 or 1 to {begun.total}"
            ) from None

    def _checked(self, data: bytes, size: int | None = None) -> bytes:
        if (len(data) if size is None else size) > self._max_size:
            raise DecodeError(f"a message in fragments has more than {self._max_size} bytes")
        return data

    def _forget(self, key: FragmentId) -> None:
        self.waiting_bytes -= self._sets.pop(key).charged


def split(message: bytes, fragment_size: int, fragment_id: FragmentId) -> Iterator[bytes]:
    """Split the JSON of an operation into fragments.

    A fragment contains at most `fragment_size` bytes of the JSON. If a single character has more bytes than that, the
    fragment contains the whole character.

    Yields:
        The message itself if it fits into one fragment. Otherwise the fragments as JSON, numbered from 0.
    """
    if len(message) <= fragment_size:
        yield message
        return
    ends = list(_ends(message, fragment_size))
    begin = 0
    for number, end in enumerate(ends):
        data = message[begin:end].decode()
        begin = end
        yield orjson.dumps(
            {"op": "fragment", "id": fragment_id, "data": data, "num": number, "total": len(ends)}
        )


def _ends(message: bytes, fragment_size: int) -> Iterator[int]:
    """Yield the index in `message` at which each fragment ends, never inside a character."""
    inside, mask = _CONTINUATION
    begin = 0
    while begin < len(message):
        end = min(begin + fragment_size, len(message))
        # Back to the beginning of a character, because each fragment is a text of its own.
        while end < len(message) and message[end] & mask == inside:
            end -= 1
        if end == begin:  # a character with more bytes than a fragment
            end += 1
            while end < len(message) and message[end] & mask == inside:
                end += 1
        yield end
        begin = end


def _read(fragment: Mapping[str, Any]) -> tuple[FragmentId, bytes, int, int]:
    """Read the id, data, number and total of a fragment."""
    key, data = fragment.get("id"), fragment.get("data")
    if (
        isinstance(key, bool)
        or not isinstance(key, str | int)
        or len(str(key)[: _LONGEST_ID + 1]) > _LONGEST_ID
    ):
        raise DecodeError("a fragment arrived whose id is neither a short string nor an integer")
    if not isinstance(data, str):
        raise DecodeError("a fragment arrived whose data is not a string")
    number, total = _number(fragment.get("num")), _number(fragment.get("total"))
    # The reference server computes (length - 1) / size + 1 without rounding down: 3.36 means 3 fragments.
    whole = math.floor(total) if total is not None else 0
    if number is None or number != math.floor(number) or not 1 <= whole <= MAX_FRAGMENTS or number > whole:
        shown = ", ".join(f"{name} {str(fragment.get(name))[:20]}" for name in ("num", "total"))
        raise DecodeError(f"a fragment arrived with an impossible number or total ({shown})")
    try:
        return key, data.encode(), int(number), whole
    except UnicodeEncodeError:
        raise DecodeError("a fragment arrived whose data is not Unicode text") from None


def _number(value: object) -> float | None:
    """Read a non-negative number, also from a string."""
    if isinstance(value, str) and _DIGITS.fullmatch(value):
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1e9:
        return None
    return value
