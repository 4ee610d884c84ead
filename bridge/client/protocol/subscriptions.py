"""The subscriptions of a client. All subscriptions to a topic share one `subscribe` operation.

If a client subscribes twice, some servers deliver the first message twice or not at all.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, Final, Literal, NamedTuple, get_args

import cbor2
import orjson

from bridge.client.protocol.events import Message, MessageDiscarded, MessageReceived, UnusableReceived
from bridge.client.protocol.wire import Wire
from bridge.codecs import cbor_codec
from bridge.codecs.cbor_codec import Arrays, with_arrays, with_lists
from bridge.codecs.json_codec import BRACE, envelope_of, excerpt, is_deeper, topic_of
from bridge.errors import DecodeError, OptionError, TypeConflictError
from bridge.names import RosVersion, absolute, check_name, same_type, split_type
from bridge.qos import Qos
from bridge.stamps import ros_version_of_message

Compression = Literal["none", "cbor", "cbor-raw"]

_OF_ENVELOPE: Final = 3
"""Number of keys of a publish operation whose envelope can be recognised: `op`, `topic` and `msg`.

The envelope is the part of the operation before the message.
"""
_ENVELOPES: Final = 8
"""Maximum number of envelopes tried for one topic, because some servers never repeat one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Delivery:
    """Settings for the delivery of a topic's messages, shared by all subscriptions of a client to the topic.

    Attributes:
        throttle_rate: Minimum number of milliseconds between two messages.
        queue_length: Number of throttled messages that the server queues.
        compression: `none` for JSON, `cbor` for long arrays, `cbor-raw` for the serialised bytes alone. Many
            servers ignore an unknown compression and send JSON.
        arrays: Python type of arrays of numbers, regardless of the encoding.
        fragment_size: Maximum number of characters in a fragment, or None for whole messages. A server applies
            the last value that a client requested to all messages for this client.
        qos: Quality of service in ROS 2.
        max_bytes: Maximum size of a message in bytes, or None for the connection's limit. The client discards
            larger messages.
    """

    throttle_rate: int = 0
    queue_length: int = 0
    compression: Compression = "none"
    arrays: Arrays = "list"
    fragment_size: int | None = None
    qos: Qos | None = None
    max_bytes: int | None = None

    def __post_init__(self) -> None:
        for name, choices in (("compression", get_args(Compression)), ("arrays", get_args(Arrays))):
            if getattr(self, name) not in choices:
                raise OptionError(f"{name} must be one of {', '.join(choices)}, not {getattr(self, name)!r}")
        for name in ("fragment_size", "max_bytes"):
            value = getattr(self, name)
            if value is not None and (type(value) is not int or value < 1):
                raise OptionError(f"{name} must be a whole number of at least 1, or None, not {value!r}")
        if self.compression == "cbor-raw" and self.arrays == "numpy":
            raise OptionError("cbor-raw has bytes instead of arrays: omit arrays")


_DEFAULT: Final = Delivery()


@dataclass(slots=True)
class _Subscribed:
    """One topic on the wire, for one or more subscriptions of this client."""

    topic: str
    # The first type that a subscription names; None while none does, and the server chooses.
    type: str | None
    delivery: Delivery
    wire_id: str
    max_size: int
    # The numbers of the subscriptions, which get all messages; never empty while the topic is subscribed to.
    numbers: tuple[int, ...] = ()

    # About the present connection; `restore` resets them.
    # Whether a message has arrived; after that, silence is no reason to renew the subscription.
    has_messages: bool = False
    renewals: int = 0

    # Number of envelopes tried, at most `_ENVELOPES`.
    envelopes_tried: int = 0

    # These outlive a connection, because the messages stay the same.
    # Whether the subscription requests JSON instead of CBOR, because no message arrived as CBOR.
    as_json: bool = False
    # Size of its largest message so far, at most `max_size`: only a larger one is compared with the limits.
    largest: int = 0
    discarded: int = 0
    # True after a message that was too large for the connection: the topic is not subscribed to again.
    left_out: bool = False

    def measure(self, topic: str, size: int) -> MessageDiscarded | None:
        """Return an event if a message of this size exceeds the topic's limit."""
        if size > self.max_size:
            self.discarded += 1
            return MessageDiscarded(topic, size, self.max_size, self.discarded, self.numbers)
        self.largest = max(self.largest, size)
        return None


class _Known(NamedTuple):
    """A known envelope and its topic, in the server's spelling."""

    envelope: bytes
    size: int
    topic: str
    subscribed: _Subscribed


_UNKNOWN: Final = _Known(b"\xff", 0, "", _Subscribed("", None, _DEFAULT, "", sys.maxsize))
"""Placeholder until an envelope is known; its byte 0xFF begins no valid message."""


class Subscriptions:
    """All subscriptions of a client.

    Receiving messages is the client's busiest path. A received publish operation contains a ROS message. The bytes
    before the ROS message are the envelope. If the client knows the envelope from an earlier message, `receive_known`
    handles the message. `receive` parses and handles all other messages.
    """

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        # By absolute name, and by the number from `subscribe`; all subscriptions of a topic share an entry.
        self._subscribed: dict[str, _Subscribed] = {}
        self._subscriptions: dict[int, _Subscribed] = {}
        # ROS version of the server according to header stamps in its messages; the first one decides.
        self.seen_version: RosVersion | None = None
        # Summaries of the deliveries of all topics, kept by `_note_deliveries`.
        # Whether any topic is subscribed as CBOR.
        self.binary = False
        # Whether any topic is subscribed with NumPy arrays.
        self.numpy = False
        # The known envelopes of messages; emptied when subscriptions or the connection change.
        self.envelopes: dict[bytes, _Known] = {}
        # The one used last, because the next message is probably of the same topic. It is always in `envelopes`, except
        # for the placeholder.
        self._known = _UNKNOWN

    def restore(self) -> None:
        """Subscribe to everything on a new connection."""
        self.forget_envelopes()
        for subscribed in self._subscribed.values():
            subscribed.has_messages = False
            subscribed.renewals = 0
            self._send_subscribe(subscribed)

    def subscribe(self, topic: str, type_name: str | None = None, delivery: Delivery = _DEFAULT) -> int:
        """Subscribe to a topic as in `bridge.client.Ros.subscribe`, and return the number of the subscription."""
        check_name(topic)
        if type_name is not None:
            split_type(type_name)
        for name in ("throttle_rate", "queue_length"):
            value = getattr(delivery, name)
            # Servers silently drop a subscription with a float here.
            if type(value) is not int or value < 0:
                raise OptionError(
                    f"{name} of topic {topic} must be a whole number of at least 0, not {value!r}"
                )
        number = self._wire.number()
        key = absolute(topic)
        subscribed = self._subscribed.get(key)
        new = subscribed is None or (subscribed.type is None and type_name is not None)
        if subscribed is None:
            max_size = min(delivery.max_bytes or self._wire.max_size, self._wire.max_size)
            subscribed = _Subscribed(topic, type_name, delivery, f"subscribe:{topic}:{number}", max_size)
            self._subscribed[key] = subscribed
            self._note_deliveries()
        elif type_name and subscribed.type and not same_type(subscribed.type, type_name):
            raise TypeConflictError(
                f"topic {topic} is already subscribed to as {subscribed.type}, not as {type_name}"
            )
        elif subscribed.delivery != delivery:
            raise TypeConflictError(
                f"topic {topic} is already subscribed to with {subscribed.delivery}, not with {delivery}: "
                "all subscriptions of a topic by one client share one on the wire"
            )
        subscribed.type = subscribed.type or type_name
        subscribed.numbers += (number,)
        self._subscriptions[number] = subscribed
        self.forget_envelopes()
        if new:
            self._send_subscribe(subscribed)
        return number

    def leave_out(self, topic: str | None) -> tuple[int, ...]:
        """Leave a topic out on later connections, because its messages are too large and end the connection.

        Returns:
            The numbers of the topic's subscriptions, or () if the topic is None or has no subscription.
        """
        subscribed = None if topic is None else self._subscribed.get(absolute(topic))
        if subscribed is None:
            return ()
        subscribed.left_out = True
        return subscribed.numbers

    def has_left_out(self, topic: str) -> bool:
        """Return whether `leave_out` was called for a topic, because a message was too large for the connection."""
        subscribed = self._subscribed.get(absolute(topic))
        return subscribed is not None and subscribed.left_out

    @property
    def largest(self) -> tuple[str, int]:
        """The topic of the largest message so far, and that message's size in bytes: 0 before the first message."""
        known = [(subscribed.topic, subscribed.largest) for subscribed in self._subscribed.values()]
        return max(known, key=itemgetter(1), default=("", 0))

    def _send_subscribe(self, subscribed: _Subscribed) -> None:
        if subscribed.left_out:
            return
        operation: dict[str, Any] = {"op": "subscribe", "id": subscribed.wire_id, "topic": subscribed.topic}
        if subscribed.type is not None:
            operation["type"] = self._wire.type_name(subscribed.type)
        delivery = subscribed.delivery
        if delivery.compression != "none" and not subscribed.as_json:
            operation["compression"] = delivery.compression
        if delivery.fragment_size is not None:
            operation["fragment_size"] = delivery.fragment_size
        if delivery.qos is not None:
            operation["qos"] = delivery.qos.as_operation()
        self._wire.write(
            **operation, throttle_rate=delivery.throttle_rate, queue_length=delivery.queue_length
        )

    def _note_deliveries(self) -> None:
        deliveries = [subscribed.delivery for subscribed in self._subscribed.values()]
        self.binary = any(delivery.compression in {"cbor", "cbor-raw"} for delivery in deliveries)
        self.numpy = any(delivery.arrays == "numpy" for delivery in deliveries)

    def unsubscribe(self, subscription: int) -> None:
        """End a subscription. If it is the last subscription to its topic, unsubscribe at the server."""
        subscribed = self._subscriptions.pop(subscription)
        subscribed.numbers = tuple(each for each in subscribed.numbers if each != subscription)
        self.forget_envelopes()
        if not subscribed.numbers:
            del self._subscribed[absolute(subscribed.topic)]
            self._note_deliveries()
            self._send_unsubscribe(subscribed)

    def _send_unsubscribe(self, subscribed: _Subscribed) -> None:
        self._wire.write(op="unsubscribe", id=subscribed.wire_id, topic=subscribed.topic)

    def retry_untyped(self) -> bool:
        """Repeat each subscription that names no type and has had no message yet.

        If a server does not know the topic yet, it drops a subscription without a type. Most servers report nothing.

        Returns:
            True if at least one subscription was repeated.
        """
        waiting = [
            s for s in self._subscribed.values() if s.type is None and not s.has_messages and not s.left_out
        ]
        for subscribed in waiting:
            self._send_subscribe(subscribed)
        return bool(waiting)

    def silent(self) -> list[str]:
        """Return the topics that were subscribed to with a type, and that have had no message on this connection.

        Topics that were passed to `leave_out` are not returned.
        """
        return [
            s.topic
            for s in self._subscribed.values()
            if s.type is not None and not s.has_messages and not s.left_out
        ]

    def renew(self, topic: str) -> bool:
        """Subscribe again to a topic that is published but silent. Return True if the encoding changes to JSON.

        rosbridge for ROS 2 fixes the quality of service when it subscribes. It then gets nothing from a best-effort
        publisher that starts later. Servers also fail to write some types as CBOR. The second and later renewals
        therefore request JSON.
        """
        subscribed = self._subscribed.get(absolute(topic))
        if subscribed is None or subscribed.has_messages:
            return False
        subscribed.renewals += 1
        # The first renewal may fix the quality of service, so only the second one changes the encoding.
        gives_up_cbor = (
            subscribed.renewals > 1 and subscribed.delivery.compression == "cbor" and not subscribed.as_json
        )
        subscribed.as_json = subscribed.as_json or gives_up_cbor
        self._send_unsubscribe(subscribed)
        self._send_subscribe(subscribed)
        return gives_up_cbor

    def receive_known(
        self, messages: Sequence[bytes], first: int, received_ns: int, monotonic_ns: int
    ) -> tuple[list[Message], tuple[int, ...]]:
        """Decode messages from index `first` on, as long as they have the same known envelope.

        Return the decoded messages, and the numbers of the subscriptions to the topic of this envelope. Decoding stops
        at the first message that has another envelope, is too large or is invalid. If no message is decoded,
        `ClientCore.receive` must handle the message at `first`.
        """
        envelope, size, topic, subscribed = self._known
        depth = self._wire.max_depth - 1  # of a message inside its operation
        received: list[Message] = []
        new = tuple.__new__  # the constructor of a named tuple takes three times as long
        for data in messages[first:] if first else messages:
            if not data.startswith(envelope):
                found = None if received else self.envelopes.get(envelope_of(data))
                if found is None:
                    break
                self._known = envelope, size, topic, subscribed = found
            if len(data) > subscribed.largest:
                if len(data) > subscribed.max_size:
                    break
                subscribed.largest = len(data)
            arrays = subscribed.delivery.arrays
            try:
                if envelope >= b"\x80":
                    msg = cbor_codec.decode(data[size:], max_size=len(data), max_depth=depth, arrays=arrays)
                else:
                    msg = orjson.loads(data[size:-1])
                    # For small messages, the first condition of `is_deeper` without its call.
                    large = len(data) > 5 * depth or len(data) + 3 * data.count(b"[") > 5 * depth
                    if data[-1] != BRACE or type(msg) is not dict or (large and is_deeper(data, depth + 1)):
                        break
                    if arrays == "numpy":
                        msg = with_arrays(msg)
            except (orjson.JSONDecodeError, DecodeError):
                break
            received.append(new(Message, (topic, msg, received_ns, monotonic_ns)))
        return received, subscribed.numbers

    def discard_known(self, data: bytes) -> MessageDiscarded | None:
        """If an unparsed message with a known envelope is larger than its topic's limit, return a `MessageDiscarded`.

        Otherwise return None.
        """
        known = self.envelopes.get(envelope_of(data))
        is_usable = len(data) <= self._wire.max_size
        return known.subscribed.measure(known.topic, len(data)) if known is not None and is_usable else None

    def forget_envelopes(self) -> None:
        """Forget all known envelopes, so that the next message of each topic is decoded in full.

        Call this method after a change of the subscriptions or of the server.
        """
        self.envelopes.clear()
        self._known = _UNKNOWN
        for subscribed in self._subscribed.values():
            subscribed.envelopes_tried = 0

    def receive(
        self, operation: dict[str, Any], data: bytes, *, from_cbor: bool = False
    ) -> MessageReceived | MessageDiscarded | UnusableReceived | None:
        """Handle a publish operation that was decoded from `data`.

        Return None if the client does not subscribe to the topic.
        """
        topic = operation.get("topic")
        msg = operation.get("msg")
        if type(topic) is not str or type(msg) is not dict:
            return UnusableReceived(f"a publish without a topic or a message object arrived: {excerpt(data)}")
        subscribed = self._subscribed.get(topic) or self._subscribed.get(absolute(topic))
        if subscribed is None:
            return None
        if not subscribed.has_messages:
            subscribed.has_messages = True
            self.seen_version = self.seen_version or ros_version_of_message(msg)
        if len(operation) == _OF_ENVELOPE and subscribed.envelopes_tried < _ENVELOPES:
            envelope, empty = envelope_of(data), {"op": "publish", "topic": topic, "msg": {}}
            if envelope not in self.envelopes:
                subscribed.envelopes_tried += 1
                # In CBOR, a map that announces three entries: nothing can follow the message.
                if envelope == cbor2.dumps(empty)[:-1] if from_cbor else topic_of(envelope) == topic:
                    self.envelopes[envelope] = _Known(envelope, len(envelope), topic, subscribed)
        discarded = subscribed.measure(topic, len(data))
        if discarded is not None:
            return discarded
        # CBOR without a known envelope is decoded with arrays if any topic wants them.
        if self.numpy:
            if subscribed.delivery.arrays == "list":
                msg = with_lists(msg) if from_cbor else msg
            elif not from_cbor:
                msg = with_arrays(msg)
        return MessageReceived(topic, msg, subscribed.numbers)
