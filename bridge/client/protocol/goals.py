"""Active goals of a client for ROS 2 actions."""

from collections.abc import Mapping
from typing import Any, Final

from bridge.client.protocol.events import GoalEnded, GoalFeedback, GoalStatus, Unusable
from bridge.client.protocol.wire import Wire
from bridge.codecs.json_codec import excerpt, text_of
from bridge.errors import SlowPeerError
from bridge.names import check_name, ros2_type

MAX_GOALS: Final = 100
"""Maximum number of active goals."""


class Goals:
    """Actions of the active goals, by id on the wire."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
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
    ) -> GoalFeedback | GoalEnded | Unusable | None:
        """Handle an event of a goal; return None if the goal is unknown."""
        goal = operation.get("id")
        if not isinstance(goal, str):
            return Unusable(f"an action's message without the id of a goal arrived: {excerpt(data)}")
        if goal not in self._actions:
            return None
        values = operation.get("values")
        if operation["op"] == "action_feedback":
            return GoalFeedback(goal, {} if values is None else values)
        del self._actions[goal]
        if operation.get("result", True) is False:
            return GoalEnded(goal, ok=False, status=GoalStatus.UNKNOWN, values=text_of(values))
        status = operation.get("status", GoalStatus.SUCCEEDED.value)
        known = type(status) is int and status in GoalStatus.__members__.values()
        return GoalEnded(
            goal,
            ok=True,
            status=GoalStatus(status) if known else GoalStatus.UNKNOWN,
            values={} if values is None else values,
        )
