"""Dispatch of messages to the outboxes of clients.

The `Dispatcher` also keeps a list of the clients with output, and the set of clients with throttled messages.
"""

from math import inf
from typing import Final

import orjson

from bridge.hub.encodings import as_png
from bridge.hub.graph import Client
from bridge.hub.limits import HubLimits, RefusedOperationError
from bridge.hub.outbox import Lane

SMALLEST_FRAGMENT: Final = 256
"""Minimum size of a fragment in bytes. A smaller fragment would consist mostly of framing."""
# Maximum number of status messages queued for a client.
_STATUS_QUEUE: Final = 20


class Dispatcher:
    """Output to all clients of one hub."""

    def __init__(self, limits: HubLimits) -> None:
        """Create a dispatcher that has no output for any client yet. `limits` are the limits of the hub."""
        self._limits = limits
        # The clients with output, each once (`Client.is_ready`), until the owner of the sockets takes them.
        self._ready: list[Client] = []
        self.throttled: set[Client] = set()
        """The clients whose outboxes hold messages that a throttle does not admit yet."""
        self.deadline = inf
        """Time at which the broker must be woken (monotonic seconds): for a throttle, a call or a fragment."""
        self.work = 0
        """Units of work in the current turn (see `bridge.hub.topics.TURN_WORK`)."""

    def mark_ready(self, client: Client) -> None:
        """Add a client to the list of clients with output. A client that is in the list is not added again."""
        if not client.is_ready:
            client.is_ready = True
            self._ready.append(client)

    def take_ready(self) -> list[Client]:
        """Return the clients marked as ready since the last call. Each client has output, or must be closed."""
        ready, self._ready = self._ready, []
        for client in ready:
            client.is_ready = False
        return ready

    def checked(self, payload: bytes, what: str) -> bytes:
        """Return a payload that does not exceed the size limit.

        Raises a RefusedOperationError if the payload is larger; `what` names the payload in the error.
        """
        if len(payload) > self._limits.message_bytes:
            raise RefusedOperationError(f"{what} has more than {self._limits.message_bytes} bytes")
        return payload

    def send(self, client: Client, payload: bytes, *, fragment_size: int = 0, png: bool = False) -> None:
        """Queue a message for a client, as PNG or in fragments if requested. The message is never dropped."""
        self.work += len(payload) >> 6
        if png:
            payload = self.as_png(payload)
        client.outbox.put(payload, fragment_size)
        if client.outbox.overflowed:
            client.close_reason = f"it leaves {self._limits.client_bytes} bytes of answers unread"
        self.mark_ready(client)

    def as_png(self, payload: bytes) -> bytes:
        """Return an operation as a PNG picture, or unchanged if the picture would exceed the size limit."""
        wrapped = as_png(payload)
        return wrapped if len(wrapped) <= self._limits.message_bytes else payload

    def offer(self, client: Client, lane: Lane, payload: bytes, now: float) -> None:
        """Queue a message in a lane. Newer messages in the lane may replace the message."""
        client.outbox.offer(lane, payload, now)
        if lane.throttle:
            self.schedule_release(client)
        self.mark_ready(client)

    def schedule(self, deadline: float) -> None:
        """Make sure that the broker is woken at `deadline` or earlier."""
        self.deadline = min(self.deadline, deadline)

    def schedule_release(self, client: Client) -> None:
        """Schedule the release of the messages that a throttle holds back for a client."""
        deadline = client.outbox.deadline
        if deadline != inf:
            self.throttled.add(client)
            self.schedule(deadline)

    def release(self, now: float) -> float:
        """Queue the throttled messages that are due at `now`. Returns the next time to call `release`, or infinity."""
        for client in [client for client in self.throttled if client.outbox.deadline <= now]:
            client.outbox.release(now)
            self.mark_ready(client)
            if client.outbox.deadline == inf:
                self.throttled.discard(client)
        return min((client.outbox.deadline for client in self.throttled), default=inf)

    def send_status(self, client: Client, sentence: str, operation_id: object, now: float) -> None:
        """Send a status message about an error. If the client does not read, drop its oldest status messages."""
        status: dict[str, object] = {"op": "status", "level": "error", "msg": sentence}
        if isinstance(operation_id, str | int) and not isinstance(operation_id, bool):
            status["id"] = operation_id
        # Status messages may be dropped: a client that sends nonsense faster than it reads must not fill its outbox.
        if client.status_lane is None:
            client.status_lane = Lane(_STATUS_QUEUE)
        try:
            payload = orjson.dumps(status)
        except TypeError:  # an unpaired surrogate in an id or a name
            return
        self.offer(client, client.status_lane, payload, now)


def fragment_size_of(requested: float) -> int:
    """Return the requested fragment size, raised to `SMALLEST_FRAGMENT` if it is smaller; 0 (no fragments) stays 0."""
    return max(int(requested), SMALLEST_FRAGMENT) if requested else 0
