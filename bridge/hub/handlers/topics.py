"""Topics: advertised, published, subscribed, latched, throttled; each message written once for all who hear it."""

import time
from collections.abc import Callable
from typing import Any, Final

import orjson

from bridge.codecs.envelope import BRACE, envelope_of, topic_of
from bridge.codecs.json_codec import could_be_deeper
from bridge.errors import BridgeError
from bridge.hub.delivery.definitions import Definitions
from bridge.hub.delivery.dispatcher import Delivery, fragment_size_of
from bridge.hub.delivery.encodings import AROUND, COMPRESSIONS, Message, compression_of, json_prefix
from bridge.hub.graph import Advertisement, Client, Graph, Subscription, Topic, Wish
from bridge.hub.handlers.rosapi import ROSOUT, rosout_type
from bridge.hub.limits import HubLimits
from bridge.hub.operations import (
    Operation,
    OperationId,
    RefusedError,
    checked_name,
    flag,
    number,
    operation_id,
    optional_text,
    quality,
    text,
)
from bridge.names import absolute, same_type, split_type

#: Keys of an operation whose envelope can be known again: op, topic and msg.
_OF_ENVELOPE: Final = 3
#: A message is cut out of what arrived from this size on; smaller ones are written anew as quickly.
_WORTH_CUTTING: Final = 512
_KEY: Final = b'"msg"'
#: Quotes in a message that is cut out, at most: to look at each of more takes as long as to write it.
_QUOTES: Final = 200
# Up to so many bytes, text is searched at once; beyond, it is mostly numbers, and looking from quote to quote is faster.
_SHORT: Final = 4096


class Topics:
    """The topics of one hub."""

    def __init__(
        self,
        graph: Graph,
        limits: HubLimits,
        delivery: Delivery,
        definitions: Definitions,
        refuse: Callable[[Client, str, OperationId], None],
    ) -> None:
        """Begin without a topic; ``refuse`` notes what cannot be done for a subscriber."""
        self._graph = graph
        self._limits = limits
        self._delivery = delivery
        self._definitions = definitions
        self._refuse = refuse

    def leave(self, client: Client) -> None:
        """A client has gone."""
        for subscription in list(client.subscriptions.values()):
            self._stop_hearing(subscription)
        for advertisement in list(client.advertisements.values()):
            self._stop_publishing(advertisement)

    # --- publishing

    def advertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Do ``advertise``."""
        latch = flag(operation, "latch") or quality(operation).get("durability") == "transient_local"
        self._start_publishing(
            client, text(operation, "topic"), text(operation, "type"), operation_id(operation), latch=latch
        )

    def unadvertise(self, client: Client, operation: Operation, _now: float) -> None:
        """Do ``unadvertise``."""
        name, its_id = text(operation, "topic"), operation_id(operation)
        advertisement = client.advertisements.get(absolute(name))
        if advertisement is None:
            raise RefusedError(f"{name} is not advertised by this client")
        if its_id is None or advertisement.ids == {its_id}:
            self._stop_publishing(advertisement)
        elif its_id in advertisement.ids:
            advertisement.ids.discard(its_id)
            client.open_advertisements -= 1

    def publish(self, client: Client, operation: Operation, raw: bytes | None, now: float) -> None:
        """Do ``publish``.

        Args:
            client: who published.
            operation: what.
            raw: the operation as it arrived, if that was strict JSON.
            now: monotonic seconds.
        """
        name, parsed = text(operation, "topic"), operation.get("msg", {})
        if type(parsed) is not dict:
            raise RefusedError(f"the message for {name} is no JSON object")
        advertisement = client.advertisements.get(name if name[0] == "/" else "/" + name)
        if advertisement is None:
            # As on the reference server, publishing advertises, if the type is said here or known already.
            advertisement = self._start_publishing(
                client,
                name,
                optional_text(operation, "type"),
                operation_id(operation),
                latch=flag(operation, "latch"),
            )
        elif raw is not None and len(operation) == _OF_ENVELOPE:
            _learn_envelope(advertisement, name, raw)
        topic = advertisement.topic
        if topic.subscriptions or topic.latching:
            self.distribute(topic, parsed, _cut_out(operation, raw), now)

    def publish_again(self, client: Client, data: bytes, now: float) -> bool:
        """Do a ``publish`` with an envelope that is known: only its message is read, and it goes on as it came.

        Args:
            client: who sent it.
            data: what came, whatever it is.
            now: monotonic seconds.

        Returns:
            Whether it was one. If not, nothing was done: it is for `publish`, or to be refused.
        """
        advertisement = client.publishing
        if advertisement is None:
            return False
        if not data.startswith(advertisement.envelope):
            known = client.envelopes.get(envelope_of(data))
            if known is None:
                return False
            client.publishing = advertisement = known
        envelope, topic = advertisement.envelope, advertisement.topic
        if data[-1] != BRACE:
            return False
        message = data[len(envelope) : -1]
        if len(topic.name) + len(message) + AROUND > self._limits.message_bytes:
            return False
        try:
            parsed = orjson.loads(message)
        except orjson.JSONDecodeError:
            return False
        if type(parsed) is not dict or could_be_deeper(message, self._limits.depth - 1):
            return False
        if topic.subscriptions or topic.latching:
            self.distribute(topic, parsed, message, now, envelope, data)
        return True

    def distribute(
        self,
        topic: Topic,
        parsed: dict[str, Any],
        data: bytes | None,
        now: float,
        prefix: bytes = b"",
        payload: bytes = b"",
    ) -> None:
        """Hand a message to all who hear its topic.

        Args:
            topic: where.
            parsed: the message.
            data: the same as JSON, None if that must be written first.
            now: monotonic seconds.
            prefix: what stands before it, if it came written for the wire.
            payload: as it came then.
        """
        data = orjson.dumps(parsed) if data is None else data
        # Rewriting can lengthen (1e15 becomes 1000000000000000.0), beyond what subscribers take.
        if len(topic.name) + len(data) + AROUND > self._limits.message_bytes:
            raise RefusedError(
                f"the message for {topic.name} has more than {self._limits.message_bytes} bytes"
            )
        if topic.latching:
            room = self._limits.latched_bytes - self._graph.latched_bytes + len(topic.latched or b"")
            self._graph.latch(topic, data if len(data) <= room else None)
        # One payload for all who know the topic by one name.
        message: Message | None = None
        for subscription in topic.subscriptions.values():
            if subscription.compression == "none":
                if subscription.prefix != prefix:
                    prefix = subscription.prefix
                    payload = b"%b%b}" % (prefix, data)
                self._delivery.offer(subscription.client, subscription.lane, payload, now)
            else:
                message = message or self._message(topic, data, parsed)
                self._deliver_in_form(subscription, message, now)

    def _message(self, topic: Topic, data: bytes, parsed: dict[str, Any] | None) -> Message:
        return Message(
            data, parsed, topic.type, time.time_ns(), self._definitions, self._limits.message_bytes
        )

    def _deliver_in_form(self, subscription: Subscription, message: Message, now: float) -> None:
        client, lane = subscription.client, subscription.lane
        if not client.outbox.passes(lane, now):
            return
        try:
            payload = message.payload(subscription.compression, subscription.name)
        except (RefusedError, BridgeError) as error:
            if lane.lost == 0:  # once is enough: the next message of the topic fails in the same way
                self._refuse(client, str(error), next(iter(subscription.wishes)))
            lane.lost += 1
            return
        self._delivery.offer(client, lane, payload, now)

    # --- subscribing

    def subscribe(self, client: Client, operation: Operation, now: float) -> None:
        """Do ``subscribe``."""
        name, type_name = text(operation, "topic"), optional_text(operation, "type")
        its_id, wanted = operation_id(operation), quality(operation)
        queue_length = int(number(operation, "queue_length"))
        if not queue_length and wanted:
            all_of_them = wanted.get("history") == "keep_all"
            queue_length = self._limits.longest_queue if all_of_them else int(wanted.get("depth") or 0)
        wish = Wish(
            number(operation, "throttle_rate") / 1000,
            queue_length,
            compression_of(operation.get("compression")),
            fragment_size_of(number(operation, "fragment_size")),
        )
        subscription = client.subscriptions.get(absolute(name))
        is_new = subscription is None or its_id not in subscription.wishes
        if is_new and client.open_subscriptions >= self._limits.subscriptions_per_client:
            raise RefusedError(f"{name} would be one subscription more than {client.open_subscriptions}")
        topic = self._join(name, type_name, type_needed=False)
        if subscription is None:
            subscription = topic.subscriptions[client] = Subscription(client, topic, json_prefix(name), name)
            client.subscriptions[topic.name] = subscription
        client.open_subscriptions += is_new
        subscription.typed = subscription.typed or type_name is not None
        subscription.wishes[its_id] = wish
        self._fulfil_wishes(subscription)
        if is_new and topic.latched is not None and wanted.get("durability") != "volatile":
            self._deliver_in_form(subscription, self._message(topic, topic.latched, None), now)

    def unsubscribe(self, client: Client, operation: Operation, _now: float) -> None:
        """Do ``unsubscribe``."""
        name, its_id = text(operation, "topic"), operation_id(operation)
        subscription = client.subscriptions.get(absolute(name))
        if subscription is None:
            raise RefusedError(f"{name} is not subscribed by this client")
        if its_id is None or list(subscription.wishes) == [its_id]:
            self._stop_hearing(subscription)
        elif its_id in subscription.wishes:
            del subscription.wishes[its_id]
            client.open_subscriptions -= 1
            self._fulfil_wishes(subscription)

    def _fulfil_wishes(self, subscription: Subscription) -> None:
        wishes = subscription.wishes.values()
        throttle = min(wish.throttle for wish in wishes)
        queue_length = min(wish.queue_length for wish in wishes)
        if queue_length == 0 and not throttle:
            queue_length = self._limits.queue_length
        subscription.compression = max((wish.compression for wish in wishes), key=COMPRESSIONS.index)
        lane, outbox = subscription.lane, subscription.client.outbox
        lane.fragment_size = min((wish.fragment_size for wish in wishes if wish.fragment_size), default=0)
        outbox.adjust(lane, throttle, min(queue_length, self._limits.longest_queue))
        self._delivery.note_throttle(subscription.client)
        self._delivery.announce(subscription.client)

    # --- joining and leaving

    def _join(self, name: str, type_name: str | None, *, type_needed: bool) -> Topic:
        """The topic, made if it is new, after all checks that can refuse it."""
        if type_name is not None:
            split_type(type_name)
            type_name = self._definitions.name(type_name)
        key = absolute(name)
        topic = self._graph.topics.get(key)
        known = topic.type if topic else ""
        if key == ROSOUT:
            known = rosout_type(self._definitions.ros_version)
        if type_name is not None and known and not same_type(type_name, known):
            raise RefusedError(f"{name} is of type {known}, not {type_name}")
        if type_needed and not known and type_name is None:
            raise RefusedError(f"nobody said of which type {name} is: advertise it first")
        if topic is None:
            checked_name(name)
            if len(self._graph.topics) >= self._limits.topics:
                raise RefusedError(f"{name} would be one topic more than {self._limits.topics}")
            topic = self._graph.topics[key] = Topic(key)
        topic.type = known or type_name or ""
        return topic

    def _start_publishing(
        self, client: Client, name: str, type_name: str | None, its_id: OperationId, *, latch: bool
    ) -> Advertisement:
        advertisement = client.advertisements.get(absolute(name))
        is_new = advertisement is None or its_id not in advertisement.ids
        if is_new and client.open_advertisements >= self._limits.advertisements_per_client:
            raise RefusedError(f"{name} would be one advertisement more than {client.open_advertisements}")
        topic = self._join(name, type_name, type_needed=True)
        if advertisement is None:
            advertisement = topic.advertisements[client] = Advertisement(client, topic)
            client.advertisements[topic.name] = advertisement
        client.open_advertisements += is_new
        advertisement.ids.add(its_id)
        advertisement.latching = advertisement.latching or latch
        topic.latching = topic.latching or latch
        return advertisement

    def _stop_publishing(self, advertisement: Advertisement) -> None:
        client, topic = advertisement.client, advertisement.topic
        client.open_advertisements -= len(advertisement.ids)
        del topic.advertisements[client]
        del client.advertisements[topic.name]
        _forget_envelope(advertisement)
        self._graph.tidy(topic)

    def _stop_hearing(self, subscription: Subscription) -> None:
        client, topic = subscription.client, subscription.topic
        client.open_subscriptions -= len(subscription.wishes)
        client.outbox.forget(subscription.lane)
        del topic.subscriptions[client]
        del client.subscriptions[topic.name]
        self._graph.tidy(topic)


def _learn_envelope(advertisement: Advertisement, name: str, raw: bytes) -> None:
    """Remember what stands before a topic's messages, if no more than that must be known of the next one."""
    client, envelope = advertisement.client, envelope_of(raw)
    if envelope and topic_of(envelope) == name:
        _forget_envelope(advertisement)
        advertisement.envelope = envelope
        client.envelopes[envelope] = advertisement
        client.publishing = advertisement


def _forget_envelope(advertisement: Advertisement) -> None:
    client = advertisement.client
    client.envelopes.pop(advertisement.envelope, None)
    if client.publishing is advertisement:
        client.publishing = None


def _cut_out(operation: Operation, raw: bytes | None) -> bytes | None:
    """A large message's own bytes in the operation as it arrived; None where it must be written anew.

    Only where it is certain which bytes they are: the operation is known to be JSON, it has nothing escaped and
    the key once, so that this is the message's own; it ends with two braces and nothing but the message is an
    object, so that the message is what stands last.
    """
    if raw is None or len(raw) < _WORTH_CUTTING or raw[-2:] != b"}}" or b"\\" in raw:
        return None
    if sum(type(value) is dict for value in operation.values()) != 1:
        return None
    if len(raw) < _SHORT:
        key = raw.find(_KEY)
        return raw[raw.index(b"{", key) : -1] if key > 0 and raw.find(_KEY, key + 1) < 0 else None
    key = at = -1
    for _ in range(_QUOTES):  # one byte is looked for ten times as fast as five are
        at = raw.find(b'"', at + 1)
        if at < 0:
            return raw[raw.index(b"{", key) : -1] if key > 0 else None
        if raw.startswith(_KEY, at):
            if key > 0:
                return None
            key = at
    return None
