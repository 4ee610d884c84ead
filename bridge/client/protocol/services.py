"""Services: the pending calls of a client, and the services that it serves.

call_service (id)       ->  server      server  ->  call_service (id)
service_response (id)  <-                      <-   service_response (id)
"""

from collections.abc import Mapping
from typing import Any, Final

from bridge.client.protocol.events import CallAnswered, ServiceRequested, UnusableReceived
from bridge.client.protocol.wire import Wire
from bridge.codecs.json_codec import excerpt, text_of
from bridge.errors import SlowPeerError, TypeConflictError
from bridge.names import absolute, check_name, split_type

MAX_CALLS: Final = 1000
"""Maximum number of pending calls."""
MAX_REQUESTS: Final = 64
"""Maximum number of pending requests; more are refused."""


class PendingCalls:
    """The pending calls, by id on the wire."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        # Ids of the calls, at most `MAX_CALLS`. An answer with another id is late or stray, and is ignored.
        self._waiting: set[str] = set()

    def __len__(self) -> int:
        return len(self._waiting)

    def send(self, service: str, args: Mapping[str, Any]) -> str:
        """Call a service, unless `MAX_CALLS` calls are pending; return the id for its `CallAnswered`."""
        check_name(service)
        if len(self._waiting) >= MAX_CALLS:
            raise SlowPeerError(f"{MAX_CALLS} service calls are pending, so {service} is not called")
        call = f"call_service:{service}:{self._wire.number()}"
        # Written first, because it raises if the arguments cannot be encoded.
        self._wire.write(op="call_service", id=call, service=service, args=args)
        self._waiting.add(call)
        return call

    def forget(self, call: str) -> None:
        """Stop waiting for an answer; a late one is ignored."""
        self._waiting.discard(call)

    def lost(self) -> None:
        """Drop the calls of a lost connection."""
        self._waiting.clear()

    def receive(self, operation: dict[str, Any], data: bytes | str) -> CallAnswered | UnusableReceived | None:
        """Handle an answer; return None if no call waits for it."""
        call = operation.get("id")
        if not isinstance(call, str):
            return UnusableReceived(f"a service_response without the id of a call arrived: {excerpt(data)}")
        if call not in self._waiting:
            return None
        self._waiting.discard(call)
        values = operation.get("values")
        # Some servers omit `result` on success.
        if operation.get("result", True) is False:
            return CallAnswered(call, ok=False, values=text_of(values))
        return CallAnswered(call, ok=True, values={} if values is None else values)


class ServedServices:
    """Types of the services by name, and requests by ticket; tickets are never reused."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        # By absolute name; `restore` repeats them.
        self._types: dict[str, str] = {}
        # Name and id on the wire by ticket, only of the present connection. Ids are chosen by callers, and may be equal,
        # so the program gets a ticket instead.
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

    def receive(
        self, operation: dict[str, Any], data: bytes | str
    ) -> ServiceRequested | UnusableReceived | None:
        """Handle a request; return None if it was refused here."""
        service = operation.get("service")
        args = operation.get("args")
        wire_id = operation.get("id")
        if not isinstance(service, str) or not isinstance(wire_id, str | int | None):
            return UnusableReceived(
                f"a call_service without a service or with an invalid id arrived: {excerpt(data)}"
            )
        # Stored even if it is refused at once, because `answer` answers only stored requests.
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
