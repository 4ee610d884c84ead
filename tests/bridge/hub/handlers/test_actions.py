"""Actions between clients: goals, feedback, cancellation, and exactly one result."""

from typing import Any

import pytest

from bridge.client.protocol.events import GoalStatus
from tests.bridge.hub.broker_harness import Guest, Room

TYPE = "example_interfaces/action/Fibonacci"


def _room(**limits: Any) -> tuple[Room, Guest, Guest]:
    room = Room(ros_version=2, **limits)
    server, client = room.enter(), room.enter()
    server.send(op="advertise_action", action="/count", type=TYPE)
    return room, server, client


def _goal(client: Guest, goal_id: Any = "g", **more: Any) -> None:
    client.send(op="send_action_goal", id=goal_id, action="/count", args={"order": 3}, **more)


def _request(server: Guest) -> dict[str, Any]:
    (request,) = server.read()
    assert request["op"] == "send_action_goal"
    return request


def test_a_goal_its_feedback_and_its_result() -> None:
    room, server, client = _room()
    _goal(client, feedback=True, action_type=TYPE)
    request = _request(server)
    assert (request["action"], request["action_type"], request["args"]) == ("/count", TYPE, {"order": 3})
    room.check()
    server.send(op="action_feedback", id=request["id"], action="/count", values={"part": 1})
    server.send(
        op="action_result", id=request["id"], action="/count", values={"all": 2}, status=4, result=True
    )
    feedback, result = client.read()
    assert feedback == {"op": "action_feedback", "action": "/count", "values": {"part": 1}, "id": "g"}
    assert result == {
        "op": "action_result",
        "action": "/count",
        "values": {"all": 2},
        "status": 4,
        "result": True,
        "id": "g",
    }
    assert not room.broker._actions.goals
    room.check()


def test_feedback_comes_only_to_who_asked_for_it() -> None:
    _, server, client = _room()
    _goal(client)
    server.send(op="action_feedback", id=_request(server)["id"], action="/count", values={"part": 1})
    assert client.read() == []


def test_a_goal_is_cancelled_by_its_server() -> None:
    room, server, client = _room()
    _goal(client, 7)
    request = _request(server)
    client.send(op="cancel_action_goal", id=7, action="count")
    assert server.read() == [{"op": "cancel_action_goal", "id": request["id"], "action": "/count"}]
    server.send(
        op="action_result",
        id=request["id"],
        action="/count",
        values={},
        status=GoalStatus.CANCELED,
        result=True,
    )
    (result,) = client.read()
    assert (result["id"], result["status"], result["result"]) == (7, GoalStatus.CANCELED, True)
    room.check()


def test_all_tasks_an_action_are_cancelled_by_its_service() -> None:
    _, server, client = _room()
    for number in range(3):
        _goal(client, number)
    server.read()
    answer = client.ask("/count/_action/cancel_goal")
    assert answer["result"] is True
    assert [operation["op"] for operation in server.read()] == ["cancel_action_goal"] * 3
    assert client.ask("/nothing/_action/cancel_goal")["result"] is False


@pytest.mark.parametrize(
    ("answer", "status", "said"),
    [
        ({"result": False}, GoalStatus.ABORTED, "did not reach"),
        ({"result": False, "values": "stuck", "status": 5}, GoalStatus.CANCELED, "stuck"),
        ({"result": False, "values": {"a": 1}, "status": 99}, GoalStatus.ABORTED, '{"a":1}'),
        ({"result": True, "values": [1]}, GoalStatus.ABORTED, "/count"),
        ({"result": "yes", "values": "?", "status": True}, GoalStatus.ABORTED, "?"),
    ],
)
def test_a_goal_that_fails_says_why(answer: dict[str, Any], status: int, said: str) -> None:
    room, server, client = _room()
    _goal(client)
    server.send(op="action_result", id=_request(server)["id"], action="/count", **answer)
    (result,) = client.read()
    assert (result["result"], result["status"]) == (False, status)
    assert said in result["values"]
    room.check()


def test_what_is_left_out_of_a_result_has_a_default() -> None:
    _, server, client = _room()
    _goal(client, None)
    server.send(op="action_result", id=_request(server)["id"], action="/count")
    (result,) = client.read()
    assert result == {
        "op": "action_result",
        "action": "/count",
        "values": {},
        "status": GoalStatus.SUCCEEDED,
        "result": True,
    }


@pytest.mark.parametrize(
    ("goal", "said"),
    [
        ({"action": "/nowhere"}, "does not exist"),
        ({"action": "/count", "action_type": "a/action/Other"}, "is of type"),
        ({"action": "/count", "action_type": "nonsense"}, "nonsense"),
        ({"action": "/count", "feedback": "much"}, "feedback"),
    ],
)
def test_a_goal_that_cannot_be_is_answered(goal: dict[str, Any], said: str) -> None:
    room, server, client = _room()
    client.send(op="send_action_goal", id="g", **goal)
    assert server.read() == []
    answers = client.read()
    if answers:
        assert (answers[0]["result"], answers[0]["status"]) == (False, GoalStatus.ABORTED)
        assert said in answers[0]["values"]
    else:
        pytest.fail("a goal without an answer")
    room.check()


def test_a_server_that_goes_fails_its_goals_and_a_client_that_goes_cancels_its_own() -> None:
    room, server, client = _room()
    _goal(client)
    server.leave()
    (result,) = client.read()
    assert (result["result"], result["status"]) == (False, GoalStatus.ABORTED)
    assert not room.broker.graph.actions
    room.check()
    room, server, client = _room()
    _goal(client)
    request = _request(server)
    client.leave()
    assert server.read() == [{"op": "cancel_action_goal", "id": request["id"], "action": "/count"}]
    server.send(op="action_result", id=request["id"], values={})
    assert server.client.refused == 1
    room.check()


def test_a_client_that_works_on_its_own_goal_and_goes_leaves_nothing() -> None:
    room = Room()
    guest = room.enter()
    guest.send(op="advertise_action", action="/count", type=TYPE)
    _goal(guest)
    guest.leave()
    assert not room.broker._actions.goals
    room.check()


def test_the_last_who_offers_an_action_works_on_its_goals() -> None:
    room, server, client = _room()
    second = room.enter()
    _goal(client, 1)
    first_request = _request(server)
    second.send(op="advertise_action", action="count", type=TYPE)
    _goal(client, 2)
    assert server.read() == []
    _request(second)
    server.send(op="unadvertise_action", action="/count")
    assert server.client.refused == 1
    server.send(op="action_result", id=first_request["id"], values={})
    assert client.read()[0]["id"] == 1
    assert client.rosapi("action_servers") == {"action_servers": ["/count"]}
    assert client.rosapi("action_type", action="count") == {"type": TYPE}
    second.send(op="unadvertise_action", action="/count")
    assert client.rosapi("action_servers") == {"action_servers": []}
    room.check()


def test_nobody_ends_the_tasks_others() -> None:
    room, server, client = _room()
    stranger = room.enter()
    _goal(client)
    key = _request(server)["id"]
    for operation in ("action_result", "action_feedback"):
        stranger.send(op=operation, id=key, action="/count", values={})
    stranger.send(op="cancel_action_goal", id="g", action="/count")
    client.send(op="cancel_action_goal", id="g", action="/other")
    assert (stranger.client.refused, client.client.refused) == (3, 1)
    assert client.read() == server.read() == []
    room.check()


def test_goals_are_bounded_and_each_refusal_is_an_answer() -> None:
    room, server, client = _room(goals_per_client=3)
    for number in range(5):
        _goal(client, number)
    _goal(client, 0)
    room.check()
    assert len(server.read()) == 3
    assert [(result["id"], result["result"]) for result in client.read()] == [
        (3, False),
        (4, False),
        (0, False),
    ]
    other = room.enter()
    _goal(other, "one more for the server")
    assert other.read()[0]["result"] is False
    assert len(room.broker._actions.goals) == 3


def test_actions_are_bounded() -> None:
    room, server, _client = _room(services_per_client=2)
    for name in ("/two", "/three", "/four"):
        server.send(op="advertise_action", action=name, type=TYPE)
    assert len(room.broker.graph.actions) == 2
    room.check()


def test_a_slow_client_loses_feedback_and_no_result() -> None:
    room, server, client = _room(queue_length=3, client_bytes=1 << 20)
    _goal(client, feedback=True)
    key = _request(server)["id"]
    for index in range(100):
        server.send(op="action_feedback", id=key, values={"i": index})
        room.check()
    server.send(op="action_result", id=key, values={})
    *feedback, result = client.read()
    assert [operation["values"]["i"] for operation in feedback] == [97, 98, 99]
    assert result["op"] == "action_result"


def test_what_is_too_large_is_refused_and_answered() -> None:
    room, server, client = _room(message_bytes=400)
    client.send(op="send_action_goal", id="g" * 250, action="/count", args={"a": "x" * 50})
    key = _request(server)["id"]
    server.send(op="action_result", id=key, values={"a": "x" * 250})
    (result,) = client.read()
    assert result["result"] is False
    assert len(result["values"]) <= 50
    room.check()


def test_actionlibs_servers_are_found_by_their_topics() -> None:
    room = Room()
    guest = room.enter()
    for part in ("cancel", "status", "feedback", "result"):
        guest.advertise(f"/dock/{part}")
    assert guest.rosapi("action_servers") == {"action_servers": []}
    guest.subscribe("/dock/goal", type="a/B")
    assert guest.rosapi("action_servers") == {"action_servers": ["/dock"]}
