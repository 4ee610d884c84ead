"""Service calls between clients, each answered exactly once, and what they have in common with goals.

    caller                          hub                           server
      │ call_service "7" /add        │                              │
      │─────────────────────────────▶│ call_service "service_request:/add:1"
      │                              │─────────────────────────────▶│
      │                              │ service_response "service_request:/add:1"
      │ service_response "7"         │◀─────────────────────────────│
      │◀─────────────────────────────│                              │

The hub replaces the caller's id by a key of its own, because ids of different clients may be equal. A call also ends,
with `result: false`, when the server leaves or the deadline passes.
"""

import heapq
import itertools
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, Final, Self

import orjson

from bridge.errors import BridgeError
from bridge.hub.definitions import MessageDefinitions
from bridge.hub.dispatcher import Dispatcher, fragment_size_of
from bridge.hub.encodings import Encoding, encoding_of
from bridge.hub.filling import Filler
from bridge.hub.graph import Client, Graph, Offer
from bridge.hub.limits import (
    HubLimits,
    Operation,
    OperationId,
    RefusedOperationError,
    checked_name,
    is_logged,
    number,
    operation_id,
    text,
)
from bridge.hub.rosapi import PREFIX, Rosapi
from bridge.names import absolute

log = logging.getLogger(__name__)

# Number of deadlines of answered calls by which the queue may exceed the open calls.
_ANSWERED: Final = 64
_RESPONSE: Final = ("service_response", "service")


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
        """Read the caller of an operation, which names a service or an action in `field`, or raise a RefusedOperationError."""
        return cls(
            client,
            operation_id(operation),
            text(operation, field),
            fragment_size_of(number(operation, "fragment_size")),
            encoding_of(operation.get("compression")) is Encoding.PNG,
        )

    def operation(self, op: str, kind: str, **fields: object) -> bytes:
        """Return an operation for this client about the `kind` (service or action) that it named."""
        identity = {} if self.id is None else {"id": self.id}
        return orjson.dumps({"op": op, kind: self.name, **fields, **identity})

    def answer(self, dispatcher: Dispatcher, payload: bytes) -> None:
        """Send an answer in the requested encoding, or raise a RefusedOperationError if it is too large."""
        dispatcher.checked(payload, f"the answer of {self.name}")
        dispatcher.send(self.client, payload, fragment_size=self.fragment_size, png=self.png)


def filled(filler: Filler | None, values: Any, room: int) -> Any:
    """Return arguments or results with all fields, which may grow by `room` bytes, and named ones instead of a list."""
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
            raise RefusedOperationError(f"this client already offers {len(names)} {self._kind}s")
        # As in ROS 1, a node that starts again takes its services over, although the old one has not been missed yet.
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
            raise RefusedOperationError(f"this client does not offer {name}")
        names.discard(absolute(name))
        del self._offers[absolute(name)]

    def leave(self, client: Client) -> None:
        """Remove the offers of a disconnected client."""
        for name in self._names_of(client):
            self._offers.pop(name, None)


@dataclass(frozen=True, slots=True)
class _Call:
    """A call that is not answered yet."""

    caller: Caller
    server: Client
    deadline: float
    filler: Filler | None
    """Fills absent fields of the answer."""


class Calls:
    """The services of one hub, and the calls that are not answered yet."""

    def __init__(
        self,
        graph: Graph,
        limits: HubLimits,
        dispatcher: Dispatcher,
        definitions: MessageDefinitions,
        rosapi: Rosapi,
        answer_here: Callable[[Client, str], dict[str, Any] | None],
    ) -> None:
        """Start without services; `answer_here` returns an answer for the hub's own services only."""
        self._graph = graph
        self._limits = limits
        self._dispatcher = dispatcher
        self._definitions = definitions
        self._rosapi = rosapi
        self._answer_here = answer_here
        self._offers = Offers(
            graph.services, lambda client: client.services, limits.services_per_client, "service"
        )
        self._numbers = itertools.count(1)
        # A heap of the calls' deadlines. Those of answered calls stay until they pass or are too many (`_schedule`),
        # because finding one in a heap takes longer than skipping it.
        self._deadlines: list[tuple[float, str]] = []
        self.pending: dict[str, _Call] = {}

    @property
    def deadline(self) -> float:
        """When `expire` may have something to do, infinity for never."""
        return self._deadlines[0][0] if self._deadlines else inf

    def leave(self, client: Client) -> None:
        """Remove a disconnected client, and fail the calls that it had yet to answer."""
        self._offers.leave(client)
        for key in list(client.calls):
            self._take(key)
        for key in list(client.requests):
            call = self._take(key)
            self._fail(call.caller, f"{call.caller.name} went away during the call")

    def expire(self, now: float) -> None:
        """Fail the calls whose deadline has passed."""
        while self.deadline <= now:
            _, key = heapq.heappop(self._deadlines)
            if key in self.pending:
                call = self._take(key)
                self._fail(call.caller, f"{call.caller.name} did not answer in time")

    def advertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `advertise_service`."""
        name, type_name = text(operation, "service"), text(operation, "type")
        if absolute(name).startswith(PREFIX):
            raise RefusedOperationError(f"{name} belongs to the hub")
        type_name = self._rosapi.service_type_name(type_name)
        self._offers.add(client, operation, type_name, self._definitions.fillers(type_name, "srv"))

    def unadvertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `unadvertise_service`."""
        self._offers.remove(client, operation)

    def call(self, client: Client, operation: Operation, now: float) -> None:
        """Perform `call_service`."""
        caller = Caller.of(client, operation, "service")
        try:
            self._start(caller, operation, now)
        except BridgeError as error:
            self._fail(caller, str(error))

    def _start(self, caller: Caller, operation: Operation, now: float) -> None:
        name, args = caller.name, operation.get("args")
        key = absolute(name)
        if self._rosapi.offers(key):
            self._dispatcher.work += (len(self._graph.topics) + len(self._graph.services)) >> 3
            self._answer(caller, self._rosapi.call(key, {} if args is None else args))
            return
        service = self._graph.services.get(key)
        if service is None:
            values = self._answer_here(caller.client, key)
            if values is None:
                raise RefusedOperationError(f"Service {name} does not exist")
            self._answer(caller, values)
            return
        client, server = caller.client, service.client
        if len(client.calls) >= self._limits.calls_per_client:
            raise RefusedOperationError(f"this client already waits for {len(client.calls)} calls")
        # Both ends are bounded: a client could otherwise fill the outbox of a server that does not answer.
        if len(server.requests) >= self._limits.calls_per_client:
            raise RefusedOperationError(f"{name} already has {len(server.requests)} calls to answer")
        deadline = now + min(number(operation, "timeout") or inf, self._limits.call_timeout)
        # Not a secret: only the client that got a request may answer it (`respond`).
        request_id = f"service_request:{key}:{next(self._numbers)}"
        args = filled(service.fillers.get("Request"), args, self._limits.message_bytes)
        payload = orjson.dumps({"op": "call_service", "id": request_id, "service": key, "args": args})
        self._dispatcher.checked(payload, f"the request for {name}")
        self.pending[request_id] = _Call(caller, server, deadline, service.fillers.get("Response"))
        self._schedule(deadline, request_id)
        client.calls.add(request_id)
        server.requests.add(request_id)
        self._dispatcher.send(server, payload)

    def _schedule(self, deadline: float, key: str) -> None:
        # A flood of calls that are answered at once would otherwise leave their deadlines for a minute.
        if len(self._deadlines) > 2 * len(self.pending) + _ANSWERED:
            self._deadlines = [(call.deadline, key) for key, call in self.pending.items()]
            heapq.heapify(self._deadlines)
        else:
            heapq.heappush(self._deadlines, (deadline, key))
        self._dispatcher.schedule(deadline)

    def respond(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `service_response`."""
        key = operation.get("id")
        if not isinstance(key, str) or key not in client.requests:
            raise RefusedOperationError(f"no client waits for the answer {str(key)[:80]!r}")
        call = self._take(key)
        caller = call.caller
        values, result = operation.get("values", {}), operation.get("result", True)
        reason = operation.get("reason")
        if result is False and isinstance(reason, str):  # of this project's client
            self._fail(caller, reason)
            return
        # In ROS 1 the reference server forwards an answer whatever its result; roslibpy's tests rely on this.
        if isinstance(values, dict) and (
            result is True or (self._rosapi.ros_version == 1 and "values" in operation)
        ):
            try:
                self._answer(caller, filled(call.filler, values, self._limits.message_bytes))
            except RefusedOperationError as error:
                self._fail(caller, str(error))
        elif result is True:
            self._fail(caller, f"{caller.name} answered with values that are not a JSON object")
        else:
            # The wire has a string here; anything else is sent as JSON.
            self._fail(caller, values if isinstance(values, str) else orjson.dumps(values).decode())

    def _take(self, key: str) -> _Call:
        call = self.pending.pop(key)
        call.caller.client.calls.discard(key)
        call.server.requests.discard(key)
        return call

    def _answer(self, caller: Caller, values: dict[str, Any]) -> None:
        caller.answer(self._dispatcher, caller.operation(*_RESPONSE, values=values, result=True))

    def _fail(self, caller: Caller, reason: str) -> None:
        # A character can take six bytes in JSON, and a failure must never be too large to send.
        reason = reason[: self._limits.message_bytes // 8]
        payload = caller.operation(*_RESPONSE, values=reason, result=False)
        self._dispatcher.send(caller.client, payload)
