"""Topics: advertising, publishing, subscribing and latching.

If several subscribers to a topic request the same encoding, the hub encodes each message once for all of them.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import orjson

from bridge.codecs.json_codec import BRACE, envelope_of, is_deeper, topic_of
from bridge.errors import BridgeError
from bridge.hub.definitions import MessageDefinitions
from bridge.hub.dispatcher import Dispatcher, fragment_size_of
from bridge.hub.encodings import AROUND, ENCODINGS, Encoding, OutgoingMessage, encoding_of, json_prefix
from bridge.hub.graph import Advertisement, Client, Graph, SubscribeOptions, Topic, TopicSubscription
from bridge.hub.limits import (
    HubLimits,
    Operation,
    OperationId,
    RefusedOperationError,
    checked_name,
    flag,
    number,
    operation_id,
    optional_text,
    quality,
    text,
)
from bridge.hub.rosapi import ROSOUT, rosout_type
from bridge.names import absolute, same_type, split_type

# Keys of an operation with a reusable envelope: op, topic and msg.
_ENVELOPE_KEYS: Final = 3
# Units of work (see `TURN_WORK`) of one message, in addition to those of each subscriber.
_MESSAGE_WORK: Final = 20
# Bytes copied for a subscriber in one unit of work. Filling a message and writing it as JSON, which happens at most
# once, takes as long as this many copies.
_COPIED: Final = 4096
_JSON_COPIES: Final = 8
TURN_WORK: Final = 10_000
"""A client's turn ends after this many units of work. A unit takes about a microsecond."""
_PLAIN: Final = Encoding.NONE


class Topics:
    """The topics of one hub."""

    def __init__(
        self,
        graph: Graph,
        limits: HubLimits,
        dispatcher: Dispatcher,
        definitions: MessageDefinitions,
        refuse: Callable[[Client, str, OperationId], None],
    ) -> None:
        """Start without topics. `refuse` is called if a message cannot be encoded for a subscriber."""
        self._graph = graph
        self._limits = limits
        self._dispatcher = dispatcher
        self._definitions = definitions
        self._refuse = refuse
        self._room = limits.message_bytes
        self._depth = limits.depth - 1  # without the operation around a message

    def leave(self, client: Client) -> None:
        """Remove a disconnected client."""
        for subscription in list(client.subscriptions.values()):
            self._end_subscription(subscription)
        for advertisement in list(client.advertisements.values()):
            self._end_advertisement(advertisement)

    # --- publishing

    def advertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `advertise`."""
        latch = flag(operation, "latch") or quality(operation).get("durability") == "transient_local"
        self._start_publishing(
            client, text(operation, "topic"), text(operation, "type"), operation_id(operation), latch=latch
        )

    def unadvertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `unadvertise`."""
        name, own_id = text(operation, "topic"), operation_id(operation)
        advertisement = client.advertisements.get(absolute(name))
        if advertisement is None:
            raise RefusedOperationError(f"this client does not advertise {name}")
        if own_id is None or advertisement.ids == {own_id}:
            self._end_advertisement(advertisement)
        elif own_id in advertisement.ids:
            advertisement.ids.discard(own_id)
            client.open_advertisements -= 1

    def publish(self, client: Client, operation: Operation, raw: bytes | None, now: float) -> None:
        """Perform a `publish` operation. `raw` is the operation as received, or None if it was not strict JSON."""
        name, parsed = text(operation, "topic"), operation.get("msg", {})
        if type(parsed) is not dict:
            raise RefusedOperationError(f"the message for {name} is not a JSON object")
        advertisement = client.advertisements.get(name if name[0] == "/" else "/" + name)
        if advertisement is None:
            # As on the reference server, publishing also advertises, if the type is given here or already
            # known.
            advertisement = self._start_publishing(
                client,
                name,
                optional_text(operation, "type"),
                operation_id(operation),
                latch=flag(operation, "latch"),
            )
        elif raw is not None and len(operation) == _ENVELOPE_KEYS:
            _learn_envelope(advertisement, name, raw)
        topic, filler = advertisement.topic, advertisement.filler
        if topic.subscriptions or topic.latching:
            if filler is not None:
                filler.fill(parsed, self._room)
            self.distribute(topic, parsed, now)

    def publish_known(self, client: Client, messages: Sequence[bytes], first: int, now: float) -> int:
        """Perform `publish` operations without parsing their envelopes.

        An envelope is all bytes before the value of `msg`. The hub learnt the envelope from an earlier operation.

        `messages` may contain any operations, and `first` is the index of the first operation to perform. The method
        stops at an operation that must be parsed in full, or when the client's turn is over. Return the index of the
        first operation that was not performed, or `len(messages)` if all were performed.
        """
        advertisement = client.last_published
        while advertisement is not None and first < len(messages) and self._dispatcher.work <= TURN_WORK:
            # A publisher of several topics changes between their envelopes; all proven ones are kept.
            if not messages[first].startswith(advertisement.envelope):
                advertisement = client.envelopes.get(envelope_of(messages[first]))
                if advertisement is None:
                    break
                client.last_published = advertisement
            topic = advertisement.topic
            batch = messages
            if len(messages) > 1:
                # As many as the turn still allows, if all are like the first, and each subscriber wants CBOR or PNG.
                each = _MESSAGE_WORK + (2 + (len(messages[first]) >> 6)) * len(topic.subscriptions)
                batch = messages[first : first + 1 + (TURN_WORK - self._dispatcher.work) // each]
            # Parsed messages are kept only for CBOR and PNG, because freeing each before the next one is parsed is
            # faster. A loop, because `any` takes as long as parsing a small message.
            keep = False
            for subscription in topic.subscriptions.values():
                if subscription.compression is not _PLAIN:
                    keep = True
                    break
            payloads, parsed = self._read_known(advertisement, batch, keep=keep)
            if not payloads:
                break
            if topic.subscriptions or topic.latching:
                self._deliver(topic, payloads, parsed, advertisement.envelope, now)
            first += len(payloads)
        return first

    def _read_known(
        self, advertisement: Advertisement, messages: Sequence[bytes], *, keep: bool
    ) -> tuple[list[bytes], list[dict[str, Any]]]:
        """Return the first messages that have the advertisement's envelope, as payloads and, with `keep`, parsed."""
        envelope, filler, room, depth = advertisement.envelope, advertisement.filler, self._room, self._depth
        shallow, complete = 2 * depth, -1 if filler is None or filler.parts else filler.count
        begin, longest = len(envelope), len(envelope) + advertisement.topic.largest + 1
        payloads: list[bytes] = []
        messages_parsed: list[dict[str, Any]] = []
        for data in messages:
            # After a proven envelope, a message and a brace follow. All else is parsed in full (and perhaps refused).
            if not data.startswith(envelope) or data[-1] != BRACE:
                break
            message, payload = data[begin:-1], data
            try:
                parsed = orjson.loads(message)
                # The second condition is the first one of `is_deeper`, without its call.
                if type(parsed) is not dict or (len(message) > shallow and is_deeper(message, depth)):
                    break
                if filler is not None and len(parsed) != complete:
                    # With white space between the last braces, the tail has no place.
                    is_spliced = data[-2] == BRACE
                    tail = filler.fill(parsed, room, keep=keep or not is_spliced)
                    if tail is None or (tail and not is_spliced):
                        payload = b"%b%b}" % (envelope, orjson.dumps(parsed))
                        room -= len(payload) - len(data)  # together they may grow by as much as one
                    elif tail:
                        payload = data[:-2] + tail
            except (orjson.JSONDecodeError, RefusedOperationError):
                break
            if len(payload) > longest:
                break
            payloads.append(payload)
            if keep:
                messages_parsed.append(parsed)
        return payloads, messages_parsed

    def distribute(self, topic: Topic, parsed: dict[str, Any], now: float) -> None:
        """Deliver a message to all subscribers of a topic. Raise a RefusedOperationError if it is too large."""
        payload = orjson.dumps(parsed) + b"}"
        # Rewriting can lengthen a message (1e15 becomes 1000000000000000.0).
        if len(payload) - 1 > topic.largest:
            raise RefusedOperationError(
                f"the message for {topic.name} has more than {self._limits.message_bytes} bytes"
            )
        self._deliver(topic, [payload], [parsed], b"", now)

    def _deliver(
        self, topic: Topic, payloads: list[bytes], parsed: list[dict[str, Any]], prefix: bytes, now: float
    ) -> None:
        """Deliver messages; a payload is a message's JSON between `prefix` and a closing brace."""
        dispatcher, subscriptions = self._dispatcher, topic.subscriptions
        # A message that is too large to be latched also removes the latched one before it.
        if topic.latching:
            latched = payloads[-1][len(prefix) : -1]
            room = self._limits.latched_bytes - self._graph.latched_bytes + len(topic.latched or b"")
            self._graph.latch(topic, latched if len(latched) <= room else None)
        copies = _JSON_COPIES + len(subscriptions)
        dispatcher.work += (_MESSAGE_WORK + 2 * len(subscriptions)) * len(payloads)
        dispatcher.work += copies * sum(map(len, payloads)) // _COPIED
        # Subscribers that use the same name for the topic share one payload.
        encoded: list[OutgoingMessage] = []
        for client, subscription in subscriptions.items():
            if subscription.compression is _PLAIN:
                if subscription.prefix != prefix:
                    payloads = [subscription.prefix + payload[len(prefix) :] for payload in payloads]
                    prefix = subscription.prefix
                lane = subscription.lane
                client.outbox.offer_all(lane, payloads, now)
                if lane.throttle:
                    dispatcher.schedule_release(client)
                if not client.is_ready:
                    dispatcher.mark_ready(client)
            else:
                encoded = encoded or [
                    self._message(topic, payload, len(prefix), message)
                    for payload, message in zip(payloads, parsed, strict=True)
                ]
                self._deliver_encoded(subscription, encoded, now)

    def _message(
        self, topic: Topic, json: bytes, begin: int, parsed: dict[str, Any] | None
    ) -> OutgoingMessage:
        return OutgoingMessage(
            json, begin, parsed, topic.type, time.time_ns(), self._definitions, self._limits.message_bytes
        )

    def _deliver_encoded(
        self, subscription: TopicSubscription, messages: Sequence[OutgoingMessage], now: float
    ) -> None:
        client, lane = subscription.client, subscription.lane
        outbox, compression, name = client.outbox, subscription.compression, subscription.name
        for message in messages:
            if lane.throttle and not outbox.accepts(lane, now):
                continue
            self._dispatcher.work += len(message.json) >> 6
            try:
                payload = message.payload(compression, name)
            except BridgeError as error:
                if lane.dropped == 0:  # reported once, because the topic's next messages fail in the same way
                    self._refuse(client, str(error), next(iter(subscription.options)))
                lane.dropped += 1
                continue
            outbox.offer(lane, payload, now)
        self._dispatcher.schedule_release(client)
        self._dispatcher.mark_ready(client)

    # --- subscribing

    def subscribe(self, client: Client, operation: Operation, now: float) -> None:
        """Perform `subscribe`."""
        name, type_name = text(operation, "topic"), optional_text(operation, "type")
        own_id, qos = operation_id(operation), quality(operation)
        # A client of ROS 2 says `depth` where one of ROS 1 says `queue_length`.
        queue_length = int(number(operation, "queue_length"))
        if not queue_length and qos:
            keeps_all = qos.get("history") == "keep_all"
            queue_length = self._limits.longest_queue if keeps_all else int(qos.get("depth") or 0)
        options = SubscribeOptions(
            number(operation, "throttle_rate") / 1000,
            queue_length,
            encoding_of(operation.get("compression")),
            fragment_size_of(number(operation, "fragment_size")),
        )
        subscription = client.subscriptions.get(absolute(name))
        # Repeating a subscribe operation changes its options; only a new one counts, and gets the latched message.
        is_new = subscription is None or own_id not in subscription.options
        if is_new and client.open_subscriptions >= self._limits.subscriptions_per_client:
            raise RefusedOperationError(f"this client already has {client.open_subscriptions} subscriptions")
        topic = self._join(name, type_name, type_needed=False)
        if subscription is None:
            subscription = topic.subscriptions[client] = TopicSubscription(
                client, topic, json_prefix(name), name
            )
            client.subscriptions[topic.name] = subscription
        client.open_subscriptions += is_new
        # The type of a topic without publishers lasts as long as a subscriber that named it (`Graph.tidy`).
        subscription.typed = subscription.typed or type_name is not None
        subscription.options[own_id] = options
        self._apply_options(subscription)
        if is_new and topic.latched is not None and qos.get("durability") != "volatile":
            self._deliver_encoded(subscription, [self._message(topic, topic.latched + b"}", 0, None)], now)

    def unsubscribe(self, client: Client, operation: Operation, _now: float) -> None:
        """Perform `unsubscribe`."""
        name, own_id = text(operation, "topic"), operation_id(operation)
        subscription = client.subscriptions.get(absolute(name))
        if subscription is None:
            raise RefusedOperationError(f"this client is not subscribed to {name}")
        if own_id is None or (len(subscription.options) == 1 and own_id in subscription.options):
            self._end_subscription(subscription)
        elif own_id in subscription.options:
            del subscription.options[own_id]
            client.open_subscriptions -= 1
            self._apply_options(subscription)

    def _apply_options(self, subscription: TopicSubscription) -> None:
        options = subscription.options.values()
        self._dispatcher.work += 2 * len(options)
        throttle = min(each.throttle for each in options)
        queue_length = min(each.queue_length for each in options)
        # With a throttle, 0 drops messages that come too early; without one, it leaves the length to the hub.
        if queue_length == 0 and not throttle:
            queue_length = self._limits.queue_length
        subscription.compression = max({each.compression for each in options}, key=ENCODINGS.index)
        lane, outbox = subscription.lane, subscription.client.outbox
        lane.fragment_size = min((each.fragment_size for each in options if each.fragment_size), default=0)
        outbox.adjust(lane, throttle, min(queue_length, self._limits.longest_queue))
        self._dispatcher.schedule_release(subscription.client)
        self._dispatcher.mark_ready(subscription.client)

    # --- joining and leaving

    def _join(self, name: str, type_name: str | None, *, type_needed: bool) -> Topic:
        """Return the topic after all checks; create it if it does not exist."""
        if type_name is not None:
            split_type(type_name)
            type_name = self._definitions.name(type_name)
        key = absolute(name)
        topic = self._graph.topics.get(key)
        known = topic.type if topic else ""
        if key == ROSOUT:
            known = rosout_type(self._definitions.ros_version)
        if type_name is not None and known and not same_type(type_name, known):
            raise RefusedOperationError(f"{name} is of type {known}, not {type_name}")
        if type_needed and not known and type_name is None:
            raise RefusedOperationError(f"the type of {name} is unknown: advertise it first")
        if topic is None:
            # Names are checked where they would be stored; a name that is known was checked before.
            checked_name(name)
            if len(self._graph.topics) >= self._limits.topics:
                raise RefusedOperationError(f"the hub already has {self._limits.topics} topics")
            topic = self._graph.topics[key] = Topic(key, self._limits.message_bytes - len(key) - AROUND)
        topic.type = known or type_name or ""
        return topic

    def _start_publishing(
        self, client: Client, name: str, type_name: str | None, own_id: OperationId, *, latch: bool
    ) -> Advertisement:
        advertisement = client.advertisements.get(absolute(name))
        is_new = advertisement is None or own_id not in advertisement.ids
        if is_new and client.open_advertisements >= self._limits.advertisements_per_client:
            raise RefusedOperationError(
                f"this client already has {client.open_advertisements} advertisements"
            )
        topic = self._join(name, type_name, type_needed=True)
        if advertisement is None:
            filler = self._definitions.filler(topic.type)
            advertisement = topic.advertisements[client] = Advertisement(client, topic, filler)
            client.advertisements[topic.name] = advertisement
        client.open_advertisements += is_new
        advertisement.ids.add(own_id)
        advertisement.latching = advertisement.latching or latch
        topic.latching = topic.latching or latch
        return advertisement

    def _end_advertisement(self, advertisement: Advertisement) -> None:
        client, topic = advertisement.client, advertisement.topic
        client.open_advertisements -= len(advertisement.ids)
        del topic.advertisements[client]
        del client.advertisements[topic.name]
        _forget_envelope(advertisement)
        self._graph.tidy(topic)

    def _end_subscription(self, subscription: TopicSubscription) -> None:
        client, topic = subscription.client, subscription.topic
        client.open_subscriptions -= len(subscription.options)
        client.outbox.forget(subscription.lane)
        del topic.subscriptions[client]
        del client.subscriptions[topic.name]
        self._graph.tidy(topic)


def _learn_envelope(advertisement: Advertisement, name: str, raw: bytes) -> None:
    """Store the bytes of a `publish` operation before its message, if they suffice to identify the topic."""
    client, envelope = advertisement.client, envelope_of(raw)
    if envelope and topic_of(envelope) == name:
        _forget_envelope(advertisement)
        advertisement.envelope = envelope
        client.envelopes[envelope] = advertisement
        client.last_published = advertisement


def _forget_envelope(advertisement: Advertisement) -> None:
    client = advertisement.client
    client.envelopes.pop(advertisement.envelope, None)
    if client.last_published is advertisement:
        client.last_published = None
