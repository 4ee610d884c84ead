"""The client's state machine without a network.

ClientCore ──data_to_send──▶ the test (plays the server; any one is in tests/bridge/test_any_input.py)
    ▲                          │
    └──────────receive─────────┘
"""

import json

import cbor2
import pytest

from bridge.client.protocol import Delivery
from bridge.client.protocol.calls_and_goals import MAX_CALLS, MAX_REQUESTS
from bridge.client.protocol.events import (
    CallAnswered,
    MessageReceived,
    ServiceRequested,
    StatusReceived,
    UnusableReceived,
)
from bridge.errors import EncodeError, NameFormError, OptionError, SlowPeerError, TypeConflictError
from bridge.qos import Qos
from tests.bridge.client.stand_ins import connected, sent, tell

# Publishing


def test_advertise_publish_unadvertise():
    core = connected()
    number = core.publications.advertise("/a", "std_msgs/String", latch=True, queue_size=5)
    (advertise,) = sent(core)
    assert advertise == {
        "op": "advertise",
        "id": advertise["id"],
        "topic": "/a",
        "type": "std_msgs/String",
        "latch": True,
        "queue_size": 5,
    }
    assert json.loads(core.publications.publish(number, {"data": "x"})) == {
        "op": "publish",
        "topic": "/a",
        "msg": {"data": "x"},
    }
    assert sent(core) == []
    core.publications.unadvertise(number)
    assert sent(core) == [{"op": "unadvertise", "id": advertise["id"], "topic": "/a"}]


@pytest.mark.parametrize(
    ("wish", "change"),
    [
        ("advertise", {"type_name": "p/U"}),
        ("advertise", {"latch": True}),
        ("advertise", {"qos": Qos(depth=1)}),
        ("subscribe", {"type_name": "p/U"}),
        ("subscribe", {"delivery": Delivery(compression="cbor")}),
        ("subscribe", {"delivery": Delivery(compression="cbor", arrays="numpy")}),
    ],
)
def test_one_topic_wanted_as_two_things_is_refused(wish, change):
    core = connected()
    want = core.publications.advertise if wish == "advertise" else core.subscriptions.subscribe
    forget = core.publications.unadvertise if wish == "advertise" else core.subscriptions.unsubscribe
    wanted = [want("/a", "p/T"), want("a", "p/msg/T")]
    with pytest.raises(TypeConflictError):
        want("a", **{"type_name": "p/T"} | change)
    assert len(sent(core)) == 1
    for number in wanted:
        forget(number)
    want("/a", **{"type_name": "p/T"} | change)


def test_the_limits_of_a_published_message():
    core = connected(max_size=100, max_depth=5)
    number = core.publications.advertise("/a", "p/T")
    room = 100 - len(core.publications.publish(number, {"d": ""}))
    assert len(core.publications.publish(number, {"d": "x" * room})) == 100
    receiver = connected(max_size=100, max_depth=5)
    receiver.subscriptions.subscribe("/a")
    deepest = core.publications.publish(number, {"a": {"b": {"c": {}}}})
    assert isinstance(receiver.receive(deepest, 0.0), MessageReceived), "what leaves can also arrive"
    for msg in ({"d": "x" * (room + 1)}, {"a": {"b": {"c": {"d": {}}}}}):
        with pytest.raises(EncodeError):
            core.publications.publish(number, msg)


@pytest.mark.parametrize(
    ("version", "message_type", "service_type"),
    [(None, "p/T", "q/S"), (1, "p/T", "q/S"), (2, "p/msg/T", "q/srv/S")],
)
def test_the_form_of_type_names_follows_the_server(version, message_type, service_type):
    core = connected(ros_version=version)
    core.publications.advertise("/a", "p/T")
    core.subscriptions.subscribe("/b", "p/msg/T")
    core.services.advertise("/c", "q/S")
    assert [operation["type"] for operation in sent(core)] == [message_type, message_type, service_type]


# Subscribing


def test_several_subscriptions_share_one_on_the_wire():
    core = connected()
    slow = Delivery(throttle_rate=100, queue_length=2)
    one = core.subscriptions.subscribe("/a", delivery=slow)
    (first,) = sent(core)
    asked = {"topic": "/a", "throttle_rate": 100, "queue_length": 2}
    assert first == {"op": "subscribe", "id": first["id"], **asked}
    other = core.subscriptions.subscribe("a", "p/T", slow)
    assert sent(core) == [first | {"type": "p/T"}]
    third = core.subscriptions.subscribe("/a", delivery=slow)
    assert sent(core) == []
    with pytest.raises(TypeConflictError, match="all subscriptions of a topic by one client share one"):
        core.subscriptions.subscribe("/a")
    for topic in ("/a", "a"):
        event = tell(core, op="publish", topic=topic, msg={"d": 1})
        assert event == MessageReceived(topic, {"d": 1}, (one, other, third))
    core.subscriptions.unsubscribe(other)
    core.subscriptions.unsubscribe(third)
    assert sent(core) == []
    core.subscriptions.unsubscribe(one)
    assert sent(core) == [{"op": "unsubscribe", "id": first["id"], "topic": "/a"}]
    assert tell(core, op="publish", topic="/a", msg={}) is None


@pytest.mark.parametrize("option", ["throttle_rate", "queue_length"])
def test_what_would_kill_a_subscription_is_refused(option):
    core = connected()
    for bad in (-1, 0.0, True, None, "5"):
        with pytest.raises(OptionError, match=f"{option} of topic /a"):
            core.subscriptions.subscribe("/a", delivery=Delivery(**{option: bad}))
    assert sent(core) == []


def test_a_topic_of_unknown_type_is_asked_for_until_it_brings_something():
    core = connected()
    core.subscriptions.subscribe("/typed", "p/T")
    assert not core.subscriptions.retry_untyped()
    core.subscriptions.subscribe("/a")
    sent(core)
    for _ in range(3):
        assert core.subscriptions.retry_untyped()
        assert [operation["topic"] for operation in sent(core)] == ["/a"]
    tell(core, op="publish", topic="/a", msg={})
    assert not core.subscriptions.retry_untyped()
    assert sent(core) == []
    core.lost()
    core.restore()
    sent(core)
    assert core.subscriptions.retry_untyped(), "the server may have forgotten it"


def test_bad_names_are_refused_before_anything_is_sent():
    core = connected()
    for attempt in (
        lambda: core.publications.advertise("/a b", "p/T"),
        lambda: core.subscriptions.subscribe("/a b"),
        lambda: core.subscriptions.subscribe("/a", "T"),
        lambda: core.calls.send("/a b", {}),
        lambda: core.goals.send("/a b", "p/T", {}, feedback=True),
        lambda: core.services.advertise("/a b", "p/T"),
        lambda: core.services.advertise("/a", "T"),
    ):
        with pytest.raises(NameFormError):
            attempt()
    assert sent(core) == []


def test_a_call_and_its_answer():
    core = connected()
    call = core.calls.send("/s", {"a": 1})
    assert sent(core) == [{"op": "call_service", "id": call, "service": "/s", "args": {"a": 1}}]
    answer = {"op": "service_response", "service": "/s", "id": call, "values": {"b": 2}, "result": True}
    assert tell(core, **answer) == CallAnswered(call, ok=True, values={"b": 2})
    core.calls.forget(forgotten := core.calls.send("/s", {}))
    for nobodys in (call, forgotten, "other"):
        assert tell(core, **answer | {"id": nobodys}) is None


@pytest.mark.parametrize(
    ("answer", "ok", "values"),
    [
        ({"values": "no such service", "result": False}, False, "no such service"),
        ({"result": False}, False, ""),
        ({"values": {"why": "not"}, "result": False}, False, '{"why":"not"}'),
        ({"values": {"a": 1}}, True, {"a": 1}),
        ({"result": True}, True, {}),
    ],
)
def test_answers_as_servers_give_them(answer, ok, values):
    core = connected()
    call = core.calls.send("/s", {})
    assert tell(core, op="service_response", id=call, **answer) == CallAnswered(call, ok=ok, values=values)


@pytest.mark.parametrize(
    ("identity", "args", "values", "ok"),
    [({"id": "x1"}, {"args": {"a": 1}}, {"b": 2}, True), ({}, {}, {}, True), ({"id": 5}, {}, "no", False)],
)
def test_a_request_and_its_answer(identity, args, values, ok):
    core = connected()
    core.services.advertise("s", "p/T")
    assert sent(core) == [{"op": "advertise_service", "service": "/s", "type": "p/T"}]
    request = tell(core, op="call_service", service="/s", **identity, **args)
    assert isinstance(request, ServiceRequested)
    assert (request.service, request.args) == ("/s", args.get("args", {}))
    core.services.answer(request.ticket, values, ok=ok)
    answer = {"values": values} if ok else {"values": {}, "reason": values}
    assert sent(core) == [{"op": "service_response", "service": "/s", "result": ok, **answer, **identity}]
    core.services.answer(request.ticket, values)
    assert sent(core) == [], "only once"


def test_what_cannot_be_served_is_refused_on_the_spot():
    core = connected()
    core.services.advertise("/s", "p/T")
    with pytest.raises(TypeConflictError):
        core.services.advertise("s", "p/T")
    sent(core)
    assert tell(core, op="call_service", service="/other", id=1) is None
    assert tell(core, op="call_service", service="/s", id=2, args=[1]) is None
    for number in range(MAX_REQUESTS):
        assert isinstance(tell(core, op="call_service", service="/s", id=f"n{number}"), ServiceRequested)
    assert tell(core, op="call_service", service="/s", id=3) is None
    assert [(answer["id"], answer["result"]) for answer in sent(core)] == [(1, False), (2, False), (3, False)]
    core.services.unadvertise("s")
    assert sent(core) == [{"op": "unadvertise_service", "service": "/s"}]
    assert tell(core, op="call_service", service="/s", id=4) is None


def test_calls_are_bounded_and_they_and_requests_end_with_the_connection():
    core = connected()
    core.services.advertise("/s", "p/T")
    calls = [core.calls.send("/x", {}) for _ in range(MAX_CALLS)]
    with pytest.raises(SlowPeerError, match="/x"):
        core.calls.send("/x", {})
    core.calls.forget(calls[0])
    call = core.calls.send("/x", {})
    request = tell(core, op="call_service", service="/s", id="x")
    core.lost()
    core.restore()
    sent(core)
    core.services.answer(request.ticket, {})
    assert sent(core) == []
    assert tell(core, op="service_response", id=call, values={}, result=True) is None


@pytest.mark.parametrize(
    ("operation", "level", "text", "of"),
    [
        ({"level": "error", "msg": "bad type", "id": "publish:/a:1"}, "error", "bad type", "publish:/a:1"),
        ({"level": "info", "msg": {"a": 1}}, "info", '{"a":1}', ""),
        ({}, "error", "", ""),
    ],
)
def test_status_messages_are_taken(operation, level, text, of):
    assert tell(connected(), op="status", **operation) == StatusReceived(level, text, of)


def wrapped(inner):
    return json.dumps({"op": "fragment", "id": 1, "num": 0, "total": 1, "data": inner.decode()}).encode()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b'{"op": 3}',
        b'{"op": "publish"}',
        b'{"op": "publish", "topic": "/a", "msg": 3}',
        b'{"op": "publish", "topic": ["/a"], "msg": {}}',
        b'{"op": "publish", "topic": "/a", "msg": ' + b'{"a":' * 100 + b"1" + b"}" * 101,
        b'{"op": "action_feedback", "id": 5}',
        b'{"op": "call_service", "service": {}}',
        b'{"op": "call_service", "service": "/s", "id": []}',
        b'{"op": "nonsense"}',
        b"\xa1",
        cbor2.dumps({"op": "call_service", "service": "/a"}),
        cbor2.dumps({"op": "publish", "topic": "/a", "msg": [1]}),
        cbor2.dumps({"op": "publish", "topic": b"/a", "msg": {}}),
        b'{"op": "fragment", "id": "1", "data": "", "num": 0, "total": 1.0}',
        wrapped(wrapped(b'{"op":"publish","topic":"/a","msg":{}}')),
        wrapped(b"no json"),
        b'{"op":{"png":1}}',
        b'{"op":"png","data":"xx"}',
    ],
)
def test_what_is_unusable_says_so(data):
    core = connected()
    core.subscriptions.subscribe("/a", delivery=Delivery(compression="cbor"))
    event = core.receive(data, 0.0)
    assert isinstance(event, UnusableReceived)
    assert 10 < len(event.reason) < 300


def nested(levels):
    return {"a": nested(levels - 1)} if levels else 1


# In an operation, 63 levels are the most.
CONTENTS = [{}, {"a": [1.5, None]}, {"a": {"msg": "cmsg"}}, nested(62), nested(63), nested(64), [1], 1]


@pytest.mark.parametrize("arrays", ["list", "numpy"])
@pytest.mark.parametrize("encode", [lambda operation: json.dumps(operation).encode(), cbor2.dumps])
def test_messages_with_a_known_envelope_are_read_like_the_first_one(encode, arrays):
    received = [encode({"op": "publish", "topic": "/a", "msg": msg}) for msg in CONTENTS]
    received += [received[1] + b"\0", received[1][:-1], received[1][:-1] + b" ", received[1] + received[1]]

    def core():
        core = connected()
        core.subscriptions.subscribe("/a", delivery=Delivery(compression="cbor", arrays=arrays))
        return core

    learnt = core()
    learnt.receive(received[0], 0.0)
    for data in received:
        first = core().receive(data, 0.0)
        assert repr(learnt.receive(data, 0.0)) == repr(first)
        known, _subscriptions = learnt.receive_known((data,), 0, 1, 2)
        assert bool(known) is isinstance(first, MessageReceived)


def test_messages_that_arrive_together_are_read_up_to_another_topic_or_an_unusable_one():
    core = connected()
    numbers = {topic: core.subscriptions.subscribe(topic) for topic in ("/a", "/b")}
    a, b = (b'{"op":"publish","topic":"%b","msg":{}}' % topic.encode() for topic in numbers)
    for data in (a, b):
        core.receive(data, 0.0)
    together = [a, a, b, a[:-1], a]
    for first, topic, count in (0, "/a", 2), (1, "/a", 1), (2, "/b", 1), (3, "/a", 0), (4, "/a", 1):
        messages, subscriptions = core.receive_known(together, first, 1, 2)
        assert messages == [(topic, {}, 1, 2)] * count
        assert not count or subscriptions == (numbers[topic],)


def test_a_message_with_a_known_envelope_has_the_limit_of_its_topic():
    core = connected()
    core.subscriptions.subscribe("/a", delivery=Delivery(max_bytes=60))
    size = len(data := b'{"op":"publish","topic":"/a","msg":{"d":""}}')
    core.receive(data, 0.0)
    for length in (59, 60, 61):
        longer = data.replace(b'""', b'"%b"' % (b"x" * (length - size)))
        messages, _ = core.receive_known((longer,), 0, 1, 2)
        assert len(messages) == (length <= 60)
        assert core.subscriptions.largest == ("/a", min(length, 60))
