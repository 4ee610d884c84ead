"""The client's state machine without a network.

ClientCore ──data_to_send──▶ PaperServer (keeps what the wire said)
    ▲                              │
    └───────────receive────────────┘
"""

import json
import math

import cbor2
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from bridge.client.protocol import ClientCore, Delivery
from bridge.client.protocol.calls_and_goals import MAX_CALLS, MAX_REQUESTS
from bridge.client.protocol.events import (
    CallAnswered,
    MessageReceived,
    ServiceRequested,
    StatusReceived,
    UnusableReceived,
)
from bridge.codecs import png
from bridge.errors import EncodeError, NameFormError, OptionError, SlowPeerError, TypeConflictError
from bridge.names import absolute
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


def test_a_message_that_cannot_leave_is_named():
    core = connected()
    number = core.publications.advertise("/a", "p/T")
    with pytest.raises(EncodeError, match=r"^a message of /a cannot be published: x\.y is NaN"):
        core.publications.publish(number, {"x": {"y": math.nan}})


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
    slow = core.subscriptions.subscribe("/a", throttle_rate=100, queue_length=2)
    (first,) = sent(core)
    asked = {"topic": "/a", "throttle_rate": 100, "queue_length": 2}
    assert first == {"op": "subscribe", "id": first["id"], **asked}
    fast = core.subscriptions.subscribe("a", "p/T", throttle_rate=50)
    (second,) = sent(core)
    assert second == first | {"throttle_rate": 50, "type": "p/T"}
    same = core.subscriptions.subscribe("/a", throttle_rate=50)
    assert sent(core) == []
    for topic, now, receivers in (
        ("/a", 0.0, (slow, fast, same)),
        ("a", 0.06, (fast, same)),
        ("/a", 0.11, (slow, fast, same)),
    ):
        event = tell(core, now, op="publish", topic=topic, msg={"d": 1})
        assert event == MessageReceived(topic, {"d": 1}, receivers)
    core.subscriptions.unsubscribe(fast)
    assert sent(core) == []
    core.subscriptions.unsubscribe(same)
    assert sent(core) == [second | {"throttle_rate": 100}]
    core.subscriptions.unsubscribe(slow)
    assert sent(core) == [{"op": "unsubscribe", "id": first["id"], "topic": "/a"}]
    assert tell(core, op="publish", topic="/a", msg={}) is None


@pytest.mark.parametrize("option", ["throttle_rate", "queue_length"])
def test_what_would_kill_a_subscription_is_refused(option):
    core = connected()
    for bad in (-1, 0.0, True, None, "5"):
        with pytest.raises(OptionError, match=f"{option} of topic /a"):
            core.subscriptions.subscribe("/a", **{option: bad})
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
    ("operation", "level", "text"),
    [
        ({"level": "error", "msg": "bad type"}, "error", "bad type"),
        ({"level": "info", "msg": {"a": 1}}, "info", '{"a":1}'),
        ({}, "error", ""),
    ],
)
def test_status_messages_are_taken(operation, level, text):
    assert tell(connected(), op="status", **operation) == StatusReceived(level, text)


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
        json.dumps({"op": "png", "data": png.encode(b"no json")}).encode(),
        json.dumps({"op": "png", "data": png.encode(b'{"op":"png","data":""}')}).encode(),
    ],
)
def test_what_is_unusable_says_so(data):
    core = connected()
    core.subscriptions.subscribe("/a", delivery=Delivery(compression="cbor"))
    event = core.receive(data, 0.0)
    assert isinstance(event, UnusableReceived)
    assert 10 < len(event.reason) < 300


# Any sequence of wishes, losses and messages

TOPICS = ["/a", "a", "/b", "c"]


class PaperServer:
    """The state of a server, as known from the wire, in the simplest form."""

    def __init__(self):
        self.advertised = {}
        self.subscribed = {}
        self.services = set()

    def hear(self, operation):
        operation["topic"] = absolute(operation.get("topic", ""))
        match operation["op"]:
            case "advertise":
                assert operation["topic"] not in self.advertised, "advertised twice"
                self.advertised[operation["topic"]] = operation
            case "unadvertise":
                assert self.advertised.pop(operation["topic"])["id"] == operation["id"]
            case "subscribe":
                self.subscribed.setdefault(operation["topic"], {})[operation["id"]] = operation
            case "unsubscribe":
                del self.subscribed[operation["topic"]][operation["id"]]
            case "advertise_service":
                self.services.add(operation["service"])
            case "unadvertise_service":
                self.services.remove(operation["service"])
            case other:
                raise AssertionError(other)


class Wishes(RuleBasedStateMachine):
    """Check that the client's requests and the server's state always agree while connected."""

    def __init__(self):
        super().__init__()
        self.core = ClientCore()
        self.server = PaperServer()
        self.now = 0.0
        self.advertisements = {}
        self.subscriptions = {}
        self.services = set()

    @rule()
    def connect(self):
        self.core.lost()
        self.server = PaperServer()
        self.core.restore()

    @rule()
    def lose(self):
        self.core.lost()

    @rule(topic=st.sampled_from(TOPICS), type_name=st.sampled_from(["p/T", "p/msg/T"]))
    def advertise(self, topic, type_name):
        self.advertisements[self.core.publications.advertise(topic, type_name)] = absolute(topic)

    @rule(data=st.data())
    @precondition(lambda self: self.advertisements)
    def unadvertise(self, data):
        number = data.draw(st.sampled_from(sorted(self.advertisements)))
        self.core.publications.unadvertise(number)
        del self.advertisements[number]

    @rule(
        topic=st.sampled_from(TOPICS),
        type_name=st.sampled_from([None, "p/T", "p/msg/T"]),
        rate=st.sampled_from([0, 100, 1000]),
        length=st.sampled_from([0, 5]),
    )
    def subscribe(self, topic, type_name, rate, length):
        number = self.core.subscriptions.subscribe(topic, type_name, throttle_rate=rate, queue_length=length)
        assert number not in self.subscriptions
        self.subscriptions[number] = (absolute(topic), rate, length)

    @rule(data=st.data())
    @precondition(lambda self: self.subscriptions)
    def unsubscribe(self, data):
        number = data.draw(st.sampled_from(sorted(self.subscriptions)))
        self.core.subscriptions.unsubscribe(number)
        del self.subscriptions[number]

    @rule(service=st.sampled_from(["/s", "/t"]))
    def toggle_service(self, service):
        if service in self.services:
            self.core.services.unadvertise(service)
        else:
            self.core.services.advertise(service, "p/T")
        self.services ^= {service}

    @rule()
    def ask_again(self):
        self.core.subscriptions.retry_untyped()
        for topic in self.core.subscriptions.silent():
            self.core.subscriptions.renew(topic)

    @rule(topic=st.sampled_from([*TOPICS, "/c"]), step=st.sampled_from([0.0, 0.05, 0.2, 2.0]))
    def message(self, topic, step):
        self.now += step
        event = self.core.receive(json.dumps({"op": "publish", "topic": topic, "msg": {}}).encode(), self.now)
        assert event is None or isinstance(event, MessageReceived)
        received = [] if event is None else list(event.subscriptions)
        assert len(set(received)) == len(received)
        wanting = {
            n: rate for n, (wanted, rate, _length) in self.subscriptions.items() if wanted == absolute(topic)
        }
        # Only those who want fewer than the server was asked for can be left out.
        fastest = {number for number, rate in wanting.items() if rate == min(wanting.values())}
        assert fastest <= set(received) <= set(wanting)

    @invariant()
    def the_server_knows_what_is_wanted(self):
        for operation in sent(self.core):
            assert self.core.wire.connected
            self.server.hear(operation)
        if not self.core.wire.connected:
            return
        assert set(self.server.advertised) == set(self.advertisements.values())
        assert self.server.services == self.services
        by_topic = {topic: by_id for topic, by_id in self.server.subscribed.items() if by_id}
        assert set(by_topic) == {topic for topic, _rate, _length in self.subscriptions.values()}
        for topic, by_id in by_topic.items():
            ((_id, subscribe),) = by_id.items()  # one on the wire
            wanted = [w for w in self.subscriptions.values() if w[0] == topic]
            assert subscribe["throttle_rate"] == min(rate for _topic, rate, _length in wanted)
            assert subscribe["queue_length"] == max(length for _topic, _rate, length in wanted)


TestWishes = Wishes.TestCase
TestWishes.settings = settings(max_examples=100, stateful_step_count=30, deadline=None)
