"""Services between clients: who offers them, and every call answered exactly once."""

import itertools
import logging
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any

import orjson

from bridge.errors import BridgeError
from bridge.hub.delivery.dispatcher import Delivery, fragment_size_of
from bridge.hub.delivery.encodings import compression_of
from bridge.hub.graph import Client, Graph, Service
from bridge.hub.handlers.rosapi import PREFIX, Rosapi, RosapiError
from bridge.hub.limits import HubLimits
from bridge.hub.operations import (
    Operation,
    OperationId,
    RefusedError,
    checked_name,
    is_round,
    number,
    operation_id,
    text,
)
from bridge.names import absolute, split_type

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Asker:
    """Who waits for an answer, under which id and name, and in which form."""

    client: Client
    id: OperationId
    name: str
    fragment_size: int = 0
    png: bool = False


@dataclass(frozen=True, slots=True)
class _Call:
    """A call on its way: who asked, who is to answer, and by when."""

    asker: Asker
    server: Client
    deadline: float


class Calls:
    """The services of one hub, and the calls that are on their way."""

    def __init__(
        self,
        graph: Graph,
        limits: HubLimits,
        delivery: Delivery,
        rosapi: Rosapi,
        answer_here: Callable[[Client, str], dict[str, Any] | None],
    ) -> None:
        """Begin without a service.

        Args:
            graph: where they are noted.
            limits: what is refused beyond.
            delivery: the way to clients.
            rosapi: the hub's own services.
            answer_here: what else the hub answers itself: the values for a client and a service, or None.
        """
        self._graph = graph
        self._limits = limits
        self._delivery = delivery
        self._rosapi = rosapi
        self._answer_here = answer_here
        self._numbers = itertools.count(1)
        self.waiting: dict[str, _Call] = {}
        self.deadline = inf

    def leave(self, client: Client) -> None:
        """A client has gone; what it had yet to answer fails now."""
        for name in client.services:
            self._graph.services.pop(name, None)
        for key in list(client.asked):
            self._take(key)
        for key in list(client.asked_of):
            call = self._take(key)
            self._fail(call.asker, f"{call.asker.name} went away during the call")

    def expire(self, now: float) -> None:
        """Fail the calls whose time is over at ``now``."""
        if now < self.deadline:
            return
        for key in [key for key, call in self.waiting.items() if call.deadline <= now]:
            call = self._take(key)
            self._fail(call.asker, f"{call.asker.name} did not answer in time")
        self.deadline = min((call.deadline for call in self.waiting.values()), default=inf)

    def advertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Do ``advertise_service``."""
        name, type_name = checked_name(text(operation, "service")), text(operation, "type")
        split_type(type_name)
        key = absolute(name)
        if key.startswith(PREFIX):
            raise RefusedError(f"{name} is the hub's own to offer")
        if key not in client.services and len(client.services) >= self._limits.services_per_client:
            raise RefusedError(f"{name} would be one service more than {len(client.services)}")
        before = self._graph.services.get(key)
        if before is not None and before.client is not client:
            note_takeover(client, before.client, key)
            before.client.services.discard(key)
        self._graph.services[key] = Service(key, self._rosapi.service_type_name(type_name), client)
        client.services.add(key)

    def unadvertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Do ``unadvertise_service``."""
        name = text(operation, "service")
        if absolute(name) not in client.services:
            raise RefusedError(f"{name} is not offered by this client")
        client.services.discard(absolute(name))
        del self._graph.services[absolute(name)]

    def call(self, client: Client, operation: Operation, now: float) -> None:
        """Do ``call_service``."""
        asker = asker_of(client, text(operation, "service"), operation)
        try:
            self._start(asker, operation, now)
        except (RefusedError, BridgeError) as error:
            self._fail(asker, str(error))

    def _start(self, asker: Asker, operation: Operation, now: float) -> None:
        client, name = asker.client, asker.name
        key, args = absolute(name), operation.get("args")
        if self._rosapi.offers(key):
            try:
                values = self._rosapi.call(key, {} if args is None else args)
            except RosapiError as error:
                raise RefusedError(str(error)) from None
            self._answer(asker, values)
            return
        service = self._graph.services.get(key)
        if service is None:
            own = self._answer_here(client, key)
            if own is None:
                raise RefusedError(f"Service {name} does not exist")
            self._answer(asker, own)
            return
        server = service.client
        if len(client.asked) >= self._limits.calls_per_client:
            raise RefusedError(f"this client waits for {len(client.asked)} calls already")
        if len(server.asked_of) >= self._limits.calls_per_client:
            raise RefusedError(f"{name} has {len(server.asked_of)} calls to answer already")
        timeout = min(number(operation, "timeout") or inf, self._limits.call_timeout)
        request_id = f"service_request:{key}:{next(self._numbers)}"
        request = {
            "op": "call_service",
            "id": request_id,
            "service": key,
            "args": {} if args is None else args,
        }
        payload = orjson.dumps(request)
        if len(payload) > self._limits.message_bytes:
            raise RefusedError(f"the request for {name} has more than {self._limits.message_bytes} bytes")
        self.waiting[request_id] = _Call(asker, server, now + timeout)
        client.asked.add(request_id)
        server.asked_of.add(request_id)
        self.deadline = min(self.deadline, now + timeout)
        self._delivery.send(server, payload)

    def respond(self, client: Client, operation: Operation, _now: float) -> None:
        """Do ``service_response``."""
        key = operation.get("id")
        if not isinstance(key, str) or key not in client.asked_of:
            raise RefusedError(f"nobody waits for the answer {str(key)[:80]!r}")
        call = self._take(key)
        values, result = operation.get("values", {}), operation.get("result", True)
        # The reference server passes an answer on in ROS 1, whatever its result; roslibpy's tests count on that.
        if isinstance(values, dict) and (
            result is True or (self._rosapi.ros_version == 1 and "values" in operation)
        ):
            try:
                self._answer(call.asker, values)
            except RefusedError as error:
                self._fail(call.asker, str(error))
        elif result is True:
            self._fail(call.asker, f"{call.asker.name} answered with values that are no JSON object")
        else:
            # The wire has a string here; what a server says beyond that is told as JSON.
            self._fail(call.asker, values if isinstance(values, str) else orjson.dumps(values).decode())

    def _take(self, key: str) -> _Call:
        call = self.waiting.pop(key)
        call.asker.client.asked.discard(key)
        call.server.asked_of.discard(key)
        return call

    def _answer(self, asker: Asker, values: dict[str, Any]) -> None:
        payload = _response(asker, values, result=True)
        if len(payload) > self._limits.message_bytes:
            raise RefusedError(f"the answer of {asker.name} has more than {self._limits.message_bytes} bytes")
        self._delivery.send(asker.client, payload, fragment_size=asker.fragment_size, png=asker.png)

    def _fail(self, asker: Asker, reason: str) -> None:
        # An eighth, as a character can take six bytes; a failure must always get through.
        reason = reason[: self._limits.message_bytes // 8]
        self._delivery.send(asker.client, _response(asker, reason, result=False))


def asker_of(client: Client, name: str, operation: Operation) -> Asker:
    """Who waits for the answer to an operation, and in which form.

    Raises:
        RefusedError: the operation's id or fragment size is none.
    """
    return Asker(
        client,
        operation_id(operation),
        name,
        fragment_size_of(number(operation, "fragment_size")),
        compression_of(operation.get("compression")) == "png",
    )


def note_takeover(client: Client, before: Client, name: str) -> None:
    """A line in the log: a client took a name from another."""
    client.takeovers += 1
    if is_round(client.takeovers):
        log.warning("%s is now offered by %s, no longer by %s", name, client.node, before.node)


def _response(asker: Asker, values: object, *, result: bool) -> bytes:
    answer = {"op": "service_response", "service": asker.name, "values": values, "result": result}
    if asker.id is not None:
        answer["id"] = asker.id
    return orjson.dumps(answer)
