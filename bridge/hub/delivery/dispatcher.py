"""What goes to clients: into their outboxes, and who has something waiting for its socket or its throttle."""

from math import inf
from typing import Final

import orjson

from bridge.hub.delivery.encodings import as_png
from bridge.hub.delivery.outbox import Lane
from bridge.hub.graph import Client
from bridge.hub.limits import HubLimits

#: Characters of a fragment at least: smaller ones would be little but their own frames.
SMALLEST_FRAGMENT: Final = 16
#: Status messages that wait for a client at most.
_STATUS_QUEUE: Final = 20


class Delivery:
    """The way to all clients of one hub."""

    def __init__(self, limits: HubLimits) -> None:
        """Hand out to nobody yet."""
        self._limits = limits
        self._ready: list[Client] = []
        self.throttled: set[Client] = set()
        self.deadline = inf

    def announce(self, client: Client) -> None:
        """Put a client on the list of those to be served."""
        if not client.has_output:
            client.has_output = True
            self._ready.append(client)

    def take_ready(self) -> list[Client]:
        """The clients that have something to be sent, or are doomed, since this was last asked."""
        ready, self._ready = self._ready, []
        for client in ready:
            client.has_output = False
        return ready

    def send(self, client: Client, payload: bytes, *, fragment_size: int = 0, png: bool = False) -> None:
        """Queue what may not be lost; in the form that the operation it answers asked for."""
        if png:
            wrapped = as_png(payload)
            # Hardly ever: what cannot be made smaller goes as it is, as nobody may lose an answer.
            payload = wrapped if len(wrapped) <= self._limits.message_bytes else payload
        client.outbox.put(payload, fragment_size)
        if client.outbox.overflowed:
            client.doomed = f"it leaves {self._limits.client_bytes} bytes of answers unread"
        self.announce(client)

    def offer(self, client: Client, lane: Lane, payload: bytes, now: float) -> None:
        """Queue what may be lost to newer ones of its lane."""
        outbox = client.outbox
        outbox.offer(lane, payload, now)
        if outbox.deadline != inf:
            self.note_throttle(client)
        if not client.has_output:
            self.announce(client)

    def note_throttle(self, client: Client) -> None:
        """See that a client whose throttle holds something back is woken for it."""
        deadline = client.outbox.deadline
        if deadline != inf:
            self.throttled.add(client)
            self.deadline = min(self.deadline, deadline)

    def release(self, now: float) -> None:
        """Queue what throttles held until ``now``."""
        if now < self.deadline:
            return
        for client in list(self.throttled):
            client.outbox.release(now)
            self.announce(client)
            if client.outbox.deadline == inf:
                self.throttled.discard(client)
        self.deadline = min((client.outbox.deadline for client in self.throttled), default=inf)

    def tell(self, client: Client, level: str, sentence: str, operation_id: object, now: float) -> None:
        """Send a status message; a client that does not read loses the oldest of them."""
        status: dict[str, object] = {"op": "status", "level": level, "msg": sentence}
        if isinstance(operation_id, str | int) and not isinstance(operation_id, bool):
            status["id"] = operation_id
        if client.status_lane is None:
            client.status_lane = Lane(_STATUS_QUEUE)
        try:
            payload = orjson.dumps(status)
        except TypeError:  # an id or a name with half a character
            return
        self.offer(client, client.status_lane, payload, now)

    def forget(self, client: Client) -> None:
        """A client has gone."""
        self.throttled.discard(client)


def fragment_size_of(asked: float) -> int:
    """Characters of a fragment for what an operation asks for; 0 is none."""
    return max(int(asked), SMALLEST_FRAGMENT) if asked else 0
