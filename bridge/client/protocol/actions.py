"""Actions of ROS 2: the active goals of a client, and the actions that it serves.

send_action_goal (id)      ->  server      server  ->  send_action_goal (id)
cancel_action_goal (id)    ->                      ->  cancel_action_goal (id)
action_feedback (id) ...  <-                      <-   action_feedback (id) ...
action_result (id)        <-                      <-   action_result (id)
"""

from collections.abc import Mapping
from typing import Any, Final

from bridge.client.protocol.events import (
    CancelRequested,
    GoalEnded,
    GoalFeedback,
    GoalRequested,
    GoalStatus,
    UnusableReceived,
)
from bridge.client.protocol.wire import Wire
from bridge.codecs.json_codec import excerpt, text_of
from bridge.errors import SlowPeerError, TypeConflictError
from bridge.names import absolute, check_name, ros2_type

MAX_GOALS: Final = 100
"""Maximum number of active goals."""
MAX_SERVED_GOALS: Final = 64
"""Maximum number of goals that this client executes; more are aborted."""


class PendingGoals:
    """Actions of the active goals, by id on the wire."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        # Names by id, at most `MAX_GOALS`. An event with another id is late or stray, and is ignored.
        self._actions: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self._actions)

    def send(self, action: str, type_name: str, goal: Mapping[str, Any], *, feedback: bool) -> str:
        """Send a goal (see `bridge.client.Ros.send_goal`), and return its id in events."""
        check_name(action)
        if len(self._actions) >= MAX_GOALS:
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
        self._actions[identity] = action
        return identity

    def cancel(self, goal: str) -> None:
        """Ask the server to cancel a goal; its end shows whether it did. No effect after the end of the goal."""
        action = self._actions.get(goal)
        if action is not None:
            self._wire.write(op="cancel_action_goal", id=goal, action=action)

    def forget(self, goal: str) -> None:
        """Ignore further events of a goal."""
        self._actions.pop(goal, None)

    def lost(self) -> None:
        """Drop the goals of a lost connection, because servers forget their senders."""
        self._actions.clear()

    def receive(
        self, operation: dict[str, Any], data: bytes | str
    ) -> GoalFeedback | GoalEnded | UnusableReceived | None:
        """Handle an event of a goal; return None if the goal is unknown."""
        goal = operation.get("id")
        if not isinstance(goal, str):
            return UnusableReceived(f"an action's message without the id of a goal arrived: {excerpt(data)}")
        if goal not in self._actions:
            return None
        values = operation.get("values")
        if operation["op"] == "action_feedback":
            return GoalFeedback(goal, {} if values is None else values)
        del self._actions[goal]
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


class ServedActions:
    """Types of the actions by name, and the executed goals by their ids on the wire."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        # By absolute name; `restore` repeats them.
        self._types: dict[str, str] = {}
        # Names of the actions by the goal's id, only of the present connection, because servers forget who executes a
        # goal.
        self._goals: dict[str, str] = {}

    def restore(self) -> None:
        """Advertise all actions on a new connection."""
        for action, type_name in self._types.items():
            self._send_advertise(action, type_name)

    def lost(self) -> None:
        """Drop the goals of a lost connection."""
        self._goals.clear()

    def advertise(self, action: str, type_name: str) -> None:
        """Serve an action (see `bridge.client.Ros.advertise_action`)."""
        key = absolute(check_name(action))
        ros2_type(type_name, "action")
        if key in self._types:
            raise TypeConflictError(f"action {action} is already served by this client")
        self._types[key] = type_name
        self._send_advertise(key, type_name)

    def _send_advertise(self, action: str, type_name: str) -> None:
        self._wire.write(op="advertise_action", action=action, type=ros2_type(type_name, "action"))

    def unadvertise(self, action: str) -> None:
        """Stop serving an action."""
        key = absolute(action)
        del self._types[key]
        self._wire.write(op="unadvertise_action", action=key)

    def feed_back(self, goal: str, values: Mapping[str, Any]) -> None:
        """Send feedback of a goal, unless it has ended."""
        action = self._goals.get(goal)
        if action is not None:
            self._wire.write(op="action_feedback", id=goal, action=action, values=values)

    def end(self, goal: str, status: GoalStatus, values: Mapping[str, Any] | str) -> None:
        """End a goal with its result, or with the text of a failure.

        Raises:
            EncodeError: The values cannot be encoded as JSON; the goal has not ended.
        """
        action = self._goals.get(goal)
        if action is not None:
            ok = not isinstance(values, str)
            self._wire.write(
                op="action_result", id=goal, action=action, values=values, status=status.value, result=ok
            )
            del self._goals[goal]

    def receive(
        self, operation: dict[str, Any], data: bytes | str
    ) -> GoalRequested | CancelRequested | UnusableReceived | None:
        """Handle a goal or its cancellation; return None if it was refused here, or has ended."""
        goal, action, args = operation.get("id"), operation.get("action"), operation.get("args")
        if not isinstance(goal, str) or not isinstance(action, str):
            return UnusableReceived(f"a goal without an action or an id arrived: {excerpt(data)}")
        if operation["op"] == "cancel_action_goal":
            served = self._goals.get(goal)
            return None if served is None else CancelRequested(served, goal)
        if goal in self._goals:
            return UnusableReceived(f"a goal with the id of another arrived: {excerpt(data)}")
        key = absolute(action)
        full = len(self._goals) >= MAX_SERVED_GOALS
        self._goals[goal] = key  # even if it is refused, because `end` ends only stored goals
        if key not in self._types:
            self.end(goal, GoalStatus.ABORTED, f"action {excerpt(action)} is not served here")
        elif full:
            self.end(goal, GoalStatus.ABORTED, f"{MAX_SERVED_GOALS} goals are already executed here")
        elif not isinstance(args, dict | None):
            self.end(goal, GoalStatus.ABORTED, "args must be an object")
        else:
            return GoalRequested(key, goal, args or {})
        return None
