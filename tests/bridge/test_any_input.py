"""Any input to the bridge gives a right message or one error: codecs, fragments, fields, and the client's core.

What client and hub remember of a publisher's messages changes nothing: each is compared with one that parses all.
"""

import contextlib
import json
import math
from dataclasses import replace

import cbor2
import numpy as np
import orjson
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from bridge import fields
from bridge.client.protocol import ClientCore, Delivery
from bridge.client.protocol.calls_and_goals import MAX_CALLS, MAX_GOALS, MAX_REQUESTS
from bridge.client.protocol.events import (
    MessageDiscarded,
    MessageReceived,
    ServiceRequested,
    UnusableReceived,
)
from bridge.codecs import cbor_codec, json_codec
from bridge.codecs.cbor_codec import with_arrays, with_lists
from bridge.codecs.fragments import Reassembler, split
from bridge.errors import BridgeError, DecodeError
from bridge.hub.broker import Broker
from bridge.hub.limits import HubLimits
from bridge.names import absolute
from bridge.qos import Qos
from tests.bridge.client.stand_ins import as_cbor

MAX_SIZE, MAX_DEPTH = 4096, 8
LONGEST_SENTENCE = 700
"""Maximum number of characters in an error message, which quotes only part of the received data."""

_NUMBERS = ["null", "1", "-1.5e300", "1e999", '"a"', "NaN", "-Infinity", "true", "[]", "{}", str(2**64)]
json_like = st.recursive(
    st.sampled_from(_NUMBERS),
    lambda inner: (
        st.lists(inner, max_size=3).map(lambda parts: f"[{','.join(parts)}]")
        | inner.map(lambda part: f'{{"a":{part}}}')
    ),
    max_leaves=8,
).map(str.encode)
cbor_like = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=2), inner, max_size=3),
).map(lambda value: cbor2.dumps({"a": value}))


def check_sentence(error):
    said = str(error)
    assert said
    assert "\n" not in said
    assert len(said) <= LONGEST_SENTENCE


def check_plain(value, *, finite, depth):
    """Check that a message has only types of ROS messages."""
    assert depth >= 0
    if isinstance(value, dict):
        for key, part in value.items():
            assert type(key) is str
            check_plain(part, finite=finite, depth=depth - 1)
    elif isinstance(value, list):
        for part in value:
            check_plain(part, finite=finite, depth=depth - 1)
    elif type(value) is float:
        assert math.isfinite(value) or not finite
    else:
        assert value is None or type(value) in {str, int, bool, bytes, np.ndarray}


# Codecs


@settings(max_examples=200)
@given(st.binary(max_size=400) | json_like)
@example(b'{"a":NaN,"b":[1e999,-Infinity,18446744073709551616],"c":"\\ud83d\\ude00"}')
def test_json_gives_a_plain_message_that_survives_a_round_trip(data):
    try:
        message = json_codec.decode(data, max_size=MAX_SIZE, max_depth=MAX_DEPTH)
    except DecodeError as error:
        check_sentence(error)
        return
    check_plain(message, finite=True, depth=MAX_DEPTH)
    written = json_codec.encode(message, max_size=100 * MAX_SIZE, max_depth=MAX_DEPTH)
    assert json_codec.decode(written, max_size=100 * MAX_SIZE, max_depth=MAX_DEPTH) == message


@settings(max_examples=200)
@given(st.binary(max_size=100) | cbor_like)
@example(as_cbor({"a": b"\x01\x02", "b": np.arange(3, dtype=np.int16)}))
@example(  # typed arrays with tags in each other
    bytes.fromhex("a26161d840563b000000000000001cffffffffd84d4600008100036161d840d840d84046000081000300")
)
def test_cbor_gives_the_same_message_as_lists_and_as_arrays(data):
    forms = {}
    for arrays in ("list", "numpy"):
        try:
            forms[arrays] = cbor_codec.decode(data, max_size=MAX_SIZE, max_depth=MAX_DEPTH, arrays=arrays)
        except DecodeError as error:
            check_sentence(error)
    assert len(forms) in {0, 2}
    if not forms:
        return
    for message in forms.values():
        check_plain(message, finite=False, depth=MAX_DEPTH + 1)
    assert repr(with_lists(forms["numpy"])) == repr(forms["list"])
    written = cbor2.dumps(forms["list"])
    assert repr(cbor_codec.decode(written, max_size=100 * MAX_SIZE)) == repr(forms["list"])


@given(
    st.lists(
        st.fixed_dictionaries(
            {
                "id": st.sampled_from((0, 1, "a", "b", None, True)),
                "num": st.sampled_from((0, 1, 2))
                | st.sampled_from((3, "1", "0x1", 2.0, -1, 1.5, None, math.nan)),
                "total": st.just(3) | st.sampled_from((1, 2, 2.5, "3", 0, -1, 1e9, math.inf, None)),
                "data": st.sampled_from(("", "a", "b" * 30, "c" * 70, None, 5)),
            }
        ),
        max_size=40,
    )
)
def test_fragments_in_any_order_and_number_stay_within_their_bounds(fragments):
    box = Reassembler(max_size=64)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bridge.codecs.fragments.MAX_SETS", 2)
        for number, fragment in enumerate(fragments):
            try:
                whole = box.take(fragment, number * 1.5)
                assert whole is None or len(whole) <= 64
            except DecodeError as error:
                check_sentence(error)
            assert len(box) <= 2
            assert 0 <= box.waiting_bytes <= 4 * (64 + 128)
            assert (box.waiting_bytes == 0) == (len(box) == 0)


@given(st.text(max_size=12) | st.sampled_from(["a.b[10]", "a", "a[1]", "a.a"]), json_like)
@example("a[1]", b'{"a":"AQID"}')
def test_any_path_in_any_message_gives_a_value_or_a_reason_in_one_line(name, data):
    try:
        field = fields.Field(name)
        message = json_codec.decode(data, max_size=MAX_SIZE)
    except BridgeError as error:
        check_sentence(error)
        return
    for form in (message, with_arrays(message)):
        try:
            present, _value = field.value(form)
            said = "" if present else str(field.missing(form))
        except BridgeError as error:
            said = str(error)
        assert "\n" not in said


# The client's core between a user and a server that both may do anything

TOPICS = st.sampled_from(("/a", "a", "b", "/a/b"))
ODD = (
    *(None, True, 0, -1, 3, 1.5, 1e300, 2**63, 2**70, "", "x", "/a", "9", [], [1.5, None], [[[]]]),
    *({}, {"a": [1]}),
)
OPS = (
    *("publish", "publish", "service_response", "call_service", "status"),
    *("action_feedback", "action_result", "fragment", "png", "bogus"),
)
DELIVERIES = (
    Delivery(),
    Delivery(compression="cbor"),
    Delivery(compression="cbor", arrays="numpy"),
    Delivery(compression="cbor-raw"),
    Delivery(fragment_size=7),
    Delivery(arrays="numpy", qos=Qos(depth=1)),
    Delivery(max_bytes=40),
)


def no_constant(name):
    raise AssertionError(f"{name} left as JSON")


@contextlib.contextmanager
def refusals():
    """Let a request be refused, by an error of the bridge."""
    try:
        yield
    except BridgeError as error:
        check_sentence(error)


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
                assert (
                    other in {"publish", "fragment", "call_service", "service_response"} or "action" in other
                )


class AnyServer(RuleBasedStateMachine):
    """Check that errors are the bridge's, memory is bounded, output is strict JSON, and the server knows the wishes."""

    def __init__(self):
        super().__init__()
        self.core = ClientCore(max_size=MAX_SIZE, max_depth=MAX_DEPTH)
        self.core.restore()
        self.now = 0.0
        self.server = PaperServer()
        self.subscriptions = {}
        self.advertisements = []
        self.services = set()
        self.asked = []
        """Identities of calls and goals."""
        self.tickets = []

    @invariant()
    def bounds_strict_json_and_the_server_knows_what_is_wanted(self):
        core = self.core
        for data in core.data_to_send():
            assert core.wire.connected
            assert len(data) <= MAX_SIZE
            operation = json.loads(data, parse_constant=no_constant)
            assert type(operation["op"]) is str
            self.server.hear(operation)
        assert len(core.services) <= MAX_REQUESTS
        assert len(core.calls) <= MAX_CALLS
        assert len(core.goals) <= MAX_GOALS
        assert core._fragments.waiting_bytes <= 4 * (MAX_SIZE + 128)
        if core.wire.connected:
            assert set(self.server.advertised) == {topic for _number, topic in self.advertisements}
            assert self.server.services == self.services
            asked = {topic: by_id for topic, by_id in self.server.subscribed.items() if by_id}
            assert set(asked) == {topic for topic, _rate in self.subscriptions.values()}
            for topic, by_id in asked.items():
                (subscribe,) = by_id.values()  # one on the wire
                assert {(topic, subscribe["throttle_rate"])} == {
                    each for each in self.subscriptions.values() if each[0] == topic
                }

    def take(self, data, step=0.5):
        self.now += step
        event = self.core.receive(data if isinstance(data, bytes) else data.encode(), self.now)
        if isinstance(event, MessageReceived | MessageDiscarded):
            assert event.subscriptions
            assert len(set(event.subscriptions)) == len(event.subscriptions)
            assert set(event.subscriptions) == self.wanting(event.topic)
        if isinstance(event, MessageReceived):
            assert type(event.msg) is dict
        elif isinstance(event, MessageDiscarded):
            assert event.size > event.limit
        elif isinstance(event, ServiceRequested):
            self.tickets.append(event.ticket)
        elif isinstance(event, UnusableReceived):
            assert len(event.reason) <= LONGEST_SENTENCE
            assert "\n" not in event.reason
        return event

    def wanting(self, topic):
        return {number for number, (name, _rate) in self.subscriptions.items() if name == absolute(topic)}

    @rule(topic=TOPICS, step=st.sampled_from([0.0, 0.05, 0.2, 2.0]))
    def message(self, topic, step):
        event = self.take(json.dumps({"op": "publish", "topic": topic, "msg": {}}), step)
        assert (event is None) == (not self.wanting(topic))

    @rule(data=st.binary(max_size=60) | json_like)
    def receive_raw(self, data):
        self.take(data)

    @rule(draw=st.data(), form=st.sampled_from(("json", "json", "cbor", "fragments")))
    def receive(self, draw, form):
        """Receive an operation of which any field may be right, wrong or absent."""
        right = {
            "topic": TOPICS,
            "msg": st.sampled_from(({}, {"a": [1.5, 2]}, {"header": {"stamp": {"sec": 1}}}, {"bytes": "x"})),
            "id": st.sampled_from((*self.asked[-4:], 7, "x")),
            "service": st.sampled_from(("/s", "t", "u")),
            "values": st.sampled_from(({}, {"a": 1}, "no")),
            "args": st.just({}),
            "result": st.booleans(),
            "status": st.integers(0, 8),
            "level": st.just("error"),
            "num": st.integers(0, 2),
            "total": st.just(2),
            "data": st.just("x"),
        }
        operation = {"op": draw.draw(st.sampled_from(OPS))}
        wrong = draw.draw(st.dictionaries(st.sampled_from(sorted(right)), st.sampled_from(ODD), max_size=2))
        absent = draw.draw(st.sets(st.sampled_from(sorted(right)), max_size=2))
        operation |= {name: draw.draw(value) for name, value in right.items() if name not in absent} | wrong
        text = json.dumps(operation).encode()
        if form == "cbor":
            self.take(cbor2.dumps(operation))
        elif form == "json":
            self.take(text)
        else:
            for piece in split(text, 20, "f"):
                self.take(piece)

    @rule()
    def connect(self):
        self.core.lost()
        self.server = PaperServer()
        self.core.restore()

    @rule()
    def lose(self):
        self.core.lost()

    @rule(
        topic=TOPICS,
        type_name=st.sampled_from((*("p/T", "p/msg/T", None) * 3, "p/U")),
        rate=st.sampled_from((*[0] * 20, 100, -1)),
        delivery=st.sampled_from((*[Delivery()] * 20, *DELIVERIES)),
    )
    def subscribe(self, topic, type_name, rate, delivery):
        with refusals():
            wanted = replace(delivery, throttle_rate=rate)
            number = self.core.subscriptions.subscribe(topic, type_name, wanted)
            assert number not in self.subscriptions
            self.subscriptions[number] = (absolute(topic), rate)

    @rule(draw=st.data())
    @precondition(lambda self: self.subscriptions)
    def unsubscribe(self, draw):
        number = draw.draw(st.sampled_from(sorted(self.subscriptions)))
        del self.subscriptions[number]
        self.core.subscriptions.unsubscribe(number)

    @rule(topic=TOPICS, type_name=st.sampled_from(("p/T", "p/msg/T", "q")), latch=st.booleans())
    def advertise(self, topic, type_name, latch):
        with refusals():
            number = self.core.publications.advertise(topic, type_name, latch=latch)
            self.advertisements.append((number, absolute(topic)))

    @rule(
        value=st.sampled_from((*ODD, "\ud800", math.nan, np.arange(3.0), np.array([math.inf]), b"x", {1: 2}))
    )
    @precondition(lambda self: self.advertisements)
    def publish(self, value):
        with refusals():
            data = self.core.publications.publish(self.advertisements[-1][0], {"value": value})
            assert type(json.loads(data, parse_constant=no_constant)["msg"]) is dict

    @rule(draw=st.data())
    @precondition(lambda self: self.advertisements)
    def unadvertise(self, draw):
        at = draw.draw(st.integers(0, len(self.advertisements) - 1))
        self.core.publications.unadvertise(self.advertisements.pop(at)[0])

    @rule(name=st.sampled_from(("/s", "t")), value=st.sampled_from(ODD), forget=st.booleans())
    def call(self, name, value, forget):
        with refusals():
            self.asked.append(self.core.calls.send(name, {"x": value}))
            if forget:
                self.core.calls.forget(self.asked[-1])

    @rule(value=st.sampled_from(ODD), then=st.sampled_from(("", "cancel", "forget")))
    def send_goal(self, value, then):
        with refusals():
            self.asked.append(self.core.goals.send("/fly", "p/Fly", {"x": value}, feedback=True))
            if then:
                getattr(self.core.goals, then)(self.asked[-1])

    @rule(service=st.sampled_from(("/s", "/t")))
    def serve(self, service):
        if service in self.services:
            self.core.services.unadvertise(service)
        else:
            self.core.services.advertise(service, "p/T")
        self.services ^= {service}

    @rule(value=st.sampled_from(ODD), ok=st.booleans())
    @precondition(lambda self: self.tickets)
    def answer(self, value, ok):
        """Answer a request, perhaps one of a lost connection."""
        with refusals():
            self.core.services.answer(self.tickets.pop(), {"x": value}, ok=ok)

    @rule(seconds=st.sampled_from((0.0, 20.0)))
    def pass_time(self, seconds):
        self.now += seconds
        self.core.subscriptions.retry_untyped()
        for topic in self.core.subscriptions.silent():
            self.core.subscriptions.renew(topic)


AnyServer.TestCase.settings = settings(max_examples=200, stateful_step_count=30)
TestAnyServer = AnyServer.TestCase


# What client and hub remember of a publisher's messages

_ENVELOPES = (
    b'{"op":"publish","topic":"/a","msg":',
    b'{"op": "publish", "topic": "/a", "msg": ',
    b'{"op":"publish","topic":"a","msg":',
    b'{"op":"publish","topic":"/b","msg":',
    b'{"topic":"\\/a","op":"publish","msg":',
    b'{"op":"publish","topic":"/a","id":1,"msg":',
    b'{"op":"publish","msg":{},"topic":"/a","msg":',
    b'{"op":"publish","topic":"/a","msg":{"msg":',
    b'{"op":"status","topic":"/a","msg":',
    b'{"op":"publish","topic":"/a","topic":"/b","msg":',
    b'{"op":"publish","topic":"/a","msg":"',
    b"",
    b'{"op":"publish","msg":',
)
_DEEP = b'{"a":[[[[[]]]]]}'
_LONG = b'{"long":"' + b"x" * 600 + b'"}'
_PARTS = (
    *(b"{}", b'{"a":1}', b'{"data":[1.5,-0.0,1e15,123456789012345678901234567890]}', b'{"a":{"b":{"c":[]}}}'),
    *(_DEEP, b'{"a":NaN}', b'{"a":1e999}', b'{"a":"\xff"}', b'{"a":"\\ud800"}', b'{"a":"\\u00e9\xc3\xa9"}'),
    *(
        *(b'{"a":1,"a":2}', b',"topic":"/a"', b',"topic":"/b"', b',"msg":{"z":1}', b"}", b"{", b'"'),
        *(b" ", b"null", b"[1]", _LONG),
    ),
)
_right = st.tuples(
    st.sampled_from((_ENVELOPES[0], _ENVELOPES[3])), st.sampled_from(_PARTS[:4]), st.just(b"}")
)
_any = st.tuples(
    st.sampled_from(_ENVELOPES),
    st.lists(st.sampled_from(_PARTS) | st.binary(max_size=5), max_size=3).map(b"".join),
    st.sampled_from((b"}", b"}", b"}", b"", b"} ", b"}}", b"]")),
)
published = (_right | _any).map(b"".join)


@settings(max_examples=200)
@example([_ENVELOPES[0] + b"{}}", _ENVELOPES[0] + b"null}"], Delivery())
@example(
    [_ENVELOPES[0] + b"{}}"] * 3 + [None] + [_ENVELOPES[0] + b"{}}", b"\xff" * 20 + b"}"] * 2, Delivery()
)
@given(st.lists(published | st.none(), max_size=8), st.sampled_from((Delivery(), Delivery(arrays="numpy"))))
@example(
    [
        _ENVELOPES[2] + _PARTS[2] + b"} ",
        _ENVELOPES[10] + b"".join(_PARTS[6:11]) + b"}",
        _ENVELOPES[0] + b"{}}",
        _ENVELOPES[6] + b"[1]" + _LONG + b"{}{}}",
        _ENVELOPES[4] + b',"topic":"/b","msg":{"z":1}{}} ',
        _ENVELOPES[0] + b"[1]" + _LONG * 3 + b"{}{}}",
    ],
    Delivery(),
)
def test_a_client_that_knows_an_envelope_reads_what_one_does_that_parses_all(messages, delivery):
    cores = [ClientCore(max_size=200, max_depth=3), ClientCore(max_size=200, max_depth=3)]
    wanted = 0
    for core in cores:
        core.restore()
        core.subscriptions.subscribe("/b")
        core.subscriptions.subscribe("/b")
    for number, received in enumerate([None, *messages]):
        if received is None:  # the topic is wanted, or not wanted any more
            for core in cores:
                if wanted:
                    core.subscriptions.unsubscribe(wanted)
            again = (
                [] if wanted else [core.subscriptions.subscribe("/a", delivery=delivery) for core in cores]
            )
            wanted = max(again, default=0)
            continue
        cores[1].subscriptions.forget_envelopes()  # so that it parses everything
        events = [repr(core.receive(received, number / 3)) for core in cores]
        assert events[0] == events[1]
        assert len(cores[0].subscriptions.envelopes) <= 16


def _content(payload):
    """Return the content of a payload: strict JSON, or CBOR."""
    return repr(orjson.loads(payload)) if payload[:1] == b"{" else payload.hex()


_AGAIN = [b'{"op":"unadvertise","topic":"/a"}', b'{"op":"advertise","topic":"/a","type":"p/T"}']
_ENDED = [b'{"op":"unadvertise","topic":"/b"}']  # nobody is subscribed to it


@settings(max_examples=200)
@given(st.lists(st.lists(published, max_size=3) | st.sampled_from((_AGAIN, _ENDED)), max_size=8))
@example([[_ENVELOPES[0] + b"{}}", _ENVELOPES[0] + b"null}"]])
@example([[_ENVELOPES[0] + b"{}}"], [_ENVELOPES[0] + b"{}}", b"", _ENVELOPES[0] + b"{}}"]])
@example([[_ENVELOPES[3] + b"{}}"], _ENDED, [_ENVELOPES[3] + b"{}}"]])
@example([[_ENVELOPES[0] + b"{}}"], [_ENVELOPES[0] + b'{"a":1}]', _ENVELOPES[0] + b'{"a":1}} ']])
@example([[_ENVELOPES[12] + b'{"n":1},"topic":"/a"}', _ENVELOPES[12] + b'{"n":2}}']])
@example([[_ENVELOPES[0] + b"{}}", _ENVELOPES[1] + _LONG + b"}"], [_ENVELOPES[1] + _LONG + b"}"] * 2])
@example(
    [[_ENVELOPES[4] + _DEEP + b"}"]] * 3 + [[_ENVELOPES[4] + b'{"a":1}}'], [_ENVELOPES[6] + _DEEP + b"}"]]
)
def test_a_hub_that_knows_envelopes_delivers_what_one_does_that_parses_all(turns):
    brokers = [Broker(HubLimits(depth=4)), Broker(HubLimits(depth=4))]
    publishers, listeners = [], []
    for broker in brokers:
        publishers.append(broker.connect("publisher"))
        listeners.append([broker.connect("listener") for _ in range(3)])
        for client, topic, form in zip(
            listeners[-1], ("/a", "a", "/a"), ("none", "none", "cbor"), strict=True
        ):
            client.outbox.wire = []
            asked = {"op": "subscribe", "topic": topic, "compression": form, "queue_length": 1000}
            broker.receive(client, json.dumps(asked).encode(), 0.0)
        for topic, latch in (("/a", True), ("/b", False)):
            asked = {"op": "advertise", "topic": topic, "type": "p/T", "latch": latch}
            broker.receive(publishers[-1], json.dumps(asked).encode(), 0.0)
    for said in turns:
        rest = said
        while rest:
            rest = rest[brokers[0].receive_turn(publishers[0], rest, 0.0) :]
        for one in said:
            brokers[1].receive(publishers[1], one, 0.0)
    for known, parsed in zip(*listeners, strict=True):
        assert list(map(_content, known.outbox.wire)) == list(map(_content, parsed.outbox.wire))
    assert publishers[0].refused == publishers[1].refused
    latched = [
        broker.graph.topics["/a"].latched if "/a" in broker.graph.topics else None for broker in brokers
    ]
    assert repr(orjson.loads(latched[0] or b"{}")) == repr(orjson.loads(latched[1] or b"{}"))
    assert len(publishers[0].envelopes) <= len(publishers[0].advertisements)
