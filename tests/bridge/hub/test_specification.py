"""The hub and rosbridge_suite's ROSBRIDGE_PROTOCOL.md, operation by operation, in raw messages.

Where the hub differs, docs/reference/rosbridge-differences.md says so.
"""

import json

import pytest

from bridge.codecs import png

DOCK = "/dock"
DOCK_TYPE = "a/action/Dock"


@pytest.fixture
def strict(hub):
    """A client that gets status messages."""
    peer = hub.connect()
    peer.send(op="set_level", level="error")
    return peer


@pytest.mark.parametrize(
    "raw",
    [
        b"{}",
        b'{"op":"png","data":"iVBORw0KGgo="}',  # only servers send it
        b'{"op":"status","level":"error","msg":"x"}',
        b'{"op":"set_status_level","level":"error"}',  # the name in the list of 2.; in 3.2.1 it is set_level
        b'{"op":"set_level","level":"loud"}',
        b'{"op":"auth","mac":"","client":"","dest":"","rand":"","t":0,"level":"","end":0}',
        b'{"op":"publish","topic":"/nowhere","msg":{}}',
        b'{"op":"unadvertise","topic":"/nowhere"}',
        b'{"op":"unsubscribe","topic":"/nowhere"}',
        b'{"op":"unadvertise_service","service":"/nowhere"}',
        b'{"op":"unadvertise_action","action":"/nowhere"}',
        b'{"op":"cancel_action_goal","id":"x","action":"/nowhere"}',
        b'{"op":"advertise","topic":"/t"}',
        b'{"op":"advertise","topic":"/rosout","type":"std_msgs/String"}',
        b'{"op":"advertise","topic":"/t","type":"a/B"}{"op":"advertise","topic":"/u","type":"a/B"}',
    ],
)
def test_a_refused_operation_causes_one_status_message(strict, raw):
    strict.send_raw(raw)
    (status,) = strict.read()
    assert (status["op"], status["level"]) == ("status", "error")
    assert strict.hub.broker.graph.topics == {}


@pytest.mark.parametrize("level", ["info", "warning", "error"])
def test_every_level_includes_errors_and_nothing_else(hub, level):
    peer = hub.connect()
    peer.send(op="set_level", level=level, id="i")
    peer.send(op="advertise", topic="/t", type="std_msgs/String")
    peer.send(op="publish", topic="/t", msg={})  # a subset of its type
    assert peer.read() == []
    peer.send(op="fly", id="f")
    assert peer.read()[0]["id"] == "f"


def test_extra_fields_are_ignored(hub):
    publisher, subscriber = hub.connect(), hub.connect()
    publisher.send(op="advertise", topic="/t", type="a/B", queue_size=1, message_intervall=5, png="png")
    subscriber.send(op="subscribe", topic="/t", type="a/B", message_intervall=5, png="png")
    publisher.publish("/t", {"a": 1})
    assert subscriber.messages() == [{"a": 1}]


def _goal(hub, **options):
    server, client = hub.connect(), hub.connect()
    server.send(op="advertise_action", action=DOCK, type=DOCK_TYPE)
    client.send(op="send_action_goal", **{"action": DOCK, "action_type": DOCK_TYPE} | options)
    return server, client, server.read()


def test_one_goal_at_a_time_may_have_no_id(hub):
    server, client, (goal,) = _goal(hub)
    client.send(op="send_action_goal", action=DOCK, action_type=DOCK_TYPE)
    (refusal,) = client.read()
    assert (refusal["result"], "id" in refusal) == (False, False)
    client.send(op="cancel_action_goal", action=DOCK)
    assert server.read() == [{"op": "cancel_action_goal", "id": goal["id"], "action": DOCK}]
    server.send(op="action_result", id=goal["id"], action=DOCK, values={}, status=5, result=True)
    assert client.read() == [
        {"op": "action_result", "action": DOCK, "values": {}, "status": 5, "result": True}
    ]


def test_feedback_and_result_as_png(hub):
    server, client, (goal,) = _goal(hub, compression="png", feedback=True, id="g")
    server.send(op="action_feedback", id=goal["id"], action=DOCK, values={"a": 1})
    server.send(op="action_result", id=goal["id"], action=DOCK, values={"b": 1}, status=4, result=True)
    operations = [json.loads(png.decode(operation["data"])) for operation in client.read()]
    assert [operation["values"] for operation in operations] == [{"a": 1}, {"b": 1}]
