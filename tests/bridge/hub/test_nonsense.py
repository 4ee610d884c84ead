"""Whatever clients send: nobody is told, nothing breaks, and they are served on."""

import json
import logging
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.bridge.hub.room import Guest, Room

NONSENSE = [
    b"",
    b"42",
    b"[1,2,3]",
    b"null",
    b"{",
    b"}{",
    b"{}",
    b'"text"',
    b"\xff\xfe",
    b'{"op":"publish"',
    b'{"op":7}',
    b'{"op":"fly"}',
    b'{"op":["publish"]}',
    b'{"op":{"a":1}}',
    b'{"op":null,"topic":"/t"}',
    b'{"op":"publish","topic":"/t","msg":{"a":"\xff"}}',
    b'{"op":"publish","topic":"/t","msg":{"a":"\\ud800","b":NaN}}',
    b'{"op":"publish","topic":"/t","msg":{"a":%b,"b":NaN}}' % (b"9" * 5000),
    b'{"op":"publish","topic":"/t","msg":{}}{"op":"publish","topic":"/t","msg":{}}',
    b'{"op":"publish","topic":"/t","msg":{"a":%b1%b}}' % (b"[" * 100, b"]" * 100),
    b'{"op":"publish","topic":"/t","msg":{"a":%b1%b}}' % (b'{"a":' * 2000, b"}" * 2000),
    b"[" * 500_000 + b"]" * 500_000,
    b'{"op":"publish","topic":"/t","msg":{"a":%bNaN%b}}' % (b"[" * 100_000, b"]" * 100_000),
    b'{"op":"fragment","id":1,"data":"","num":0,"total":1}',
    b'{"op":"png","data":"abc"}',
    b'{"op":"set_level","level":"error"}',
    b'{"op":"advertise_action","action":"/a","type":"a/B"}',
    b'{"op":"publish","topic":"/t","msg":{"a":1}}'.decode().encode("utf-16"),
    b" " * 1000 + b"x",
]


@pytest.mark.parametrize("data", NONSENSE, ids=lambda data: repr(data[:40]))
def test_nonsense_is_refused_and_its_sender_served_on(data: bytes) -> None:
    room = Room()
    sender, other = room.enter(), room.enter()
    for guest in (sender, other):
        guest.advertise("/t")
        guest.subscribe("/t")
    sender.send_raw(data)
    assert sender.read() == other.read() == []
    assert sender.client.refused == 1
    room.check()
    sender.publish("/t", {"a": 1})
    assert sender.heard() == other.heard() == [{"a": 1}]


def test_depth_up_to_the_limit_passes() -> None:
    room = Room(depth=10)
    guest = room.enter()
    guest.advertise("/t")
    guest.subscribe("/t")
    for levels, passes in ((8, True), (9, False)):  # the operation and its message are two more
        guest.send_raw(b'{"op":"publish","topic":"/t","msg":{"a":%b%b}}' % (b"[" * levels, b"]" * levels))
        assert bool(guest.read()) is passes


def test_what_is_larger_than_the_limit_is_refused() -> None:
    room = Room(message_bytes=100)
    guest = room.enter()
    guest.send_raw(b'{"op":"subscribe","topic":"/t"%b}' % (b" " * 100))
    assert guest.client.refused == 1


def test_a_flood_of_nonsense_is_no_flood_of_log_lines(caplog: pytest.LogCaptureFixture) -> None:
    guest = Room().enter("192.0.2.1")
    with caplog.at_level(logging.WARNING, "bridge.hub.broker"):
        for _ in range(1234):
            guest.send_raw(b"42")
    assert len(caplog.records) == 4  # the 1st, 10th, 100th and 1000th
    assert "192.0.2.1" in caplog.text


# --- anything at all

_NAMES = st.sampled_from(["/t", "t", "/u", "/u/v", "/rosapi/topics", "/rosapi/x", "", "/", "a b", "/s", "s"])
_TYPES = st.sampled_from(["a/B", "a/msg/B", "a/C", "a/srv/C", "B", ""])
_IDS = st.sampled_from(["one", "two", 3, 0, None, "", 1.5, "x" * 2000, True])
_SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
    _NAMES,
    _TYPES,
    st.just(10**400),
)
_VALUES = st.recursive(
    _SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)
_OPERATIONS = st.sampled_from([*Room().broker._operations, "fly"])
_SENSIBLE: dict[str, st.SearchStrategy[Any]] = {
    "topic": _NAMES,
    "service": _NAMES,
    "type": _TYPES,
    "id": _IDS,
    "msg": st.dictionaries(st.text(max_size=3), _VALUES, max_size=3),
    "args": st.one_of(st.dictionaries(st.sampled_from(["name", "value", "topic"]), _VALUES), _VALUES),
    "values": _VALUES,
    "result": st.booleans(),
    "latch": st.booleans(),
    "throttle_rate": st.sampled_from([0, 1, 50, 1000, 0.0, 2.5]),
    "queue_length": st.sampled_from([0, 1, 2, 100]),
    "timeout": st.sampled_from([0, 1, 0.5]),
}
_FIELDS = st.fixed_dictionaries(
    {"op": _OPERATIONS},
    optional={name: st.one_of(sensible, sensible, sensible, _VALUES) for name, sensible in _SENSIBLE.items()},
)
_STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("operation"), st.integers(0, 2), _FIELDS),
        st.tuples(st.just("operation"), st.integers(0, 2), _FIELDS),
        st.tuples(st.just("operation"), st.integers(0, 2), _FIELDS),
        st.tuples(st.just("bytes"), st.integers(0, 2), st.binary(max_size=20)),
        st.tuples(st.just("json"), st.integers(0, 2), _VALUES),
        st.tuples(st.just("answer"), st.integers(0, 2), st.tuples(st.booleans(), _VALUES)),
        st.tuples(st.just("read"), st.integers(0, 2), st.none()),
        st.tuples(st.just("wait"), st.integers(0, 2), st.sampled_from([0.01, 1.0, 30.0])),
        st.tuples(st.just("reconnect"), st.integers(0, 2), st.none()),
    ),
    max_size=40,
)


class _Visitor:
    """A guest that remembers what it was asked, and counts its own calls and their answers."""

    def __init__(self, room: Room) -> None:
        self.guest: Guest = room.enter()
        self.requests: list[str] = []
        self.calls: set[int] = set()
        self.answered: set[int] = set()

    def read(self) -> None:
        for operation in self.guest.read():
            assert operation["op"] in {"publish", "call_service", "service_response"}
            if operation["op"] == "call_service":
                self.requests.append(operation["id"])
            elif operation["op"] == "service_response":
                assert operation["result"] is True or isinstance(operation["values"], str)
                number = operation.get("id")
                if isinstance(number, int) and number >= 1000:
                    assert number in self.calls - self.answered, "answered twice, or never asked"
                    self.answered.add(number)


@given(_STEPS)
@settings(max_examples=400, deadline=None)
def test_anything_keeps_the_hub_well(steps: list[tuple[str, int, Any]]) -> None:
    room = Room(
        topics=3,
        advertisements_per_client=3,
        subscriptions_per_client=3,
        services_per_client=2,
        calls_per_client=2,
        message_bytes=4000,
        client_bytes=5000,
        latched_bytes=40,
        queue_length=2,
        parameters=2,
    )
    visitors = [_Visitor(room) for _ in range(3)]
    for number, (step, who, what) in enumerate(steps):
        visitor = visitors[who]
        if step == "operation":
            if what["op"] == "call_service" and isinstance(what.get("service"), str) and what["service"]:
                what = {**what, "id": 1000 + number}  # noqa: PLW2901 - so that its answer is known
                visitor.calls.add(1000 + number)
            visitor.guest.send(**what)
        elif step == "bytes":
            visitor.guest.send_raw(what)
        elif step == "json":
            visitor.guest.send_raw(json.dumps(what).encode())
        elif step == "answer" and visitor.requests:
            result, values = what
            visitor.guest.send(op="service_response", id=visitor.requests.pop(), values=values, result=result)
        elif step == "read":
            visitor.read()
        elif step == "wait":
            room.pass_time(what)
        elif step == "reconnect":
            visitor.guest.leave()
            visitors[who] = _Visitor(room)
        room.check()
        ready = room.broker.take_ready()
        assert len(set(ready)) == len(ready)
    for _ in range(2):
        for visitor in visitors:
            visitor.read()
        room.pass_time(120)
    for visitor in visitors:
        visitor.read()
        if not visitor.guest.client.doomed:
            assert visitor.calls == visitor.answered, "a call without an answer"
        visitor.guest.leave()
        room.check()
    assert not room.broker.graph.topics
    assert not room.broker.graph.services
    assert not room.broker._calls
    room.pass_time(120)
    assert not room.broker._throttled
