"""Malformed messages are refused silently, and their senders continue to be served."""

import json
import logging

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.bridge.hub.broker_harness import Harness


def _nested_fragments():
    operation = {"op": "call_service", "service": "/rosapi/get_time"}
    for _ in range(8):  # each one makes the next three times as large
        operation = {"op": "fragment", "id": "f", "data": json.dumps(operation), "num": 0, "total": 1}
    return json.dumps(operation).encode()


NONSENSE = [
    b"",
    b"42",
    b"{",
    b"\xff\xfe",
    b'{"op":"fly"}',
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
    b'{"op":"fragment","id":1,"data":"{\\"op\\":\\"fragment\\"}","num":0,"total":1}',
    b'{"op":"fragment","id":1,"data":"{}","num":-1,"total":1e400}',
    b'{"op":"advertise_action","action":"/a b","type":"a/B"}',
    b'{"op":"action_feedback","id":"x","action":"/a","values":{}}',
    b'{"op":"action_result","id":["x"],"action":"/a","values":{}}',
    b'{"op":"cancel_action_goal","id":{},"action":"/a"}',
    b'{"op":"subscribe","topic":"/t","qos":7}',
    b'{"op":"subscribe","topic":"/t","qos":{"depth":-1}}',
    b'{"op":"advertise","topic":"/t","type":"a/B","qos":{"durability":["volatile"]}}',
    b'{"op":"subscribe","topic":"/t","fragment_size":"small"}',
    b'{"op":"publish","topic":"/t","msg":{"a":1}}'.decode().encode("utf-16"),
    b'{"op":"advertise_service","service":"/rosapi/topics","type":"a/B"}',
    b'{"op":"advertise_service","service":"/a b","type":"a/B"}',
    b'{"op":"advertise_service","service":"/s","type":"nonsense"}',
    b'{"op":"call_service","service":7}',
    b'{"op":"call_service","service":"/s","id":1.5}',
    b'{"op":"service_response","id":7,"values":{},"result":true}',
    b'{"op":"service_response","values":{},"result":true}',
    b"{}",
    b'{"op":"png","data":"iVBORw0KGgo="}',  # only servers send it
    b'{"op":"status","level":"error","msg":"x"}',
    b'{"op":"set_status_level","level":"error"}',  # the name in the list of 2.; in 3.2.1 it is set_level
    b'{"op":"set_level","level":"loud"}',
    b'{"op":"publish","topic":"/nowhere","msg":{}}',
    b'{"op":"unadvertise","topic":"/nowhere"}',
    b'{"op":"unsubscribe","topic":"/nowhere"}',
    b'{"op":"unadvertise_service","service":"/nowhere"}',
    b'{"op":"unadvertise_action","action":"/nowhere"}',
    b'{"op":"cancel_action_goal","id":"x","action":"/nowhere"}',
    b'{"op":"advertise","topic":"/u"}',
    b'{"op":"advertise","topic":"/rosout","type":"std_msgs/String"}',
    b"\x81" * 100_000,
    b"\xd8\x56\x5b\xff\xff\xff\xff\xff\xff\xff\xff",
    _nested_fragments(),
]


@pytest.mark.parametrize("data", NONSENSE, ids=lambda data: repr(data[:40]))
def test_nonsense_is_refused_with_one_status_and_its_sender_served_on(data):
    hub = Harness()
    sender, other = hub.connect(), hub.connect()
    for peer in (sender, other):
        peer.advertise("/t")
        peer.subscribe("/t")
        peer.send_raw(data)
        assert peer.client.refused == 1
        assert peer.read() == []
    sender.send(op="set_level", level="error")
    sender.send_raw(data)
    assert [(said["op"], said["level"]) for said in sender.read()] == [("status", "error")]
    sender.send(op="set_level", level="none")
    assert not hub.broker.graph.services
    assert list(hub.broker.graph.topics) == ["/t"]
    sender.publish("/t", {"a": 1})
    assert sender.messages() == other.messages() == [{"a": 1}]


def test_depth_up_to_the_limit_passes():
    peer = Harness(depth=10).connect()
    peer.advertise("/t")
    peer.subscribe("/t")
    for levels, passes in ((8, True), (9, False)):  # the operation and its message are two more
        peer.send_raw(b'{"op":"publish","topic":"/t","msg":{"a":%b%b}}' % (b"[" * levels, b"]" * levels))
        assert bool(peer.read()) is passes


def test_a_message_beyond_the_limit_is_refused():
    peer = Harness(message_bytes=100).connect()
    peer.send_raw(b'{"op":"subscribe","topic":"/t"%b}' % (b" " * 100))
    assert peer.client.refused == 1


def test_a_flood_of_nonsense_does_not_flood_the_log(caplog):
    peer = Harness().connect("192.0.2.1")
    with caplog.at_level(logging.WARNING, "bridge.hub.broker"):
        for _ in range(1234):
            peer.send_raw(b"42")
    assert len(caplog.records) == 4  # the 1st, 10th, 100th and 1000th
    assert "192.0.2.1" in caplog.text


_JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text()),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=6,
)
_KNOWN_FIELDS = st.fixed_dictionaries(
    {"op": st.sampled_from(sorted(Harness().broker._operations))},
    optional=dict.fromkeys(["topic", "service", "type", "id", "msg", "args", "values", "result"], _JSON),
)


@given(st.lists(st.one_of(st.binary(), _JSON, _KNOWN_FIELDS), min_size=1, max_size=5))
@settings(max_examples=100, deadline=None)
def test_any_bytes_and_any_json_keep_the_hub_well(contents):
    hub = Harness()
    sender, other = hub.connect(), hub.connect()
    for content in contents:
        sender.send_raw(content if isinstance(content, bytes) else json.dumps(content).encode())
    sender.disconnect()
    other.advertise("/still/there")
    other.subscribe("/still/there")
    other.publish("/still/there", {"a": 1})
    assert other.messages() == [{"a": 1}]
