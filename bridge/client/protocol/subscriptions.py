"""What a client listens to: several subscriptions of one topic share one on the wire, and each message is for some of them.

There are servers that deliver a first message twice, or not at all, to a client that subscribes twice.
"""

from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import orjson

from bridge.client.protocol.events import MessageReceived, Unusable
from bridge.client.protocol.subscription_options import Delivery
from bridge.client.protocol.wire import RosVersion, Wire
from bridge.codecs.arrays import with_arrays, with_lists
from bridge.codecs.envelope import BRACE, envelope_of, topic_of
from bridge.codecs.json_codec import excerpt, is_deeper
from bridge.errors import OptionError, TypeConflictError
from bridge.names import absolute, check_name, same_type, split_type
from bridge.stamps import ros_version_of_message

#: Keys of an operation whose envelope can be known again: op, topic and msg.
_OF_ENVELOPE: Final = 3
#: Envelopes of one topic that are looked at: a server that never says the same twice is not tried on and on.
_ENVELOPES: Final = 8


@dataclass(slots=True)
class _Wanted:
    """What one subscription asked for; ``due`` is when its throttle lets the next message through."""

    throttle_rate: int
    queue_length: int
    due: float = 0.0


@dataclass(slots=True)
class _Subscribed:
    """One topic as subscribed on the wire, for one or more subscriptions of this client."""

    topic: str
    type: str | None
    delivery: Delivery
    wire_id: str
    wanted: dict[int, _Wanted] = field(default_factory=dict)
    throttle_rate: int = 0
    queue_length: int = 0
    everyone: tuple[int, ...] = ()
    someone_is_slower: bool = False
    heard: bool = False
    envelopes_tried: int = 0

    def settle(self) -> bool:
        """Find what to ask of the server for all: fastest rate, longest queue. True if that changed."""
        before = (self.throttle_rate, self.queue_length)
        self.throttle_rate = min(w.throttle_rate for w in self.wanted.values())
        self.queue_length = max(w.queue_length for w in self.wanted.values())
        self.everyone = tuple(self.wanted)
        self.someone_is_slower = any(w.throttle_rate > self.throttle_rate for w in self.wanted.values())
        return before != (self.throttle_rate, self.queue_length)

    def receivers(self, now: float) -> tuple[int, ...]:
        """The subscriptions that a message arriving ``now`` is for."""
        if not self.someone_is_slower:
            return self.everyone
        through = []
        for number, wanted in self.wanted.items():
            if wanted.throttle_rate > self.throttle_rate:
                if now < wanted.due:
                    continue
                wanted.due = now + wanted.throttle_rate / 1000
            through.append(number)
        return tuple(through)


class _Known(NamedTuple):
    """An envelope that came before, and whose messages stand after it; ``topic`` is as the server names it."""

    envelope: bytes
    size: int
    topic: str
    subscribed: _Subscribed


#: In place of an envelope, before the first is known: nothing begins so.
_UNKNOWN: Final = _Known(b"\xff", 0, "", _Subscribed("", None, Delivery(), ""))


class Subscriptions:
    """All that a client subscribes to.

    Attributes:
        seen_version: what the header stamps of received messages say about the server's ROS.
        binary: whether some topic is to come as CBOR.
        numpy: whether some topic's arrays are wanted as NumPy's.
        envelopes: what stood before messages that came, and whose they were.
    """

    def __init__(self, wire: Wire) -> None:
        """Begin with nothing subscribed."""
        self.seen_version: RosVersion | None = None
        self.binary = False
        self.numpy = False
        self.envelopes: dict[bytes, _Known] = {}
        self._known = _UNKNOWN  # the last of these
        self._wire = wire
        self._max_size = wire.max_size
        self._max_depth = wire.max_depth
        self._subscribed: dict[str, _Subscribed] = {}
        self._subscriptions: dict[int, _Subscribed] = {}

    def restore(self) -> None:
        """Say all of it to a server that has heard none of it."""
        self.forget_envelopes()
        for subscribed in self._subscribed.values():
            subscribed.heard = False
            self._say(subscribed)

    def subscribe(
        self,
        topic: str,
        type_name: str | None = None,
        *,
        throttle_rate: int = 0,
        queue_length: int = 0,
        delivery: Delivery | None = None,
    ) -> int:
        """Want the messages of a topic.

        The server is asked for the fastest rate and the longest queue that any subscription of this client
        wants of the topic; who wants fewer messages is served at its own rate from those.

        Args:
            topic: its name.
            type_name: in the form of ROS 1 or of ROS 2; None leaves it to the server (see `ask_again`).
            throttle_rate: milliseconds between two messages at least.
            queue_length: messages that the server keeps while the throttle holds them back; 0 drops them.
            delivery: how they are to come; None is as usual.

        Returns:
            The subscription's number.

        Raises:
            NameFormError: of topic or type.
            TypeConflictError: this client subscribes to the topic already, as another type or in another form.
            OptionError: a rate or length that is no whole number from 0 up (servers drop a subscription
                with a float here without a word).
        """
        check_name(topic)
        if type_name is not None:
            split_type(type_name)
        for name, value in (("throttle_rate", throttle_rate), ("queue_length", queue_length)):
            if type(value) is not int or value < 0:
                raise OptionError(f"{name} of topic {topic} must be a whole number from 0 up, not {value!r}")
        number = self._wire.number()
        key = absolute(topic)
        subscribed = self._subscribed.get(key)
        new = subscribed is None
        delivery = delivery or Delivery()
        if subscribed is None:
            subscribed = _Subscribed(topic, type_name, delivery, f"subscribe:{topic}:{number}")
            self._subscribed[key] = subscribed
            self._note_deliveries()
        elif (
            type_name is not None
            and subscribed.type is not None
            and not same_type(subscribed.type, type_name)
        ):
            raise TypeConflictError(
                f"topic {topic} is already subscribed to as {subscribed.type}, not as {type_name}"
            )
        elif subscribed.delivery != delivery:
            raise TypeConflictError(
                f"topic {topic} is already subscribed to with {subscribed.delivery}, not with {delivery}: "
                "all subscriptions of a topic by one client share one on the wire"
            )
        elif type_name is not None and subscribed.type is None:
            subscribed.type = type_name
            new = True
        subscribed.wanted[number] = _Wanted(throttle_rate, queue_length)
        self._subscriptions[number] = subscribed
        self.forget_envelopes()
        if subscribed.settle() or new:
            self._say(subscribed)
        return number

    def _say(self, subscribed: _Subscribed) -> None:
        operation: dict[str, Any] = {"op": "subscribe", "id": subscribed.wire_id, "topic": subscribed.topic}
        if subscribed.type is not None:
            operation["type"] = self._wire.type_name(subscribed.type)
        delivery = subscribed.delivery
        if delivery.compression != "none":
            operation["compression"] = delivery.compression
        if delivery.fragment_size is not None:
            operation["fragment_size"] = delivery.fragment_size
        if delivery.qos is not None:
            operation["qos"] = delivery.qos.as_operation()
        self._wire.say(
            **operation, throttle_rate=subscribed.throttle_rate, queue_length=subscribed.queue_length
        )

    def _note_deliveries(self) -> None:
        deliveries = [subscribed.delivery for subscribed in self._subscribed.values()]
        self.binary = any(delivery.compression in {"cbor", "cbor-raw"} for delivery in deliveries)
        self.numpy = any(delivery.arrays == "numpy" for delivery in deliveries)

    def unsubscribe(self, subscription: int) -> None:
        """Stop wanting messages; the last subscription of a topic takes it off the wire."""
        subscribed = self._subscriptions.pop(subscription)
        del subscribed.wanted[subscription]
        self.forget_envelopes()
        if subscribed.wanted:
            if subscribed.settle():
                self._say(subscribed)
        else:
            del self._subscribed[absolute(subscribed.topic)]
            self._note_deliveries()
            self._wire.say(op="unsubscribe", id=subscribed.wire_id, topic=subscribed.topic)

    def ask_again(self) -> bool:
        """Ask again for topics of unknown type that have brought nothing yet.

        A server that does not know the topic yet forgets such a subscription, most without a word.

        Returns:
            Whether there are such topics, so that it is worth asking once more later.
        """
        waiting = [s for s in self._subscribed.values() if s.type is None and not s.heard]
        for subscribed in waiting:
            self._say(subscribed)
        return bool(waiting)

    def receive_again(self, data: bytes) -> MessageReceived | None:
        """Take a message whose envelope is known; None if it is none such, or needs a closer look."""
        known = self._known
        if not data.startswith(known.envelope):
            found = self.envelopes.get(envelope_of(data))
            if found is None:
                return None
            self._known = known = found
        subscribed = known.subscribed
        if data[-1] != BRACE or len(data) > self._max_size or subscribed.someone_is_slower:
            return None
        message = data[known.size : -1]
        try:
            msg = orjson.loads(message)
        except orjson.JSONDecodeError:
            return None
        if type(msg) is not dict or is_deeper(message, self._max_depth - 1):
            return None
        if self.numpy and subscribed.delivery.arrays == "numpy":
            msg = with_arrays(msg)
        # What a named tuple's own constructor does takes three times as long.
        return tuple.__new__(MessageReceived, (known.topic, msg, subscribed.everyone))

    def _learn_envelope(self, data: bytes, topic: str, subscribed: _Subscribed) -> None:
        """Remember what stands before a topic's messages, if no more than that must be known of the next one."""
        envelope = envelope_of(data)
        if envelope not in self.envelopes:
            subscribed.envelopes_tried += 1
            if topic_of(envelope) == topic:
                self.envelopes[envelope] = _Known(envelope, len(envelope), topic, subscribed)

    def forget_envelopes(self) -> None:
        """Look at all messages closely again: who hears them may have changed, or the server."""
        self.envelopes.clear()
        self._known = _UNKNOWN
        for subscribed in self._subscribed.values():
            subscribed.envelopes_tried = 0

    def receive(
        self, operation: dict[str, Any], now: float, data: bytes | str, *, from_cbor: bool = False
    ) -> MessageReceived | Unusable | None:
        """Take a publish; None for one that nobody wants, or not so often.

        Args:
            operation: the message as decoded, its arrays lists or NumPy's.
            now: seconds of any clock that never goes back, for throttled subscriptions.
            data: the message as it came.
            from_cbor: whether it came as CBOR, with arrays as `numpy` says.
        """
        topic = operation.get("topic")
        msg = operation.get("msg")
        if type(topic) is not str or type(msg) is not dict:
            return Unusable(f"a publish without a topic or a message object arrived: {excerpt(data)}")
        subscribed = self._subscribed.get(topic) or self._subscribed.get(absolute(topic))
        if subscribed is None:
            return None
        if not subscribed.heard:
            subscribed.heard = True
            self.seen_version = self.seen_version or ros_version_of_message(msg)
        if (
            type(data) is bytes
            and len(operation) == _OF_ENVELOPE
            and not from_cbor
            and subscribed.envelopes_tried < _ENVELOPES
        ):
            self._learn_envelope(data, topic, subscribed)
        receivers = subscribed.receivers(now)
        if not receivers:
            return None
        if self.numpy:
            if subscribed.delivery.arrays == "list":
                msg = with_lists(msg) if from_cbor else msg
            elif not from_cbor:
                msg = with_arrays(msg)
        return MessageReceived(topic, msg, receivers)
