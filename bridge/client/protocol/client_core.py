"""A client's whole state: what it wants of the server, what it waits for, and what the server's messages mean to it.

Bytes to send gather in an outbox that the shell empties with `ClientCore.data_to_send`; while there is no connection
nothing gathers, what is wanted is only remembered.
"""

from typing import Any

from bridge.client.protocol.calls import Calls
from bridge.client.protocol.events import Event, StatusReceived, Unusable
from bridge.client.protocol.goals import Goals
from bridge.client.protocol.publications import Publications
from bridge.client.protocol.services import Services
from bridge.client.protocol.subscriptions import Subscriptions
from bridge.client.protocol.wire import RosVersion, Wire
from bridge.codecs import cbor_codec, png
from bridge.codecs.fragments import Reassembler
from bridge.codecs.json_codec import MAX_DEPTH, MAX_SIZE, decode, excerpt, text_of
from bridge.errors import DecodeError


class ClientCore:
    """All that a rosbridge client has to remember, and what its messages mean.

    Numbers that name an advertisement, a subscription or a ticket are never used twice.

    Attributes:
        wire: what leaves, and in which form.
        publications: the topics that are advertised.
        subscriptions: the topics that are listened to.
        calls: the calls of services that wait for answers.
        goals: the goals of actions under way.
        services: the services that are served.
    """

    def __init__(
        self,
        *,
        ros_version: RosVersion | None = None,
        max_size: int = MAX_SIZE,
        max_depth: int = MAX_DEPTH,
        fragment_size: int | None = None,
    ) -> None:
        """Begin with no connection and nothing wanted.

        Args:
            ros_version: which ROS the server speaks for, where that is known.
            max_size: bytes of a message at most, both ways.
            max_depth: objects and arrays within each other at most, both ways.
            fragment_size: characters of a message beyond which `Wire.pieces` cuts it, None for never.

        Raises:
            OptionError: the size of fragments is no whole number from 1 up.
        """
        self.wire = wire = Wire(
            ros_version=ros_version, max_size=max_size, max_depth=max_depth, fragment_size=fragment_size
        )
        self.publications = Publications(wire)
        self.subscriptions = Subscriptions(wire)
        self.calls = Calls(wire)
        self.goals = Goals(wire)
        self.services = Services(wire)
        self._max_size = max_size
        self._max_depth = max_depth
        self._fragments = Reassembler(max_size=max_size)

    @property
    def ros_version(self) -> RosVersion | None:
        """Which ROS the server speaks for: as it was told, or as its messages show; None while nobody knows."""
        return self.wire.ros_version or self.subscriptions.seen_version

    def restore(self) -> None:
        """Take up a new connection: everything wanted goes into the outbox, advertisements first."""
        self.wire.connected = True
        self.wire.clear()
        self.publications.restore()
        self.services.restore()
        self.subscriptions.restore()

    def lost(self) -> None:
        """Take note that the connection is gone: its calls and requests will not be answered."""
        self.wire.connected = False
        self.wire.clear()
        self.calls.lost()
        self.services.lost()
        self.goals.lost()
        self._fragments.clear()

    def data_to_send(self) -> list[bytes]:
        """Empty the outbox: whole messages, in order."""
        return self.wire.take()

    def receive(self, data: bytes | str, now: float) -> Event | None:
        """Take one WebSocket message.

        Args:
            data: the message, whatever it may be.
            now: seconds of any clock that never goes back, for throttled subscriptions.

        Returns:
            What it means; None for what was answered here, or comes too late to mean anything (a topic or a
            call given up).
        """
        if type(data) is bytes:
            subscriptions = self.subscriptions
            if subscriptions.envelopes:
                event = subscriptions.receive_again(data)
                if event is not None:
                    return event
            if subscriptions.binary and data[:1] >= b"\x80":  # no JSON begins so, a map of CBOR does
                return self._receive_cbor(data, now)
        try:
            operation = decode(data, max_size=self._max_size, max_depth=self._max_depth)
        except DecodeError as error:
            return Unusable(str(error))
        op = operation.get("op")
        if op == "publish":
            return self.subscriptions.receive(operation, now, data)
        if op in ("fragment", "png"):
            return self._receive_wrapped(operation, now, data)
        return self._receive_other(operation, data)

    def _receive_cbor(self, data: bytes, now: float) -> Event | None:
        try:
            operation = cbor_codec.decode(
                data,
                max_size=self._max_size,
                max_depth=self._max_depth,
                arrays="numpy" if self.subscriptions.numpy else "list",
            )
        except DecodeError as error:
            return Unusable(str(error))
        if operation.get("op") == "publish":
            return self.subscriptions.receive(operation, now, data, from_cbor=True)
        return Unusable(f"a message in CBOR arrived that is none of a topic: {excerpt(data)}")

    def _receive_wrapped(self, operation: dict[str, Any], now: float, data: bytes | str) -> Event | None:
        """Take a fragment or a picture: the message is in it, perhaps one in the other."""
        wrapped = ["fragment", "png"]
        try:
            while (op := operation.get("op")) in wrapped:
                wrapped.remove(op)  # each once
                whole = self._unwrapped(operation, now)
                if whole is None:
                    return None
                operation = decode(whole, max_size=self._max_size, max_depth=self._max_depth)
                data = whole
        except DecodeError as error:
            return Unusable(str(error))
        if op == "publish":
            return self.subscriptions.receive(operation, now, data)
        return self._receive_other(operation, data)

    def _unwrapped(self, operation: dict[str, Any], now: float) -> bytes | str | None:
        if operation["op"] == "fragment":
            return self._fragments.take(operation, now)
        picture = operation.get("data")
        if not isinstance(picture, str):
            raise DecodeError("a png without data arrived")
        return png.decode(picture, max_size=self._max_size)

    def _receive_other(self, operation: dict[str, Any], data: bytes | str) -> Event | None:
        match operation.get("op"):
            case "service_response":
                return self.calls.receive(operation, data)
            case "call_service":
                return self.services.receive(operation, data)
            case "status":
                return StatusReceived(
                    text_of(operation.get("level")) or "error", text_of(operation.get("msg"))
                )
            case "action_feedback" | "action_result":
                return self.goals.receive(operation, data)
            case str():
                return Unusable(f"a message with an op that was not asked for arrived: {excerpt(data)}")
            case _:
                return Unusable(f"a message without an op arrived: {excerpt(data)}")
