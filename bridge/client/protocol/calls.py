"""The calls of services that a client waits for."""

from collections.abc import Mapping
from typing import Any, Final

from bridge.client.protocol.events import CallAnswered, Unusable
from bridge.client.protocol.wire import Wire
from bridge.codecs.json_codec import excerpt, text_of
from bridge.errors import SlowPeerError
from bridge.names import check_name

#: Calls that may wait for their answers at once.
MAX_CALLS: Final = 1000


class Calls:
    """The calls under way, by their identities on the wire."""

    def __init__(self, wire: Wire) -> None:
        """Begin with none."""
        self._wire = wire
        self._waiting: set[str] = set()

    def __len__(self) -> int:
        return len(self._waiting)

    def send(self, service: str, args: Mapping[str, Any]) -> str:
        """Call a service.

        Returns:
            The call's identity, which its `CallAnswered` bears.

        Raises:
            NameFormError: of the service.
            EncodeError: the arguments cannot leave as JSON.
            SlowPeerError: `MAX_CALLS` calls wait already.
        """
        check_name(service)
        if len(self._waiting) >= MAX_CALLS:
            raise SlowPeerError(
                f"{MAX_CALLS} service calls wait for answers already, {service} is not called"
            )
        call = f"call_service:{service}:{self._wire.number()}"
        self._wire.say(op="call_service", id=call, service=service, args=args)
        self._waiting.add(call)
        return call

    def forget(self, call: str) -> None:
        """Wait no longer for an answer; one that comes all the same is passed over."""
        self._waiting.discard(call)

    def lost(self) -> None:
        """Take note that the connection is gone: none of them will be answered."""
        self._waiting.clear()

    def receive(self, operation: dict[str, Any], data: bytes | str) -> CallAnswered | Unusable | None:
        """Take what claims to be an answer; None if nobody waits for it."""
        call = operation.get("id")
        if not isinstance(call, str):
            return Unusable(f"a service_response without the id of a call arrived: {excerpt(data)}")
        if call not in self._waiting:
            return None
        self._waiting.discard(call)
        values = operation.get("values")
        # Some servers leave `result` out when all went well.
        if operation.get("result", True) is False:
            return CallAnswered(call, ok=False, values=text_of(values))
        return CallAnswered(call, ok=True, values={} if values is None else values)
