"""Absent fields of messages, which every subscriber sees with their defaults."""

import json
from functools import cache

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.codecs import cbor_codec
from bridge.hub.conversions import DEFAULTS, TIMES
from bridge.hub.definitions import _HEADER, MessageDefinitions
from bridge.hub.filling import _KNOWN
from bridge.names import ros2_type
from tests.bridge.hub.broker_harness import WALL_CLOCK, Harness, publisher_and_subscriber, unpacked

_SECONDS, _NANOSECONDS = divmod(WALL_CLOCK, 10**9)
_NOW = {1: {"secs": _SECONDS, "nsecs": _NANOSECONDS}, 2: {"sec": _SECONDS, "nanosec": _NANOSECONDS}}
_ZERO = {1: {"secs": 0, "nsecs": 0}, 2: {"sec": 0, "nanosec": 0}}
_IDENTITY = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


def _send(publisher, *payloads):
    """Send operations as a connection does, which recognises repeated envelopes."""
    assert publisher.hub.broker.receive_turn(publisher.client, list(payloads), 0.0) == len(payloads)


def test_a_complete_message_is_forwarded_as_it_was_received():
    publisher, subscriber = publisher_and_subscriber("std_msgs/Header")
    payload = b'{"op":"publish","topic":"/t","msg":{"frame_id":"" , "seq":1e0,"stamp":{"nsecs":0,"secs":0},"more":1}}'
    _send(publisher, payload, payload)
    assert subscriber.payloads()[1] == payload


@pytest.mark.parametrize("ros_version", [1, 2])
@pytest.mark.parametrize("header", [None, {}, {"frame_id": "map"}])
def test_an_absent_stamp_of_a_header_is_the_time_of_receipt(ros_version, header):
    publisher, subscriber = publisher_and_subscriber("geometry_msgs/PointStamped", ros_version)
    message = {"point": {"x": 1, "y": 2, "z": 3}} | ({} if header is None else {"header": header})
    publisher.publish("/t", message)
    (received,) = subscriber.messages()
    assert received["point"] == message["point"]
    assert received["header"]["stamp"] == _NOW[ros_version]
    assert received["header"]["frame_id"] == ("map" if header else "")
    assert ("seq" in received["header"]) is (ros_version == 1)


@pytest.mark.parametrize("ros_version", [1, 2])
def test_a_time_of_the_other_version_is_translated_alone(ros_version):
    publisher, subscriber = publisher_and_subscriber("std_msgs/Header", ros_version)
    publisher.publish("/t", {"stamp": _NOW[3 - ros_version], "frame_id": "a"})
    assert subscriber.messages()[0]["stamp"] == _NOW[1] | _NOW[2]


@pytest.mark.parametrize(
    ("type_name", "field", "default", "ros_version"),
    [
        ("geometry_msgs/PoseWithCovariance", "covariance", [0.0] * 36, 1),
        ("sensor_msgs/Image", "data", "", 1),
        ("std_msgs/ByteMultiArray", "data", [], 1),
        ("actionlib/TestActionResult", "result", {"result": 0}, 1),
        ("move_base_msgs/MoveBaseActionGoal", "goal_id", {"stamp": _ZERO[1], "id": ""}, 1),
        ("tf2_msgs/TFMessage", "transforms", [], 1),
        ("tf2_msgs/LookupTransformActionFeedback", "feedback", {}, 1),
        ("geometry_msgs/Pose", "orientation", _IDENTITY, 2),
        ("geometry_msgs/Pose", "orientation", _IDENTITY | {"w": 0.0}, 1),
    ],
)
def test_defaults_of_fields(type_name, field, default, ros_version):
    publisher, subscriber = publisher_and_subscriber(type_name, ros_version)
    publisher.publish("/t", {})
    assert subscriber.messages()[0][field] == default


def test_all_encodings_have_the_whole_message():
    hub = Harness()
    publisher = hub.connect()
    publisher.advertise("/t", "std_msgs/Float64MultiArray")
    peers = {name: hub.connect() for name in ("none", "png", "cbor", "cbor-raw")}
    for name, peer in peers.items():
        peer.subscribe("/t", compression=name)
    publisher.publish("/t", {"data": [1.5]})
    whole = {"data": [1.5], "layout": {"dim": [], "data_offset": 0}}
    for name in ("none", "cbor"):
        assert peers[name].messages() == [whole]
    (picture,) = peers["png"].read()
    assert unpacked(picture)["msg"] == whole
    (payload,) = peers["cbor-raw"].payloads()
    assert cbor_codec.decode(payload)["msg"]["bytes"] == b"\0" * 8 + b"\x01\0\0\0" + b"\0" * 6 + b"\xf8\x3f"


@pytest.mark.parametrize(
    "text", [b'{"markers":[%b{}]}' % (b"{}," * 50_000), b'{"x":"%b","y":0}' % (b"x" * ((1 << 20) - 60))]
)
def test_a_message_may_not_outgrow_the_limit(text):
    publisher, subscriber = publisher_and_subscriber("visualization_msgs/MarkerArray")
    envelope = b'{"op":"publish","topic":"/t","msg":'
    _send(publisher, b"%b{}}" % envelope, b"%b%b}" % (envelope, text))
    assert subscriber.messages() == [{"markers": []}]
    assert publisher.client.refused == 1
    publisher.publish("/t", {"markers": [{}]})
    assert json.loads(subscriber.payloads()[0])["msg"]["markers"][0]["pose"]["orientation"]["w"] == 0.0


_TYPES = (
    *(
        "std_msgs/Header",
        "std_msgs/Time",
        "std_msgs/Empty",
        "std_msgs/Float64MultiArray",
        "actionlib_msgs/GoalID",
    ),
    *("sensor_msgs/JointState", "geometry_msgs/Twist", "geometry_msgs/PoseStamped", "tf2_msgs/TFMessage"),
    *("nav_msgs/Odometry", "visualization_msgs/MarkerArray", "move_base_msgs/MoveBaseActionFeedback"),
)
_LEAVES = st.sampled_from(
    [0, 1.5, "a", None, True, [], {}, [{}], {"x": 1}, {"sec": 3, "nsecs": True}, ["a", 1]]
)


class Slow:
    """Filling as the reference server does it: field by field, for each message."""

    def __init__(self, definitions):
        self.types = definitions

    def filled(self, name, value):
        """Return a message with all its fields, in the order of the text with the absent ones appended."""
        if type(value) is not dict:
            return value
        fields = self.types.fields(name)
        whole = dict(value)
        for field, (element, length) in fields.items():
            if field not in value:
                if len(value) != len(fields) or name in TIMES:
                    whole[field] = self.default(name, field, value)
            elif element not in DEFAULTS:
                whole[field] = (
                    self.filled(element, value[field]) if length < 0 else self.each(element, value[field])
                )
        return whole

    def each(self, element, values):
        return [self.filled(element, value) for value in values] if type(values) is list else values

    def default(self, name, field, value):
        now = _NOW[self.types.ros_version]
        default = self.types.defaults(name)[field]
        if name in TIMES:
            given = value.get({"sec": "secs", "secs": "sec", "nanosec": "nsecs", "nsecs": "nanosec"}[field])
            return given if type(given) is int else 0
        if name == _HEADER and field == "stamp":
            return now
        return default | {"stamp": now} if self.types.fields(name)[field] == (_HEADER, -1) else default


def _messages(definitions, name):
    """Return messages of a type, mostly of its form, with some of the fields."""
    types = definitions
    fields = {"more": _LEAVES}
    for field, (element, length) in types.fields(name).items():
        if element in DEFAULTS:
            fields[field] = _LEAVES
        else:
            part = _messages(definitions, element)
            fields[field] = (part if length < 0 else st.lists(part, max_size=2)) | _LEAVES
    order = st.permutations(list(fields))
    return st.tuples(order, st.fixed_dictionaries({}, optional=fields)).map(
        lambda drawn: {field: drawn[1][field] for field in drawn[0] if field in drawn[1]}
    )


@cache
def _known(ros_version):
    definitions = MessageDefinitions(ros_version, lambda: WALL_CLOCK)
    definitions.load()
    return definitions


@cache
def _messages_of(ros_version, name):
    definitions = _known(ros_version)
    assert definitions.filler(name)
    return _messages(definitions, ros2_type(name))


@pytest.mark.parametrize("name", _TYPES)
@given(ros_version=st.sampled_from([1, 2]), data=st.data())
def test_messages_are_filled_as_field_by_field(name, ros_version, data):
    definitions = _known(ros_version)
    filler = definitions.filler(name)
    if filler is None:
        return  # a type of the other version
    slow = Slow(definitions)
    for given_message in data.draw(st.lists(_messages_of(ros_version, name), min_size=1, max_size=4)):
        expected = slow.filled(ros2_type(name), given_message)
        operation = json.dumps({"op": "publish", "topic": "/t", "msg": given_message}).encode()
        message = json.loads(operation)["msg"]
        tail = filler.fill(message, 100_000)
        assert json.dumps(message) == json.dumps(expected)
        if tail is not None:
            spliced = operation[:-2] + tail if tail else operation
            assert json.dumps(json.loads(spliced)["msg"]) == json.dumps(expected)
        assert (tail == b"") == (expected == given_message)


@pytest.mark.parametrize(
    "name", ["std_msgs/Float64MultiArray", "geometry_msgs/PoseStamped", "std_msgs/Header"]
)
@given(data=st.data())
def test_subscribers_of_a_burst_get_messages_filled_field_by_field(name, data):
    """The broker forwards a message as received, with appended fields or written again, to each name of the topic."""
    slow = Slow(_known(1))
    hub = Harness()
    publisher, same, other, latecomer = (hub.connect() for _ in range(4))
    publisher.advertise("/t", name, latch=True)
    same.subscribe("/t")
    other.subscribe("t")
    messages = data.draw(st.lists(_messages_of(1, name), min_size=1, max_size=6))
    ends = data.draw(st.lists(st.sampled_from(["}", " }", "\n}"]), min_size=6, max_size=6))
    texts = [json.dumps(message) for message in messages]
    _send(
        publisher,
        *(
            f'{{"op":"publish","topic":"/t","msg":{text}{end}'.encode()
            for text, end in zip(texts, ends, strict=False)
        ),
    )
    expected = [slow.filled(ros2_type(name), message) for message in messages]
    for peer in (same, other):
        assert json.dumps(peer.messages()) == json.dumps(expected)
    latecomer.subscribe("/t")
    assert json.dumps(latecomer.messages()) == json.dumps(expected[-1:])


def test_few_tails_are_kept():
    filler = _known(1).filler("sensor_msgs/CameraInfo")
    assert filler is not None
    fields = ["header", "height", "width", "distortion_model", "D", "K", "R", "P"]
    for number in range(1 << len(fields)):
        message = {field: 0 for bit, field in enumerate(fields) if number >> bit & 1}
        assert filler.fill(message, 10_000)
        assert filler.fill({"header": 0, "unknown": number}, 10_000)
    assert not any({"unknown"} & set(present) for present in filler._known)
    assert len(filler._known) <= _KNOWN
