"""Services of a client, and pending requests to them."""

from collections.abc import Mapping
from typing import Any, Final

from bridge.client.protocol.events import ServiceRequested, Unusable
from bridge.client.protocol.wire import Wire
from bridge.codecs.json_codec import excerpt
from bridge.errors import TypeConflictError
from bridge.names import absolute, check_name, split_type

MAX_REQUESTS: Final = 64
"""Maximum number of pending requests; more are refused."""


class Services:
    """Types of the services by name, and requests by ticket; tickets are never reused."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._types: dict[str, str] = {}
        self._requests: dict[int, tuple[str, Any]] = {}

    def __contains__(self, service: str) -> bool:
        return absolute(service) in self._types

    def __len__(self) -> int:
        return len(self._requests)

    def restore(self) -> None:
        """Advertise all services on a new connection."""
        for service, type_name in self._types.items():
            self._send_advertise(service, type_name)

    def lost(self) -> None:
        """Drop the requests of a lost connection."""
        self._requests.clear()

    def advertise(self, service: str, type_name: str) -> None:
        """Serve a service (see `bridge.client.Ros.advertise_service`)."""
        check_name(service)
        split_type(type_name)
        key = absolute(service)
        if key in self._types:
            raise TypeConflictError(f"service {service} is already served by this client")
        self._types[key] = type_name
        self._send_advertise(key, type_name)

    def _send_advertise(self, service: str, type_name: str) -> None:
        self._wire.write(op="advertise_service", service=service, type=self._wire.type_name(type_name, "srv"))

    def unadvertise(self, service: str) -> None:
        """Stop serving a service."""
        key = absolute(service)
        del self._types[key]
        self._wire.write(op="unadvertise_service", service=key)

    def answer(self, ticket: int, values: Mapping[str, Any] | str, *, ok: bool = True) -> None:
        """Answer a request with fields, or with `ok=False` a reason as text, unless its connection was lost.

        The reference server drops an answer whose `values` are not an object, and the caller waits for ever
        (rosbridge_library/capabilities/service_response.py, `service_response_msg_fields`), so the text is in a
        field of its own, which it ignores and the hub passes on.

        Raises:
            EncodeError: The values cannot be encoded as JSON; the request is still pending.
        """
        request = self._requests.get(ticket)
        if request is None:
            return
        service, wire_id = request
        identity = {} if wire_id is None else {"id": wire_id}
        answer = {"values": values} if ok else {"values": {}, "reason": values}
        self._wire.write(op="service_response", service=service, result=ok, **answer, **identity)
        del self._requests[ticket]

    def receive(self, operation: dict[str, Any], data: bytes | str) -> ServiceRequested | Unusable | None:
        """Handle a request; return None if it was refused here."""
        service = operation.get("service")
        args = operation.get("args")
        wire_id = operation.get("id")
        if not isinstance(service, str) or not isinstance(wire_id, str | int | None):
            return Unusable(
                f"a call_service without a service or with an invalid id arrived: {excerpt(data)}"
            )
        ticket = self._wire.number()
        self._requests[ticket] = (service, wire_id)
        if absolute(service) not in self._types:
            self.answer(ticket, f"service {excerpt(service)} is not served here", ok=False)
        elif len(self._requests) > MAX_REQUESTS:
            self.answer(ticket, f"{MAX_REQUESTS} requests are already pending here", ok=False)
        elif not isinstance(args, dict | None):
            self.answer(ticket, "args must be an object", ok=False)
        else:
            return ServiceRequested(absolute(service), args or {}, ticket)
        return None
