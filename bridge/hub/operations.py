"""The fields of an operation that a client sent, each checked when it is read.

What is wrong raises `RefusedError`; the broker makes a line in the log or the answer to a call of it.
"""

import re
from typing import Any, Final

from bridge.names import MAX_NAME

Operation = dict[str, Any]
#: What tells one operation of a client from another: rosbridge's optional ``id``.
OperationId = str | int | None

#: What both ROS 1 and ROS 2 would take, and a little more: parts that start with a digit (``/camera/0``).
_NAME: Final = re.compile(r"[~/]?[A-Za-z0-9_]+(?:/[A-Za-z0-9_]+)*")
#: Characters of an operation's id at most: the hub remembers those of what is open.
_LONGEST_ID: Final = 1024
#: No rate, length or time is as large.
_HUGE: Final = 1e12
#: What ROS 2 knows of quality of service, as the reference server writes it.
_POLICIES: Final = {
    "durability": ("volatile", "transient_local"),
    "reliability": ("reliable", "best_effort"),
    "history": ("keep_last", "keep_all"),
}
_ANY_POLICY: Final = ("system_default", "best_available")


class RefusedError(Exception):
    """What a client asked for is not done. The text is for the log, or for the answer to a call."""


def checked_name(name: str) -> str:
    """Refuse what cannot be the name of a topic, a service or an action.

    Raises:
        RefusedError: too long, or with characters that no name has.
    """
    if len(name) > MAX_NAME or _NAME.fullmatch(name) is None:
        raise RefusedError(f"{name[:80]!r} cannot be a name: letters, digits, _ and / make one")
    return name


def text(operation: Operation, field: str) -> str:
    """A string that must be there, and not empty.

    Raises:
        RefusedError: it is not.
    """
    value = operation.get(field)
    if not isinstance(value, str) or not value:
        raise RefusedError(f"{operation['op']} needs a string in {field}")
    return value


def optional_text(operation: Operation, field: str) -> str | None:
    """A string, None where it is left out.

    Raises:
        RefusedError: it is something else.
    """
    return None if operation.get(field) is None else text(operation, field)


def flag(operation: Operation, field: str) -> bool:
    """True or false, false where it is left out.

    Raises:
        RefusedError: it is something else.
    """
    value = operation.get(field)
    if value is not None and not isinstance(value, bool):
        raise RefusedError(f"{field} of {operation['op']} is neither true nor false")
    return bool(value)


def number(operation: Operation, field: str) -> float:
    """A number that is not negative, 0 when it is not there.

    The reference server takes integers alone and ignores the whole operation for ``0.0``; no client relies
    on that.

    Raises:
        RefusedError: it is something else.
    """
    value = operation.get(field)
    if value is None:
        return 0
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < _HUGE:
        raise RefusedError(f"{field} of {operation['op']} is no number from 0 up")
    return value


def operation_id(operation: Operation) -> OperationId:
    """The operation's id, None where it is left out.

    Raises:
        RefusedError: neither a string nor an integer, or too long.
    """
    value = operation.get("id")
    if isinstance(value, bool) or not isinstance(value, str | int | None):
        raise RefusedError(f"id of {operation['op']} is neither a string nor an integer")
    if isinstance(value, str) and len(value) > _LONGEST_ID:
        raise RefusedError(f"id of {operation['op']} has more than {_LONGEST_ID} characters")
    return value


def quality(operation: Operation) -> Operation:
    """The quality of service that an operation asks for (``qos``), empty where it is left out.

    Raises:
        RefusedError: no object, or a policy that ROS 2 does not know.
    """
    value = operation.get("qos")
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise RefusedError(f"qos of {operation['op']} is no JSON object")
    for policy, known in _POLICIES.items():
        chosen = value.get(policy)
        if chosen is not None and chosen not in known and chosen not in _ANY_POLICY:
            raise RefusedError(f"{policy} in qos of {operation['op']} is none of {', '.join(known)}")
    number(value | {"op": f"qos of {operation['op']}"}, "depth")
    return value


def is_round(count: int) -> bool:
    """Whether to log it: the 1st, 10th, 100th and so on, so that a flood fills no log."""
    return str(count).strip("0") == "1"
