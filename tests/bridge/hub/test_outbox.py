"""The outbox compared with a model: two plain lists, and every rule in its simplest form."""

from dataclasses import dataclass, field
from math import inf

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.hub.outbox import Lane, Outbox


def _drain(outbox):
    payloads = []
    while (payload := outbox.pop()) is not None:
        payloads.append(payload)
    return payloads


def _lane(throttle=0.0, queue_length=3):
    lane = Lane()
    lane.throttle, lane.queue_length = throttle, queue_length
    return lane


@pytest.mark.parametrize(
    ("throttle", "length", "deadline", "dropped", "released"),
    [(0.5, 1, 0.5, 2, [b"3"]), (0.0, 5, inf, 0, [b"1", b"2", b"3"])],
    ids=["shorter", "lifted"],
)
def test_an_adjusted_lane_drops_or_queues_what_it_held(throttle, length, deadline, dropped, released):
    outbox, lane = Outbox(1000), _lane(throttle=1.0, queue_length=5)
    for index in range(4):
        outbox.offer(lane, b"%d" % index, 0)
    assert _drain(outbox) == [b"0"]
    outbox.adjust(lane, throttle, length)
    outbox.release(0)
    assert (lane.dropped, outbox.deadline) == (dropped, deadline)
    outbox.release(0.5)
    assert _drain(outbox) == released


def test_forgetting_a_lane_leaves_nothing_of_it():
    outbox, gone, stays = Outbox(1000), _lane(throttle=1.0, queue_length=5), _lane()
    for index in range(3):
        outbox.offer(gone, b"%d" % index, 0)
        outbox.offer(stays, b"s", 0)
    outbox.forget(gone)
    outbox.release(1)
    assert outbox.deadline == inf
    assert outbox.size == 3
    assert _drain(outbox) == [b"s", b"s", b"s"]


def test_dropping_does_not_make_the_queue_longer():
    outbox, lane = Outbox(10_000), _lane(queue_length=1)
    outbox.put(b"first")
    for _ in range(10_000):
        outbox.offer(lane, b"x", 0)
    assert len(outbox._entries) < 200
    assert _drain(outbox) == [b"first", b"x"]


def test_while_the_socket_takes_it_nothing_waits():
    outbox, lane = Outbox(10), _lane(queue_length=1)
    outbox.wire = []
    for index in range(5):
        outbox.offer(lane, b"%d" % index, 0)
        outbox.put(b"answer of more than ten bytes")
    assert outbox.wire == [
        part for index in range(5) for part in (b"%d" % index, b"answer of more than ten bytes")
    ]
    assert outbox.empty
    assert (outbox.size, lane.dropped, outbox.overflowed) == (0, 0, False)


def test_queued_payloads_keep_their_place():
    outbox, lane, cut = Outbox(1000), _lane(), _lane()
    cut.fragment_size = 16
    outbox.put(b"1")
    outbox.wire = wire = []
    outbox.offer(lane, b"2", 0)
    outbox.put(b"3")
    assert wire == []
    assert _drain(outbox) == [b"1", b"2", b"3"]
    outbox.offer(lane, b"4", 0)
    outbox.offer(cut, b"{%b}" % (b"5" * 30), 0)
    assert outbox.pop() is not None  # the first of its two fragments
    outbox.offer(lane, b"6", 0)
    outbox.put(b"7")
    assert wire == [b"4"]
    *rest, six, seven = _drain(outbox)
    assert len(rest) == 1
    assert (six, seven) == (b"6", b"7")
    assert outbox.empty


def test_a_throttle_holds_also_while_the_socket_takes_everything():
    outbox, lane = Outbox(1000), _lane(throttle=1.0, queue_length=1)
    outbox.wire = wire = []
    for index in range(3):
        assert outbox.accepts(lane, index / 10)
        outbox.offer(lane, b"%d" % index, index / 10)
    assert wire == [b"0"]
    outbox.release(1.0)
    assert wire == [b"0", b"2"]
    lane.queue_length = 0
    assert not outbox.accepts(lane, 1.5)
    assert outbox.accepts(lane, 2.0)


@dataclass
class _ModelLane:
    throttle: float
    queue_length: int
    next_time: float = -inf
    held: list[bytes] = field(default_factory=list)
    dropped: int = 0


class _Model:
    """The outbox's rules over plain lists. A waiting item is (payload, lane or None)."""

    def __init__(self, max_bytes):
        self.max_bytes = max_bytes
        self.waiting = []
        self.lanes = []
        self.overflowed = False

    @property
    def size(self):
        held = sum(len(payload) for lane in self.lanes for payload in lane.held)
        return held + sum(len(payload) for payload, _lane in self.waiting)

    @property
    def deadline(self):
        return min((lane.next_time for lane in self.lanes if lane.held), default=inf)

    def put(self, payload):
        if self._make_room(len(payload)):
            self.waiting.append((payload, None))
        else:
            self.overflowed = True

    def offer(self, lane, payload, now):
        if not lane.throttle:
            self._queue(lane, payload)
        elif now >= lane.next_time and not lane.held:
            lane.next_time = now + lane.throttle
            self._queue(lane, payload)
        elif lane.queue_length:
            if len(lane.held) == lane.queue_length:
                del lane.held[0]
                lane.dropped += 1
            if self._make_room(len(payload)):
                lane.held.append(payload)
            else:
                lane.dropped += 1

    def release(self, now):
        for lane in self.lanes:
            if lane.held and lane.next_time <= now:
                lane.next_time = now + lane.throttle
                self._queue(lane, lane.held.pop(0))

    def _queue(self, lane, payload):
        own = [index for index, (_payload, its_lane) in enumerate(self.waiting) if its_lane is lane]
        if len(own) >= max(lane.queue_length, 1):
            del self.waiting[own[0]]
            lane.dropped += 1
        if self._make_room(len(payload)):
            self.waiting.append((payload, lane))
        else:
            lane.dropped += 1

    def _make_room(self, size):
        while self.size + size > self.max_bytes:
            index = next((i for i, (_payload, lane) in enumerate(self.waiting) if lane is not None), None)
            if index is not None:
                lane = self.waiting.pop(index)[1]
            else:
                lane = next((lane for lane in self.lanes if lane.held), None)
                if lane is None:
                    return False
                del lane.held[0]
            assert lane is not None
            lane.dropped += 1
        return True


_LANES = st.lists(st.tuples(st.sampled_from([0.0, 0.0, 1.0, 2.5]), st.integers(0, 4)), min_size=1, max_size=3)
_STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("offer"), st.integers(0, 2), st.integers(1, 12)),
        st.tuples(st.just("offer"), st.integers(0, 2), st.integers(1, 12)),
        st.tuples(st.just("put"), st.just(0), st.integers(1, 12)),
        st.tuples(st.just("pop"), st.just(0), st.just(0)),
        st.tuples(st.just("wait"), st.just(0), st.integers(0, 3)),
        st.tuples(st.just("be late"), st.just(0), st.integers(0, 3)),
    ),
    max_size=120,
)


@given(_LANES, _STEPS, st.integers(12, 60))
@settings(max_examples=300, deadline=None)
def test_the_outbox_is_its_model(shapes, steps, max_bytes):
    outbox, model, now = Outbox(max_bytes), _Model(max_bytes), 0.0
    # Harness for held messages is made in no stated order of lanes: one throttled lane keeps the model exact.
    throttles = [throttle for throttle, _length in shapes]
    first = next((index for index, throttle in enumerate(throttles) if throttle), None)
    lanes = []
    for index, (throttle, length) in enumerate(shapes):
        used = throttle if index == first else 0.0
        lanes.append(_lane(used, length if used else max(length, 1)))
        model.lanes.append(_ModelLane(used, length if used else max(length, 1)))
    for number, (step, which, amount) in enumerate(steps):
        payload = b"%d " % number + b"x" * amount
        if step == "offer":
            outbox.offer(lanes[which % len(lanes)], payload, now)
            model.offer(model.lanes[which % len(lanes)], payload, now)
        elif step == "put":
            outbox.put(payload)
            model.put(payload)
        elif step == "pop":
            assert outbox.pop() == (model.waiting.pop(0)[0] if model.waiting else None)
        elif step == "be late":
            now += amount / 2
        else:
            now += amount / 2
            outbox.release(now)
            model.release(now)
            assert outbox.deadline == model.deadline
        assert outbox.size == model.size
        assert outbox.overflowed == model.overflowed
        assert [lane.dropped for lane in lanes] == [lane.dropped for lane in model.lanes]
        assert outbox.deadline <= model.deadline
    assert _drain(outbox) == [payload for payload, _lane in model.waiting]
