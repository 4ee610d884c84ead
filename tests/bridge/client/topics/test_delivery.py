"""Forms of delivery: CBOR, serialised bytes, fragments, arrays, quality of service; without a network.

ClientCore ──data_to_send──▶ the test (plays the server)
    ▲                          │
    └──────────receive─────────┘
"""

import json

import numpy as np
import pytest

from bridge.client.protocol import Delivery
from bridge.client.protocol.calls_and_goals import MAX_GOALS
from bridge.client.protocol.events import GoalEnded, GoalStatus, MessageReceived, UnusableReceived
from bridge.codecs.fragments import split
from bridge.errors import OptionError, SlowPeerError
from bridge.qos import Qos
from tests.bridge.client.stand_ins import as_cbor, connected, sent, tell

CBOR = Delivery(compression="cbor")
ARRAYS = Delivery(compression="cbor", arrays="numpy")
RAW = Delivery(compression="cbor-raw")


def publish(msg, topic="/a"):
    return {"op": "publish", "topic": topic, "msg": msg}


def in_cbor(msg, topic="/a"):
    return as_cbor(publish(msg, topic))


def in_json(msg, topic="/a"):
    return json.dumps(publish(msg, topic)).encode()


# Requests


def test_everything_that_can_be_asked_is_asked_again_after_a_loss():
    core = connected()
    delivery = Delivery(compression="cbor", fragment_size=1000, qos=Qos(depth=3))
    core.subscriptions.subscribe("/a", "p/T", delivery=delivery)
    core.publications.advertise("/b", "p/T", qos=Qos(durability="transient_local"))
    before = sent(core)
    core.lost()
    core.restore()
    advertise, subscribe = sent(core)
    assert before == [subscribe, advertise]
    assert (subscribe["compression"], subscribe["fragment_size"]) == ("cbor", 1000)
    assert (subscribe["qos"], advertise["qos"]) == ({"depth": 3}, {"durability": "transient_local"})


@pytest.mark.parametrize(
    "wrong",
    [
        {"compression": "zip"},
        {"arrays": "array"},
        {"fragment_size": 0},
        {"fragment_size": 1.5},
        {"fragment_size": True},
        {"compression": "cbor-raw", "arrays": "numpy"},
    ],
)
def test_what_cannot_be_asked(wrong):
    with pytest.raises(OptionError, match="|".join(wrong)):
        Delivery(**wrong)


# Deliveries


def test_topics_of_one_client_that_want_it_differently():
    core = connected()
    core.subscriptions.subscribe("/arrays", "p/T", delivery=ARRAYS)
    core.subscriptions.subscribe("/lists", "p/T", delivery=CBOR)
    core.subscriptions.subscribe("/raw", "p/T", delivery=RAW)
    core.subscriptions.subscribe("/json", "p/T")
    msg = {"data": np.array([1.5]), "bytes": b"\x01"}

    def came(data):
        event = core.receive(data, 0.0)
        assert isinstance(event, MessageReceived)
        return event.msg

    assert isinstance(came(in_cbor(msg, "/arrays"))["data"], np.ndarray)
    assert came(in_cbor(msg, "/lists")) == {"data": [1.5], "bytes": b"\x01"}
    assert came(in_cbor({"secs": 1, "nsecs": 2, "bytes": b"\x01"}, "/raw"))["bytes"] == b"\x01"
    assert came(in_json({"data": [1.5]}, "/json")) == {"data": [1.5]}


def test_cbor_that_nobody_asked_for_is_not_read():
    core = connected()
    number = core.subscriptions.subscribe("/a", "p/T")
    assert isinstance(core.receive(in_cbor({}), 0.0), UnusableReceived)
    core.subscriptions.unsubscribe(number)
    number = core.subscriptions.subscribe("/a", "p/T", delivery=CBOR)
    assert isinstance(core.receive(in_cbor({}), 0.0), MessageReceived)
    core.subscriptions.unsubscribe(number)
    assert isinstance(core.receive(in_cbor({}), 0.0), UnusableReceived)


def test_fragments_of_a_lost_connection_do_not_count():
    core = connected()
    core.subscriptions.subscribe("/a", "p/T", delivery=Delivery(fragment_size=10))
    first, *others = split(in_json({"text": "x" * 50}), 10, 0)
    for lost in (False, True):
        assert core.receive(first, 0.0) is None
        if lost:
            core.lost()
            core.restore()
        *rest, last = [core.receive(piece, 0.0) for piece in others]
        assert rest == [None] * len(rest)
        assert (last is None) == lost


# Goals of actions


def goal_of(core, **options):
    return core.goals.send("/fly", "boat_msgs/Fly", {"to": [1, 2]}, feedback=True, **options)


@pytest.mark.parametrize(
    ("answer", "ended"),
    [
        ({"values": {}, "status": 4, "result": True}, (True, GoalStatus.SUCCEEDED, {})),
        ({"values": {"a": 1}}, (True, GoalStatus.SUCCEEDED, {"a": 1})),
        ({}, (True, GoalStatus.SUCCEEDED, {})),
        ({"status": 77, "result": True}, (True, GoalStatus.UNKNOWN, {})),
        ({"status": "4", "result": True}, (True, GoalStatus.UNKNOWN, {})),
        ({"status": [4], "result": True}, (True, GoalStatus.UNKNOWN, {})),
        ({"values": "no", "status": 0, "result": False}, (False, GoalStatus.UNKNOWN, "no")),
        ({"values": {"why": 1}, "result": False}, (False, GoalStatus.UNKNOWN, '{"why":1}')),
    ],
)
def test_how_a_goal_may_end(answer, ended):
    core = connected()
    goal = goal_of(core)
    ok, status, values = ended
    assert tell(core, op="action_result", id=goal, **answer) == GoalEnded(
        goal, ok=ok, status=status, values=values
    )


def test_goals_are_bounded_and_forgotten_with_the_connection():
    core = connected()
    goals = [goal_of(core) for _ in range(MAX_GOALS)]
    with pytest.raises(SlowPeerError):
        goal_of(core)
    core.goals.forget(goals[0])
    goal_of(core)
    core.lost()
    core.restore()
    assert tell(core, op="action_result", id=goals[1], values={}) is None
    assert isinstance(tell(core, op="action_result", values={}), UnusableReceived)
    assert isinstance(tell(core, op="action_feedback", id=5, values={}), UnusableReceived)
