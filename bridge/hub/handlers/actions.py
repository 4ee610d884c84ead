"""Actions between clients, as ROS 2 has them: goals with feedback, cancellation, and exactly one result each."""

import itertools
from dataclasses import dataclass, field
from typing import Any, Final

import orjson

from bridge.client.protocol.events import GoalStatus
from bridge.errors import BridgeError
from bridge.hub.delivery.dispatcher import Delivery
from bridge.hub.delivery.outbox import Lane
from bridge.hub.graph import Action, Client, Graph
from bridge.hub.handlers.calls import Asker, asker_of, note_takeover
from bridge.hub.limits import HubLimits
from bridge.hub.operations import (
    Operation,
    RefusedError,
    checked_name,
    flag,
    optional_text,
    text,
)
from bridge.names import absolute, ros2_type, same_type

#: The service of ROS 2 that cancels all goals of an action, as roslibjs calls it.
_CANCEL_ALL: Final = "/_action/cancel_goal"


@dataclass(eq=False, slots=True)
class _Goal:
    """A goal under way: who wants it, who works on it, and the way of its feedback."""

    key: str
    asker: Asker
    action: str
    server: Client
    wants_feedback: bool
    feedback: Lane = field(default_factory=Lane)


class Actions:
    """The actions of one hub, and the goals under way."""

    def __init__(self, graph: Graph, limits: HubLimits, delivery: Delivery) -> None:
        """Begin without an action."""
        self._graph = graph
        self._limits = limits
        self._delivery = delivery
        self._numbers = itertools.count(1)
        self.goals: dict[str, _Goal] = {}

    def leave(self, client: Client) -> None:
        """A client has gone: goals that it worked on are aborted, goals that it wanted are cancelled."""
        for name in client.actions:
            self._graph.actions.pop(name, None)
        for key in list(client.goals.values()):
            goal = self._take(key)
            self._send_cancel(goal)
        for key in list(client.goals_of):
            goal = self._take(key)
            self._fail(goal.asker, f"{goal.action} went away during the goal")

    def advertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Do ``advertise_action``."""
        name, type_name = checked_name(text(operation, "action")), text(operation, "type")
        type_name, key = ros2_type(type_name, "action"), absolute(name)
        if key not in client.actions and len(client.actions) >= self._limits.services_per_client:
            raise RefusedError(f"{name} would be one action more than {len(client.actions)}")
        before = self._graph.actions.get(key)
        if before is not None and before.client is not client:
            note_takeover(client, before.client, key)
            before.client.actions.discard(key)
        self._graph.actions[key] = Action(key, type_name, client)
        client.actions.add(key)

    def unadvertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Do ``unadvertise_action``. Goals under way may still be ended."""
        name = text(operation, "action")
        if absolute(name) not in client.actions:
            raise RefusedError(f"{name} is not offered by this client")
        client.actions.discard(absolute(name))
        del self._graph.actions[absolute(name)]

    def send_goal(self, client: Client, operation: Operation, _now: float) -> None:
        """Do ``send_action_goal``."""
        asker = asker_of(client, text(operation, "action"), operation)
        try:
            self._start(asker, operation)
        except (RefusedError, BridgeError) as error:
            self._fail(asker, str(error))

    def _start(self, asker: Asker, operation: Operation) -> None:
        client, name, args = asker.client, asker.name, operation.get("args")
        action = self._graph.actions.get(absolute(name))
        if action is None:
            raise RefusedError(f"Action {name} does not exist")
        type_name = optional_text(operation, "action_type")
        if type_name is not None and not same_type(ros2_type(type_name, "action"), action.type):
            raise RefusedError(f"{name} is of type {action.type}, not {type_name}")
        server = action.client
        if asker.id in client.goals:
            raise RefusedError(f"this client has a goal with the id {str(asker.id)[:80]!r} already")
        if len(client.goals) >= self._limits.goals_per_client:
            raise RefusedError(f"this client waits for {len(client.goals)} goals already")
        if len(server.goals_of) >= self._limits.goals_per_client:
            raise RefusedError(f"{name} works on {len(server.goals_of)} goals already")
        wants_feedback = flag(operation, "feedback")
        key = f"action_goal:{action.name}:{next(self._numbers)}"
        request = {
            "op": "send_action_goal",
            "id": key,
            "action": action.name,
            "action_type": action.type,
            "args": {} if args is None else args,
            "feedback": wants_feedback,
        }
        payload = orjson.dumps(request)
        if len(payload) > self._limits.message_bytes:
            raise RefusedError(f"the goal for {name} has more than {self._limits.message_bytes} bytes")
        lane = Lane(self._limits.queue_length)
        lane.fragment_size = asker.fragment_size
        self.goals[key] = _Goal(key, asker, action.name, server, wants_feedback, lane)
        client.goals[asker.id] = key
        server.goals_of.add(key)
        self._delivery.send(server, payload)

    def cancel(self, client: Client, operation: Operation, _now: float) -> None:
        """Do ``cancel_action_goal``: ask the server, whose result ends the goal."""
        name = text(operation, "action")
        goal_id = operation.get("id")
        key = client.goals.get(goal_id) if isinstance(goal_id, str | int | None) else None
        goal = self.goals[key] if key is not None else None
        if goal is None or goal.action != absolute(name):
            raise RefusedError(f"this client has no goal {str(goal_id)[:80]!r} of {name}")
        self._send_cancel(goal)

    def cancel_all(self, client: Client, service: str) -> dict[str, Any] | None:
        """Answer ``ACTION/_action/cancel_goal``: cancel the goals that this client has of it; None for other services."""
        name = service.removesuffix(_CANCEL_ALL)
        if name == service or name not in self._graph.actions:
            return None
        goals = [goal for key in client.goals.values() if (goal := self.goals[key]).action == name]
        for goal in goals:
            self._send_cancel(goal)
        return {"return_code": 0, "goals_canceling": []}

    def feed_back(self, client: Client, operation: Operation, now: float) -> None:
        """Do ``action_feedback``: to whom it concerns, if it wants feedback; the oldest is lost to a slow client."""
        goal = self._goal_of(client, operation)
        values = operation.get("values", {})
        if not isinstance(values, dict):
            raise RefusedError(f"the feedback of {goal.action} is no JSON object")
        if not goal.wants_feedback:
            return
        payload = _operation("action_feedback", goal.asker, values=values)
        if len(payload) > self._limits.message_bytes:
            raise RefusedError(
                f"the feedback of {goal.action} has more than {self._limits.message_bytes} bytes"
            )
        self._delivery.offer(goal.asker.client, goal.feedback, payload, now)

    def end_goal(self, client: Client, operation: Operation, _now: float) -> None:
        """Do ``action_result``."""
        goal = self._take(self._goal_of(client, operation).key)
        result, status, values = (
            operation.get("result", True),
            operation.get("status"),
            operation.get("values"),
        )
        if isinstance(status, bool) or not isinstance(status, int) or status not in set(GoalStatus):
            status = GoalStatus.SUCCEEDED if result is True else GoalStatus.ABORTED
        if result is not True:
            reason = values if isinstance(values, str) else f"{goal.action} did not reach the goal"
            self._fail(
                goal.asker, reason if values is None or isinstance(values, str) else _text(values), status
            )
            return
        if not isinstance(values, dict | None):
            self._fail(goal.asker, f"{goal.action} ended with values that are no JSON object")
            return
        payload = _operation("action_result", goal.asker, values=values or {}, status=status, result=True)
        if len(payload) > self._limits.message_bytes:
            self._fail(
                goal.asker, f"the result of {goal.action} has more than {self._limits.message_bytes} bytes"
            )
            return
        self._delivery.send(
            goal.asker.client, payload, fragment_size=goal.asker.fragment_size, png=goal.asker.png
        )

    def _goal_of(self, client: Client, operation: Operation) -> _Goal:
        key = operation.get("id")
        if not isinstance(key, str) or key not in client.goals_of:
            raise RefusedError(f"this client works on no goal {str(key)[:80]!r}")
        return self.goals[key]

    def _take(self, key: str) -> _Goal:
        goal = self.goals.pop(key)
        del goal.asker.client.goals[goal.asker.id]
        goal.server.goals_of.discard(key)
        return goal

    def _send_cancel(self, goal: _Goal) -> None:
        cancel = {"op": "cancel_action_goal", "id": goal.key, "action": goal.action}
        self._delivery.send(goal.server, orjson.dumps(cancel))

    def _fail(self, asker: Asker, reason: str, status: int = GoalStatus.ABORTED) -> None:
        # An eighth, as a character can take six bytes; a failure must always get through.
        reason = reason[: self._limits.message_bytes // 8]
        payload = _operation("action_result", asker, values=reason, status=status, result=False)
        self._delivery.send(asker.client, payload)


def _text(values: object) -> str:
    return orjson.dumps(values).decode()


def _operation(op: str, asker: Asker, **fields: object) -> bytes:
    operation: dict[str, object] = {"op": op, "action": asker.name, **fields}
    if asker.id is not None:
        operation["id"] = asker.id
    return orjson.dumps(operation)
