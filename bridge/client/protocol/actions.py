"""Actions that a client serves (ROS 2), and the goals that it executes."""

from collections.abc import Mapping
from typing import Any, Final

from bridge.client.protocol.events import CancelRequested, GoalRequested, GoalStatus, Unusable
from bridge.client.protocol.wire import Wire
from bridge.codecs.json_codec import excerpt
from bridge.errors import TypeConflictError
from bridge.names import absolute, check_name, ros2_type

MAX_SERVED_GOALS: Final = 64
"""Maximum number of goals that this client executes; more are aborted."""


class Actions:
    """Types of the actions by name, and the executed goals by their ids on the wire."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._types: dict[str, str] = {}
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
    ) -> GoalRequested | CancelRequested | Unusable | None:
        """Handle a goal or its cancellation; return None if it was refused here, or has ended."""
        goal, action, args = operation.get("id"), operation.get("action"), operation.get("args")
        if not isinstance(goal, str) or not isinstance(action, str):
            return Unusable(f"a goal without an action or an id arrived: {excerpt(data)}")
        if operation["op"] == "cancel_action_goal":
            served = self._goals.get(goal)
            return None if served is None else CancelRequested(served, goal)
        if goal in self._goals:
            return Unusable(f"a goal with the id of another arrived: {excerpt(data)}")
        key = absolute(action)
        full = len(self._goals) >= MAX_SERVED_GOALS
        self._goals[goal] = key
        if key not in self._types:
            self.end(goal, GoalStatus.ABORTED, f"action {excerpt(action)} is not served here")
        elif full:
            self.end(goal, GoalStatus.ABORTED, f"{MAX_SERVED_GOALS} goals are already executed here")
        elif not isinstance(args, dict | None):
            self.end(goal, GoalStatus.ABORTED, "args must be an object")
        else:
            return GoalRequested(key, goal, args or {})
        return None
