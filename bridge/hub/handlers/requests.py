"""Servers and callers, common to services and actions."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Self

import orjson

from bridge.hub.delivery.dispatcher import Dispatcher, fragment_size_of
from bridge.hub.delivery.encodings import Compression, compression_of
from bridge.hub.delivery.filling import Filler
from bridge.hub.errors import RefusedError
from bridge.hub.graph import Client, Offer
from bridge.hub.operations import Operation, OperationId, checked_name, is_logged, number, operation_id, text
from bridge.names import absolute

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Caller:
    """A client that waits for an answer, with its id, name and encoding."""

    client: Client
    id: OperationId
    name: str
    fragment_size: int = 0
    png: bool = False

    @classmethod
    def of(cls, client: Client, operation: Operation, field: str) -> Self:
        """Read the caller of an operation, which names a service or an action in `field`, or raise a RefusedError."""
        return cls(
            client,
            operation_id(operation),
            text(operation, field),
            fragment_size_of(number(operation, "fragment_size")),
            compression_of(operation.get("compression")) is Compression.PNG,
        )

    def operation(self, op: str, kind: str, **fields: object) -> bytes:
        """Return an operation for this client about the `kind` (service or action) that it named."""
        identity = {} if self.id is None else {"id": self.id}
        return orjson.dumps({"op": op, kind: self.name, **fields, **identity})

    def answer(self, dispatcher: Dispatcher, payload: bytes) -> None:
        """Send an answer in the requested encoding, or raise a RefusedError if it is too large."""
        dispatcher.checked(payload, f"the answer of {self.name}")
        dispatcher.send(self.client, payload, fragment_size=self.fragment_size, png=self.png)


def filled(filler: Filler | None, values: Any, room: int) -> Any:
    """Return arguments or results with the defaults of absent fields, and named fields instead of a list.

    Raises:
        RefusedError: They would grow by more than `room` bytes.
    """
    if values is None:
        values = {}
    if filler is not None:
        if isinstance(values, list):
            values = filler.named(values)
        if isinstance(values, dict):
            filler.fill(values, room)
    return values


class Offers:
    """Services or actions by name; the last client to offer a name serves it."""

    def __init__(
        self, offers: dict[str, Offer], names_of: Callable[[Client], set[str]], limit: int, kind: str
    ) -> None:
        """Manage services or actions of a graph, at most `limit` per client; `kind` is also a field of operations."""
        self._offers = offers
        self._names_of = names_of
        self._limit = limit
        self._kind = kind

    def add(
        self, client: Client, operation: Operation, type_name: str, fillers: Mapping[str, Filler]
    ) -> None:
        """Add an offer, or take it over from another client."""
        name = checked_name(text(operation, self._kind))
        key, names = absolute(name), self._names_of(client)
        if key not in names and len(names) >= self._limit:
            raise RefusedError(f"this client already offers {len(names)} {self._kind}s")
        before = self._offers.get(key)
        if before is not None and before.client is not client:
            client.takeovers += 1
            if is_logged(client.takeovers):
                log.warning("%s took %s over from %s", client.node, key, before.client.node)
            self._names_of(before.client).discard(key)
        self._offers[key] = Offer(key, type_name, client, fillers)
        names.add(key)

    def remove(self, client: Client, operation: Operation) -> None:
        """Withdraw an offer; open requests may still be answered."""
        name = text(operation, self._kind)
        names = self._names_of(client)
        if absolute(name) not in names:
            raise RefusedError(f"this client does not offer {name}")
        names.discard(absolute(name))
        del self._offers[absolute(name)]

    def leave(self, client: Client) -> None:
        """Remove the offers of a disconnected client."""
        for name in self._names_of(client):
            self._offers.pop(name, None)
