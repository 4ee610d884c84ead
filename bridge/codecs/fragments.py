"""Fragments: a message that is too large for one piece, cut into pieces and put together again.

A fragment is ``{"op": "fragment", "id": ..., "data": ..., "num": ..., "total": ...}``; the ``data`` of a message's
fragments, one after the other in the order of ``num``, are its JSON. Servers differ (``docs/rosbridge-differences.md``):
``num`` counts from 0 or from 1, ``total`` may be a float that is no whole number, either may be a string, ids are
strings or integers and are used again. All that is taken; what no message can come of is refused or forgotten:
the sets that wait for more are bounded in number, in bytes and in time.
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import orjson

from bridge.codecs.json_codec import MAX_SIZE
from bridge.errors import DecodeError

#: Messages that may be incomplete at once; then the one that began first is given up.
MAX_SETS: Final = 16
#: Fragments of one message at most.
MAX_FRAGMENTS: Final = 1 << 16
#: Seconds after which a message that no further fragment came of is given up.
MAX_AGE: Final = 10.0
#: Bytes that keeping a fragment takes beyond its data, at least: empty ones count too.
_OVERHEAD: Final = 128
#: Characters of a text that is a number, and of an id.
_LONGEST: Final = 1024

_DIGITS = re.compile(r"[0-9]{1,9}(?:\.[0-9]{0,9})?")

FragmentId = str | int


@dataclass(slots=True)
class _Set:
    """The fragments of one message so far."""

    total: int
    touched: float
    parts: dict[int, str] = field(default_factory=dict)
    size: int = 0
    charged: int = 0


class Reassembler:
    """Puts messages together, for one connection. It reads no clock: whoever calls it does.

    Attributes:
        given_up: how many messages were begun and will never be complete.
    """

    def __init__(
        self, *, max_size: int = MAX_SIZE, max_sets: int = MAX_SETS, max_age: float = MAX_AGE
    ) -> None:
        """Bound what may wait.

        Args:
            max_size: characters of a complete message at most; all incomplete ones together may take four
                times as many bytes, with what keeping them takes.
            max_sets: messages that may be incomplete at once.
            max_age: seconds that a message waits for its next fragment.
        """
        self.given_up = 0
        self._max_size = max_size
        self._max_sets = max_sets
        self._max_age = max_age
        self._sets: dict[FragmentId, _Set] = {}  # in the order in which they began
        self._charged = 0

    def __len__(self) -> int:
        """How many messages are incomplete."""
        return len(self._sets)

    @property
    def waiting_bytes(self) -> int:
        """Bytes that incomplete messages take."""
        return self._charged

    def take(self, fragment: Mapping[str, Any], now: float) -> str | None:
        """Take one fragment.

        Args:
            fragment: the operation.
            now: seconds of any clock that never goes back.

        Returns:
            The message that it completes; None if there is more to come, or the fragment was there before.

        Raises:
            DecodeError: it is no fragment, or it belongs to a message that is too large or makes no sense,
                which is given up.
        """
        key, data, number, total = _read(fragment)
        self.forget_old(now)
        begun = self._sets.get(key)
        if begun is not None and (begun.total != total or begun.parts.get(number, data) != data):
            # Ids are used again: this is another message, and the one before will never be complete.
            self._give_up(key)
            begun = None
        if begun is None:
            if total == 1:
                return self._checked(data)
            while len(self._sets) >= self._max_sets:
                self._give_up(next(iter(self._sets)))
            begun = self._sets[key] = _Set(total, now)
        elif number in begun.parts:
            begun.touched = now
            return None
        begun.touched = now
        begun.parts[number] = data
        size = len(data)
        begun.size += size
        begun.charged += size + _OVERHEAD
        self._charged += size + _OVERHEAD
        if begun.size > self._max_size:
            self._give_up(key)
            raise DecodeError(f"a message in fragments has more than {self._max_size} characters")
        if len(begun.parts) == total:
            return self._join(key, begun)
        while self._charged > 4 * (self._max_size + _OVERHEAD):
            first = next(iter(self._sets))
            self._give_up(first)
            if first == key:
                raise DecodeError("a message came in too many small fragments")
        return None

    def forget_old(self, now: float) -> None:
        """Give up the messages that no fragment came of for too long."""
        if self._sets:
            for key in [key for key, begun in self._sets.items() if now - begun.touched > self._max_age]:
                self._give_up(key)

    def clear(self) -> None:
        """Forget everything: the connection is gone."""
        self._sets.clear()
        self._charged = 0

    def _join(self, key: FragmentId, begun: _Set) -> str:
        first = 0 if 0 in begun.parts else 1
        self._forget(key)
        try:
            message = "".join([begun.parts[number] for number in range(first, first + begun.total)])
        except KeyError:
            self.given_up += 1
            raise DecodeError(
                f"the fragments of a message are not numbered from 0 or 1 to {begun.total}"
            ) from None
        return self._checked(message)

    def _checked(self, message: str) -> str:
        if len(message) > self._max_size:
            raise DecodeError(f"a message in fragments has more than {self._max_size} characters")
        return message

    def _forget(self, key: FragmentId) -> None:
        self._charged -= self._sets.pop(key).charged

    def _give_up(self, key: FragmentId) -> None:
        self._forget(key)
        self.given_up += 1


def split(message: bytes, fragment_size: int, fragment_id: FragmentId) -> Iterator[bytes]:
    """Cut a message into fragments.

    Args:
        message: an operation as JSON.
        fragment_size: characters of the message in one fragment at most.
        fragment_id: names the message: no other that is on its way may have it.

    Yields:
        The message itself if it fits into one, else its fragments as JSON, in order, numbered from 0.
    """
    text = message.decode()
    if len(text) <= fragment_size:
        yield message
        return
    total = -(-len(text) // fragment_size)
    for number in range(total):
        data = text[number * fragment_size : (number + 1) * fragment_size]
        yield orjson.dumps({"op": "fragment", "id": fragment_id, "data": data, "num": number, "total": total})


def _read(fragment: Mapping[str, Any]) -> tuple[FragmentId, str, int, int]:
    """Id, data, number and total of a fragment."""
    key, data = fragment.get("id"), fragment.get("data")
    if isinstance(key, bool) or not isinstance(key, str | int) or len(str(key)[: _LONGEST + 1]) > _LONGEST:
        raise DecodeError("a fragment has an id that is neither a short text nor a whole number")
    if not isinstance(data, str):
        raise DecodeError("a fragment has data that is no text")
    number, total = _number(fragment.get("num")), _number(fragment.get("total"))
    # The reference server says (length - 1) / size + 1 and forgets to round down: 3.36 are 3 fragments.
    whole = math.floor(total) if total is not None else 0
    if number is None or number != math.floor(number) or not 1 <= whole <= MAX_FRAGMENTS or number > whole:
        shown = ", ".join(f"{name} {str(fragment.get(name))[:20]}" for name in ("num", "total"))
        raise DecodeError(f"a fragment is numbered as none can be ({shown})")
    return key, data, int(number), whole


def _number(value: object) -> float | None:
    """A number from 0 up, also one that came as text."""
    if isinstance(value, str) and _DIGITS.fullmatch(value):
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1e9:
        return None
    return value
