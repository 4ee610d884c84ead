"""Limits of the hub, its errors, and the validation of the fields of an operation.

If a field is invalid, the function that reads the field raises a `RefusedOperationError`. The broker logs the error.
For a call or a goal, the error is also the answer.
"""

import re
from dataclasses import dataclass, fields
from typing import Any, Final

from bridge.codecs.json_codec import MAX_DEPTH, MAX_SIZE
from bridge.errors import BridgeError
from bridge.names import MAX_NAME

# Maximum depth that orjson writes, minus one level for the operation around a message.
_DEEPEST: Final = 250

Operation = dict[str, Any]
OperationId = str | int | None
"""rosbridge's optional `id`, which distinguishes operations of one client."""

# Names of ROS 1 and ROS 2, and names with parts that start with a digit (`/camera/0`).
_NAME: Final = re.compile(r"[~/]?[A-Za-z0-9_]+(?:/[A-Za-z0-9_]+)*")
# Maximum number of characters in an id, because the hub stores ids of open operations.
_LONGEST_ID: Final = 1024
# Upper bound of every rate, length and time.
_HUGE: Final = 1e12
# ROS 2's quality-of-service policies, as the reference server writes them.
_POLICIES: Final = {
    "durability": ("volatile", "transient_local"),
    "reliability": ("reliable", "best_effort"),
    "history": ("keep_last", "keep_all"),
}
_ANY_POLICY: Final = ("system_default", "best_available")


class HubError(BridgeError):
    """Raised when the hub cannot serve, because its address, limits or access control are unusable."""

    exit_code = 2


class RefusedOperationError(BridgeError):
    """Raised when the hub refuses an operation. The text is logged, and is the answer to a call or a goal."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HubLimits:
    """Bounds of one hub, all above 0. Sizes are bytes, times are seconds.

    Like the reference server, the hub logs and refuses an operation that exceeds a bound, without an answer.
    Only calls and goals are answered, with `result: false`. The hub disconnects a client only for a message
    that is too large, for answers that the client never reads, or for a silent or stuck socket.

    Attributes:
        message_bytes: Size of one WebSocket message, in both directions. A larger message closes the connection
            with code 1009. All incomplete messages of a client may together occupy four times this size
            (`bridge.codecs.fragments.Reassembler`).
        depth: Levels of nested objects and arrays in one message.
        clients: Number of simultaneous connections. A further connection is refused with HTTP status 503.
        topics: Number of topics of all clients together.
        advertisements_per_client: Open advertise operations (topic and id) of one client.
        subscriptions_per_client: Open subscribe operations (topic and id) of one client.
        services_per_client: Services that one client offers. The same bound holds for its actions.
        calls_per_client: Open calls that one client made. The same bound holds for calls that the client must answer.
        goals_per_client: Open goals that one client sent. The same bound holds for goals that the client executes.
        call_timeout: Time after which a call without an answer fails. A client may request a shorter time.
        queue_length: Messages of a topic queued for a slow client that did not request a length. A further
            message replaces the oldest.
        longest_queue: Maximum `queue_length` that a client can request.
        client_bytes: All output queued for one client. Beyond this bound, the hub drops the oldest messages of
            topics. If the client's answers alone exceed the bound, the hub disconnects the client.
        latched_bytes: All latched messages together. A message that would exceed this bound is delivered but not
            latched.
        parameters: Number of parameters of ROS (see `bridge.hub.rosapi`).
        parameter_bytes: The values of all parameters together, as JSON.
        handshake_timeout: Time from the TCP connection to a valid WebSocket request.
        ping_interval: Silence of a client after which the hub pings the client.
        ping_timeout: Silence of a client after a ping, after which the hub disconnects the client.
        stuck_timeout: Time after which the hub disconnects a client if data waits but the socket accepts nothing.
    """

    message_bytes: int = MAX_SIZE
    depth: int = MAX_DEPTH
    clients: int = 256
    topics: int = 8192
    advertisements_per_client: int = 4096
    subscriptions_per_client: int = 4096
    services_per_client: int = 256
    calls_per_client: int = 256
    goals_per_client: int = 256
    call_timeout: float = 60.0
    queue_length: int = 100
    longest_queue: int = 1000
    client_bytes: int = 4 * MAX_SIZE
    latched_bytes: int = 64 * MAX_SIZE
    parameters: int = 1024
    parameter_bytes: int = MAX_SIZE
    handshake_timeout: float = 10.0
    ping_interval: float = 10.0
    ping_timeout: float = 20.0
    stuck_timeout: float = 20.0

    def __post_init__(self) -> None:
        """Refuse bounds that are not positive or contradict each other, with a HubError."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not value > 0:
                raise HubError(f"limit {field.name} = {value} of the hub: expected more than 0")
        if self.depth > _DEEPEST:
            raise HubError(f"limit depth = {self.depth} of the hub: expected at most {_DEEPEST}")
        if self.client_bytes < self.message_bytes:
            raise HubError(
                f"limit client_bytes = {self.client_bytes} of the hub: expected at least message_bytes = "
                f"{self.message_bytes}, or no message of that size could be queued for a client"
            )


# Fields of operations


def checked_name(name: str) -> str:
    """Return a valid name of a topic, service or action unchanged, or raise a RefusedOperationError."""
    if len(name) > MAX_NAME or _NAME.fullmatch(name) is None:
        raise RefusedOperationError(f"{name[:80]!r} cannot be a name: expected letters, digits, _ and /")
    return name


def text(operation: Operation, field: str) -> str:
    """Return the non-empty string in a required field of an operation."""
    value = operation.get(field)
    if not isinstance(value, str) or not value:
        raise RefusedOperationError(f"{field} of {operation['op']} must be a string")
    return value


def optional_text(operation: Operation, field: str) -> str | None:
    """Return the non-empty string in a field, or None if the field is absent."""
    return None if operation.get(field) is None else text(operation, field)


def flag(operation: Operation, field: str) -> bool:
    """Return the boolean in a field, or False if the field is absent."""
    value = operation.get(field)
    if value is not None and not isinstance(value, bool):
        raise RefusedOperationError(f"{field} of {operation['op']} must be true or false")
    return bool(value)


def number(operation: Operation, field: str) -> float:
    """Return the number in a field, or 0 if the field is absent. The number must not be negative.

    The reference server accepts only integers, and ignores an operation that contains `0.0`. The hub accepts `0.0`
    too, because no client wants its operations ignored.
    """
    value = operation.get(field)
    if value is None:
        return 0
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < _HUGE:
        raise RefusedOperationError(f"{field} of {operation['op']} must be a number from 0 up")
    return value


def operation_id(operation: Operation) -> OperationId:
    """Return the operation's id, or None if the operation has no id."""
    value = operation.get("id")
    if isinstance(value, bool) or not isinstance(value, str | int | None):
        raise RefusedOperationError(f"id of {operation['op']} must be a string or an integer")
    if isinstance(value, str) and len(value) > _LONGEST_ID:
        raise RefusedOperationError(f"id of {operation['op']} has more than {_LONGEST_ID} characters")
    return value


def quality(operation: Operation) -> Operation:
    """Return an operation's quality of service (`qos`), or {} if the operation has none."""
    value = operation.get("qos")
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise RefusedOperationError(f"qos of {operation['op']} must be a JSON object")
    for policy, known in _POLICIES.items():
        chosen = value.get(policy)
        if chosen is not None and chosen not in known and chosen not in _ANY_POLICY:
            raise RefusedOperationError(
                f"{policy} in qos of {operation['op']} must be one of {', '.join(known)}"
            )
    number(value | {"op": f"qos of {operation['op']}"}, "depth")
    return value


def is_logged(count: int) -> bool:
    """Return whether to log occurrence number `count` of an event. Only the 1st, 10th, 100th and so on are logged."""
    return str(count).strip("0") == "1"
