"""Pending service calls of a client."""

from collections.abc import Mapping
from typing import Any, Final

from bridge.client.protocol.events import CallAnswered, Unusable
from bridge.client.protocol.wire import Wire
from bridge.codecs.json_codec import excerpt, text_of
from bridge.errors import SlowPeerError
from bridge.names import check_name

MAX_CALLS: Final = 1000
"""Maximum number of pending calls."""


class Calls:
    """The pending calls, by id on the wire."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._waiting: set[str] = set()

    def __len__(self) -> int:
        return len(self._waiting)

    def send(self, service: str, args: Mapping[str, Any]) -> str:
        """Call a service, unless `MAX_CALLS` calls are pending; return the id for its `CallAnswered`."""
        check_name(service)
        if len(self._waiting) >= MAX_CALLS:
            raise SlowPeerError(f"{MAX_CALLS} service calls are pending, so {service} is not called")
        call = f"call_service:{service}:{self._wire.number()}"
        self._wire.write(op="call_service", id=call, service=service, args=args)
        self._waiting.add(call)
        return call

    def forget(self, call: str) -> None:
        """Stop waiting for an answer; a late one is ignored."""
        self._waiting.discard(call)

    def lost(self) -> None:
        """Drop the calls of a lost connection."""
        self._waiting.clear()

    def receive(self, operation: dict[str, Any], data: bytes | str) -> CallAnswered | Unusable | None:
        """Handle an answer; return None if no call waits for it."""
        call = operation.get("id")
        if not isinstance(call, str):
            return Unusable(f"a service_response without the id of a call arrived: {excerpt(data)}")
        if call not in self._waiting:
            return None
        self._waiting.discard(call)
        values = operation.get("values")
        # Some servers omit `result` on success.
        if operation.get("result", True) is False:
            return CallAnswered(call, ok=False, values=text_of(values))
        return CallAnswered(call, ok=True, values={} if values is None else values)
