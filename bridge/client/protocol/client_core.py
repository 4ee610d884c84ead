"""The protocol state of a client. It encodes messages to the server, and decodes messages from the server.

Outgoing messages wait in an outbox until the client's `Session` takes them with `ClientCore.data_to_send`.
Without a connection, the outbox stays empty.
"""

from typing import Any

from bridge.client.protocol.calls_and_goals import PendingCalls, PendingGoals, ServedActions, ServedServices
from bridge.client.protocol.events import Event, MessageReceived, StatusReceived, UnusableReceived
from bridge.client.protocol.publications import Publications
from bridge.client.protocol.subscriptions import Subscriptions
from bridge.client.protocol.wire import Wire
from bridge.codecs import cbor_codec
from bridge.codecs.fragments import Reassembler
from bridge.codecs.json_codec import MAX_DEPTH, MAX_SIZE, decode, excerpt, text_of
from bridge.errors import DecodeError
from bridge.names import RosVersion


class ClientCore:
    """State of a rosbridge client.

    Each advertisement, subscription and request has a number that is never reused. So a late event about an ended
    subscription, for example, cannot reach a newer subscription.
    """

    def __init__(
        self, *, ros_version: RosVersion | None = None, max_size: int = MAX_SIZE, max_depth: int = MAX_DEPTH
    ) -> None:
        self.wire = wire = Wire(ros_version=ros_version, max_size=max_size, max_depth=max_depth)
        # What the program has registered; `restore` repeats it on each connection.
        self.publications = Publications(wire)
        self.subscriptions = Subscriptions(wire)
        # The shortcut for most messages; if it returns None, `receive` handles the message.
        self.receive_known = self.subscriptions.receive_known
        self.services = ServedServices(wire)
        self.actions = ServedActions(wire)
        # What waits for an answer of the server; `lost` drops it.
        self.calls = PendingCalls(wire)
        self.goals = PendingGoals(wire)
        # Incomplete messages of this connection, bounded in number, size and age.
        self._fragments = Reassembler(max_size=max_size)

    @property
    def ros_version(self) -> RosVersion | None:
        """The configured ROS version, or the version that the server's messages show, or None while unknown."""
        return self.wire.ros_version or self.subscriptions.seen_version

    def restore(self) -> None:
        """Begin a new connection: put all advertisements, services, actions and subscriptions into the outbox."""
        self.wire.connected = True
        self.wire.clear()
        # Advertisements first, so that the program can publish as soon as its first message arrives.
        self.publications.restore()
        self.services.restore()
        self.actions.restore()
        self.subscriptions.restore()

    def lost(self) -> None:
        """After a connection was lost, drop the outbox and all unanswered calls, goals and requests."""
        self.wire.connected = False
        self.wire.clear()
        self.calls.lost()
        self.services.lost()
        self.actions.lost()
        self.goals.lost()
        self._fragments.clear()

    def data_to_send(self) -> list[bytes]:
        """Empty the outbox, and return its messages in order."""
        return self.wire.take()

    def receive(self, data: bytes, now: float) -> Event | None:
        """Return the event in a WebSocket message; `now` is in monotonic seconds.

        Return None if this client refused the call or goal that arrived, or if the message belongs to a topic, call
        or goal that no longer exists. Also return None for all fragments of a message but the last. Invalid data
        gives an `UnusableReceived`.
        """
        # The usual case: a message of a topic that had one before.
        known, subscriptions = self.receive_known((data,), 0, 0, 0)
        if known:
            return MessageReceived(known[0].topic, known[0].msg, subscriptions)
        # A CBOR map begins like this, and JSON does not; it is expected only if a subscription requests CBOR.
        if self.subscriptions.binary and data[:1] >= b"\x80":
            return self._receive_cbor(data)
        discarded = self.subscriptions.discard_known(data)
        if discarded is not None:
            return discarded
        try:
            operation = self._decode(data)
            if operation.get("op") == "fragment":
                whole = self._fragments.take(operation, now)
                if whole is None:
                    return None
                data, operation = whole, self._decode(whole)
        except DecodeError as error:
            return UnusableReceived(str(error))
        return self._receive_plain(operation, data)

    def _decode(self, data: bytes) -> dict[str, Any]:
        return decode(data, max_size=self.wire.max_size, max_depth=self.wire.max_depth)

    def _receive_cbor(self, data: bytes) -> Event | None:
        try:
            operation = cbor_codec.decode(
                data,
                max_size=self.wire.max_size,
                max_depth=self.wire.max_depth,
                arrays="numpy" if self.subscriptions.numpy else "list",
            )
        except DecodeError as error:
            return UnusableReceived(str(error))
        if operation.get("op") == "publish":
            return self.subscriptions.receive(operation, data, from_cbor=True)
        return UnusableReceived(f"a CBOR message other than publish arrived: {excerpt(data)}")

    def _receive_plain(self, operation: dict[str, Any], data: bytes) -> Event | None:
        match operation.get("op"):
            case "publish":
                return self.subscriptions.receive(operation, data)
            case "service_response":
                return self.calls.receive(operation, data)
            case "call_service":
                return self.services.receive(operation, data)
            case "status":
                return StatusReceived(
                    text_of(operation.get("level")) or "error",
                    text_of(operation.get("msg")),
                    text_of(operation.get("id")),
                )
            case "action_feedback" | "action_result":
                return self.goals.receive(operation, data)
            case "send_action_goal" | "cancel_action_goal":
                return self.actions.receive(operation, data)
            case str():
                return UnusableReceived(f"a message with an unknown op arrived: {excerpt(data)}")
            case _:
                return UnusableReceived(f"a message without an op arrived: {excerpt(data)}")
