"""The rosbridge client as a state machine: objects in, events and bytes out, no socket and no clock anywhere.

What a client wants (advertisements, subscriptions, served services) is kept here, so that
`ClientCore.restore` can say it all again to a server that has forgotten it. Bytes to send gather in an outbox
that the shell empties with `ClientCore.data_to_send`; while there is no connection nothing gathers, what is
wanted is only remembered.

Several advertisements, or several subscriptions, of one topic share one on the wire: there are servers that
deliver a first message twice, or not at all, to a client that subscribes twice.

Source: the rosbridge protocol, version 2 (https://github.com/RobotWebTools/rosbridge_suite), and what its
servers really do (``docs/rosbridge-differences.md``).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import Any, Final, Literal, NamedTuple, get_args

import orjson

from bridge import cbor_codec, png
from bridge.arrays import with_arrays, with_lists
from bridge.cbor_codec import Arrays
from bridge.envelope import BRACE, envelope_of, topic_of
from bridge.errors import BridgeError, DecodeError, EncodeError, OptionError, SlowPeerError, TypeConflictError
from bridge.events import (
    CallAnswered,
    Event,
    GoalEnded,
    GoalFeedback,
    GoalStatus,
    MessageReceived,
    ServiceRequested,
    StatusReceived,
    Unusable,
)
from bridge.fragments import Reassembler, split
from bridge.json_codec import MAX_DEPTH, MAX_SIZE, could_be_deeper, decode, encode, excerpt
from bridge.names import Kind, absolute, check_name, ros1_type, ros2_type, same_type, split_type
from bridge.qos import Qos
from bridge.stamps import ros_version_of_message

RosVersion = Literal[1, 2]
Compression = Literal["none", "png", "cbor", "cbor-raw"]

#: Calls that may wait for their answers at once.
MAX_CALLS: Final = 1000
#: Requests to services of this client that may wait for their answers at once; more are refused.
MAX_REQUESTS: Final = 64
#: Goals of actions that may be under way at once.
MAX_GOALS: Final = 100
#: Keys of an operation whose envelope can be known again: op, topic and msg.
_OF_ENVELOPE: Final = 3
#: Envelopes of one topic that are looked at: a server that never says the same twice is not tried on and on.
_ENVELOPES: Final = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Delivery:
    """How the messages of a topic are to come; all subscriptions of one topic by one client have it in common.

    Attributes:
        compression: ``cbor`` for long arrays, ``cbor-raw`` for the serialised bytes alone, ``png`` for servers of
            ROS 1 on thin lines. Many servers pass over what they do not know, and send JSON.
        arrays: what arrays of numbers become, whatever the server sends.
        fragment_size: characters of a message in one fragment at most; None for whole messages. Servers keep
            the last one that a client asked for and use it for all they send to it.
        qos: what the server is to ask of ROS 2.
    """

    compression: Compression = "none"
    arrays: Arrays = "list"
    fragment_size: int | None = None
    qos: Qos | None = None

    def __post_init__(self) -> None:
        """Refuse what servers would pass over without a word."""
        for name, choices in (("compression", get_args(Compression)), ("arrays", get_args(Arrays))):
            if getattr(self, name) not in choices:
                raise OptionError(f"{name} must be one of {', '.join(choices)}, not {getattr(self, name)!r}")
        check_fragment_size(self.fragment_size)
        if self.compression == "cbor-raw" and self.arrays == "numpy":
            raise OptionError("cbor-raw brings bytes, no arrays: leave arrays out")


def check_fragment_size(size: int | None) -> None:
    """Refuse what is no size of a fragment.

    Raises:
        OptionError: it is neither None nor a whole number from 1 up.
    """
    if size is not None and (type(size) is not int or size < 1):
        raise OptionError(f"fragment_size must be a whole number from 1 up, or None, not {size!r}")


@dataclass(slots=True)
class _Advertised:
    """One topic as advertised on the wire, for one or more advertisements of this client."""

    topic: str
    type: str
    latch: bool
    queue_size: int
    qos: Qos | None
    wire_id: str
    prefix: bytes  # of its messages on the wire; a brace completes them
    holders: set[int] = field(default_factory=set)
    latched: bytes | None = None  # the last message, said again after a reconnection


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


class ClientCore:
    """All that a rosbridge client has to remember, and what its messages mean.

    Numbers that name an advertisement, a subscription or a ticket are never used twice.

    Attributes:
        ros_version: which ROS the server speaks for, None while nobody knows. Decides the form of type names
            on the wire: if unknown, they leave in the form of ROS 1, which ROS 2 servers take too.
        seen_version: what the header stamps of received messages say about it.
        connected: between `restore` and `lost`.
        fragment_size: characters of a message beyond which `pieces` cuts it, None for never.
    """

    def __init__(
        self,
        *,
        ros_version: RosVersion | None = None,
        max_size: int = MAX_SIZE,
        max_depth: int = MAX_DEPTH,
        fragment_size: int | None = None,
    ) -> None:
        """Begin with no connection and nothing wanted."""
        check_fragment_size(fragment_size)
        self.fragment_size = fragment_size
        self.ros_version: RosVersion | None = ros_version
        self.seen_version: RosVersion | None = None
        self.connected = False
        self._max_size = max_size
        self._max_depth = max_depth
        self._outbox: list[bytes] = []
        self._numbers = count(1)
        self._advertised: dict[str, _Advertised] = {}
        self._advertisements: dict[int, _Advertised] = {}
        self._subscribed: dict[str, _Subscribed] = {}
        self._subscriptions: dict[int, _Subscribed] = {}
        self._services: dict[str, str] = {}
        self._calls: set[str] = set()
        self._requests: dict[int, tuple[str, Any]] = {}
        self._goals: dict[str, str] = {}
        self._fragments = Reassembler(max_size=max_size)
        # What stood before messages that came, and whose they were; the last of these.
        self._envelopes: dict[bytes, _Known] = {}
        self._known = _UNKNOWN
        self._binary = False  # some topic is to come as CBOR
        self._numpy = False  # some topic's arrays are wanted as NumPy's

    # The connection

    def restore(self) -> None:
        """Take up a new connection: everything wanted goes into the outbox, advertisements first."""
        self.connected = True
        self._outbox.clear()
        for advertised in self._advertised.values():
            self._send_advertise(advertised)
            if advertised.latched is not None:
                self._outbox.append(advertised.latched)
        for service, type_name in self._services.items():
            self._send_advertise_service(service, type_name)
        self._forget_envelopes()
        for subscribed in self._subscribed.values():
            subscribed.heard = False
            self._send_subscribe(subscribed)

    def lost(self) -> None:
        """Take note that the connection is gone: its calls and requests will not be answered."""
        self.connected = False
        self._outbox.clear()
        self._calls.clear()
        self._requests.clear()
        self._goals.clear()
        self._fragments.clear()

    def data_to_send(self) -> list[bytes]:
        """Empty the outbox: whole messages, in order."""
        data, self._outbox = self._outbox, []
        return data

    def _send(self, **operation: Any) -> None:
        if self.connected:
            self._outbox.append(encode(operation, max_size=self._max_size, max_depth=self._max_depth))

    def pieces(self, data: bytes) -> Iterator[bytes]:
        """A whole message as it goes onto the wire: itself, or its fragments if it is larger than one may be."""
        if self.fragment_size is None or len(data) <= self.fragment_size:
            yield data
        else:
            yield from split(data, self.fragment_size, f"fragment:{next(self._numbers)}")

    def _wire_type(self, name: str, kind: Kind = "msg") -> str:
        return ros2_type(name, kind) if self.ros_version == 2 else ros1_type(name)

    # Publishing

    def advertise(
        self,
        topic: str,
        type_name: str,
        *,
        latch: bool = False,
        queue_size: int = 100,
        qos: Qos | None = None,
    ) -> int:
        """Want to publish on a topic.

        Args:
            topic: its name.
            type_name: in the form of ROS 1 or of ROS 2.
            latch: the server keeps the last message for those who subscribe later.
            queue_size: messages that the server holds for ROS's transport.
            qos: what the server is to ask of ROS 2.

        Returns:
            The advertisement's number, for `publish` and `unadvertise`.

        Raises:
            NameFormError: of topic or type.
            TypeConflictError: this client advertises the topic already, as something else.
        """
        check_name(topic)
        split_type(type_name)
        number = next(self._numbers)
        key = absolute(topic)
        advertised = self._advertised.get(key)
        if advertised is None:
            prefix = b'{"op":"publish","topic":"%b","msg":' % topic.encode()
            wire_id = f"advertise:{topic}:{number}"
            advertised = _Advertised(topic, type_name, latch, queue_size, qos, wire_id, prefix)
            self._advertised[key] = advertised
            self._send_advertise(advertised)
        elif not same_type(advertised.type, type_name) or advertised.latch != latch or advertised.qos != qos:
            raise TypeConflictError(
                f"topic {topic} is already advertised as {advertised.type}, latch={advertised.latch}, "
                f"qos={advertised.qos}; it cannot be advertised as {type_name}, latch={latch}, qos={qos} too"
            )
        advertised.holders.add(number)
        self._advertisements[number] = advertised
        return number

    def _send_advertise(self, advertised: _Advertised) -> None:
        qos = {} if advertised.qos is None else {"qos": advertised.qos.as_operation()}
        self._send(
            op="advertise",
            id=advertised.wire_id,
            topic=advertised.topic,
            type=self._wire_type(advertised.type),
            latch=advertised.latch,
            queue_size=advertised.queue_size,
            **qos,
        )

    def publish(self, advertisement: int, msg: Mapping[str, Any]) -> bytes:
        """Write one message of an advertised topic; the bytes are for the wire at once, not for the outbox.

        Raises:
            EncodeError: the message cannot leave as JSON; a NaN or an infinity is named with its place.
        """
        advertised = self._advertisements[advertisement]
        prefix = advertised.prefix
        try:
            body = encode(
                msg,
                nonfinite="refuse",
                max_size=self._max_size - len(prefix) - 1,
                max_depth=self._max_depth - 1,
            )
        except EncodeError as error:
            raise EncodeError(f"a message of {advertised.topic} cannot be published: {error}") from None
        data = b"%b%b}" % (prefix, body)
        if advertised.latch:
            advertised.latched = data
        return data

    def unadvertise(self, advertisement: int) -> None:
        """Stop wanting to publish; the last advertisement of a topic takes it off the wire."""
        advertised = self._advertisements.pop(advertisement)
        advertised.holders.discard(advertisement)
        if not advertised.holders:
            del self._advertised[absolute(advertised.topic)]
            self._send(op="unadvertise", id=advertised.wire_id, topic=advertised.topic)

    # Subscribing

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
        number = next(self._numbers)
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
        self._forget_envelopes()
        if subscribed.settle() or new:
            self._send_subscribe(subscribed)
        return number

    def _send_subscribe(self, subscribed: _Subscribed) -> None:
        operation: dict[str, Any] = {"op": "subscribe", "id": subscribed.wire_id, "topic": subscribed.topic}
        if subscribed.type is not None:
            operation["type"] = self._wire_type(subscribed.type)
        delivery = subscribed.delivery
        if delivery.compression != "none":
            operation["compression"] = delivery.compression
        if delivery.fragment_size is not None:
            operation["fragment_size"] = delivery.fragment_size
        if delivery.qos is not None:
            operation["qos"] = delivery.qos.as_operation()
        self._send(**operation, throttle_rate=subscribed.throttle_rate, queue_length=subscribed.queue_length)

    def _note_deliveries(self) -> None:
        deliveries = [subscribed.delivery for subscribed in self._subscribed.values()]
        self._binary = any(delivery.compression in {"cbor", "cbor-raw"} for delivery in deliveries)
        self._numpy = any(delivery.arrays == "numpy" for delivery in deliveries)

    def unsubscribe(self, subscription: int) -> None:
        """Stop wanting messages; the last subscription of a topic takes it off the wire."""
        subscribed = self._subscriptions.pop(subscription)
        del subscribed.wanted[subscription]
        self._forget_envelopes()
        if subscribed.wanted:
            if subscribed.settle():
                self._send_subscribe(subscribed)
        else:
            del self._subscribed[absolute(subscribed.topic)]
            self._note_deliveries()
            self._send(op="unsubscribe", id=subscribed.wire_id, topic=subscribed.topic)

    def ask_again(self) -> bool:
        """Ask again for topics of unknown type that have brought nothing yet.

        A server that does not know the topic yet forgets such a subscription, most without a word.

        Returns:
            Whether there are such topics, so that it is worth asking once more later.
        """
        waiting = [s for s in self._subscribed.values() if s.type is None and not s.heard]
        for subscribed in waiting:
            self._send_subscribe(subscribed)
        return bool(waiting)

    # Calling services

    def call(self, service: str, args: Mapping[str, Any]) -> str:
        """Call a service.

        Returns:
            The call's identity, which its `CallAnswered` bears.

        Raises:
            NameFormError: of the service.
            EncodeError: the arguments cannot leave as JSON.
            SlowPeerError: `MAX_CALLS` calls wait already.
        """
        check_name(service)
        if len(self._calls) >= MAX_CALLS:
            raise SlowPeerError(
                f"{MAX_CALLS} service calls wait for answers already, {service} is not called"
            )
        call = f"call_service:{service}:{next(self._numbers)}"
        data = encode(
            {"op": "call_service", "id": call, "service": service, "args": args},
            nonfinite="refuse",
            max_size=self._max_size,
            max_depth=self._max_depth,
        )
        self._calls.add(call)
        if self.connected:
            self._outbox.append(data)
        return call

    def forget_call(self, call: str) -> None:
        """Wait no longer for an answer; one that comes all the same is passed over."""
        self._calls.discard(call)

    # Goals of actions

    def send_goal(self, action: str, type_name: str, goal: Mapping[str, Any], *, feedback: bool) -> str:
        """Send a goal to an action of ROS 2.

        Args:
            action: its name.
            type_name: its type, in any form.
            goal: the goal's fields.
            feedback: whether to be told how far it is.

        Returns:
            The goal's identity, which its events bear.

        Raises:
            NameFormError: of action or type.
            EncodeError: the goal cannot leave as JSON.
            SlowPeerError: `MAX_GOALS` goals are under way already.
        """
        check_name(action)
        if len(self._goals) >= MAX_GOALS:
            raise SlowPeerError(f"{MAX_GOALS} goals are under way already, {action} gets none")
        identity = f"send_action_goal:{action}:{next(self._numbers)}"
        data = encode(
            {
                "op": "send_action_goal",
                "id": identity,
                "action": action,
                "action_type": ros2_type(type_name, "action"),
                "args": goal,
                "feedback": feedback,
            },
            nonfinite="refuse",
            max_size=self._max_size,
            max_depth=self._max_depth,
        )
        self._goals[identity] = action
        if self.connected:
            self._outbox.append(data)
        return identity

    def cancel_goal(self, goal: str) -> None:
        """Ask for a goal to be given up; its end tells whether it was. Nothing happens if it is over."""
        action = self._goals.get(goal)
        if action is not None:
            self._send(op="cancel_action_goal", id=goal, action=action)

    def forget_goal(self, goal: str) -> None:
        """Be told no more of a goal."""
        self._goals.pop(goal, None)

    # Serving services

    def advertise_service(self, service: str, type_name: str) -> None:
        """Want to serve a service.

        Raises:
            NameFormError: of service or type.
            TypeConflictError: this client serves it already.
        """
        check_name(service)
        split_type(type_name)
        key = absolute(service)
        if key in self._services:
            raise TypeConflictError(f"service {service} is already served by this client")
        self._services[key] = type_name
        self._send_advertise_service(key, type_name)

    def _send_advertise_service(self, service: str, type_name: str) -> None:
        self._send(op="advertise_service", service=service, type=self._wire_type(type_name, "srv"))

    def unadvertise_service(self, service: str) -> None:
        """Stop serving a service."""
        key = absolute(service)
        del self._services[key]
        self._send(op="unadvertise_service", service=key)

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
        operation = {"op": "service_response", "service": service, "values": values, "result": ok}
        if wire_id is not None:
            operation["id"] = wire_id
        data = encode(operation, nonfinite="refuse", max_size=self._max_size, max_depth=self._max_depth)
        del self._requests[ticket]
        if self.connected:
            self._outbox.append(data)

    # Receiving

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
            if self._envelopes:
                event = self._receive_again(data)
                if event is not None:
                    return event
            if self._binary and data[:1] >= b"\x80":  # no JSON begins so, a map of CBOR does
                return self._receive_cbor(data, now)
        try:
            operation = decode(data, max_size=self._max_size, max_depth=self._max_depth)
        except DecodeError as error:
            return Unusable(str(error))
        op = operation.get("op")
        if op == "publish":
            return self._receive_publish(operation, now, data)
        if op in ("fragment", "png"):
            return self._receive_wrapped(operation, now, data)
        return self._receive_other(operation, data)

    def _receive_again(self, data: bytes) -> MessageReceived | None:
        """Take a message whose envelope is known; None if it is none such, or needs a closer look."""
        known = self._known
        if not data.startswith(known.envelope):
            found = self._envelopes.get(envelope_of(data))
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
        if type(msg) is not dict or could_be_deeper(message, self._max_depth - 1):
            return None
        if self._numpy and subscribed.delivery.arrays == "numpy":
            msg = with_arrays(msg)
        # What a named tuple's own constructor does takes three times as long.
        return tuple.__new__(MessageReceived, (known.topic, msg, subscribed.everyone))

    def _learn_envelope(self, data: bytes, topic: str, subscribed: _Subscribed) -> None:
        """Remember what stands before a topic's messages, if no more than that must be known of the next one."""
        envelope = envelope_of(data)
        if envelope not in self._envelopes:
            subscribed.envelopes_tried += 1
            if topic_of(envelope) == topic:
                self._envelopes[envelope] = _Known(envelope, len(envelope), topic, subscribed)

    def _forget_envelopes(self) -> None:
        """Look at all messages closely again: who hears them may have changed, or the server."""
        self._envelopes.clear()
        self._known = _UNKNOWN
        for subscribed in self._subscribed.values():
            subscribed.envelopes_tried = 0

    def _receive_cbor(self, data: bytes, now: float) -> Event | None:
        try:
            operation = cbor_codec.decode(
                data,
                max_size=self._max_size,
                max_depth=self._max_depth,
                arrays="numpy" if self._numpy else "list",
            )
        except DecodeError as error:
            return Unusable(str(error))
        if operation.get("op") == "publish":
            return self._receive_publish(operation, now, data, from_cbor=True)
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
            return self._receive_publish(operation, now, data)
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
                return self._receive_answer(operation, data)
            case "call_service":
                return self._receive_request(operation, data)
            case "status":
                return StatusReceived(_text(operation.get("level")) or "error", _text(operation.get("msg")))
            case "action_feedback" | "action_result":
                return self._receive_of_goal(operation, data)
            case str():
                return Unusable(f"a message with an op that was not asked for arrived: {excerpt(data)}")
            case _:
                return Unusable(f"a message without an op arrived: {excerpt(data)}")

    def _receive_publish(
        self, operation: dict[str, Any], now: float, data: bytes | str, *, from_cbor: bool = False
    ) -> Event | None:
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
        if self._numpy:
            if subscribed.delivery.arrays == "list":
                msg = with_lists(msg) if from_cbor else msg
            elif not from_cbor:
                msg = with_arrays(msg)
        return MessageReceived(topic, msg, receivers)

    def _receive_answer(self, operation: dict[str, Any], data: bytes | str) -> Event | None:
        call = operation.get("id")
        if not isinstance(call, str):
            return Unusable(f"a service_response without the id of a call arrived: {excerpt(data)}")
        if call not in self._calls:
            return None
        self._calls.discard(call)
        values = operation.get("values")
        # Some servers leave `result` out when all went well.
        if operation.get("result", True) is False:
            return CallAnswered(call, ok=False, values=_text(values))
        return CallAnswered(call, ok=True, values={} if values is None else values)

    def _receive_of_goal(self, operation: dict[str, Any], data: bytes | str) -> Event | None:
        goal = operation.get("id")
        if not isinstance(goal, str):
            return Unusable(f"something about an action's goal arrived without its id: {excerpt(data)}")
        if goal not in self._goals:
            return None
        values = operation.get("values")
        if operation["op"] == "action_feedback":
            return GoalFeedback(goal, {} if values is None else values)
        del self._goals[goal]
        if operation.get("result", True) is False:
            return GoalEnded(goal, ok=False, status=GoalStatus.UNKNOWN, values=_text(values))
        status = operation.get("status", GoalStatus.SUCCEEDED.value)
        known = type(status) is int and status in GoalStatus.__members__.values()
        return GoalEnded(
            goal,
            ok=True,
            status=GoalStatus(status) if known else GoalStatus.UNKNOWN,
            values={} if values is None else values,
        )

    def _receive_request(self, operation: dict[str, Any], data: bytes | str) -> Event | None:
        service = operation.get("service")
        args = operation.get("args")
        wire_id = operation.get("id")
        if not isinstance(service, str) or not isinstance(wire_id, str | int | None):
            return Unusable(f"a call_service without a service or with an odd id arrived: {excerpt(data)}")
        ticket = next(self._numbers)
        self._requests[ticket] = (service, wire_id)
        if absolute(service) not in self._services:
            self.answer(ticket, f"service {excerpt(service)} is not served here", ok=False)
        elif len(self._requests) > MAX_REQUESTS:
            self.answer(ticket, f"{MAX_REQUESTS} requests wait here already", ok=False)
        elif not isinstance(args, dict | None):
            self.answer(ticket, "args must be an object", ok=False)
        else:
            return ServiceRequested(absolute(service), args or {}, ticket)
        return None


def _text(value: Any) -> str:
    """What a server says, as text: it is meant to be a string, and some send an object."""
    if isinstance(value, str):
        return value
    if value is None:
        return ""
    try:
        return encode({"": value})[4:-1].decode()
    except BridgeError:
        return repr(value)
