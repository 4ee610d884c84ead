"""The queue of output for one client: ordered, bounded, and throttled if requested.

The owner of the socket drains the outbox as fast as the socket accepts data. While the socket accepts no data,
newer messages of a topic replace older messages in the outbox. A slow client does not slow down other clients.
Answers and requests of services are never dropped. If they exceed the bound, the client has *overflowed*.

Dropping a message only empties its entry in the queue, so it is as fast as sending. If a client requested
fragments, each message is queued whole. The message counts towards the bound until its last fragment is sent.
"""

import itertools
from collections import deque
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Final

from bridge.codecs.fragments import split

if TYPE_CHECKING:
    from collections.abc import Iterator

# Number of gaps by which a queue may exceed its messages before it is packed.
_GAPS: Final = 64
_BRACE: Final = ord("{")


def is_text(payload: bytes) -> bool:
    """Return whether a payload is JSON and not CBOR. A JSON payload begins with a brace, and a CBOR map does not."""
    return payload[0] == _BRACE


@dataclass(eq=False, slots=True)
class _Entry:
    """One message in the queue, or the gap that a dropped message leaves (a `payload` of None)."""

    payload: bytes | None
    lane: "Lane | None"
    fragment_size: int


class Lane:
    """The queued messages of one subscription, in the outbox of its client. Only the outbox changes a lane."""

    __slots__ = ("dropped", "fragment_size", "held", "next_time", "queue_length", "queued", "throttle")

    def __init__(self, queue_length: int = 1) -> None:
        self.throttle = 0.0
        """Minimum seconds between two messages, 0 for none."""
        self.queue_length = queue_length
        """Maximum number of queued messages; with a throttle, 0 drops messages that come too early."""
        self.fragment_size = 0
        """Maximum bytes of a message in one fragment, 0 for whole messages."""
        self.next_time = -inf
        """Time at which the throttle admits the next message (monotonic seconds)."""
        self.queued: deque[_Entry] = deque()
        """Messages that wait for the socket."""
        self.held: deque[bytes] = deque()
        """Messages that wait for the throttle."""
        self.dropped = 0
        """Messages dropped because the client or its throttle was slower than the topic."""


class Outbox:
    """The queue of output for one client."""

    __slots__ = (
        "_cutting",
        "_droppable",
        "_entries",
        "_fragments",
        "_gaps",
        "_holding",
        "_largest",
        "_max_bytes",
        "_numbers",
        "deadline",
        "overflowed",
        "size",
        "undroppable",
        "wire",
    )

    def __init__(self, max_bytes: int, largest: int = 0) -> None:
        """Bound the queue to `max_bytes` bytes. `largest` is the maximum size of a single answer in bytes."""
        self._max_bytes = max_bytes
        self._largest = largest
        # All queued messages in order. `_droppable` and each lane's `queued` have the same entries of topics, in the
        # same order, so that the oldest of all or of one lane is found at once.
        self._entries: deque[_Entry] = deque()
        self._droppable: deque[_Entry] = deque()
        # Entries without a payload in `_entries`, left by dropped messages.
        self._gaps = 0
        # The lanes with held messages, for `release`.
        self._holding: set[Lane] = set()
        # The rest of the message that is being sent in fragments, whose bytes (`_cutting`) count until the last one.
        self._fragments: Iterator[bytes] | None = None
        self._cutting = 0
        # Ids of fragmented messages.
        self._numbers = itertools.count(1)
        self.wire: list[bytes] | None = None
        """Payloads for the socket in this turn; None while the socket accepts nothing and everything is queued."""
        self.size = 0
        """Bytes in the queue."""
        self.undroppable = 0
        """Bytes of answers and requests in the queue."""
        self.overflowed = False
        """True if output that cannot be dropped exceeds the bound: the client does not read its answers."""
        self.deadline = inf
        """Time at which to call `release` next (monotonic seconds), infinity for never."""

    def __len__(self) -> int:
        return len(self._entries) - self._gaps

    @property
    def empty(self) -> bool:
        """Return whether nothing is queued for the socket."""
        return not self._entries and self._fragments is None

    @property
    def congested(self) -> bool:
        """Return whether one more answer could exceed the bound. If so, the client must first read earlier answers."""
        return self.undroppable > 0 and self.undroppable + self._largest > self._max_bytes

    def put(self, payload: bytes, fragment_size: int = 0) -> None:
        """Queue an answer or a request of a service or an action. If the queue has no room, set `overflowed`."""
        if self._bypass(payload, fragment_size):
            return
        # Messages of topics are dropped for an answer, never the reverse.
        if self._make_room(len(payload)):
            self._entries.append(_Entry(payload, None, fragment_size))
            self.size += len(payload)
            self.undroppable += len(payload)
        else:
            self.overflowed = True

    def offer(self, lane: Lane, payload: bytes, now: float) -> None:
        """Queue a topic's message, hold it until the lane's throttle admits it, or drop it."""
        if lane.throttle:
            # A message must not overtake the ones that are held.
            if now < lane.next_time or lane.held:
                if lane.queue_length:
                    self._hold(lane, payload)
                return
            lane.next_time = now + lane.throttle
        wire = self.wire  # `_bypass` inlined, because most messages take this path
        if wire is None or lane.fragment_size or self._entries or self._fragments is not None:
            self._queue(lane, payload)
        else:
            wire.append(payload)

    def offer_all(self, lane: Lane, payloads: list[bytes], now: float) -> None:
        """Offer each message of a list. While the socket accepts data, this is hardly slower than a single `offer`."""
        if self.wire is None or lane.throttle or lane.fragment_size or not self.empty:
            for payload in payloads:
                self.offer(lane, payload, now)
        else:
            self.wire += payloads

    def pop(self) -> bytes | None:
        """Remove and return the next message or fragment for the socket, or None if nothing is queued."""
        if self._fragments is not None:
            fragment = next(self._fragments, None)
            if fragment is not None:
                return fragment
            self._fragments = None
            self.size -= self._cutting
        while self._entries:
            entry = self._entries.popleft()
            payload = entry.payload
            if payload is None:
                self._gaps -= 1
                continue
            if entry.lane is None:
                self.undroppable -= len(payload)
            else:
                entry.lane.queued.popleft()  # this entry, because a lane has the outbox's order
                entry.payload = None
                # Dropped and sent entries stay in `_droppable` until they are first, which keeps both operations cheap.
                while self._droppable and self._droppable[0].payload is None:
                    self._droppable.popleft()
            if entry.fragment_size:
                self._fragments = split(payload, entry.fragment_size, f"hub:{next(self._numbers)}")
                self._cutting = len(payload)
                return next(self._fragments)
            self.size -= len(payload)
            return payload
        return None

    def accepts(self, lane: Lane, now: float) -> bool:
        """Return whether `offer` would keep a message now. Otherwise the caller need not encode the message."""
        return not lane.throttle or bool(lane.queue_length) or (now >= lane.next_time and not lane.held)

    def release(self, now: float) -> None:
        """Queue the held messages that the throttles of their lanes admit at `now`, at most one for each lane."""
        for lane in [lane for lane in self._holding if lane.next_time <= now]:
            lane.next_time = now + lane.throttle
            self._deliver(lane, self._take_held(lane))
        self.deadline = min((lane.next_time for lane in self._holding), default=inf)

    def adjust(self, lane: Lane, throttle: float, queue_length: int) -> None:
        """Change a lane's throttle and queue length.

        If the new throttle is 0, all held messages are queued. Messages beyond the new length are dropped, the oldest
        first.
        """
        # The throttle would have admitted the next message one old interval after the last one; now one new interval.
        lane.next_time += throttle - lane.throttle
        lane.throttle, lane.queue_length = throttle, queue_length
        while lane.held and not throttle:
            self._deliver(lane, self._take_held(lane))
        while len(lane.held) > queue_length:
            self._take_held(lane)
            lane.dropped += 1
        self._shorten(lane, max(queue_length, 1))
        if lane.held:
            self.deadline = min(self.deadline, lane.next_time)

    def forget(self, lane: Lane) -> None:
        """Drop all messages of a lane, because its subscription has ended."""
        while lane.queued:
            self._drop_queued(lane)
        while lane.held:
            self._take_held(lane)

    def _bypass(self, payload: bytes, fragment_size: int) -> bool:
        """Append a payload to `wire` and return True, if nothing waits before it and the socket accepts data."""
        if self.wire is None or fragment_size or self._entries or self._fragments is not None:
            return False
        self.wire.append(payload)
        return True

    def _deliver(self, lane: Lane, payload: bytes) -> None:
        if not self._bypass(payload, lane.fragment_size):
            self._queue(lane, payload)

    def _queue(self, lane: Lane, payload: bytes) -> None:
        self._shorten(lane, max(lane.queue_length, 1) - 1)  # with a throttle, 0 means one at a time
        if not self._make_room(len(payload)):
            lane.dropped += 1
            return
        entry = _Entry(payload, lane, lane.fragment_size if is_text(payload) else 0)
        for queue in (self._entries, self._droppable, lane.queued):
            queue.append(entry)
        self.size += len(payload)

    def _hold(self, lane: Lane, payload: bytes) -> None:
        while len(lane.held) >= lane.queue_length:
            self._take_held(lane)
            lane.dropped += 1
        if not self._make_room(len(payload)):
            lane.dropped += 1
            return
        lane.held.append(payload)
        self.size += len(payload)
        self._holding.add(lane)
        self.deadline = min(self.deadline, lane.next_time)

    def _shorten(self, lane: Lane, length: int) -> None:
        while len(lane.queued) > length:
            self._drop_queued(lane)
            lane.dropped += 1

    def _drop_queued(self, lane: Lane) -> None:
        """Leave a gap in place of the lane's oldest queued message."""
        entry = lane.queued.popleft()
        self.size -= len(entry.payload or b"")
        entry.payload = None
        self._gaps += 1
        # Packing takes time in proportion to the queue, so it waits until there are as many gaps as messages.
        if self._gaps > _GAPS + len(self):
            self._entries = deque(entry for entry in self._entries if entry.payload is not None)
            self._droppable = deque(entry for entry in self._droppable if entry.payload is not None)
            self._gaps = 0

    def _take_held(self, lane: Lane) -> bytes:
        payload = lane.held.popleft()
        self.size -= len(payload)
        if not lane.held:
            self._holding.discard(lane)
        return payload

    def _make_room(self, size: int) -> bool:
        """Drop the oldest messages of topics until `size` more bytes fit; return False if they cannot."""
        while self.size + size > self._max_bytes and self._droppable:
            entry = self._droppable.popleft()
            if entry.payload is not None and entry.lane is not None:
                self._drop_queued(entry.lane)
                entry.lane.dropped += 1
        while self.size + size > self._max_bytes and self._holding:
            lane = next(iter(self._holding))
            self._take_held(lane)
            lane.dropped += 1
        return self.size + size <= self._max_bytes
