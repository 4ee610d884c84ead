"""Bounds on everything that clients can make the hub store or do."""

from dataclasses import dataclass, fields
from typing import Final

from bridge.codecs.json_codec import MAX_DEPTH, MAX_SIZE
from bridge.hub.errors import HubError

_DEEPEST: Final = 250
"""Maximum depth that orjson writes, less one level for the operation around a message."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HubLimits:
    """Bounds of one hub, all above 0. Sizes are bytes, times are seconds.

    An operation beyond a bound is refused and logged without an answer, as the reference server treats all errors;
    only calls and goals are answered, with `result: false`. A client loses its connection only for what harms others:
    a message that is too large, answers that it never reads, a silent or a stuck socket.

    Attributes:
        message_bytes: One WebSocket message, in both directions. A larger one closes the connection with 1009.
            Incomplete messages in fragments may occupy four times as much (`bridge.codecs.fragments.Reassembler`).
        depth: Nested objects and arrays in one message.
        clients: Simultaneous connections; a further one is answered 503.
        topics: Topics of all clients.
        advertisements_per_client: Open advertise operations (topic and id) of one client.
        subscriptions_per_client: Open subscribe operations (topic and id) of one client.
        services_per_client: Services that one client offers, and as many actions.
        calls_per_client: Calls that one client waits for, and as many that it has yet to answer.
        goals_per_client: Goals that one client waits for, and as many that it works on.
        call_timeout: A call without an answer fails after this time; a client may ask for less.
        queue_length: Messages of a topic queued for a slow client, oldest dropped first, if it asked for no length.
        longest_queue: Maximum of `queue_length` that a client can ask for.
        client_bytes: Everything queued for one client. Beyond, the topics' oldest messages are dropped; a client
            whose answers alone are more is closed.
        latched_bytes: All latched messages; a message beyond is delivered but not latched.
        parameters: Number of parameters.
        parameter_bytes: All parameters' values, as JSON.
        handshake_timeout: From the TCP connection to a valid WebSocket request.
        ping_interval: A client silent for this long is pinged.
        ping_timeout: A pinged client silent for this long is closed.
        stuck_timeout: A client whose socket accepts nothing for this long while data waits is closed.
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
        """Refuse bounds that contradict each other.

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
