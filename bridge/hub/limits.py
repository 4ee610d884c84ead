"""How much of everything the hub takes: no client can make it grow, or make it slow for the others."""

from dataclasses import dataclass, fields
from typing import Final

from bridge.codecs.json_codec import MAX_DEPTH, MAX_SIZE
from bridge.hub.errors import HubError

#: orjson writes at most this depth; one level is the operation around a message.
_DEEPEST: Final = 250


@dataclass(frozen=True, slots=True, kw_only=True)
class HubLimits:
    """Bounds of one hub. Sizes are bytes, times are seconds; all are at least 1 (times: above 0).

    What comes in fragments may have ``message_bytes`` characters when it is complete, and four times as many while
    it is not (see `bridge.codecs.fragments.Reassembler`).

    What goes beyond a bound is refused and logged, as the reference server does with everything wrong: the
    client is not told, but for calls, which are answered ``result: false``. Only what harms others costs the
    connection: a message that is too large, an answer that is never read, a silent or a stuck socket.

    Attributes:
        message_bytes: one WebSocket message, in and out. A larger one closes its sender with 1009.
        depth: objects and arrays within each other in one message.
        clients: connections at a time; a further one is answered 503.
        topics: topics at a time, over all clients.
        advertisements_per_client: advertise operations (topic and id) that one client has open.
        subscriptions_per_client: subscribe operations (topic and id) that one client has open.
        services_per_client: services that one client offers, and actions.
        calls_per_client: calls that one client waits for, and calls that one client has yet to answer.
        goals_per_client: goals that one client waits for, and goals that one client works on.
        call_timeout: a call without answer fails after this long; a client may ask for less.
        queue_length: messages that wait for a slow client per topic, the oldest dropped, if it did not say.
        longest_queue: the most that a client can ask for with ``queue_length``.
        client_bytes: all that waits for one client. Topics' oldest messages are dropped beyond; when
            answers alone are more, the client is closed.
        latched_bytes: all latched messages together; a message beyond is delivered but not latched.
        parameters: parameters at a time.
        parameter_bytes: all parameters' values together, as JSON.
        handshake_timeout: from the TCP connection to a valid WebSocket request.
        ping_interval: a client not heard for this long is pinged.
        ping_timeout: and closed when it is not heard for this long after that.
        stuck_timeout: a client whose socket takes nothing for this long while data waits is closed.
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
            HubError: a bound is not positive, or two do not fit together; the sentence names them.
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
                f"{self.message_bytes}, or no message of that size could wait for a client"
            )
