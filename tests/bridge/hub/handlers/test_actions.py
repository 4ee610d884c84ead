"""Actions between clients: goals, feedback, cancellation, and exactly one result."""

from typing import Any

import pytest

from bridge.client.protocol.events import GoalStatus
from tests.bridge.hub.broker_harness import Harness

TYPE = "example_interfaces/action/Fibonacci"


class Action:
    """A hub with a client that offers /count, and one that sends it goals."""

    def __init__(self, **limits: Any) -> None:
        self.hub = Harness(ros_version=2, **limits)
        self.server, self.client = self.hub.connect(), self.hub.connect()
        self.server.send(op="advertise_action", action="/count", type=TYPE)

    def send_goal(self, goal_id: Any = "g", **more: Any) -> None:
        self.client.send(op="send_action_goal", id=goal_id, action="/count", args={"order": 3}, **more)

    def request(self) -> dict[str, Any]:
        (request,) = self.server.read()
        assert request["op"] == "send_action_goal"
        return request

    def started(self, goal_id: Any = "g", **more: Any) -> str:
        """Send a goal, and return its key at the server."""
        self.send_goal(goal_id, **more)
        return str(self.request()["id"])

    def end(self, key: str, **result: Any) -> dict[str, Any]:
        """End a goal, and return the result that the client gets."""
        self.server.send(op="action_result", id=key, action="/count", **result)
        (arrived,) = self.client.read()
        return arrived


@pytest.fixture
def action() -> Action:
    return Action()


def test_a_goal_its_feedback_and_its_result(action: Action) -> None:
    action.send_goal(feedback=True, action_type=TYPE)
    request = action.request()
    assert (request["action"], request["action_type"], request["args"]) == ("/count", TYPE, {"order": 3})
    action.server.send(op="action_feedback", id=request["id"], action="/count", values={"part": 1})
    assert action.client.read() == [
        {"op": "action_feedback", "action": "/count", "values": {"part": 1}, "id": "g"}
    ]
    result = {"action": "/count", "values": {"all": 2}, "status": 4, "result": True}
    ended = action.end(request["id"], values={"all": 2}, status=4, result=True)
    assert ended == {"op": "action_result", "id": "g", **result}
    assert not action.hub.broker._actions.goals


def test_feedback_is_sent_only_if_requested(action: Action) -> None:
    action.server.send(op="action_feedback", id=action.started(), action="/count", values={"part": 1})
    assert action.client.read() == []


def test_a_goal_is_cancelled_by_its_server(action: Action) -> None:
    key = action.started(7)
    action.client.send(op="cancel_action_goal", id=7, action="count")
    assert action.server.read() == [{"op": "cancel_action_goal", "id": key, "action": "/count"}]
    result = action.end(key, values={}, status=GoalStatus.CANCELED, result=True)
    assert (result["id"], result["status"], result["result"]) == (7, GoalStatus.CANCELED, True)


def test_all_goals_of_an_action_are_cancelled_by_its_service(action: Action) -> None:
    for number in range(3):
        action.send_goal(number)
    action.server.read()
    assert action.client.ask("/count/_action/cancel_goal")["result"] is True
    assert [operation["op"] for operation in action.server.read()] == ["cancel_action_goal"] * 3
    assert action.client.ask("/nothing/_action/cancel_goal")["result"] is False


@pytest.mark.parametrize(
    ("answer", "status", "part"),
    [
        ({"result": False}, GoalStatus.ABORTED, "/count"),
        ({"result": False, "values": "stuck", "status": 5}, GoalStatus.CANCELED, "stuck"),
        ({"result": False, "values": {"a": 1}, "status": 99}, GoalStatus.ABORTED, '{"a":1}'),
        ({"result": True, "values": [1]}, GoalStatus.ABORTED, "/count"),
        ({"result": "yes", "values": "?", "status": True}, GoalStatus.ABORTED, "?"),
    ],
)
def test_a_failed_goal_has_a_reason(action: Action, answer: dict[str, Any], status: int, part: str) -> None:
    result = action.end(action.started(), **answer)
    assert (result["result"], result["status"]) == (False, status)
    assert part in result["values"]


def test_fields_left_out_of_a_result_have_defaults(action: Action) -> None:
    assert action.end(action.started(None)) == {
        "op": "action_result",
        "action": "/count",
        "values": {},
        "status": GoalStatus.SUCCEEDED,
        "result": True,
    }


@pytest.mark.parametrize(
    "goal",
    [
        {"action": "/nowhere"},
        {"action": "/count", "action_type": "a/action/Other"},
        {"action": "/count", "action_type": "nonsense"},
        {"action": "/count", "feedback": "much"},
    ],
)
def test_an_impossible_goal_is_answered(action: Action, goal: dict[str, Any]) -> None:
    action.client.send(op="send_action_goal", id="g", **goal)
    assert action.server.read() == []
    (answer,) = action.client.read()
    assert (answer["result"], answer["status"]) == (False, GoalStatus.ABORTED)


def test_a_server_that_leaves_fails_its_goals(action: Action) -> None:
    action.started()
    action.server.send(op="send_action_goal", id="own", action="/count")
    action.server.disconnect()
    (result,) = action.client.read()
    assert (result["result"], result["status"]) == (False, GoalStatus.ABORTED)
    assert not action.hub.broker.graph.actions
    assert not action.hub.broker._actions.goals


def test_a_client_that_leaves_cancels_its_goals(action: Action) -> None:
    key = action.started()
    action.client.disconnect()
    assert action.server.read() == [{"op": "cancel_action_goal", "id": key, "action": "/count"}]
    action.server.send(op="action_result", id=key, values={})
    assert action.server.client.refused == 1


def test_the_newest_offer_of_an_action_counts(action: Action) -> None:
    second = action.hub.connect()
    first_key = action.started(1)
    second.send(op="advertise_action", action="count", type=TYPE)
    action.send_goal(2)
    assert action.server.read() == []
    assert len(second.read()) == 1
    action.server.send(op="unadvertise_action", action="/count")
    assert action.server.client.refused == 1
    assert action.end(first_key, values={})["id"] == 1
    assert action.client.rosapi("action_servers") == {"action_servers": ["/count"]}
    assert action.client.rosapi("action_type", action="count") == {"type": TYPE}
    second.send(op="unadvertise_action", action="/count")
    assert action.client.rosapi("action_servers") == {"action_servers": []}


def test_nobody_ends_the_goals_of_others(action: Action) -> None:
    stranger = action.hub.connect()
    key = action.started()
    for operation in ("action_result", "action_feedback"):
        stranger.send(op=operation, id=key, action="/count", values={})
    stranger.send(op="cancel_action_goal", id="g", action="/count")
    action.client.send(op="cancel_action_goal", id="g", action="/other")
    assert (stranger.client.refused, action.client.client.refused) == (3, 1)
    assert action.client.read() == action.server.read() == []


def test_goals_are_bounded_and_each_refusal_is_an_answer() -> None:
    action = Action(goals_per_client=3)
    for number in (0, 1, 2, 3, 4, 0):
        action.send_goal(number)
    assert len(action.server.read()) == 3
    assert [(result["id"], result["result"]) for result in action.client.read()] == [
        (number, False) for number in (3, 4, 0)
    ]
    other = action.hub.connect()
    other.send(op="send_action_goal", id="one more for the server", action="/count")
    assert other.read()[0]["result"] is False
    assert len(action.hub.broker._actions.goals) == 3


def test_a_slow_client_loses_feedback_but_not_the_result() -> None:
    action = Action(queue_length=3)
    key = action.started(feedback=True)
    for index in range(100):
        action.server.send(op="action_feedback", id=key, values={"i": index})
    action.server.send(op="action_result", id=key, values={})
    *feedback, result = action.client.read()
    assert [operation["values"]["i"] for operation in feedback] == [97, 98, 99]
    assert result["op"] == "action_result"


def test_a_result_that_is_too_large_fails_the_goal() -> None:
    action = Action(message_bytes=400)
    result = action.end(action.started("g" * 250), values={"a": "x" * 250})
    assert result["result"] is False
    assert len(result["values"]) <= 50


def test_actionlibs_servers_are_found_by_their_topics() -> None:
    peer = Harness().connect()
    for part in ("cancel", "status", "feedback", "result"):
        peer.advertise(f"/dock/{part}")
    assert peer.rosapi("action_servers") == {"action_servers": []}
    peer.subscribe("/dock/goal", type="a/B")
    assert peer.rosapi("action_servers") == {"action_servers": ["/dock"]}
