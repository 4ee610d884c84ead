"""The synchroniser. It groups the messages of several topics into sets by their stamps.

The synchroniser does not read a clock: the caller passes the time with every call. Add the messages of one topic in
the order in which they were sent. Messages of different topics may be added in any order: the sets stay the same, as
long as the delays of the topics differ by less than the tolerance.

The period of a topic is the median of the topic's last intervals. A topic is *alive* until it is silent for
`ALIVE_PERIODS` of its periods.
"""

import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

DEPTH: Final = 64
"""Maximum number of messages of one topic that wait for messages of the other topics."""
ALIVE_PERIODS: Final = 4
_INTERVALS: Final = 8
_UNKNOWN_PERIOD_NS: Final = 1_000_000_000
"""Assumed period of a topic before its second message."""

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Stamped(Generic[Item]):
    """A message with its stamp and the time of its receipt on the monotonic clock (`tick`), both in ns."""

    stamp: int
    tick: int
    item: Item


@dataclass(slots=True)
class _Topic(Generic[Item]):
    """A topic: its unpaired messages, the oldest first, and the last intervals between its messages."""

    # Whether every set needs a message of this topic.
    needed: bool
    waiting: deque[Stamped[Item]] = field(default_factory=deque)
    # Stamp and receipt of the last message; None before the first one; the stamp also after a restart of the clock.
    newest: int | None = None
    heard: int | None = None
    # Nanoseconds between the stamps of consecutive messages; a repeated or older stamp adds none.
    intervals: deque[int] = field(default_factory=lambda: deque(maxlen=_INTERVALS))

    @property
    def period(self) -> int | None:
        """Nanoseconds between two messages, or None before the second one."""
        return int(statistics.median(self.intervals)) if self.intervals else None

    def is_alive(self, tick: int, begun: int) -> bool:
        """Return whether another message is expected; silence counts from the last message, at first from `begun`."""
        silence = tick - (begun if self.heard is None else self.heard)
        return silence <= ALIVE_PERIODS * (self.period or _UNKNOWN_PERIOD_NS)

    def nearest(self, stamp: int, reach: int) -> Stamped[Item] | None:
        """Return the waiting message nearest to a stamp, within `reach`."""
        near = min(self.waiting, key=lambda each: abs(each.stamp - stamp), default=None)
        return near if near is not None and abs(near.stamp - stamp) <= reach else None

    def may_complete(self, stamp: int, reach: int) -> bool:
        """Return whether the next message may be within `reach` of a stamp, by the shortest interval so far."""
        if self.newest is None:
            return True
        # the shortest interval: lost messages make the others longer
        return self.newest < stamp and self.newest + min(self.intervals, default=0) < stamp + reach


class Synchroniser(Generic[Item]):
    """Search for sets of messages within a tolerance of each other.

    Each set has a message called the *pivot*. If some topics are needed, the pivot is chosen among the oldest waiting
    messages of the needed topics: it is the newest of these oldest messages. If no topic is needed, the pivot is the
    oldest waiting message of all topics.

    Every other topic adds its message nearest to the pivot. All messages of a set must be within the tolerance of the
    pivot. A message of a topic that is not needed must also be nearer to this pivot than to the next message of the
    pivot's topic. Each message is used once.

    If a topic is alive and may still send a message nearer to the pivot, the set waits for this message. The wait is
    at most as long as the tolerance.

    Attributes:
        unpaired: Number of messages that were dropped without a set.
        deadline: Tick at which `take_set` must be called again, or None.
        absent: Indices of the topics that have no message in the last set, although the set waited for one.
    """

    def __init__(self, needed: Sequence[bool], tolerance_ns: int) -> None:
        """Start without messages. `needed` says for each topic whether every set must have a message of the topic."""
        self.unpaired = 0
        self.deadline: int | None = None
        self.absent: list[int] = []
        self._topics: list[_Topic[Item]] = [_Topic(each) for each in needed]
        self._tolerance = tolerance_ns
        # Receipt of the first message of all: a topic that has had no message counts as silent from then on.
        self._begun: int | None = None
        # If no topic is needed: the stamp up to which messages are too late for a set of their own.
        self._done = -1

    def add(self, at: int, stamp: int, tick: int, item: Item) -> None:
        """Add a message of the topic with the index `at`."""
        if self._begun is None:
            self._begun = tick
        topic = self._topics[at]
        if topic.newest is not None:
            # a smaller step back is disorder between the publishers of one topic
            if stamp < topic.newest - self._tolerance:
                self._restart()
            elif stamp > topic.newest:
                topic.intervals.append(stamp - topic.newest)
        topic.newest, topic.heard = stamp, tick
        if len(topic.waiting) == DEPTH:
            # the other topics are silent, or their stamps far away
            self._drop(topic, 1)
        topic.waiting.append(Stamped(stamp, tick, item))

    def take_set(self, tick: int) -> dict[int, Item] | None:
        """Return the next set that is complete at `tick` (ns), or None. The keys are the indices of the topics."""
        self.deadline = None
        while (found := self._pivot()) is not None:
            at, pivot = found
            # messages older than the pivot by more than the tolerance do not fit into any later set either; if a
            # needed message is missing after their removal, the pivot changes
            needed_are_there = True
            for topic in self._topics:
                stale = sum(each.stamp < pivot.stamp - self._tolerance for each in topic.waiting)
                self._drop(topic, stale)
                needed_are_there = needed_are_there and (bool(topic.waiting) or not topic.needed)
            if needed_are_there:
                return self._set(at, pivot, tick)
        return None

    def forget(self) -> None:
        """Drop the waiting messages, and count them as unpaired."""
        for topic in self._topics:
            self._drop(topic, len(topic.waiting))
        self.deadline = None

    def _restart(self) -> None:
        """Forget the stamps of all topics, because a bag or a simulation has restarted."""
        self.forget()
        self._done = -1
        for topic in self._topics:
            topic.newest = None
            topic.intervals.clear()

    def _pivot(self) -> tuple[int, Stamped[Item]] | None:
        needed = [topic for topic in self._topics if topic.needed]
        if not all(topic.waiting for topic in needed):
            return None
        if not needed:
            # the remaining messages of an instant whose set was returned
            for topic in self._topics:
                self._drop(topic, sum(each.stamp <= self._done for each in topic.waiting))
        heads = [
            (at, topic.waiting[0])
            for at, topic in enumerate(self._topics)
            if topic.waiting and (topic.needed or not needed)
        ]
        choose = max if needed else min
        return choose(heads, key=lambda head: head[1].stamp, default=None)

    def _set(self, at: int, pivot: Stamped[Item], tick: int) -> dict[int, Item] | None:
        # beyond half a period, a message is nearer to another one of the pivot's topic
        own_period = self._topics[at].period
        half = self._tolerance if own_period is None else min(self._tolerance, own_period // 2)
        chosen = {at: pivot}
        expected: list[int] = []
        for other, topic in enumerate(self._topics):
            if other == at:
                continue
            reach = self._tolerance if topic.needed else half
            near = topic.nearest(pivot.stamp, reach)
            if near is not None:
                chosen[other] = near
                reach = abs(near.stamp - pivot.stamp)
            if topic.is_alive(tick, self._begun or 0) and topic.may_complete(pivot.stamp, reach):
                expected.append(other)
        # The first message of each needed topic completed the set; a nearer, later one does not prolong the
        # wait.
        complete = max((topic.waiting[0].tick for topic in self._topics if topic.needed), default=pivot.tick)
        if expected and tick < complete + self._tolerance:
            self.deadline = complete + self._tolerance
            return None
        self.absent = [other for other in expected if other not in chosen]
        for other, each in chosen.items():
            waiting = self._topics[other].waiting
            while waiting.popleft() is not each:
                self.unpaired += 1
        self._done = pivot.stamp + half if self.absent else max(each.stamp for each in chosen.values())
        return {other: each.item for other, each in chosen.items()}

    def _drop(self, topic: _Topic[Item], count: int) -> None:
        for _ in range(count):
            topic.waiting.popleft()
        self.unpaired += count
