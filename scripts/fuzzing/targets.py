"""Fuzzing targets, each of which takes any bytes and fails if the bridge violates an invariant.

A target reads its input as a small program (`Source`): one input determines the requests to the client, the
operations of a server, their encodings, and when the connection breaks. `scripts/fuzz` runs them under
atheris; tests/bridge runs them with generated input, and with every input that ever failed
(tests/bridge/findings).
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import orjson

from bridge import fields
from bridge.client.protocol import ClientCore, Delivery
from bridge.client.protocol.calls import MAX_CALLS
from bridge.client.protocol.events import (
    CallAnswered,
    GoalEnded,
    GoalFeedback,
    MessageDiscarded,
    MessageReceived,
    ServiceRequested,
    StatusReceived,
    Unusable,
)
from bridge.client.protocol.goals import MAX_GOALS
from bridge.client.protocol.services import MAX_REQUESTS
from bridge.codecs import cbor_codec, json_codec, png
from bridge.codecs.arrays import with_arrays, with_lists
from bridge.codecs.fragments import Reassembler, split
from bridge.codecs.serialised import MessageTypes
from bridge.errors import BridgeError, DecodeError, EncodeError, PathError
from bridge.hub.broker import Broker
from bridge.hub.limits import HubLimits
from bridge.qos import Qos

LONGEST_SENTENCE = 700
"""Maximum number of characters in an error message, which quotes only part of the received data."""
MAX_SIZE, MAX_DEPTH = 4096, 8
TOPICS = ("/a", "b", "/a/b")
DELIVERIES = (
    Delivery(),
    Delivery(compression="cbor"),
    Delivery(compression="cbor", arrays="numpy"),
    Delivery(compression="cbor-raw"),
    Delivery(compression="png", fragment_size=7),
    Delivery(arrays="numpy", qos=Qos(depth=1)),
    Delivery(max_bytes=40),
)
OPS = (
    "publish",
    "service_response",
    "call_service",
    "status",
    "action_feedback",
    "action_result",
    "fragment",
    "png",
    "bogus",
)
ODD: tuple[Any, ...] = (
    None,
    True,
    0,
    -1,
    3,
    1.5,
    1e300,
    2**63,
    2**70,
    "",
    "x",
    "/a",
    "9",
    "\ud800",
    [],
    [1.5, None],
    [[[]]],
    {},
    {"a": [1]},
)
ENVELOPES = (
    b'{"op":"publish","topic":"/a","msg":',
    b'{"op":"publish","topic":"/a","msg":',
    b'{"op": "publish", "topic": "/a", "msg": ',
    b'{"op":"publish","topic":"a","msg":',
    b'{"op":"publish","topic":"b","msg":',
    b'{"topic":"\\/a","op":"publish","msg":',
    b'{"op":"publish","topic":"/a","id":1,"msg":',
    b'{"op":"publish","msg":{},"topic":"/a","msg":',
    b'{"op":"publish","topic":"/a","msg":{"msg":',
    b'{"op":"status","topic":"/a","msg":',
    b'{"op":"publish","topic":"/a","topic":"b","msg":',
    b'{"op":"publish","topic":"/a","msg":"',
    b"",
)
PARTS = (
    b"{}",
    b'{"a":1}',
    b'{"data":[1.5,-0.0,1e15,123456789012345678901234567890]}',
    b'{"a":{"b":{"c":[]}}}',
    b'{"a":[[[[[]]]]]}',
    b'{"a":NaN}',
    b'{"a":1e999}',
    b'{"a":"\xff"}',
    b'{"a":"\\ud800"}',
    b'{"a":"\\u00e9\xc3\xa9"}',
    b'{"a":1,"a":2}',
    b',"topic":"b"',
    b',"msg":{"z":1}',
    b"}",
    b"{",
    b'"',
    b" ",
    b"null",
    b"[1]",
    b'{"long":"' + b"x" * 600 + b'"}',
    b"",
)
EVENTS = (
    MessageReceived,
    MessageDiscarded,
    CallAnswered,
    ServiceRequested,
    StatusReceived,
    GoalFeedback,
    GoalEnded,
    Unusable,
)
TYPES = ("sensor_msgs/LaserScan", "std_msgs/String", "std_msgs/Float64MultiArray", "tf2_msgs/TFMessage")


class Source:
    """A program of bytes: choices, numbers and pieces; after its end all of them are 0 or empty."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def byte(self) -> int:
        """Return the next byte."""
        self._at += 1
        return self._data[self._at - 1] if self._at <= len(self._data) else 0

    def pick(self, choices: Any) -> Any:
        """Return one of the choices."""
        return choices[self.byte() % len(choices)]

    def piece(self) -> bytes:
        """Return up to 255 of the next bytes."""
        size = self.byte()
        self._at += size
        return self._data[self._at - size : self._at]

    def rest(self) -> bytes:
        """Return the rest."""
        rest, self._at = self._data[self._at :], len(self._data)
        return rest


def check_sentence(error: BridgeError) -> None:
    """Check that the text of an error is one short line."""
    said = str(error)
    assert said
    assert "\n" not in said
    assert len(said) <= LONGEST_SENTENCE, len(said)


def check_plain(value: Any, *, finite: bool, depth: int) -> None:
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
        assert value is None or type(value) in {str, int, bool, bytes, np.ndarray}, type(value)


def fuzz_json(data: bytes) -> None:
    """Decode JSON to an object of plain values that survives a round trip, or to one error."""
    try:
        message = json_codec.decode(data, max_size=MAX_SIZE, max_depth=MAX_DEPTH)
    except DecodeError as error:
        check_sentence(error)
        return
    assert type(message) is dict
    assert len(data) <= MAX_SIZE
    check_plain(message, finite=True, depth=MAX_DEPTH)
    written = json_codec.encode(message, nonfinite="refuse", max_size=100 * MAX_SIZE, max_depth=MAX_DEPTH)
    assert json_codec.decode(written, max_size=100 * MAX_SIZE, max_depth=MAX_DEPTH) == message
    as_text = json_codec.decode(data.decode("utf-8"), max_size=MAX_SIZE, max_depth=MAX_DEPTH)
    assert as_text == message
    with_lists(with_arrays(message))


def fuzz_cbor(data: bytes) -> None:
    """Decode CBOR to a map of plain values, alike as lists and as arrays, or to one error, and encode it."""
    forms: dict[str, Any] = {}
    for arrays in ("list", "numpy"):
        try:
            forms[arrays] = cbor_codec.decode(
                data, max_size=MAX_SIZE, max_depth=MAX_DEPTH, arrays="list" if arrays == "list" else "numpy"
            )
        except DecodeError as error:
            check_sentence(error)
    assert len(forms) in {0, 2}
    if not forms:
        return
    for message in forms.values():
        check_plain(message, finite=False, depth=MAX_DEPTH + 1)
    for pack in (False, True):
        written = cbor_codec.encode(forms["list"], max_size=100 * MAX_SIZE, pack_floats=pack)
        again = cbor_codec.decode(written, max_size=100 * MAX_SIZE)
        assert pack or repr(again) == repr(forms["list"])
    assert repr(with_lists(forms["numpy"])) == repr(forms["list"])


def fuzz_png(data: bytes) -> None:
    """Decode a picture to bytes within the limit, or to one error, and every message from its own picture."""
    try:
        found = png.decode(data.decode("latin-1"), max_size=MAX_SIZE)
        assert len(found) <= 16 * MAX_SIZE
    except DecodeError as error:
        check_sentence(error)
    assert png.decode(png.encode(data[:MAX_SIZE]), max_size=2 * MAX_SIZE).startswith(data[:MAX_SIZE])


def fuzz_fragments(data: bytes) -> None:
    """Reassemble fragments in any order and number, within all bounds."""
    source = Source(data)
    box = Reassembler(max_size=64, max_sets=3, max_age=10)
    now = 0.0
    while source:
        now += source.byte() / 16
        fragment = {
            "id": source.pick((0, 1, "a", None, True)),
            "num": source.pick((0, 1, 2, 3, "1", "0x1", 2.0, -1, 1.5, None, math.nan)),
            "total": source.pick((1, 2, 3, 2.5, "3", 0, -1, 1e9, math.inf, None)),
            "data": source.pick(("", "a", "b" * 30, "c" * 70, None, 5)),
        }
        try:
            whole = box.take(fragment, now)
            assert whole is None or len(whole) <= 64
        except DecodeError as error:
            check_sentence(error)
        assert len(box) <= 3
        assert 0 <= box.waiting_bytes <= 4 * (64 + 128)
        assert (box.waiting_bytes == 0) == (len(box) == 0)


def fuzz_fields(data: bytes) -> None:
    """Look up any path in any message, and find a value or an error with the reason."""
    source = Source(data)
    name = source.piece().decode("utf-8", "replace")
    try:
        field = fields.Field(name)
        message = json_codec.decode(source.rest(), max_size=MAX_SIZE)
    except (PathError, DecodeError) as error:
        check_sentence(error)
        return
    for form in (message, with_arrays(message)):
        try:
            present, _value = field.value(form)
            said = "" if present else str(field.missing(form))
        except BridgeError as error:
            said = str(error)
        assert "\n" not in said


_TYPES = MessageTypes()


def fuzz_serialised(data: bytes) -> None:
    """Decode serialised bytes to a message of the type, or to one error."""
    source = Source(data)
    name = source.pick(TYPES)
    try:
        message = _TYPES.read(source.rest()[:MAX_SIZE], name)
    except DecodeError as error:
        check_sentence(error)
    else:
        assert type(message) is dict


class Play:
    """A client's core between a user and a server that both may do anything."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.core = ClientCore(
            max_size=MAX_SIZE, max_depth=MAX_DEPTH, fragment_size=source.pick((None, 1, 50))
        )
        self.now = 0.0
        self.subscriptions: set[int] = set()
        self.advertisements: list[int] = []
        self.calls: list[str] = []
        self.goals: list[str] = []
        self.tickets: list[int] = []

    def run(self) -> None:
        """Run until the input ends."""
        steps: tuple[Callable[[], None], ...] = (
            self.receive_raw,
            self.receive,
            self.receive,
            self.receive,
            self.connect,
            self.core.lost,
            self.subscribe,
            self.unsubscribe,
            self.advertise,
            self.publish,
            self.unadvertise,
            self.call,
            self.send_goal,
            self.serve,
            self.answer,
            self.pass_time,
        )
        while self.source:
            self.now += 0.5
            try:
                self.source.pick(steps)()
            except BridgeError as error:
                check_sentence(error)
            self.check()

    def check(self) -> None:
        """Check the invariants."""
        core = self.core
        for data in core.data_to_send():
            assert core.wire.connected
            assert len(data) <= MAX_SIZE
            operation = json.loads(data, parse_constant=_no_constant)
            assert type(operation) is dict
            assert type(operation["op"]) is str
            pieces = list(core.wire.pieces(data))
            assert pieces == [data] or all(json.loads(piece)["op"] == "fragment" for piece in pieces)
        assert len(core.services) <= MAX_REQUESTS
        assert len(core.calls) <= MAX_CALLS
        assert len(core.goals) <= MAX_GOALS
        assert core._fragments.waiting_bytes <= 4 * (MAX_SIZE + 128)  # noqa: SLF001 - the size has no public name

    def receive_raw(self) -> None:
        """Receive any data from the server."""
        data = self.source.piece()
        self.take(data)
        with contextlib.suppress(UnicodeDecodeError):
            self.take(data.decode())

    def receive(self) -> None:
        """Receive an operation with any of its fields right or wrong, in any encoding."""
        source = self.source
        operation: dict[str, Any] = {"op": source.pick(OPS)}
        right = {
            "topic": source.pick(TOPICS),
            "msg": source.pick(({}, {"a": [1.5, 2]}, {"header": {"stamp": {"sec": 1}}}, {"bytes": "x"})),
            "id": source.pick((*self.calls[-2:], *self.goals[-2:], 7, "x")),
            "service": source.pick(("/s", "t", "u")),
            "values": source.pick(({}, {"a": 1}, "no")),
            "args": {},
            "result": bool(source.byte() % 3),
            "status": source.byte() % 9,
            "level": "error",
            "num": source.byte() % 3,
            "total": 2,
            "data": "x",
        }
        for name, value in right.items():
            choice = source.byte()
            if choice < 200:
                operation[name] = value
            elif choice < 240:
                operation[name] = source.pick(ODD)
        if operation.get("level") == "\ud800" or "\ud800" in map(str, operation.values()):
            return  # a server cannot send half a character
        form = source.pick(("json", "json", "cbor", "fragments", "png", "both"))
        text = json.dumps(operation).encode()
        if form == "cbor":
            try:
                self.take(cbor_codec.encode(operation))
            except EncodeError:
                return
        elif form == "png":
            self.take(_picture(text))
        elif form == "json":
            self.take(text)
        else:
            for piece in split(_picture(text) if form == "both" else text, 20, "f"):
                self.take(piece)

    def take(self, data: bytes | str) -> None:
        """Pass input to the core, which must cause at most one event."""
        event = self.core.receive(data, self.now)
        assert event is None or type(event) in EVENTS
        if type(event) is MessageReceived:
            assert event.subscriptions
            assert set(event.subscriptions) <= self.subscriptions
            assert type(event.msg) is dict
        elif type(event) is MessageDiscarded:
            assert event.size > event.limit
            assert event.subscriptions
            assert set(event.subscriptions) <= self.subscriptions
        elif type(event) is ServiceRequested:
            self.tickets.append(event.ticket)
        elif type(event) is Unusable:
            assert len(event.reason) <= LONGEST_SENTENCE
            assert "\n" not in event.reason

    def connect(self) -> None:
        """Establish a first or a further connection."""
        self.core.lost()
        self.core.restore()

    def subscribe(self) -> None:
        """Subscribe, perhaps with options that conflict with another subscription."""
        number = self.core.subscriptions.subscribe(
            self.source.pick(TOPICS),
            self.source.pick(("p/T", "p/msg/T", None, "p/U")),
            throttle_rate=self.source.pick((0, 0, 700, -1)),
            delivery=self.source.pick(DELIVERIES),
        )
        self.subscriptions.add(number)

    def unsubscribe(self) -> None:
        """Unsubscribe."""
        if self.subscriptions:
            number = sorted(self.subscriptions)[self.source.byte() % len(self.subscriptions)]
            self.subscriptions.remove(number)
            self.core.subscriptions.unsubscribe(number)

    def advertise(self) -> None:
        """Advertise a topic."""
        self.advertisements.append(
            self.core.publications.advertise(
                self.source.pick(TOPICS),
                self.source.pick(("p/T", "p/msg/T", "q")),
                latch=self.source.byte() % 2 == 0,
            )
        )

    def publish(self) -> None:
        """Publish a message, which may be impossible to encode."""
        if self.advertisements:
            number = self.advertisements[self.source.byte() % len(self.advertisements)]
            value = self.source.pick((*ODD, math.nan, np.arange(3.0), np.array([math.inf]), b"x", {1: 2}))
            data = self.core.publications.publish(number, {"value": value})
            assert type(json.loads(data, parse_constant=_no_constant)["msg"]) is dict

    def unadvertise(self) -> None:
        """Stop publishing."""
        if self.advertisements:
            self.core.publications.unadvertise(
                self.advertisements.pop(self.source.byte() % len(self.advertisements))
            )

    def call(self) -> None:
        """Call a service, and perhaps abandon the call."""
        self.calls.append(self.core.calls.send(self.source.pick(("/s", "t")), {"x": self.source.pick(ODD)}))
        if self.source.byte() % 4 == 0:
            self.core.calls.forget(self.calls[-1])

    def send_goal(self) -> None:
        """Send a goal, and perhaps cancel or abandon it."""
        goal = self.core.goals.send("/fly", "p/Fly", {"x": self.source.pick(ODD)}, feedback=True)
        self.goals.append(goal)
        what = self.source.byte() % 4
        if what == 0:
            self.core.goals.cancel(goal)
        elif what == 1:
            self.core.goals.forget(goal)

    def serve(self) -> None:
        """Offer a service, or withdraw it."""
        service = self.source.pick(("/s", "/t"))
        if service in self.core.services:
            self.core.services.unadvertise(service)
        else:
            self.core.services.advertise(service, "p/T")

    def answer(self) -> None:
        """Answer a request, perhaps an abandoned one."""
        if self.tickets:
            ticket = self.tickets.pop(self.source.byte() % len(self.tickets))
            self.core.services.answer(ticket, {"x": self.source.pick(ODD)}, ok=self.source.byte() % 2 == 0)

    def pass_time(self) -> None:
        """Let time pass."""
        self.now += 20 * (self.source.byte() % 2)
        self.core.subscriptions.retry_untyped()


def fuzz_core(data: bytes) -> None:
    """Check, with any user and server, that errors are the bridge's, memory is bounded, and output is JSON."""
    Play(Source(data)).run()


def _published(source: Source) -> bytes:
    """Return a possible publish operation: all or part of an envelope, and anything instead of its message."""
    message = b"".join(source.pick(PARTS) or source.piece() for _ in range(source.byte() % 6))
    return bytes(source.pick(ENVELOPES)) + message + bytes(source.pick((b"}", b"}", b"}", b"", b"} ", b"}}")))


def fuzz_again(data: bytes) -> None:
    """Compare a client that knows an envelope with one that parses everything."""
    source = Source(data)
    cores = [ClientCore(max_size=200, max_depth=3), ClientCore(max_size=200, max_depth=3)]
    delivery = source.pick((Delivery(), Delivery(arrays="numpy")))
    for core in cores:
        core.restore()
        core.subscriptions.subscribe("/a", delivery=delivery)
        core.subscriptions.subscribe("b")
    while source:
        received = _published(source)
        cores[1].subscriptions.forget_envelopes()  # so that it parses everything
        events = [repr(core.receive(received, 0.0)) for core in cores]
        assert events[0] == events[1], events
        assert len(cores[0].subscriptions.envelopes) <= 16


def fuzz_hub(data: bytes) -> None:
    """Compare a hub that knows a publisher's envelopes with one that parses everything."""
    source = Source(data)
    brokers = [Broker(HubLimits(depth=4)), Broker(HubLimits(depth=4))]
    publishers, received = [], []
    for broker in brokers:
        publishers.append(broker.connect("publisher"))
        listeners = [broker.connect("listener") for _ in range(3)]
        for client, topic, form in zip(listeners, ("/a", "a", "/a"), ("none", "none", "cbor"), strict=True):
            client.outbox.wire = []
            asked = {"op": "subscribe", "topic": topic, "compression": form, "queue_length": 1000}
            broker.receive(client, json.dumps(asked).encode(), 0.0)
        for topic, latch in (("/a", True), ("b", False)):
            asked = {"op": "advertise", "topic": topic, "type": "p/T", "latch": latch}
            broker.receive(publishers[-1], json.dumps(asked).encode(), 0.0)
        received.append(listeners)
    while source:
        said = [_published(source) for _ in range(source.byte() % 4)]
        if source.byte() % 8 == 0:
            said.append(b'{"op":"unadvertise","topic":"/a"}')
            said.append(b'{"op":"advertise","topic":"/a","type":"p/T"}')
        rest = said
        while rest:
            rest = rest[brokers[0].receive_turn(publishers[0], rest, 0.0) :]
        for one in said:
            brokers[1].receive(publishers[1], one, 0.0)
    for known, looked in zip(*received, strict=True):
        assert known.outbox.wire is not None
        assert looked.outbox.wire is not None
        assert [_read(payload) for payload in known.outbox.wire] == [
            _read(payload) for payload in looked.outbox.wire
        ]
    assert publishers[0].refused == publishers[1].refused
    latched = [
        topic.latched for broker in brokers for name, topic in broker.graph.topics.items() if name == "/a"
    ]
    assert repr(orjson.loads(latched[0] or b"{}")) == repr(orjson.loads(latched[1] or b"{}"))
    assert len(publishers[0].envelopes) <= len(publishers[0].advertisements)


def _read(payload: bytes) -> str:
    """Return the content of a payload: strict JSON, or CBOR."""
    return repr(orjson.loads(payload)) if payload[:1] == b"{" else payload.hex()


def _picture(text: bytes) -> bytes:
    return json.dumps({"op": "png", "data": png.encode(text)}).encode()


def _no_constant(name: str) -> None:
    raise AssertionError(f"{name} left as JSON")


TARGETS: dict[str, Callable[[bytes], None]] = {
    "json": fuzz_json,
    "cbor": fuzz_cbor,
    "png": fuzz_png,
    "fragments": fuzz_fragments,
    "fields": fuzz_fields,
    "serialised": fuzz_serialised,
    "core": fuzz_core,
    "again": fuzz_again,
    "hub": fuzz_hub,
}

_PUBLISH = b'{"op":"publish","topic":"/a","msg":{"data":[1.5,null,2],"deep":{"x":[{}]}}}'
SEEDS: dict[str, tuple[bytes, ...]] = {
    "json": (_PUBLISH, b'{"a":NaN,"b":[1e999,-Infinity,18446744073709551616],"c":"\\ud83d\\ude00"}'),
    "cbor": (
        cbor_codec.encode({"op": "publish", "msg": {"data": np.arange(3.0), "n": [1, "x", None, {}]}}),
        cbor_codec.encode({"a": b"\x01\x02", "b": np.arange(3, dtype=np.int16)}),
    ),
    "png": (png.encode(_PUBLISH).encode(),),
    "fields": (b"\x07a.b[10]" + _PUBLISH, b"\x01d" + _PUBLISH, b'\x04a[1]{"a":"AQID"}'),
    "serialised": (b"\x01\0\1\0\0\x04\0\0\0abc\0", b"\x02" + bytes(24), b"\x01\x03\0\0\0abc"),
    "again": (bytes([0, *([1, 0, 0, 0] * 3), 2, 1, 3, 0, 0]), bytes(range(64))),
    "hub": (bytes([*([3, 1, 0, 0, 0] * 4), 1, 1, 2, 0, 1]), bytes(range(64))),
    "core": (b"\0" + bytes(range(256)), bytes([0, 4, 6, 0, 0, 0, 1, *([1, 0] * 40)])),
}
