"""Names, types and statuses of actionlib, the actions of ROS 1, which are topics.

    NAME/goal, NAME/cancel  ->  server  ->  NAME/status (5 Hz, and at changes), NAME/feedback, NAME/result

Source: http://wiki.ros.org/actionlib/DetailedDescription.
"""

import time
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, Final

from bridge import stamps
from bridge.names import ros1_type, split_type

GOAL_ID: Final = "actionlib_msgs/GoalID"
STATUS_ARRAY: Final = "actionlib_msgs/GoalStatusArray"
_ENDING: Final = "Action"


class ActionlibStatus(IntEnum):
    """Status of a goal (`actionlib_msgs/GoalStatus`)."""

    PENDING = 0
    ACTIVE = 1
    PREEMPTED = 2
    SUCCEEDED = 3
    ABORTED = 4
    REJECTED = 5
    PREEMPTING = 6
    RECALLING = 7
    RECALLED = 8
    LOST = 9


def is_actionlib_type(type_name: str) -> bool:
    """Return whether a type looks like an action of ROS 1: `pkg/FibonacciAction`, or of a package of actionlib."""
    package, kind, own = split_type(type_name)
    return not kind and (own.endswith(_ENDING) or package.startswith("actionlib"))


def base_type(type_name: str) -> str:
    """Return the type to which `ActionGoal`, `ActionResult` and `ActionFeedback` are appended."""
    name = ros1_type(type_name)
    base = name.removesuffix(_ENDING)
    return name if base.endswith("/") else base


def with_header(message: Mapping[str, Any]) -> dict[str, Any]:
    """Return a message with the current time in its header."""
    return {"header": stamps.header(time.time_ns(), "", 1), **message}
