"""Encodings that subscribers request: PNG, CBOR, serialised, fragments; each is produced once."""

import base64
import json
import logging
import math
import os
import sys

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from bridge.codecs import cbor_codec
from bridge.codecs.fragments import Reassembler
from bridge.hub import topics
from bridge.hub.definitions import MessageDefinitions
from bridge.hub.encodings import Encoding, OutgoingMessage
from bridge.hub.limits import RefusedOperationError
from tests.bridge.hub.broker_harness import WALL_CLOCK, Harness, publisher_and_subscriber, unpacked

ARRAY = "std_msgs/Float64MultiArray"


def _whole(payloads):
    reassembler = Reassembler()
    parts = [reassembler.take(json.loads(payload), 0) for payload in payloads]
    assert parts[:-1] == [None] * (len(parts) - 1)
    assert parts[-1] is not None
    return parts[-1]


# --- CBOR


def test_cbor_has_bytes_and_typed_arrays_of_the_types_elements():
    publisher, subscriber = publisher_and_subscriber("sensor_msgs/LaserScan", compression="cbor")
    scan = {"ranges": [1.5, 2, None], "intensities": [], "angle_min": -1.5, "header": {"frame_id": "é"}}
    publisher.publish("/t", scan)
    (payload,) = subscriber.payloads()
    msg = cbor_codec.decode(payload, arrays="numpy")["msg"]
    np.testing.assert_array_equal(msg["ranges"], np.array([1.5, 2, math.nan], "f4"), strict=True)
    np.testing.assert_array_equal(msg["intensities"], np.array([], "f4"), strict=True)
    assert (msg["angle_min"], msg["header"]["frame_id"]) == (-1.5, "é")
    publisher, subscriber = publisher_and_subscriber("sensor_msgs/PointCloud2", compression="cbor")
    for data in ("AAH/", [0, 1, 255]):
        publisher.publish("/t", {"data": data, "width": 3})
    assert [(cloud["data"], cloud["width"]) for cloud in subscriber.messages()] == [(b"\x00\x01\xff", 3)] * 2


@pytest.mark.parametrize(
    ("type_name", "message"),
    [
        ("boat_msgs/Sensors", {"data": [1.5, 2, None], "n": [1, 2]}),
        (ARRAY, {"data": [1.5, 2, None], "n": [1, 2]}),  # has no field n: nothing to go by for it
        (None, {"data": [1.5, 2.5], "n": [1, 2]}),  # no rosbags
    ],
)
def test_of_an_unknown_field_floats_alone_are_packed(type_name, message, monkeypatch):
    if type_name is None:
        monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    publisher, subscriber = publisher_and_subscriber(type_name or ARRAY, compression="cbor")
    publisher.publish("/t", message)
    (payload,) = subscriber.payloads()
    msg = cbor_codec.decode(payload, arrays="numpy")["msg"]
    assert msg["data"].dtype == "f8"
    assert msg["n"] == [1, 2]
    if type_name is None:
        assert subscriber.ask("/rosapi/message_details", {"type": ARRAY})["result"] is False


# --- serialised


@pytest.mark.parametrize("ros_version", [1, 2])
def test_cbor_raw_is_what_ros_would_send(ros_version):
    publisher, subscriber = publisher_and_subscriber(
        "geometry_msgs/PoseStamped", ros_version, compression="cbor-raw"
    )
    own, other = (("secs", "nsecs"), ("sec", "nanosec"))[:: 1 if ros_version == 1 else -1]
    for names in (own, other):
        header = {"stamp": dict(zip(names, (12, 34), strict=True)), "frame_id": "map"}
        publisher.publish("/t", {"header": header, "pose": {"position": {"x": 1.5, "y": 2}}})
    payloads = subscriber.payloads()
    store = get_typestore(Stores.ROS1_NOETIC if ros_version == 1 else Stores.ROS2_JAZZY)
    read = store.deserialize_ros1 if ros_version == 1 else store.deserialize_cdr
    for payload in payloads:
        msg = cbor_codec.decode(payload)["msg"]
        assert set(msg) == {"secs", "nsecs", "bytes"}
        assert msg["secs"] > 1_600_000_000
        pose = read(msg["bytes"], "geometry_msgs/msg/PoseStamped")
        assert (pose.header.stamp.sec, pose.header.stamp.nanosec) == (12, 34)
        assert pose.header.frame_id == "map"
        assert (pose.pose.position.x, pose.pose.position.y, pose.pose.position.z) == (1.5, 2.0, 0.0)
    assert len(payloads) == 2


def test_arrays_are_serialised_with_their_type_and_length():
    publisher, subscriber = publisher_and_subscriber("sensor_msgs/Imu", 2, compression="cbor-raw")
    publisher.publish("/t", {"orientation_covariance": [0.5, *[None] * 8]})
    imu = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(
        cbor_codec.decode(subscriber.payloads()[0])["msg"]["bytes"], "sensor_msgs/msg/Imu"
    )
    assert imu.orientation_covariance[0] == 0.5
    assert math.isnan(imu.orientation_covariance[8])
    assert imu.linear_acceleration_covariance.tolist() == [0.0] * 9


@pytest.mark.parametrize(
    ("type_name", "message"),
    [
        ("boat_msgs/Sensors", {}),
        ("std_msgs/String", {"date": "x"}),
        ("std_msgs/Int32", {"data": "7"}),
        ("std_msgs/Header", {"stamp": 7}),
        (ARRAY, {"layout": {"dim": 7}}),
    ],
)
def test_a_message_that_cannot_be_serialised_is_reported_once(type_name, message):
    publisher, subscriber = publisher_and_subscriber(type_name, compression="cbor-raw", id="the one")
    for _ in range(3):
        publisher.publish("/t", message)
    (status,) = subscriber.read()
    assert (status["op"], status["level"], status["id"]) == ("status", "error", "the one")
    assert type_name in status["msg"]
    assert publisher.read() == []


def test_a_png_that_is_larger_than_may_be_is_refused():
    publisher, subscriber = publisher_and_subscriber("a/B", limits={"message_bytes": 400}, compression="png")
    publisher.publish("/t", {"data": base64.b85encode(bytes(range(256))).decode()[:300]})
    assert subscriber.read()[0]["op"] == "status"
    assert subscriber.client.refused == 1


@pytest.mark.parametrize("compression", list(Encoding))
def test_the_limit_of_a_message_is_exact(compression):
    definitions = MessageDefinitions()
    message = {"data": "x" * 100}

    def payload(max_size):
        data = json.dumps(message).encode()
        return OutgoingMessage(data + b"}", 0, message, "std_msgs/String", 0, definitions, max_size).payload(
            compression, "/t"
        )

    size = len(payload(10_000))
    assert len(payload(size)) == size
    with pytest.raises(RefusedOperationError):
        payload(size - 1)


# --- fragments


@pytest.mark.parametrize(("asked", "size"), [(1, 256), (256, 256), (300, 300)])
@pytest.mark.parametrize("compression", ["none", "png"])
def test_a_message_in_fragments(asked, size, compression):
    publisher, subscriber = publisher_and_subscriber("a/B", fragment_size=asked, compression=compression)
    messages = [{"data": os.urandom(600).hex() + letter} for letter in "é☃"]
    for message in messages:
        publisher.publish("/t", message)
    by_id = {}
    for payload in subscriber.payloads():
        operation = json.loads(payload)
        assert operation["op"] == "fragment"
        assert 1 <= len(operation["data"]) <= size
        assert type(operation["total"]) is int
        by_id.setdefault(operation["id"], []).append(payload)
    heard = []
    for payloads in by_id.values():
        whole = json.loads(_whole(payloads))
        heard.append(unpacked(whole) if compression == "png" else whole)
    assert [operation["msg"] for operation in heard] == messages


@pytest.mark.parametrize(
    ("message", "wish"),
    [
        ({"a": 1}, {"fragment_size": 60}),
        ({"data": "x" * 1000}, {"fragment_size": 256, "compression": "cbor"}),
        *(({"a": 1}, {"compression": unknown}) for unknown in ("bson", "", None, 7, ["png"], {})),
    ],
)
def test_small_messages_cbor_and_unknown_forms_are_neither_cut_nor_packed(message, wish):
    publisher, subscriber = publisher_and_subscriber("a/B", **wish)
    publisher.publish("/t", message)
    assert subscriber.messages() == [message]


def test_fragments_are_dropped_as_messages_are():
    publisher, slow = publisher_and_subscriber("a/B", limits={"queue_length": 2}, fragment_size=256)
    for index in range(10):
        publisher.publish("/t", {"i": index, "data": "x" * 1000})
    payloads = slow.payloads()
    half = len(payloads) // 2
    assert [json.loads(_whole(part))["msg"]["i"] for part in (payloads[:half], payloads[half:])] == [8, 9]


def test_the_answer_to_a_call_in_fragments_and_as_png():
    peer = Harness().connect()
    peer.send(op="call_service", service="/rosapi/services", id="x", fragment_size=300)
    assert "/rosapi/topics" in json.loads(_whole(peer.payloads()))["values"]["services"]
    peer.send(op="call_service", service="/rosapi/services", id="x", compression="png")
    (operation,) = peer.read()
    assert unpacked(operation)["id"] == "x"


def test_of_several_wishes_the_last_form_and_the_least_size_count():
    publisher, subscriber = publisher_and_subscriber("a/B", id=1, fragment_size=640)
    subscriber.subscribe("/t", id=2, compression="cbor")
    subscriber.subscribe("/t", id=3, compression="png", fragment_size=320)
    noise = os.urandom(500).hex()
    publisher.publish("/t", {"data": noise})
    assert subscriber.messages() == [{"data": noise}], "as CBOR"
    subscriber.send(op="unsubscribe", topic="/t", id=2)
    publisher.publish("/t", {"data": noise})
    payloads = subscriber.payloads()
    assert max(len(json.loads(payload)["data"]) for payload in payloads) == 320
    assert json.loads(_whole(payloads))["op"] == "png"


def test_a_dropped_message_is_not_encoded(monkeypatch):
    publisher, subscriber = publisher_and_subscriber("a/B", compression="cbor", throttle_rate=1000)
    publisher.publish("/t", {"data": [1.5]})
    monkeypatch.setattr(topics.OutgoingMessage, "payload", None)
    publisher.publish("/t", {"data": [2.5]})
    assert subscriber.messages() == [{"data": [1.5]}]


# --- what goes wrong is told to who wants it


@pytest.mark.parametrize("level", ["info", "warning", "error"])
def test_status_messages_are_sent_on_request_and_do_not_pile_up(level):
    peer = Harness().connect()
    peer.send_raw(b"42")
    peer.send(op="set_level", level=level, id="i")
    peer.advertise("/s", "std_msgs/String", queue_size=1, png="png")  # further fields are ignored
    peer.publish("/s")  # a subset of its type
    assert peer.read() == []
    peer.send(op="fly", id="f1")
    peer.send(op="publish", topic="/t", id=7, msg=1)
    first, second = peer.read()
    assert (first["op"], first["level"], first["id"]) == ("status", "error", "f1")
    assert "fly" in first["msg"]
    assert second["id"] == 7
    for _ in range(1000):
        peer.send_raw(b"42")
    assert len(peer.read()) <= 20
    assert not peer.client.close_reason
    peer.send(op="set_level", level="none")
    peer.send(op="fly")
    assert peer.read() == []
    assert peer.client.refused == 1004


@pytest.mark.parametrize("ros_version", [1, 2])
def test_refusals_are_logged_on_rosout(ros_version):
    hub = Harness(ros_version=ros_version)
    peer, listener = hub.connect(), hub.connect()
    listener.subscribe("/rosout", type="rosgraph_msgs/Log" if ros_version == 1 else "rcl_interfaces/msg/Log")
    peer.send(op="fly")
    (log,) = listener.messages("/rosout")
    assert "/client_1" in log["msg"]
    assert "fly" in log["msg"]
    stamp = log["stamp"] if ros_version == 2 else log["header"]["stamp"]
    assert tuple(stamp) == (("sec", "nanosec") if ros_version == 2 else ("secs", "nsecs"))
    assert tuple(stamp.values()) == divmod(WALL_CLOCK, 10**9)
    listener.subscribe("/rosout", id="wrong", type="a/B")
    assert len(listener.messages("/rosout")) == 1


def test_a_failure_on_rosout_is_not_reported_there(monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    hub = Harness()
    peer = hub.connect()
    peer.subscribe("/rosout", compression="cbor-raw")
    with caplog.at_level(logging.WARNING):
        peer.send(op="fly")
    assert [operation["op"] for operation in peer.read()] == ["status"]


@pytest.mark.parametrize(
    ("wish", "length"),
    [
        ({"qos": {"depth": 3}}, 3),
        ({"qos": {"depth": 3}, "queue_length": 5}, 5),
        ({"qos": {"history": "keep_all"}}, 40),
        ({"qos": {}}, 20),
        ({"qos": {"depth": 10**6}}, 40),
        ({"qos": {"lifespan": {"secs": 1, "nsecs": 0}, "deadline": "infinite"}}, 20),
    ],
)
def test_depth_is_the_length_of_the_queue(wish, length):
    publisher, slow = publisher_and_subscriber(
        "a/B", limits={"queue_length": 20, "longest_queue": 40}, **wish
    )
    for index in range(100):
        publisher.publish("/t", {"i": index})
    assert len(slow.messages()) == length


@pytest.mark.parametrize(("ros_version", "time"), [(1, "time"), (2, "builtin_interfaces/msg/Time")])
def test_message_details(ros_version, time):
    peer = Harness(ros_version=ros_version).connect()
    definitions = peer.rosapi("message_details", type="sensor_msgs/LaserScan")["typedefs"]
    by_type = {definition["type"]: definition for definition in definitions}
    scan = definitions[0]
    at = scan["fieldnames"].index("ranges")
    assert (scan["fieldtypes"][at], scan["fieldarraylen"][at], scan["examples"][at]) == ("float32", 0, "[]")
    header = by_type[scan["fieldtypes"][0]]
    stamp = header["fieldnames"].index("stamp")
    assert header["fieldtypes"][stamp] == time
    assert by_type[time]["fieldnames"] == (["secs", "nsecs"] if ros_version == 1 else ["sec", "nanosec"])
    for definition in definitions:
        lengths = {len(definition[f"field{part}"]) for part in ("names", "types", "arraylen")}
        assert lengths == {len(definition["examples"])}
    array = peer.rosapi("message_details", type="sensor_msgs/Imu")["typedefs"][0]
    assert 9 in array["fieldarraylen"]


def test_topics_and_raw_types():
    hub = Harness()
    peer = hub.connect()
    peer.advertise("/known", "geometry_msgs/msg/PoseStamped")
    peer.advertise("/unknown", "boat_msgs/Sensors")
    answer = peer.rosapi("topics_and_raw_types")
    texts = dict(zip(answer["topics"], answer["typedefs_full_text"], strict=True))
    assert "MSG: std_msgs/Header" in texts["/known"]
    assert texts["/unknown"] == ""
    assert len(answer["types"]) == len(answer["topics"])
