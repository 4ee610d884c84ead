"""Validation of the fields of an operation that a client sent.

Every function raises a `RefusedError` for an invalid field, which the broker logs or, for a call, answers.
"""

import re
from typing import Any, Final

from bridge.hub.errors import RefusedError
from bridge.names import MAX_NAME

Operation = dict[str, Any]
OperationId = str | int | None
"""rosbridge's optional `id`, which distinguishes operations of one client."""

_NAME: Final = re.compile(r"[~/]?[A-Za-z0-9_]+(?:/[A-Za-z0-9_]+)*")
"""Names of ROS 1 and ROS 2, and names with parts that start with a digit (`/camera/0`)."""
_LONGEST_ID: Final = 1024
"""Maximum number of characters in an id, because the hub stores ids of open operations."""
_HUGE: Final = 1e12
"""Upper bound of every rate, length and time."""
_POLICIES: Final = {
    "durability": ("volatile", "transient_local"),
    "reliability": ("reliable", "best_effort"),
    "history": ("keep_last", "keep_all"),
}
"""ROS 2's quality-of-service policies, as the reference server writes them."""
_ANY_POLICY: Final = ("system_default", "best_available")


def checked_name(name: str) -> str:
    """Return the name of a topic, a service or an action."""
    if len(name) > MAX_NAME or _NAME.fullmatch(name) is None:
        raise RefusedError(f"{name[:80]!r} cannot be a name: expected letters, digits, _ and /")
    return name


def text(operation: Operation, field: str) -> str:
    """Return a required string, which must not be empty."""
    value = operation.get(field)
    if not isinstance(value, str) or not value:
        raise RefusedError(f"{field} of {operation['op']} must be a string")
    return value


def optional_text(operation: Operation, field: str) -> str | None:
    """Return a string that must not be empty, or None if it is left out."""
    return None if operation.get(field) is None else text(operation, field)


def flag(operation: Operation, field: str) -> bool:
    """Return a boolean; False if it is left out."""
    value = operation.get(field)
    if value is not None and not isinstance(value, bool):
        raise RefusedError(f"{field} of {operation['op']} must be true or false")
    return bool(value)


def number(operation: Operation, field: str) -> float:
    """Return a number that is not negative; 0 if it is left out.

    The reference server accepts only integers, and ignores a whole operation with `0.0`; no client relies on
    that.
    """
    value = operation.get(field)
    if value is None:
        return 0
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < _HUGE:
        raise RefusedError(f"{field} of {operation['op']} must be a number from 0 up")
    return value


def operation_id(operation: Operation) -> OperationId:
    """Return the operation's id, or None if it is left out."""
    value = operation.get("id")
    if isinstance(value, bool) or not isinstance(value, str | int | None):
        raise RefusedError(f"id of {operation['op']} must be a string or an integer")
    if isinstance(value, str) and len(value) > _LONGEST_ID:
        raise RefusedError(f"id of {operation['op']} has more than {_LONGEST_ID} characters")
    return value


def quality(operation: Operation) -> Operation:
    """Return the requested quality of service (`qos`), empty if it is left out."""
    value = operation.get("qos")
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise RefusedError(f"qos of {operation['op']} must be a JSON object")
    for policy, known in _POLICIES.items():
        chosen = value.get(policy)
        if chosen is not None and chosen not in known and chosen not in _ANY_POLICY:
            raise RefusedError(f"{policy} in qos of {operation['op']} must be one of {', '.join(known)}")
    number(value | {"op": f"qos of {operation['op']}"}, "depth")
    return value


def is_logged(count: int) -> bool:
    """Return whether to log the occurrence with this number: the 1st, 10th, 100th and so on."""
    return str(count).strip("0") == "1"
