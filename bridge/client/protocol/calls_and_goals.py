"""Service calls and action goals of a client, and the services and actions that a client offers.

On the left, the client is the caller. On the right, the client offers the service or action.

call_service (id)          ->  server      server  ->  call_service (id)
service_response (id)     <-                      <-   service_response (id)

send_action_goal (id)      ->  server      server  ->  send_action_goal (id)
cancel_action_goal (id)    ->                      ->  cancel_action_goal (id)
action_feedback (id) ...  <-                      <-   action_feedback (id) ...
action_result (id)        <-                      <-   action_result (id)

Only actions of ROS 2 are supported.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Final

from bridge.client.protocol.events import (
    CallAnswered,
    CancelRequested,
    GoalEnded,
    GoalFeedback,
    GoalRequested,
    GoalStatus,
    ServiceRequested,
    UnusableReceived,
)
from bridge.client.protocol.wire import Wire
from bridge.codecs.json_codec import excerpt, text_of
from bridge.errors import SlowPeerError, TypeConflictError
from bridge.names import absolute, check_name, ros2_type, split_type

MAX_CALLS: Final = 1000
"""Maximum number of calls of this client that wait for an answer."""
MAX_GOALS: Final = 100
"""Maximum number of goals that this client has sent and that have not ended."""
MAX_REQUESTS: Final = 64
"""Maximum number of unanswered requests to this client's services. Further requests are refused."""
MAX_SERVED_GOALS: Final = 64
"""Maximum number of goals that this client executes at the same time. The client aborts further goals."""


# What this client asks for


class _Pending:
    """The pending calls or goals: the name of the service or action of each, by the request's id."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        # Bounded. An answer with another id is late or unexpected, and is ignored.
        self._names: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self._names)

    def forget(self, identity: str) -> None:
        """Ignore further answers to the request with this id."""
        self._names.pop(identity, None)

    def lost(self) -> None:
        """Drop everything after a lost connection, because servers forget their clients' calls and goals."""
        self._names.clear()


class PendingCalls(_Pending):
    """Service calls of this client that have no answer yet."""

    def send(self, service: str, args: Mapping[str, Any]) -> str:
        """Call a service, and return the id that the event `CallAnswered` will have.

        Raises a SlowPeerError if `MAX_CALLS` calls are pending.
        """
        check_name(service)
        if len(self._names) >= MAX_CALLS:
            raise SlowPeerError(f"{MAX_CALLS} service calls are pending, so {service} is not called")
        call = f"call_service:{service}:{self._wire.number()}"
        # Written first, because it raises if the arguments cannot be encoded.
        self._wire.write(op="call_service", id=call, service=service, args=args)
        self._names[call] = service
        return call

    def receive(self, operation: dict[str, Any], data: bytes) -> CallAnswered | UnusableReceived | None:
        """Handle an answer. Return the answer as an event, or None if no call waits for it."""
        call = operation.get("id")
        if not isinstance(call, str):
            return UnusableReceived(f"a service_response without the id of a call arrived: {excerpt(data)}")
        if self._names.pop(call, None) is None:
            return None
        values = operation.get("values")
        # Some servers omit `result` on success.
        if operation.get("result", True) is False:
            return CallAnswered(call, ok=False, values=text_of(values))
        return CallAnswered(call, ok=True, values={} if values is None else values)


class PendingGoals(_Pending):
    """Goals that this client has sent and that have not ended."""

    def send(self, action: str, type_name: str, goal: Mapping[str, Any], *, feedback: bool) -> str:
        """Send a goal, and return the id that the goal has in events (see `bridge.client.Ros.send_goal`)."""
        check_name(action)
        if len(self._names) >= MAX_GOALS:
            raise SlowPeerError(f"{MAX_GOALS} goals are active, so none was sent to {action}")
        identity = f"send_action_goal:{action}:{self._wire.number()}"
        self._wire.write(
            op="send_action_goal",
            id=identity,
            action=action,
            action_type=ros2_type(type_name, "action"),
            args=goal,
            feedback=feedback,
        )
        self._names[identity] = action
        return identity

    def cancel(self, goal: str) -> None:
        """Ask the server to cancel a goal, or do nothing if the goal has ended. `GoalEnded` shows the outcome."""
        action = self._names.get(goal)
        if action is not None:
            self._wire.write(op="cancel_action_goal", id=goal, action=action)

    def receive(
        self, operation: dict[str, Any], data: bytes
    ) -> GoalFeedback | GoalEnded | UnusableReceived | None:
        """Handle an event of a goal; return None if the goal is unknown."""
        goal = operation.get("id")
        if not isinstance(goal, str):
            return UnusableReceived(f"an action's message without the id of a goal arrived: {excerpt(data)}")
        if goal not in self._names:
            return None
        values = operation.get("values")
        if operation["op"] == "action_feedback":
            return GoalFeedback(goal, {} if values is None else values)
        del self._names[goal]
        if operation.get("result", True) is False:
            return GoalEnded(goal, ok=False, status=GoalStatus.UNKNOWN, values=text_of(values))
        # Some servers omit the status on success; an unknown number is accepted too.
        status = operation.get("status", GoalStatus.SUCCEEDED.value)
        known = type(status) is int and status in GoalStatus.__members__.values()
        return GoalEnded(
            goal,
            ok=True,
            status=GoalStatus(status) if known else GoalStatus.UNKNOWN,
            values={} if values is None else values,
        )


# What this client serves


class _Served:
    """Services or actions that this client serves: their types, by name."""

    # Field of operations that contains the name, and last word of the operations, as in `advertise_service`.
    kind: ClassVar[str]

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        # By absolute name; `restore` repeats them.
        self._types: dict[str, str] = {}

    def __contains__(self, name: str) -> bool:
        return absolute(name) in self._types

    def restore(self) -> None:
        """Advertise everything on a new connection."""
        for name in self._types:
            self._send_advertise(name)

    def advertise(self, name: str, type_name: str) -> None:
        """Serve a service or an action (see `bridge.client.Ros.advertise_service` and `advertise_action`)."""
        key = absolute(check_name(name))
        split_type(type_name)
        if key in self._types:
            raise TypeConflictError(f"{self.kind} {name} is already served by this client")
        self._types[key] = type_name
        self._send_advertise(key)

    def _send_advertise(self, name: str) -> None:
        spelt = self._spelt(self._types[name])
        self._wire.write(op=f"advertise_{self.kind}", **{self.kind: name}, type=spelt)

    def _spelt(self, type_name: str) -> str:
        """Return a type's name in the form of the server's ROS version."""
        raise NotImplementedError

    def unadvertise(self, name: str) -> None:
        """Stop serving a service or an action."""
        key = absolute(name)
        del self._types[key]
        self._wire.write(op=f"unadvertise_{self.kind}", **{self.kind: key})


class ServedServices(_Served):
    """This client's services, and their unanswered requests. Each request has a unique number, the ticket."""

    kind = "service"

    def __init__(self, wire: Wire) -> None:
        super().__init__(wire)
        # Name and id on the wire by ticket, only of the present connection. Ids are chosen by callers, and may be
        # equal, so the program gets a ticket instead.
        self._requests: dict[int, tuple[str, Any]] = {}

    def __len__(self) -> int:
        return len(self._requests)

    def lost(self) -> None:
        """Drop the requests of a lost connection."""
        self._requests.clear()

    def _spelt(self, type_name: str) -> str:
        return self._wire.type_name(type_name, "srv")

    def answer(self, ticket: int, values: Mapping[str, Any] | str, *, ok: bool = True) -> None:
        """Answer a request. `values` has the fields of the answer or, if `ok` is False, the reason as text.

        If the connection of the request was lost, do nothing.

        A reason is sent in an additional field `reason` of the operation, and the operation's field `values` is then
        an empty object. If the reason were sent in `values`, the reference server would drop the answer, and the caller
        would wait for ever (rosbridge_library/capabilities/service_response.py, `service_response_msg_fields`).
        `bridge.hub` passes the reason on.

        Raises:
            EncodeError: The values cannot be encoded as JSON. The request is then still pending.
        """
        request = self._requests.get(ticket)
        if request is None:
            return
        service, wire_id = request
        identity = {} if wire_id is None else {"id": wire_id}
        answer = {"values": values} if ok else {"values": {}, "reason": values}
        self._wire.write(op="service_response", service=service, result=ok, **answer, **identity)
        del self._requests[ticket]

    def receive(self, operation: dict[str, Any], data: bytes) -> ServiceRequested | UnusableReceived | None:
        """Handle a request. Return the request as an event, or None if this client refused it."""
        service = operation.get("service")
        args = operation.get("args")
        wire_id = operation.get("id")
        if not isinstance(service, str) or not isinstance(wire_id, str | int | None):
            return UnusableReceived(
                f"a call_service without a service or with an invalid id arrived: {excerpt(data)}"
            )
        # Stored even if it is refused at once, because `answer` answers only stored requests.
        ticket = self._wire.number()
        self._requests[ticket] = (service, wire_id)
        if service not in self:
            self.answer(ticket, f"service {excerpt(service)} is not served here", ok=False)
        elif len(self._requests) > MAX_REQUESTS:
            self.answer(ticket, f"{MAX_REQUESTS} requests are already pending here", ok=False)
        elif not isinstance(args, dict | None):
            self.answer(ticket, "args must be an object", ok=False)
        else:
            return ServiceRequested(absolute(service), args or {}, ticket)
        return None


class ServedActions(_Served):
    """The actions that this client offers, and the goals that it executes. Goals are stored by their ids."""

    kind = "action"

    def __init__(self, wire: Wire) -> None:
        super().__init__(wire)
        # Names of the actions by the goal's id, only of the present connection, because servers forget who executes a
        # goal.
        self._goals: dict[str, str] = {}

    def lost(self) -> None:
        """Drop the goals of a lost connection."""
        self._goals.clear()

    def _spelt(self, type_name: str) -> str:
        return ros2_type(type_name, "action")

    def feed_back(self, goal: str, values: Mapping[str, Any]) -> None:
        """Send feedback on a goal, or do nothing if the goal has ended."""
        action = self._goals.get(goal)
        if action is not None:
            self._wire.write(op="action_feedback", id=goal, action=action, values=values)

    def end(self, goal: str, status: GoalStatus, values: Mapping[str, Any] | str) -> None:
        """End a goal with a result, or with a text that describes a failure.

        Raises:
            EncodeError: The values cannot be encoded as JSON. The goal has then not ended.
        """
        action = self._goals.get(goal)
        if action is not None:
            ok = not isinstance(values, str)
            self._wire.write(
                op="action_result", id=goal, action=action, values=values, status=status.value, result=ok
            )
            del self._goals[goal]

    def receive(
        self, operation: dict[str, Any], data: bytes
    ) -> GoalRequested | CancelRequested | UnusableReceived | None:
        """Handle a goal or a cancellation, and return it as an event.

        Return None if this client refused the goal, or if the goal to cancel is not active.
        """
        goal, action, args = operation.get("id"), operation.get("action"), operation.get("args")
        if not isinstance(goal, str) or not isinstance(action, str):
            return UnusableReceived(f"a goal without an action or an id arrived: {excerpt(data)}")
        if operation["op"] == "cancel_action_goal":
            served = self._goals.get(goal)
            return None if served is None else CancelRequested(served, goal)
        if goal in self._goals:
            return UnusableReceived(f"a goal with the id of another arrived: {excerpt(data)}")
        full = len(self._goals) >= MAX_SERVED_GOALS
        self._goals[goal] = absolute(action)  # even if it is refused, because `end` ends only stored goals
        if action not in self:
            self.end(goal, GoalStatus.ABORTED, f"action {excerpt(action)} is not served here")
        elif full:
            self.end(goal, GoalStatus.ABORTED, f"{MAX_SERVED_GOALS} goals are already executed here")
        elif not isinstance(args, dict | None):
            self.end(goal, GoalStatus.ABORTED, "args must be an object")
        else:
            return GoalRequested(absolute(action), goal, args or {})
        return None
