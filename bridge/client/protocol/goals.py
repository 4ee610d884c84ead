"""The goals of ROS 2 actions that a client has under way."""

from collections.abc import Mapping
from typing import Any, Final

from bridge.client.protocol.events import GoalEnded, GoalFeedback, GoalStatus, Unusable
from bridge.client.protocol.wire import Wire
from bridge.codecs.json_codec import excerpt, text_of
from bridge.errors import SlowPeerError
from bridge.names import check_name, ros2_type

#: Goals of actions that may be under way at once.
MAX_GOALS: Final = 100


class Goals:
    """The goals under way: their actions by their identities on the wire."""

    def __init__(self, wire: Wire) -> None:
        """Begin with none."""
        self._wire = wire
        self._actions: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self._actions)

    def send(self, action: str, type_name: str, goal: Mapping[str, Any], *, feedback: bool) -> str:
        """Send a goal to an action of ROS 2.

        Args:
            action: its name.
            type_name: its type, in any form.
            goal: the goal's fields.
            feedback: whether to be told how far it is.

        Returns:
            The goal's identity, which its events bear.

        Raises:
            NameFormError: of action or type.
            EncodeError: the goal cannot leave as JSON.
            SlowPeerError: `MAX_GOALS` goals are under way already.
        """
        check_name(action)
        if len(self._actions) >= MAX_GOALS:
            raise SlowPeerError(f"{MAX_GOALS} goals are under way already, {action} gets none")
        identity = f"send_action_goal:{action}:{self._wire.number()}"
        self._wire.say(
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
        """Ask for a goal to be given up; its end tells whether it was. Nothing happens if it is over."""
        action = self._actions.get(goal)
        if action is not None:
            self._wire.say(op="cancel_action_goal", id=goal, action=action)

    def forget(self, goal: str) -> None:
        """Be told no more of a goal."""
        self._actions.pop(goal, None)

    def lost(self) -> None:
        """Take note that the connection is gone: a server forgets whose goals they were."""
        self._actions.clear()

    def receive(
        self, operation: dict[str, Any], data: bytes | str
    ) -> GoalFeedback | GoalEnded | Unusable | None:
        """Take what the server says of a goal; None if it is none of these."""
        goal = operation.get("id")
        if not isinstance(goal, str):
            return Unusable(f"something about an action's goal arrived without its id: {excerpt(data)}")
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
