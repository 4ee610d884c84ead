"""Limits of the memory and work that clients can cause in the hub."""

from dataclasses import dataclass, fields
from typing import Final

from bridge.codecs.json_codec import MAX_DEPTH, MAX_SIZE
from bridge.hub.errors import HubError

_DEEPEST: Final = 250
"""Maximum depth that orjson writes, minus one level for the operation around a message."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HubLimits:
    """Bounds of one hub, all above 0. Sizes are bytes, times are seconds.

    An operation that exceeds a bound is refused and logged without an answer, as the reference server does
    for all errors; only calls and goals are answered, with `result: false`. A client is disconnected only if
    it could harm others: for a message that is too large, answers that it never reads, or a silent or stuck
    socket.

    Attributes:
        message_bytes: One WebSocket message, in both directions. A larger one closes the connection with 1009.
            Incomplete messages in fragments may occupy four times as much (`bridge.codecs.fragments.Reassembler`).
        depth: Nested objects and arrays in one message.
        clients: Simultaneous connections; the answer to a further one is 503.
        topics: Topics of all clients.
        advertisements_per_client: Open advertise operations (topic and id) of one client.
        subscriptions_per_client: Open subscribe operations (topic and id) of one client.
        services_per_client: Services that one client offers, and as many actions.
        calls_per_client: Open calls that one client made, and as many that it has yet to answer.
        goals_per_client: Open goals that one client sent, and as many that it executes.
        call_timeout: A call without an answer fails after this time; a client may request less.
        queue_length: Messages of a topic queued for a slow client that did not request a length, oldest
            dropped first.
        longest_queue: Maximum `queue_length` that a client can request.
        client_bytes: All output queued for one client. If it is exceeded, the oldest messages of topics are
            dropped; a client whose answers alone exceed it is disconnected.
        latched_bytes: All latched messages; a message that exceeds it is delivered but not latched.
        parameters: Number of parameters.
        parameter_bytes: All parameters' values, as JSON.
        handshake_timeout: Time from the TCP connection to a valid WebSocket request.
        ping_interval: A client silent for this long is pinged.
        ping_timeout: A client that remains silent for this long after a ping is disconnected.
        stuck_timeout: A client whose socket accepts nothing for this long, while data waits, is disconnected.
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
        """Refuse bounds that are not positive or contradict each other.

        Raises:
            HubError: A bound is not positive, or two do not fit together.
        """
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
