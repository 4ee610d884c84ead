"""Actions between clients, as in ROS 2: goals with feedback, cancellation and exactly one result each.

caller ── send_action_goal ──▶ hub ── send_action_goal ──▶ server     with a key of the hub as id
caller ◀── action_feedback ─── hub ◀── action_feedback ─── server     any number, the oldest may be dropped
caller ─ cancel_action_goal ─▶ hub ─ cancel_action_goal ─▶ server     a wish: the server still ends the goal
caller ◀─── action_result ──── hub ◀─── action_result ──── server     once; from the hub if the server leaves
"""

import itertools
from dataclasses import dataclass, field
from typing import Any, Final

import orjson

from bridge.client.protocol.events import GoalStatus
from bridge.errors import BridgeError
from bridge.hub.calls import Caller, Offers, filled
from bridge.hub.definitions import MessageDefinitions
from bridge.hub.dispatcher import Dispatcher
from bridge.hub.graph import Client, Graph, Offer
from bridge.hub.limits import HubLimits, Operation, RefusedOperationError, flag, optional_text, text
from bridge.hub.outbox import Lane
from bridge.names import absolute, ros2_type, same_type

# ROS 2's service that cancels all goals of an action, as roslibjs calls it.
_CANCEL_ALL: Final = "/_action/cancel_goal"
_RESULT: Final = ("action_result", "action")


@dataclass(eq=False, slots=True)
class _Goal:
    """A goal that has not ended."""

    key: str
    caller: Caller
    action: Offer
    server: Client
    wants_feedback: bool
    feedback: Lane = field(default_factory=Lane)


class Actions:
    """The actions of one hub, and the goals that have not ended."""

    def __init__(
        self, graph: Graph, limits: HubLimits, dispatcher: Dispatcher, definitions: MessageDefinitions
    ) -> None:
        """Start without actions."""
        self._graph = graph
        self._limits = limits
        self._dispatcher = dispatcher
        self._definitions = definitions
        self._offers = Offers(
            graph.actions, lambda client: client.actions, limits.services_per_client, "action"
        )
        self._numbers = itertools.count(1)
        self.goals: dict[str, _Goal] = {}

    def leave(self, client: Client) -> None:
        """Cancel the goals that a disconnected client sent, and abort those that it executed."""
        self._offers.leave(client)
        # Nobody hears of these results any more, so their servers may stop.
        for key in list(client.goals.values()):
            self._send_cancel(self._take(key))
        for key in list(client.tasks):
            goal = self._take(key)
            self._fail(goal.caller, f"{goal.action.name} went away during the goal")

    def advertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `advertise_action`."""
        type_name = ros2_type(text(operation, "type"), "action")
        self._offers.add(client, operation, type_name, self._definitions.fillers(type_name, "action"))

    def unadvertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `unadvertise_action`; goals that it executes may still be ended."""
        self._offers.remove(client, operation)

    def send_goal(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `send_action_goal`."""
        caller = Caller.of(client, operation, "action")
        try:
            self._start(caller, operation)
        except BridgeError as error:
            self._fail(caller, str(error))

    def _start(self, caller: Caller, operation: Operation) -> None:
        client, name, args = caller.client, caller.name, operation.get("args")
        action = self._graph.actions.get(absolute(name))
        if action is None:
            raise RefusedOperationError(f"Action {name} does not exist")
        type_name = optional_text(operation, "action_type")
        if type_name is not None and not same_type(ros2_type(type_name, "action"), action.type):
            raise RefusedOperationError(f"{name} is of type {action.type}, not {type_name}")
        server = action.client
        if caller.id in client.goals:
            raise RefusedOperationError(f"this client already has a goal with the id {str(caller.id)[:80]!r}")
        if len(client.goals) >= self._limits.goals_per_client:
            raise RefusedOperationError(f"this client already waits for {len(client.goals)} goals")
        if len(server.tasks) >= self._limits.goals_per_client:
            raise RefusedOperationError(f"{name} already executes {len(server.tasks)} goals")
        wants_feedback = flag(operation, "feedback")
        key = f"action_goal:{action.name}:{next(self._numbers)}"
        request = {
            "op": "send_action_goal",
            "id": key,
            "action": action.name,
            "action_type": action.type,
            "args": filled(action.fillers.get("Goal"), args, self._limits.message_bytes),
            "feedback": wants_feedback,
        }
        payload = self._dispatcher.checked(orjson.dumps(request), f"the goal for {name}")
        # Feedback may be dropped, so each goal has a lane of its own; the result may not.
        lane = Lane(self._limits.queue_length)
        lane.fragment_size = caller.fragment_size
        self.goals[key] = _Goal(key, caller, action, server, wants_feedback, lane)
        client.goals[caller.id] = key
        server.tasks.add(key)
        self._dispatcher.send(server, payload)

    def cancel(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `cancel_action_goal`: ask the server, whose result ends the goal."""
        name = text(operation, "action")
        goal_id = operation.get("id")
        key = client.goals.get(goal_id) if isinstance(goal_id, str | int | None) else None
        goal = self.goals[key] if key is not None else None
        if goal is None or goal.action.name != absolute(name):
            raise RefusedOperationError(f"this client does not have a goal {str(goal_id)[:80]!r} of {name}")
        self._send_cancel(goal)

    def cancel_all(self, client: Client, service: str) -> dict[str, Any] | None:
        """Answer `ACTION/_action/cancel_goal` by cancelling the client's goals; return None for other services."""
        name = service.removesuffix(_CANCEL_ALL)
        if name == service or name not in self._graph.actions:
            return None
        for key in client.goals.values():
            if self.goals[key].action.name == name:
                self._send_cancel(self.goals[key])
        return {"return_code": 0, "goals_canceling": []}

    def feed_back(self, client: Client, operation: Operation, now: float) -> None:
        """Perform `action_feedback`; the oldest feedback for a slow client is dropped."""
        goal = self._goal_of(client, operation)
        values = operation.get("values", {})
        if not isinstance(values, dict):
            raise RefusedOperationError(f"the feedback of {goal.action.name} must be a JSON object")
        if not goal.wants_feedback:
            return
        values = filled(goal.action.fillers.get("Feedback"), values, self._limits.message_bytes)
        payload = goal.caller.operation("action_feedback", "action", values=values)
        self._dispatcher.checked(payload, f"the feedback of {goal.action.name}")
        if goal.caller.png:
            payload = self._dispatcher.as_png(payload)
        self._dispatcher.offer(goal.caller.client, goal.feedback, payload, now)

    def end_goal(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `action_result`."""
        goal = self._take(self._goal_of(client, operation).key)
        result, values = operation.get("result", True), operation.get("values")
        status = operation.get("status")
        if isinstance(status, bool) or not isinstance(status, int) or status not in set(GoalStatus):
            status = GoalStatus.SUCCEEDED if result is True else GoalStatus.ABORTED
        if result is not True:
            reason = f"{goal.action.name} did not reach the goal" if values is None else values
            self._fail(
                goal.caller, reason if isinstance(reason, str) else orjson.dumps(reason).decode(), status
            )
        elif not isinstance(values, dict | None):
            self._fail(goal.caller, f"{goal.action.name} ended with values that are not a JSON object")
        else:
            try:
                values = filled(goal.action.fillers.get("Result"), values, self._limits.message_bytes)
                payload = goal.caller.operation(*_RESULT, values=values, status=status, result=True)
                goal.caller.answer(self._dispatcher, payload)
            except RefusedOperationError as error:
                self._fail(goal.caller, str(error))

    def _goal_of(self, client: Client, operation: Operation) -> _Goal:
        key = operation.get("id")
        if not isinstance(key, str) or key not in client.tasks:
            raise RefusedOperationError(f"this client does not execute a goal {str(key)[:80]!r}")
        return self.goals[key]

    def _take(self, key: str) -> _Goal:
        goal = self.goals.pop(key)
        del goal.caller.client.goals[goal.caller.id]
        goal.server.tasks.discard(key)
        return goal

    def _send_cancel(self, goal: _Goal) -> None:
        cancel = {"op": "cancel_action_goal", "id": goal.key, "action": goal.action.name}
        self._dispatcher.send(goal.server, orjson.dumps(cancel))

    def _fail(self, caller: Caller, reason: str, status: int = GoalStatus.ABORTED) -> None:
        # A character can take six bytes in JSON, and a failure must never be too large to send.
        reason = reason[: self._limits.message_bytes // 8]
        payload = caller.operation(*_RESULT, values=reason, status=status, result=False)
        self._dispatcher.send(caller.client, payload)
