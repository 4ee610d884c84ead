"""Service calls and goals of actions between clients, each ended exactly once.

    caller                          hub                           server
      │ call_service "7" /add        │                              │
      │─────────────────────────────▶│ call_service "service_request:/add:1"
      │                              │─────────────────────────────▶│
      │                              │ service_response "service_request:/add:1"
      │ service_response "7"         │◀─────────────────────────────│
      │◀─────────────────────────────│                              │

    caller ── send_action_goal ──▶ hub ── send_action_goal ──▶ server
    caller ◀── action_feedback ─── hub ◀── action_feedback ─── server     any number, the oldest may be dropped
    caller ─ cancel_action_goal ─▶ hub ─ cancel_action_goal ─▶ server     a request: the server still ends the goal
    caller ◀─── action_result ──── hub ◀─── action_result ──── server

The server here is the client that offers the service or action. Ids of different clients may be equal, so the hub
replaces the caller's id by a key of its own. If the server leaves, the hub ends the server's calls and goals with
`result: false`. If the deadline of a call passes, the hub ends the call in the same way.
"""

import heapq
import itertools
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Any, ClassVar, Final, Literal, Self

import orjson

from bridge.client.protocol.events import GoalStatus
from bridge.errors import BridgeError
from bridge.hub.definitions import MessageDefinitions
from bridge.hub.dispatcher import Dispatcher, fragment_size_of
from bridge.hub.encodings import Encoding, encoding_of
from bridge.hub.filling import Filler
from bridge.hub.graph import Client, Graph, Offer
from bridge.hub.limits import (
    HubLimits,
    Operation,
    OperationId,
    RefusedOperationError,
    checked_name,
    flag,
    is_logged,
    number,
    operation_id,
    optional_text,
    text,
)
from bridge.hub.outbox import Lane
from bridge.hub.rosapi import PREFIX, Rosapi
from bridge.names import absolute, ros2_type, same_type

log = logging.getLogger(__name__)

# Number of deadlines of answered calls by which the queue may exceed the open calls.
_ANSWERED: Final = 64
# ROS 2's service that cancels all goals of an action, as roslibjs calls it.
_CANCEL_ALL: Final = "/_action/cancel_goal"


@dataclass(frozen=True, slots=True)
class Caller:
    """A client that waits for the answer to a request.

    The request gave the id, the name of the service or action, and the encoding of the answer.
    """

    client: Client
    id: OperationId
    name: str
    fragment_size: int = 0
    png: bool = False

    @classmethod
    def of(cls, client: Client, operation: Operation, kind: str) -> Self:
        """Read the caller from an operation, or raise a RefusedOperationError. `kind` is `service` or `action`."""
        return cls(
            client,
            operation_id(operation),
            text(operation, kind),
            fragment_size_of(number(operation, "fragment_size")),
            encoding_of(operation.get("compression")) is Encoding.PNG,
        )

    def operation(self, op: str, kind: str, **fields: object) -> bytes:
        """Return an operation for this client, as JSON.

        `kind` is `service` or `action`. The operation's field `service` or `action` contains the name of the service or
        action, spelled as in the client's request.
        """
        identity = {} if self.id is None else {"id": self.id}
        return orjson.dumps({"op": op, kind: self.name, **fields, **identity})


def _filled(filler: Filler | None, values: Any, room: int) -> Any:
    """Return arguments or results as an object, after filling absent fields, which adds at most `room` bytes."""
    if values is None:
        values = {}
    if filler is not None:
        if isinstance(values, list):
            values = filler.named(values)
        if isinstance(values, dict):
            filler.fill(values, room)
    return values


class _Exchange:
    """Services or actions by name, and their open calls or goals. The last client to offer a name serves it."""

    # A kind of exchange: its field in operations, the kind of its types, the operation that ends a call or a goal,
    # and the additional fields of such an operation for a failure.
    kind: ClassVar[str]
    type_kind: ClassVar[Literal["srv", "action"]]
    answer: ClassVar[str]
    failed: ClassVar[dict[str, Any]] = {}

    def __init__(
        self,
        limits: HubLimits,
        dispatcher: Dispatcher,
        definitions: MessageDefinitions,
        offers: dict[str, Offer],
        names_of: Callable[[Client], set[str]],
    ) -> None:
        self._limits = limits
        self._dispatcher = dispatcher
        self._definitions = definitions
        # The graph's offers by absolute name, and the names that a client offers.
        self._offers = offers
        self._names_of = names_of
        self._numbers = itertools.count(1)

    def _offer(self, client: Client, operation: Operation, type_name: str) -> None:
        """Store a client's offer of a service or an action, and replace another client's offer of the same name."""
        name = checked_name(text(operation, self.kind))
        key, names = absolute(name), self._names_of(client)
        if key not in names and len(names) >= self._limits.services_per_client:
            raise RefusedOperationError(f"this client already offers {len(names)} {self.kind}s")
        # As in ROS 1, a node that starts again takes its services over, although the loss of the old one has not been
        # noticed yet.
        before = self._offers.get(key)
        if before is not None and before.client is not client:
            client.takeovers += 1
            if is_logged(client.takeovers):
                log.warning("%s took %s over from %s", client.node, key, before.client.node)
            self._names_of(before.client).discard(key)
        fillers = self._definitions.fillers(type_name, self.type_kind)
        self._offers[key] = Offer(key, type_name, client, fillers)
        names.add(key)

    def unadvertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Withdraw an offer; the client may still answer open calls or goals."""
        name = text(operation, self.kind)
        names = self._names_of(client)
        if absolute(name) not in names:
            raise RefusedOperationError(f"this client does not offer {name}")
        names.discard(absolute(name))
        del self._offers[absolute(name)]

    def leave(self, client: Client) -> None:
        """Remove the offers of a disconnected client."""
        for name in self._names_of(client):
            self._offers.pop(name, None)

    def ask(self, client: Client, operation: Operation, now: float) -> None:
        """Pass a `call_service` or `send_action_goal` on to the client that offers it, or answer that it failed."""
        caller = Caller.of(client, operation, self.kind)
        try:
            self._start(caller, operation, now)
        except BridgeError as error:
            self._fail(caller, str(error))

    def _start(self, caller: Caller, operation: Operation, now: float) -> None:
        raise NotImplementedError

    def _succeed(self, caller: Caller, filler: Filler | None, values: Any, **more: object) -> None:
        """Send the answer in the requested encoding, or a failure if the answer is too large."""
        try:
            values = _filled(filler, values, self._limits.message_bytes)
            payload = caller.operation(self.answer, self.kind, values=values, **more, result=True)
            self._dispatcher.checked(payload, f"the answer of {caller.name}")
        except RefusedOperationError as error:
            self._fail(caller, str(error))
        else:
            self._dispatcher.send(caller.client, payload, fragment_size=caller.fragment_size, png=caller.png)

    def _fail(self, caller: Caller, reason: Any, **more: object) -> None:
        # The wire has a string here; anything else is sent as JSON.
        why = reason if isinstance(reason, str) else orjson.dumps(reason).decode()
        # A character can take six bytes in JSON, and a failure must never be too large to send.
        why = why[: self._limits.message_bytes // 8]
        fields = self.failed | more
        payload = caller.operation(self.answer, self.kind, values=why, **fields, result=False)
        self._dispatcher.send(caller.client, payload)


@dataclass(frozen=True, slots=True)
class _Call:
    """A call that is not answered yet."""

    caller: Caller
    server: Client
    deadline: float
    filler: Filler | None
    """Fills absent fields of the answer."""


class Calls(_Exchange):
    """The services of one hub, and the calls that are not answered yet."""

    kind, type_kind, answer = "service", "srv", "service_response"

    def __init__(
        self,
        graph: Graph,
        limits: HubLimits,
        dispatcher: Dispatcher,
        definitions: MessageDefinitions,
        rosapi: Rosapi,
        answer_here: Callable[[Client, str], dict[str, Any] | None],
    ) -> None:
        """Start without services.

        If no client offers a called service, the hub calls `answer_here` with the caller and the service's name.
        `answer_here` returns the answer, or None if the service does not exist.
        """
        super().__init__(limits, dispatcher, definitions, graph.services, lambda client: client.services)
        self._graph = graph
        self._rosapi = rosapi
        self._answer_here = answer_here
        # A heap of the calls' deadlines. Those of answered calls stay until they pass or are too many (`_schedule`),
        # because finding one in a heap takes longer than skipping it.
        self._deadlines: list[tuple[float, str]] = []
        self.pending: dict[str, _Call] = {}

    @property
    def deadline(self) -> float:
        """Time at which to call `expire` next, or infinity if it need not be called."""
        return self._deadlines[0][0] if self._deadlines else inf

    def leave(self, client: Client) -> None:
        """Remove a disconnected client, and fail the calls that it has not answered."""
        super().leave(client)
        for key in list(client.calls):
            self._take(key)
        for key in list(client.requests):
            call = self._take(key)
            self._fail(call.caller, f"{call.caller.name} went away during the call")

    def expire(self, now: float) -> None:
        """Fail the calls whose deadline has passed."""
        while self.deadline <= now:
            _, key = heapq.heappop(self._deadlines)
            if key in self.pending:
                call = self._take(key)
                self._fail(call.caller, f"{call.caller.name} did not answer in time")

    def advertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `advertise_service`."""
        name, type_name = text(operation, "service"), text(operation, "type")
        if absolute(name).startswith(PREFIX):
            raise RefusedOperationError(f"{name} belongs to the hub")
        self._offer(client, operation, self._rosapi.service_type_name(type_name))

    def _start(self, caller: Caller, operation: Operation, now: float) -> None:
        name, args = caller.name, operation.get("args")
        key = absolute(name)
        if self._rosapi.offers(key):
            self._dispatcher.work += (len(self._graph.topics) + len(self._graph.services)) >> 3
            self._succeed(caller, None, self._rosapi.call(key, {} if args is None else args))
            return
        service = self._offers.get(key)
        if service is None:
            values = self._answer_here(caller.client, key)
            if values is None:
                raise RefusedOperationError(f"Service {name} does not exist")
            self._succeed(caller, None, values)
            return
        client, server = caller.client, service.client
        if len(client.calls) >= self._limits.calls_per_client:
            raise RefusedOperationError(f"this client already waits for {len(client.calls)} calls")
        # Bounded for the server too: many clients could otherwise fill the outbox of a server that does not answer.
        if len(server.requests) >= self._limits.calls_per_client:
            raise RefusedOperationError(f"{name} already has {len(server.requests)} calls to answer")
        deadline = now + min(number(operation, "timeout") or inf, self._limits.call_timeout)
        # Not a secret: only the client that got a request may answer it (`respond`).
        request_id = f"service_request:{key}:{next(self._numbers)}"
        args = _filled(service.fillers.get("Request"), args, self._limits.message_bytes)
        payload = orjson.dumps({"op": "call_service", "id": request_id, "service": key, "args": args})
        self._dispatcher.checked(payload, f"the request for {name}")
        self.pending[request_id] = _Call(caller, server, deadline, service.fillers.get("Response"))
        self._schedule(deadline, request_id)
        client.calls.add(request_id)
        server.requests.add(request_id)
        self._dispatcher.send(server, payload)

    def _schedule(self, deadline: float, key: str) -> None:
        # A flood of calls that are answered at once would otherwise leave their deadlines for a minute.
        if len(self._deadlines) > 2 * len(self.pending) + _ANSWERED:
            self._deadlines = [(call.deadline, key) for key, call in self.pending.items()]
            heapq.heapify(self._deadlines)
        else:
            heapq.heappush(self._deadlines, (deadline, key))
        self._dispatcher.schedule(deadline)

    def respond(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `service_response`."""
        key = operation.get("id")
        if not isinstance(key, str) or key not in client.requests:
            raise RefusedOperationError(f"no client waits for the answer {str(key)[:80]!r}")
        call = self._take(key)
        caller = call.caller
        values, result = operation.get("values", {}), operation.get("result", True)
        reason = operation.get("reason")
        if result is False and isinstance(reason, str):  # of this project's client
            self._fail(caller, reason)
        # In ROS 1 the reference server forwards an answer whatever its result; roslibpy's tests rely on this.
        elif isinstance(values, dict) and (
            result is True or (self._rosapi.ros_version == 1 and "values" in operation)
        ):
            self._succeed(caller, call.filler, values)
        elif result is True:
            self._fail(caller, f"{caller.name} answered with values that are not a JSON object")
        else:
            self._fail(caller, values)

    def _take(self, key: str) -> _Call:
        call = self.pending.pop(key)
        call.caller.client.calls.discard(key)
        call.server.requests.discard(key)
        return call


@dataclass(eq=False, slots=True)
class _Goal:
    """A goal that has not ended."""

    key: str
    caller: Caller
    action: Offer
    server: Client
    wants_feedback: bool
    feedback: Lane = field(default_factory=Lane)


class Actions(_Exchange):
    """The actions of one hub, and the goals that have not ended."""

    kind, type_kind, answer = "action", "action", "action_result"
    failed: ClassVar = {"status": GoalStatus.ABORTED}

    def __init__(
        self, graph: Graph, limits: HubLimits, dispatcher: Dispatcher, definitions: MessageDefinitions
    ) -> None:
        """Start without actions."""
        super().__init__(limits, dispatcher, definitions, graph.actions, lambda client: client.actions)
        self.goals: dict[str, _Goal] = {}

    def leave(self, client: Client) -> None:
        """Cancel the goals that a disconnected client has sent, and abort the goals that the client was executing."""
        super().leave(client)
        # Nobody receives these results any more, so their servers may stop.
        for key in list(client.goals.values()):
            self._send_cancel(self._take(key))
        for key in list(client.tasks):
            goal = self._take(key)
            self._fail(goal.caller, f"{goal.action.name} went away during the goal")

    def advertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `advertise_action`."""
        self._offer(client, operation, ros2_type(text(operation, "type"), "action"))

    def _start(self, caller: Caller, operation: Operation, _now: float) -> None:
        client, name, args = caller.client, caller.name, operation.get("args")
        action = self._offers.get(absolute(name))
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
            "args": _filled(action.fillers.get("Goal"), args, self._limits.message_bytes),
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
        """Perform `cancel_action_goal`: pass the cancellation on to the client that serves the action.

        The goal ends when the serving client sends the result of the goal.
        """
        name = text(operation, "action")
        goal_id = operation.get("id")
        key = client.goals.get(goal_id) if isinstance(goal_id, str | int | None) else None
        goal = self.goals[key] if key is not None else None
        if goal is None or goal.action.name != absolute(name):
            raise RefusedOperationError(f"this client does not have a goal {str(goal_id)[:80]!r} of {name}")
        self._send_cancel(goal)

    def cancel_all(self, client: Client, service: str) -> dict[str, Any] | None:
        """Answer `ACTION/_action/cancel_goal` by cancelling the client's goals. Return None for any other service."""
        name = service.removesuffix(_CANCEL_ALL)
        if name == service or name not in self._offers:
            return None
        for key in client.goals.values():
            if self.goals[key].action.name == name:
                self._send_cancel(self.goals[key])
        return {"return_code": 0, "goals_canceling": []}

    def feed_back(self, client: Client, operation: Operation, now: float) -> None:
        """Perform `action_feedback`. If the sender of the goal reads slowly, the oldest feedback is dropped."""
        goal = self._goal_of(client, operation)
        values = operation.get("values", {})
        if not isinstance(values, dict):
            raise RefusedOperationError(f"the feedback of {goal.action.name} must be a JSON object")
        if not goal.wants_feedback:
            return
        values = _filled(goal.action.fillers.get("Feedback"), values, self._limits.message_bytes)
        payload = goal.caller.operation("action_feedback", "action", values=values)
        self._dispatcher.checked(payload, f"the feedback of {goal.action.name}")
        if goal.caller.png:
            payload = self._dispatcher.as_png(payload)
        self._dispatcher.offer(goal.caller.client, goal.feedback, payload, now)

    def end_goal(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `action_result`."""
        goal = self._take(self._goal_of(client, operation).key)
        caller, name = goal.caller, goal.action.name
        result, values = operation.get("result", True), operation.get("values")
        status = operation.get("status")
        if isinstance(status, bool) or not isinstance(status, int) or status not in set(GoalStatus):
            status = GoalStatus.SUCCEEDED if result is True else GoalStatus.ABORTED
        if result is not True:
            self._fail(caller, f"{name} did not reach the goal" if values is None else values, status=status)
        elif not isinstance(values, dict | None):
            self._fail(caller, f"{name} ended with values that are not a JSON object")
        else:
            self._succeed(caller, goal.action.fillers.get("Result"), values, status=status)

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
