"""The client's state machine without a network.

ClientCore ──data_to_send──▶ PaperServer (keeps what the wire said)
    ▲                              │
    └───────────receive────────────┘
"""

import json
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from bridge.client.protocol import ClientCore
from bridge.client.protocol.calls import MAX_CALLS
from bridge.client.protocol.events import (
    CallAnswered,
    MessageReceived,
    ServiceRequested,
    StatusReceived,
    Unusable,
)
from bridge.client.protocol.services import MAX_REQUESTS
from bridge.codecs.json_codec import MAX_DEPTH
from bridge.errors import (
    BridgeError,
    EncodeError,
    NameFormError,
    OptionError,
    SlowPeerError,
    TypeConflictError,
)


def connected(**options: Any) -> ClientCore:
    core = ClientCore(**options)
    core.restore()
    return core


def sent(core: ClientCore) -> list[dict[str, Any]]:
    return [json.loads(data) for data in core.data_to_send()]


def tell(core: ClientCore, now: float = 0.0, **operation: Any) -> Any:
    return core.receive(json.dumps(operation), now)


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


def test_one_topic_advertised_twice_is_once_on_the_wire():
    core = connected()
    one, two = core.publications.advertise("/a", "p/T"), core.publications.advertise("a", "p/msg/T")
    assert len(sent(core)) == 1
    core.publications.unadvertise(one)
    assert sent(core) == []
    assert json.loads(core.publications.publish(two, {}))["topic"] == "/a"
    core.publications.unadvertise(two)
    assert len(sent(core)) == 1


def test_one_topic_advertised_as_two_things_is_refused():
    core = connected()
    core.publications.advertise("/a", "p/T")
    with pytest.raises(TypeConflictError, match=r"/a is already advertised as p/T.*p/U"):
        core.publications.advertise("/a", "p/U")
    with pytest.raises(TypeConflictError, match="latch"):
        core.publications.advertise("/a", "p/T", latch=True)
    assert len(sent(core)) == 1


def test_a_message_that_cannot_leave_is_named():
    core = connected()
    number = core.publications.advertise("/a", "p/T")
    with pytest.raises(EncodeError, match=r"^a message of /a cannot be published: x\.y is NaN"):
        core.publications.publish(number, {"x": {"y": math.nan}})


def test_the_limits_of_a_published_message():
    core = connected(max_size=100)
    number = core.publications.advertise("/a", "p/T")
    room = 100 - len(core.publications.publish(number, {"d": ""}))
    assert len(core.publications.publish(number, {"d": "x" * room})) == 100
    with pytest.raises(EncodeError, match="bytes"):
        core.publications.publish(number, {"d": "x" * (room + 1)})


def test_the_depth_of_a_published_message():
    core = connected()
    number = core.publications.advertise("/a", "p/T")

    def nested(levels: int) -> dict[str, Any]:
        return {"a": nested(levels - 1)} if levels else {}

    receiver = connected()
    receiver.subscriptions.subscribe("/a")
    deepest = core.publications.publish(number, nested(MAX_DEPTH - 2))
    assert isinstance(receiver.receive(deepest, 0.0), MessageReceived), "what leaves can also arrive"
    with pytest.raises(EncodeError, match="nested deeper"):
        core.publications.publish(number, nested(MAX_DEPTH - 1))


@pytest.mark.parametrize(
    ("version", "message_type", "service_type"),
    [(None, "p/T", "q/S"), (1, "p/T", "q/S"), (2, "p/msg/T", "q/srv/S")],
)
@pytest.mark.parametrize("form", ["p/T", "p/msg/T"])
def test_the_form_of_type_names_follows_the_server(version, message_type, service_type, form):
    core = connected(ros_version=version)
    core.publications.advertise("/a", form)
    core.subscriptions.subscribe("/b", form)
    core.services.advertise("/c", "q/S")
    assert [operation["type"] for operation in sent(core)] == [message_type, message_type, service_type]


# Subscribing


def test_subscribe_and_unsubscribe():
    core = connected()
    number = core.subscriptions.subscribe("/a", "p/T", throttle_rate=100, queue_length=3)
    (subscribe,) = sent(core)
    assert subscribe == {
        "op": "subscribe",
        "id": subscribe["id"],
        "topic": "/a",
        "type": "p/T",
        "throttle_rate": 100,
        "queue_length": 3,
    }
    assert tell(core, op="publish", topic="/a", msg={"d": 1}) == MessageReceived("/a", {"d": 1}, (number,))
    core.subscriptions.unsubscribe(number)
    assert sent(core) == [{"op": "unsubscribe", "id": subscribe["id"], "topic": "/a"}]
    assert tell(core, op="publish", topic="/a", msg={}) is None


def test_the_type_is_left_out_if_unknown():
    core = connected()
    core.subscriptions.subscribe("/a")
    (subscribe,) = sent(core)
    assert "type" not in subscribe


def test_several_subscriptions_share_one_on_the_wire():
    core = connected()
    slow = core.subscriptions.subscribe("/a", throttle_rate=100, queue_length=2)
    (first,) = sent(core)
    fast = core.subscriptions.subscribe("a", "p/T", throttle_rate=50)
    (second,) = sent(core)
    assert second == first | {"throttle_rate": 50, "type": "p/T"}
    same = core.subscriptions.subscribe("/a", throttle_rate=50)
    assert sent(core) == []
    assert tell(core, 0.0, op="publish", topic="/a", msg={}).subscriptions == (slow, fast, same)
    assert tell(core, 0.06, op="publish", topic="/a", msg={}).subscriptions == (fast, same)
    assert tell(core, 0.11, op="publish", topic="/a", msg={}).subscriptions == (slow, fast, same)
    core.subscriptions.unsubscribe(fast)
    assert sent(core) == []
    core.subscriptions.unsubscribe(same)
    assert sent(core) == [second | {"throttle_rate": 100}]
    core.subscriptions.unsubscribe(slow)
    assert sent(core) == [{"op": "unsubscribe", "id": first["id"], "topic": "/a"}]


def test_a_topic_is_known_with_and_without_its_slash():
    core = connected()
    number = core.subscriptions.subscribe("a")
    assert tell(core, op="publish", topic="/a", msg={}).subscriptions == (number,)
    assert tell(core, op="publish", topic="a", msg={}).subscriptions == (number,)


def test_one_topic_subscribed_as_two_types_is_refused():
    core = connected()
    core.subscriptions.subscribe("/a", "p/T")
    core.subscriptions.subscribe("/a", "p/msg/T")
    core.subscriptions.subscribe("/a")
    with pytest.raises(TypeConflictError, match=r"/a is already subscribed to as p/T, not as p/U"):
        core.subscriptions.subscribe("/a", "p/U")


@pytest.mark.parametrize("bad", [-1, 0.0, 1.5, True, None, "5"])
@pytest.mark.parametrize("option", ["throttle_rate", "queue_length"])
def test_what_would_kill_a_subscription_is_refused(option, bad):
    core = connected()
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


@pytest.mark.parametrize(
    ("header", "version"),
    [
        ({"stamp": {"sec": 1, "nanosec": 2}}, 2),
        ({"stamp": {"secs": 1, "nsecs": 2}, "seq": 1}, 1),
        ({}, None),
        (3, None),
    ],
)
def test_stamps_show_the_version(header, version):
    core = connected()
    core.subscriptions.subscribe("/a")
    core.subscriptions.subscribe("/b")
    tell(core, op="publish", topic="/a", msg={"no": "header"})
    tell(core, op="publish", topic="/b", msg={"header": header})
    assert core.subscriptions.seen_version == core.ros_version == version


@pytest.mark.parametrize("name", ["", "/a b", 'x"', "/a\\"])
def test_bad_names_are_refused_before_anything_is_sent(name):
    core = connected()
    for attempt in (
        lambda: core.publications.advertise(name, "p/T"),
        lambda: core.subscriptions.subscribe(name),
        lambda: core.calls.send(name, {}),
        lambda: core.services.advertise(name, "p/T"),
    ):
        with pytest.raises(NameFormError):
            attempt()
    assert sent(core) == []


# Calling


def test_a_call_and_its_answer():
    core = connected()
    call = core.calls.send("/s", {"a": 1})
    assert sent(core) == [{"op": "call_service", "id": call, "service": "/s", "args": {"a": 1}}]
    answer = {"op": "service_response", "service": "/s", "id": call, "values": {"b": 2}, "result": True}
    assert tell(core, **answer) == CallAnswered(call, ok=True, values={"b": 2})
    assert tell(core, **answer) is None, "only once"


@pytest.mark.parametrize(
    ("answer", "ok", "values"),
    [
        ({"values": "no such service", "result": False}, False, "no such service"),
        ({"result": False}, False, ""),
        ({"values": {"why": "not"}, "result": False}, False, '{"why":"not"}'),
        ({"values": {"a": 1}}, True, {"a": 1}),
        ({"result": True}, True, {}),
        ({"values": [1, 2], "result": True}, True, [1, 2]),
    ],
)
def test_answers_as_servers_give_them(answer, ok, values):
    core = connected()
    call = core.calls.send("/s", {})
    assert tell(core, op="service_response", id=call, **answer) == CallAnswered(call, ok=ok, values=values)


def test_an_answer_that_nobody_waits_for_is_passed_over():
    core = connected()
    call = core.calls.send("/s", {})
    core.calls.forget(call)
    assert tell(core, op="service_response", id=call, values={}, result=True) is None
    assert tell(core, op="service_response", id="other", values={}, result=True) is None
    assert isinstance(tell(core, op="service_response", values={}, result=True), Unusable)


def test_calls_are_bounded():
    core = connected()
    calls = [core.calls.send("/s", {}) for _ in range(MAX_CALLS)]
    with pytest.raises(SlowPeerError, match="/s"):
        core.calls.send("/s", {})
    core.calls.forget(calls[0])
    core.calls.send("/s", {})


# Serving


def test_a_request_and_its_answer():
    core = connected()
    core.services.advertise("/s", "p/T")
    assert sent(core) == [{"op": "advertise_service", "service": "/s", "type": "p/T"}]
    request = tell(core, op="call_service", service="/s", id="x1", args={"a": 1})
    assert isinstance(request, ServiceRequested)
    assert (request.service, request.args) == ("/s", {"a": 1})
    core.services.answer(request.ticket, {"b": 2})
    answer = {"op": "service_response", "service": "/s", "values": {"b": 2}, "result": True, "id": "x1"}
    assert sent(core) == [answer]
    core.services.answer(request.ticket, {"b": 2})
    assert sent(core) == [], "only once"


def test_a_request_without_args_or_id_and_a_refusal():
    core = connected()
    core.services.advertise("s", "p/T")
    sent(core)
    request = tell(core, op="call_service", service="/s")
    assert request.args == {}
    core.services.answer(request.ticket, "no", ok=False)
    assert sent(core) == [{"op": "service_response", "service": "/s", "values": "no", "result": False}]


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


def test_an_answer_that_cannot_leave_can_still_be_a_refusal():
    core = connected()
    core.services.advertise("/s", "p/T")
    request = tell(core, op="call_service", service="/s", id="x")
    sent(core)
    with pytest.raises(EncodeError):
        core.services.answer(request.ticket, {"a": math.nan})
    core.services.answer(request.ticket, "it is NaN", ok=False)
    assert [answer["values"] for answer in sent(core)] == ["it is NaN"]


# Losing and restoring


def test_everything_is_restored():
    core = connected()
    number = core.publications.advertise("/a", "p/T", latch=True)
    core.publications.advertise("/b", "p/T")
    core.subscriptions.subscribe("/c", "p/T", throttle_rate=5)
    core.services.advertise("/s", "p/T")
    before = sent(core)
    last = json.loads(core.publications.publish(number, {"last": 1}))
    core.lost()
    assert sent(core) == []
    core.subscriptions.subscribe("/later")
    assert sent(core) == [], "there is no one to tell"
    core.restore()
    restored = sent(core)
    assert [o["op"] for o in restored] == [
        "advertise",
        "publish",
        "advertise",
        "advertise_service",
        "subscribe",
        "subscribe",
    ]
    assert restored[1] == last
    for operation in before:
        assert operation in restored
    assert restored[-1]["topic"] == "/later"


def test_what_was_taken_back_is_not_restored():
    core = connected()
    advertisement, subscription = core.publications.advertise("/a", "p/T"), core.subscriptions.subscribe("/b")
    core.services.advertise("/s", "p/T")
    core.lost()
    core.publications.unadvertise(advertisement)
    core.subscriptions.unsubscribe(subscription)
    core.services.unadvertise("/s")
    core.restore()
    assert sent(core) == []


def test_calls_and_requests_end_with_the_connection():
    core = connected()
    core.services.advertise("/s", "p/T")
    call = core.calls.send("/x", {})
    request = tell(core, op="call_service", service="/s", id="x")
    core.lost()
    core.restore()
    sent(core)
    core.services.answer(request.ticket, {})
    assert sent(core) == []
    assert tell(core, op="service_response", id=call, values={}, result=True) is None


# Whatever arrives


@pytest.mark.parametrize(
    ("operation", "level", "text"),
    [
        ({"level": "error", "msg": "bad type"}, "error", "bad type"),
        ({"level": "info", "msg": {"a": 1}}, "info", '{"a":1}'),
        ({}, "error", ""),
        ({"level": 3, "msg": None}, "3", ""),
    ],
)
def test_status_messages_are_taken(operation, level, text):
    assert tell(connected(), op="status", **operation) == StatusReceived(level, text)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"42",
        b"{}",
        b'{"op": 3}',
        b'{"op": "publish"}',
        b'{"op": "publish", "topic": "/a", "msg": 3}',
        b'{"op": "publish", "topic": ["/a"], "msg": {}}',
        b'{"op": "service_response", "id": {}}',
        b'{"op": "call_service", "service": {}}',
        b'{"op": "call_service", "service": "/s", "id": []}',
        b'{"op": "fragment", "id": "1", "data": "", "num": 0, "total": 1.0}',
        b'{"op": "png", "data": "x"}',
        b'{"op": "nonsense"}',
        b"\x00\xff" * 500,
    ],
)
def test_what_is_unusable_says_so(data):
    core = connected()
    core.subscriptions.subscribe("/a")
    event = core.receive(data, 0.0)
    assert isinstance(event, Unusable)
    assert 10 < len(event.reason) < 300


words = st.sampled_from(
    [
        "op",
        "topic",
        "msg",
        "id",
        "service",
        "values",
        "result",
        "args",
        "level",
        "header",
        "stamp",
        "sec",
        "secs",
    ]
)
known = st.sampled_from(
    [
        "publish",
        "service_response",
        "call_service",
        "status",
        "png",
        "fragment",
        "/a",
        "/s",
        "a",
        "subscribe:/a:1",
    ]
)
junk = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4) | known,
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(words | st.text(max_size=3), inner, max_size=5)
    ),
    max_leaves=10,
)
operations = st.fixed_dictionaries(
    {"op": known},
    optional={"topic": known, "service": known}
    | dict.fromkeys(["id", "msg", "args", "values", "result", "level"], junk),
)


@settings(max_examples=400)
@given(st.lists(st.binary(max_size=80) | (junk | operations).map(json.dumps), max_size=6))
def test_nothing_that_arrives_raises_or_changes_what_is_wanted(arrivals):
    core = connected()
    core.publications.advertise("/a", "p/T")
    subscription = core.subscriptions.subscribe("/a")
    core.services.advertise("/s", "p/T")
    core.calls.send("/s", {})
    wanted = sent(core)[:3]
    for data in arrivals:
        event = core.receive(data, 0.0)
        if isinstance(event, MessageReceived):
            assert event.subscriptions == (subscription,)
        elif isinstance(event, ServiceRequested):
            core.services.answer(event.ticket, {"ok": True})
    assert all(answer["op"] == "service_response" for answer in sent(core))
    core.lost()
    core.restore()
    assert sent(core) == [wanted[0], wanted[2], wanted[1]]


# Any sequence of wishes, losses and messages

TOPICS = ["/a", "/b", "c"]


class PaperServer:
    """What a server would know from the wire, kept as simply as can be."""

    def __init__(self) -> None:
        self.advertised: dict[str, dict[str, Any]] = {}
        self.subscribed: dict[str, dict[str, dict[str, Any]]] = {}
        self.services: set[str] = set()

    def hear(self, operation: dict[str, Any]) -> None:
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
    """What this client wants and what the server knows must always agree while there is a connection."""

    def __init__(self) -> None:
        super().__init__()
        self.core = ClientCore()
        self.server = PaperServer()
        self.now = 0.0
        self.advertisements: dict[int, str] = {}
        self.subscriptions: dict[int, tuple[str, int, int]] = {}
        self.services: set[str] = set()

    @rule()
    def connect(self) -> None:
        self.core.lost()
        self.server = PaperServer()
        self.core.restore()

    @rule()
    def lose(self) -> None:
        self.core.lost()

    @rule(topic=st.sampled_from(TOPICS))
    def advertise(self, topic: str) -> None:
        self.advertisements[self.core.publications.advertise(topic, "p/T")] = topic

    @rule(data=st.data())
    @precondition(lambda self: self.advertisements)
    def unadvertise(self, data: Any) -> None:
        number = data.draw(st.sampled_from(sorted(self.advertisements)))
        self.core.publications.unadvertise(number)
        del self.advertisements[number]

    @rule(
        topic=st.sampled_from(TOPICS),
        type_name=st.sampled_from([None, "p/T", "p/msg/T"]),
        rate=st.sampled_from([0, 100, 1000]),
        length=st.sampled_from([0, 5]),
    )
    def subscribe(self, topic: str, type_name: str | None, rate: int, length: int) -> None:
        number = self.core.subscriptions.subscribe(topic, type_name, throttle_rate=rate, queue_length=length)
        assert number not in self.subscriptions
        self.subscriptions[number] = (topic, rate, length)

    @rule(data=st.data())
    @precondition(lambda self: self.subscriptions)
    def unsubscribe(self, data: Any) -> None:
        number = data.draw(st.sampled_from(sorted(self.subscriptions)))
        self.core.subscriptions.unsubscribe(number)
        del self.subscriptions[number]

    @rule(service=st.sampled_from(["/s", "/t"]))
    def toggle_service(self, service: str) -> None:
        if service in self.services:
            self.core.services.unadvertise(service)
        else:
            self.core.services.advertise(service, "p/T")
        self.services ^= {service}

    @rule()
    def ask_again(self) -> None:
        self.core.subscriptions.retry_untyped()

    @rule(name=st.text(max_size=3), rate=st.sampled_from([-1, 0.5, None]))
    def want_nonsense(self, name: str, rate: Any) -> None:
        for attempt in (
            lambda: self.core.subscriptions.subscribe("/a", throttle_rate=rate),
            lambda: self.core.publications.advertise(f" {name}", "p/T"),
            lambda: self.core.publications.advertise("/a", f" {name}"),
        ):
            with pytest.raises(BridgeError):
                attempt()

    @rule(topic=st.sampled_from(["/a", "/b", "/c", "c"]), step=st.sampled_from([0.0, 0.05, 0.2, 2.0]))
    def message(self, topic: str, step: float) -> None:
        self.now += step
        event = self.core.receive(json.dumps({"op": "publish", "topic": topic, "msg": {}}), self.now)
        wanting = {n: w for n, w in self.subscriptions.items() if w[0].strip("/") == topic.strip("/")}
        if event is None:
            # Only those who want fewer than the server was asked for can be left out.
            fastest = min((rate for _topic, rate, _length in wanting.values()), default=0)
            assert not any(rate == fastest for _topic, rate, _length in wanting.values())
            return
        assert isinstance(event, MessageReceived)
        assert set(event.subscriptions) <= set(wanting)
        assert len(set(event.subscriptions)) == len(event.subscriptions)
        fastest = min(rate for _topic, rate, _length in wanting.values())
        for number, (_topic, rate, _length) in wanting.items():
            if rate == fastest:
                assert number in event.subscriptions

    @invariant()
    def the_server_knows_what_is_wanted(self) -> None:
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
