"""The services that a client serves, and the requests to them that wait for answers."""

from collections.abc import Mapping
from typing import Any, Final

from bridge.client.protocol.events import ServiceRequested, Unusable
from bridge.client.protocol.wire import Wire
from bridge.codecs.json_codec import excerpt
from bridge.errors import TypeConflictError
from bridge.names import absolute, check_name, split_type

#: Requests to services of this client that may wait for their answers at once; more are refused.
MAX_REQUESTS: Final = 64


class Services:
    """What a client serves: types by names, and requests by their tickets, which are never used twice."""

    def __init__(self, wire: Wire) -> None:
        """Begin with none."""
        self._wire = wire
        self._types: dict[str, str] = {}
        self._requests: dict[int, tuple[str, Any]] = {}

    def __contains__(self, service: str) -> bool:
        return absolute(service) in self._types

    @property
    def waiting(self) -> int:
        """How many requests wait for their answers."""
        return len(self._requests)

    def restore(self) -> None:
        """Say all of it to a server that has heard none of it."""
        for service, type_name in self._types.items():
            self._say(service, type_name)

    def lost(self) -> None:
        """Take note that the connection is gone, and with it who asked."""
        self._requests.clear()

    def advertise(self, service: str, type_name: str) -> None:
        """Want to serve a service.

        Raises:
            NameFormError: of service or type.
            TypeConflictError: this client serves it already.
        """
        check_name(service)
        split_type(type_name)
        key = absolute(service)
        if key in self._types:
            raise TypeConflictError(f"service {service} is already served by this client")
        self._types[key] = type_name
        self._say(key, type_name)

    def _say(self, service: str, type_name: str) -> None:
        self._wire.say(op="advertise_service", service=service, type=self._wire.type_name(type_name, "srv"))

    def unadvertise(self, service: str) -> None:
        """Stop serving a service."""
        key = absolute(service)
        del self._types[key]
        self._wire.say(op="unadvertise_service", service=key)

    def answer(self, ticket: int, values: Mapping[str, Any] | str, *, ok: bool = True) -> None:
        """Answer a request; one whose connection is gone needs no answer any more.

        Args:
            ticket: the request's.
            values: the answer's fields, or with ``ok=False`` the reason as text.
            ok: whether the service did it.

        Raises:
            EncodeError: the values cannot leave as JSON; the request still waits for an answer.
        """
        request = self._requests.get(ticket)
        if request is None:
            return
        service, wire_id = request
        identity = {} if wire_id is None else {"id": wire_id}
        self._wire.say(op="service_response", service=service, values=values, result=ok, **identity)
        del self._requests[ticket]

    def receive(self, operation: dict[str, Any], data: bytes | str) -> ServiceRequested | Unusable | None:
        """Take a request; None for one that was refused on the spot."""
        service = operation.get("service")
        args = operation.get("args")
        wire_id = operation.get("id")
        if not isinstance(service, str) or not isinstance(wire_id, str | int | None):
            return Unusable(f"a call_service without a service or with an odd id arrived: {excerpt(data)}")
        ticket = self._wire.number()
        self._requests[ticket] = (service, wire_id)
        if absolute(service) not in self._types:
            self.answer(ticket, f"service {excerpt(service)} is not served here", ok=False)
        elif len(self._requests) > MAX_REQUESTS:
            self.answer(ticket, f"{MAX_REQUESTS} requests wait here already", ok=False)
        elif not isinstance(args, dict | None):
            self.answer(ticket, "args must be an object", ok=False)
        else:
            return ServiceRequested(absolute(service), args or {}, ticket)
        return None
