"""What waits for one client: in order, bounded, each topic's oldest dropped first, throttled where asked.

A hub's outbox is emptied by whoever owns the socket, as fast as the socket takes it. While it takes nothing,
messages of topics replace their elders here and nothing else in the hub slows down. Answers and requests
of services are never dropped: a client that lets them pile up beyond the bound has *overflowed*.

A message that is dropped leaves a gap in its place, so that dropping costs as little as sending. What a client
wants in fragments waits whole, and is cut when its turn has come.
"""

import itertools
from collections import deque
from math import inf
from typing import TYPE_CHECKING, Final

from bridge.codecs.fragments import split

if TYPE_CHECKING:
    from collections.abc import Iterator

#: Gaps in a queue before it is packed, beyond as many as there are messages.
_GAPS: Final = 64
_BRACE: Final = ord("{")


def is_text(payload: bytes) -> bool:
    """Whether a payload is JSON, and not CBOR: its object begins with a brace, as no map of CBOR does."""
    return payload[0] == _BRACE


class _Entry:
    """One message in its place in the order, or a gap where one was (``payload`` is None)."""

    __slots__ = ("fragment_size", "lane", "payload")

    def __init__(self, payload: bytes, lane: "Lane | None", fragment_size: int) -> None:
        self.payload: bytes | None = payload
        self.lane = lane
        self.fragment_size = fragment_size


class Lane:
    """The way of one subscription's messages to its client. Only its outbox changes it.

    Attributes:
        throttle: seconds between two messages at least, 0 for none.
        queue_length: messages that may wait; with a throttle, 0 means that early ones are dropped.
        next_time: when the throttle lets the next message through (monotonic seconds).
        queued: its messages that wait for the socket.
        held: its messages that wait for its throttle.
        fragment_size: characters of one fragment of a message, 0 for messages in one piece.
        lost: messages dropped because the client (or its throttle) was slower than the topic.
    """

    __slots__ = ("fragment_size", "held", "lost", "next_time", "queue_length", "queued", "throttle")

    def __init__(self, queue_length: int = 1) -> None:
        self.throttle = 0.0
        self.queue_length = queue_length
        self.fragment_size = 0
        self.next_time = -inf
        self.queued: deque[_Entry] = deque()
        self.held: deque[bytes] = deque()
        self.lost = 0


class Outbox:
    """All that waits for one client.

    Attributes:
        size: bytes waiting.
        wire: where a payload goes at once when nothing waits before it; None while the socket takes nothing.
        overflowed: what cannot be dropped is more than ``max_bytes``: the client does not read its answers.
        deadline: when `release` has something to do (monotonic seconds), infinity for never.
    """

    __slots__ = (
        "_entries",
        "_fragments",
        "_gaps",
        "_holding",
        "_max_bytes",
        "_numbers",
        "deadline",
        "overflowed",
        "size",
        "wire",
    )

    def __init__(self, max_bytes: int) -> None:
        """Bound what may wait to ``max_bytes``."""
        self._max_bytes = max_bytes
        self._entries: deque[_Entry] = deque()
        self._gaps = 0
        self._holding: set[Lane] = set()
        self._fragments: Iterator[bytes] | None = None
        self._numbers = itertools.count(1)
        self.wire: list[bytes] | None = None
        self.size = 0
        self.overflowed = False
        self.deadline = inf

    def __len__(self) -> int:
        return len(self._entries) - self._gaps

    @property
    def empty(self) -> bool:
        """Whether nothing waits to be taken."""
        return not self._entries and self._fragments is None

    def put(self, payload: bytes, fragment_size: int = 0) -> None:
        """Queue what may not be lost: an answer or a request of a service or an action."""
        if self.wire is not None and not fragment_size and not self._entries and self._fragments is None:
            self.wire.append(payload)
            return
        if not self._make_room(len(payload)):
            self.overflowed = True
            return
        self._entries.append(_Entry(payload, None, fragment_size))
        self.size += len(payload)

    def offer(self, lane: Lane, payload: bytes, now: float) -> None:
        """Queue a message of a topic now, hold it until its throttle is over, or drop it.

        Args:
            lane: the subscription's.
            payload: what goes onto the wire.
            now: monotonic seconds.
        """
        if lane.throttle:
            if now < lane.next_time or lane.held:
                if lane.queue_length:
                    self._hold(lane, payload)
                return
            lane.next_time = now + lane.throttle
        # What `_queue` would do first, at once: most messages go this way.
        if self.wire is None or lane.fragment_size or self._entries or self._fragments is not None:
            self._queue(lane, payload)
        else:
            self.wire.append(payload)

    def pop(self) -> bytes | None:
        """Take the next message or fragment for the wire, None when there is none."""
        if self._fragments is not None:
            fragment = next(self._fragments, None)
            if fragment is not None:
                return fragment
            self._fragments = None
        entries = self._entries
        while entries:
            entry = entries.popleft()
            payload = entry.payload
            if payload is None:
                self._gaps -= 1
                continue
            if entry.lane is not None:
                entry.lane.queued.popleft()  # this very entry: a lane is in order as the outbox is
            self.size -= len(payload)
            if entry.fragment_size:
                # One by one: a mebibyte in pieces of 16 characters need not be there at once.
                self._fragments = split(payload, entry.fragment_size, f"hub:{next(self._numbers)}")
                return next(self._fragments)
            return payload
        return None

    def passes(self, lane: Lane, now: float) -> bool:
        """Whether `offer` would do anything but drop a message: what would not need not be encoded."""
        return not lane.throttle or bool(lane.queue_length) or (now >= lane.next_time and not lane.held)

    def release(self, now: float) -> None:
        """Queue what was held until ``now``, one message of each lane at most."""
        for lane in [lane for lane in self._holding if lane.next_time <= now]:
            lane.next_time = now + lane.throttle
            self._queue(lane, self._take_held(lane))
        self._find_deadline()

    def adjust(self, lane: Lane, throttle: float, queue_length: int) -> None:
        """Change a lane's throttle and length. What is held and need not be any more is queued."""
        lane.next_time += throttle - lane.throttle
        lane.throttle, lane.queue_length = throttle, queue_length
        while lane.held and not throttle:
            self._queue(lane, self._take_held(lane))
        while len(lane.held) > queue_length:
            self._take_held(lane)
            lane.lost += 1
        self._shorten(lane, max(queue_length, 1))
        self._find_deadline()

    def forget(self, lane: Lane) -> None:
        """Drop all of a subscription that is over."""
        while lane.queued:
            self._drop_queued(lane)
        while lane.held:
            self._take_held(lane)
        self._find_deadline()

    def _queue(self, lane: Lane, payload: bytes) -> None:
        if self.wire is not None and not lane.fragment_size and self.empty:
            self.wire.append(payload)
            return
        self._shorten(lane, max(lane.queue_length, 1) - 1)  # 0 with a throttle: one under way
        if not self._make_room(len(payload)):
            lane.lost += 1
            return
        entry = _Entry(payload, lane, lane.fragment_size if is_text(payload) else 0)
        self._entries.append(entry)
        lane.queued.append(entry)
        self.size += len(payload)

    def _hold(self, lane: Lane, payload: bytes) -> None:
        while len(lane.held) >= lane.queue_length:
            self._take_held(lane)
            lane.lost += 1
        if not self._make_room(len(payload)):
            lane.lost += 1
            return
        lane.held.append(payload)
        self.size += len(payload)
        self._holding.add(lane)
        self.deadline = min(self.deadline, lane.next_time)

    def _shorten(self, lane: Lane, length: int) -> None:
        while len(lane.queued) > length:
            self._drop_queued(lane)
            lane.lost += 1

    def _drop_queued(self, lane: Lane) -> None:
        """Leave a gap where the lane's oldest queued message was."""
        entry = lane.queued.popleft()
        self.size -= len(entry.payload or b"")
        entry.payload = None
        self._gaps += 1
        if self._gaps > _GAPS + len(self):
            self._entries = deque(entry for entry in self._entries if entry.payload is not None)
            self._gaps = 0

    def _take_held(self, lane: Lane) -> bytes:
        payload = lane.held.popleft()
        self.size -= len(payload)
        if not lane.held:
            self._holding.discard(lane)
        return payload

    def _make_room(self, size: int) -> bool:
        """Drop topics' oldest messages until ``size`` bytes more fit; False if they never will."""
        if self.size + size <= self._max_bytes:
            return True
        while self._entries and self._entries[0].payload is None:
            self._entries.popleft()
            self._gaps -= 1
        for entry in self._entries:  # packing replaces the queue, it does not change this one
            if entry.payload is not None and entry.lane is not None:
                self._drop_queued(entry.lane)
                entry.lane.lost += 1
                if self.size + size <= self._max_bytes:
                    return True
        for lane in list(self._holding):
            while lane.held and self.size + size > self._max_bytes:
                self._take_held(lane)
                lane.lost += 1
        self._find_deadline()
        return self.size + size <= self._max_bytes

    def _find_deadline(self) -> None:
        self.deadline = min((lane.next_time for lane in self._holding), default=inf)
