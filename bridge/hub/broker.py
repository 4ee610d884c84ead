"""The rosbridge server without a socket: messages of clients in, messages for clients out.

Whoever owns sockets and clocks calls `Broker.connect`, `Broker.receive`, `Broker.wake` and
`Broker.disconnect`, then serves the clients that `Broker.take_ready` names from their outboxes. Nothing here
waits, reads a clock or raises for what a client sends.

What is wrong is refused as the reference server refuses it: not a word to the client, a line in the log.
Only calls are answered, ``result: false`` with a sentence in ``values``. A client is served on, whatever
nonsense it sent before.

Messages are not checked against their types, whose definitions the hub does not have; but what goes out is
strict JSON, with ``null`` for every NaN and infinity that came in.
"""

import itertools
import logging
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any, Final

import orjson

from bridge.errors import BridgeError
from bridge.hub.graph import (
    Advertisement,
    Client,
    Graph,
    OperationId,
    Service,
    Subscription,
    Topic,
    Wish,
)
from bridge.hub.limits import HubLimits
from bridge.hub.outbox import Outbox
from bridge.hub.rosapi import PREFIX, Rosapi, RosapiError
from bridge.json_codec import decode
from bridge.names import MAX_NAME, absolute, same_type, split_type

log = logging.getLogger(__name__)

_Operation = dict[str, Any]

#: What both ROS 1 and ROS 2 would take, and a little more: parts that start with a digit (``/camera/0``).
_NAME: Final = re.compile(r"[~/]?[A-Za-z0-9_]+(?:/[A-Za-z0-9_]+)*")
#: Characters of an operation's id at most: the hub remembers those of what is open.
_LONGEST_ID: Final = 1024
#: No rate, length or time is as large.
_HUGE: Final = 1e12


class _RefusedError(Exception):
    """What a client asked for is not done. The text is for the log, or for the answer to a call."""


@dataclass(frozen=True, slots=True)
class _Call:
    """A call on its way: who asked, under which id and name, who is to answer, and by when."""

    caller: Client
    call_id: OperationId
    service: str
    server: Client
    deadline: float


class Broker:
    """All clients of one hub, and what they have between them.

    Attributes:
        limits: what it refuses beyond.
        graph: clients, topics and services at the moment.
    """

    def __init__(
        self, limits: HubLimits | None = None, *, wall_clock: Callable[[], int] = time.time_ns
    ) -> None:
        """Start with nobody; ``wall_clock`` (nanoseconds since 1970) is what ``/rosapi/get_time`` tells."""
        self.limits = limits or HubLimits()
        self.graph = Graph()
        self._rosapi = Rosapi(self.graph, self.limits, wall_clock)
        self._client_numbers = itertools.count(1)
        self._call_numbers = itertools.count(1)
        self._calls: dict[str, _Call] = {}
        self._calls_deadline = inf
        self._throttled: set[Client] = set()
        self._throttle_deadline = inf
        self._ready: list[Client] = []
        self._operations: dict[str, Callable[[Client, _Operation, float], None]] = {
            "publish": self._publish,
            "subscribe": self._subscribe,
            "unsubscribe": self._unsubscribe,
            "advertise": self._advertise,
            "unadvertise": self._unadvertise,
            "call_service": self._call_service,
            "service_response": self._service_response,
            "advertise_service": self._advertise_service,
            "unadvertise_service": self._unadvertise_service,
        }

    # --- the border

    @property
    def full(self) -> bool:
        """Whether there are as many clients as may be."""
        return len(self.graph.clients) >= self.limits.clients

    @property
    def deadline(self) -> float:
        """When `wake` has something to do (monotonic seconds), infinity for never."""
        return min(self._calls_deadline, self._throttle_deadline)

    def connect(self, address: str) -> Client:
        """Take a client in, from ``address``; ask `full` before."""
        client = Client(next(self._client_numbers), address, Outbox(self.limits.client_bytes))
        self.graph.clients[client.number] = client
        return client

    def disconnect(self, client: Client) -> None:
        """Forget a client. Calls that it has yet to answer fail now. A second time does nothing."""
        if self.graph.clients.pop(client.number, None) is None:
            return
        lost = sum(subscription.lane.lost for subscription in client.subscriptions.values())
        if lost or client.refused:
            log.info(
                "%s of %s is gone: %d of its operations were refused, %d messages dropped as it was too slow",
                client.node,
                client.address,
                client.refused,
                lost,
            )
        for subscription in list(client.subscriptions.values()):
            self._stop_hearing(subscription)
        for advertisement in list(client.advertisements.values()):
            self._stop_publishing(advertisement)
        for name in client.services:
            self.graph.services.pop(name, None)
        for key in list(client.asked):
            self._take_call(key)
        for key in list(client.asked_of):
            call = self._take_call(key)
            self._fail_call(call, f"{call.service} went away during the call")
        self._throttled.discard(client)

    def receive(self, client: Client, data: bytes, now: float) -> None:
        """Do what one message of a client asks for.

        Args:
            client: who sent it.
            data: a whole WebSocket message, text or binary, whatever its content.
            now: monotonic seconds.
        """
        try:
            operation = decode(data, max_size=self.limits.message_bytes, max_depth=self.limits.depth)
            self._handler(operation)(client, operation, now)
        except (_RefusedError, BridgeError) as error:
            self._note_refusal(client, str(error))

    def wake(self, now: float) -> None:
        """Do what is due at ``now``: messages whose throttle is over, calls whose time is over."""
        if now >= self._throttle_deadline:
            for client in list(self._throttled):
                client.outbox.release(now)
                self._announce(client)
                if client.outbox.deadline == inf:
                    self._throttled.discard(client)
            self._throttle_deadline = min((client.outbox.deadline for client in self._throttled), default=inf)
        if now >= self._calls_deadline:
            for key in [key for key, call in self._calls.items() if call.deadline <= now]:
                call = self._take_call(key)
                self._fail_call(call, f"{call.service} did not answer in time")
            self._calls_deadline = min((call.deadline for call in self._calls.values()), default=inf)

    def take_ready(self) -> list[Client]:
        """The clients that have something to be sent, or are doomed, since this was last asked."""
        ready, self._ready = self._ready, []
        for client in ready:
            client.has_output = False
        return ready

    def _handler(self, operation: _Operation) -> Callable[[Client, _Operation, float], None]:
        name = operation.get("op")
        handler = self._operations.get(name) if isinstance(name, str) else None
        if handler is None:
            raise _RefusedError(f"unknown operation {str(name)[:60]!r}")
        return handler

    def _announce(self, client: Client) -> None:
        if not client.has_output:
            client.has_output = True
            self._ready.append(client)

    def _send(self, client: Client, payload: bytes) -> None:
        """Queue what may not be lost."""
        client.outbox.put(payload)
        if client.outbox.overflowed:
            client.doomed = f"it leaves {self.limits.client_bytes} bytes of answers unread"
        self._announce(client)

    def _note_refusal(self, client: Client, why: str) -> None:
        client.refused += 1
        if _is_round(client.refused):
            log.warning("%s of %s: refused (no. %d): %s", client.node, client.address, client.refused, why)

    # --- topics

    def _join_topic(self, name: str, type_name: str | None, *, type_needed: bool) -> Topic:
        """The topic, made if it is new, after all checks that can refuse it."""
        if type_name is not None:
            split_type(type_name)
        topic = self.graph.topics.get(absolute(name))
        known = topic.type if topic else ""
        if type_name is not None and known and not same_type(type_name, known):
            raise _RefusedError(f"{name} is of type {known}, not {type_name}")
        if type_needed and not known and type_name is None:
            raise _RefusedError(f"nobody said of which type {name} is: advertise it first")
        if topic is None:
            _checked_name(name)
            if len(self.graph.topics) >= self.limits.topics:
                raise _RefusedError(f"{name} would be one topic more than {self.limits.topics}")
            topic = self.graph.topics[absolute(name)] = Topic(absolute(name))
        topic.type = known or type_name or ""
        return topic

    def _start_publishing(
        self, client: Client, name: str, type_name: str | None, operation_id: OperationId, *, latch: bool
    ) -> Advertisement:
        advertisement = client.advertisements.get(absolute(name))
        is_new = advertisement is None or operation_id not in advertisement.ids
        if is_new and client.open_advertisements >= self.limits.advertisements_per_client:
            raise _RefusedError(f"{name} would be one advertisement more than {client.open_advertisements}")
        topic = self._join_topic(name, type_name, type_needed=True)
        if advertisement is None:
            advertisement = topic.advertisements[client] = Advertisement(client, topic)
            client.advertisements[topic.name] = advertisement
        client.open_advertisements += is_new
        advertisement.ids.add(operation_id)
        advertisement.latching = advertisement.latching or latch
        return advertisement

    def _stop_publishing(self, advertisement: Advertisement) -> None:
        client, topic = advertisement.client, advertisement.topic
        client.open_advertisements -= len(advertisement.ids)
        del topic.advertisements[client]
        del client.advertisements[topic.name]
        self.graph.tidy(topic)

    def _stop_hearing(self, subscription: Subscription) -> None:
        client, topic = subscription.client, subscription.topic
        client.open_subscriptions -= len(subscription.wishes)
        client.outbox.forget(subscription.lane)
        del topic.subscriptions[client]
        del client.subscriptions[topic.name]
        self.graph.tidy(topic)

    def _advertise(self, client: Client, operation: _Operation, _now: float) -> None:
        self._start_publishing(
            client,
            _text(operation, "topic"),
            _text(operation, "type"),
            _operation_id(operation),
            latch=_flag(operation, "latch"),
        )

    def _unadvertise(self, client: Client, operation: _Operation, _now: float) -> None:
        name, operation_id = _text(operation, "topic"), _operation_id(operation)
        advertisement = client.advertisements.get(absolute(name))
        if advertisement is None:
            raise _RefusedError(f"{name} is not advertised by this client")
        if operation_id is None or advertisement.ids == {operation_id}:
            self._stop_publishing(advertisement)
        elif operation_id in advertisement.ids:
            advertisement.ids.discard(operation_id)
            client.open_advertisements -= 1

    def _publish(self, client: Client, operation: _Operation, now: float) -> None:
        name, message = _text(operation, "topic"), operation.get("msg", {})
        if not isinstance(message, dict):
            raise _RefusedError(f"the message for {name} is no JSON object")
        advertisement = client.advertisements.get(absolute(name))
        if advertisement is None:
            # As on the reference server, publishing advertises, if the type is said here or known already.
            advertisement = self._start_publishing(
                client,
                name,
                _optional_text(operation, "type"),
                _operation_id(operation),
                latch=_flag(operation, "latch"),
            )
        topic = advertisement.topic
        data = orjson.dumps(message)
        # Rewriting can lengthen (1e15 becomes 1000000000000000.0), beyond what subscribers take.
        if len(topic.name) + len(data) + _AROUND > self.limits.message_bytes:
            raise _RefusedError(f"the message for {name} has more than {self.limits.message_bytes} bytes")
        if topic.latching:
            fits = (
                self.graph.latched_bytes - len(topic.latched or b"") + len(data) <= self.limits.latched_bytes
            )
            self.graph.latch(topic, data if fits else None)
        # One payload for all who know the topic by one name.
        prefix, payload = b"", b""
        for subscription in topic.subscriptions.values():
            if subscription.prefix != prefix:
                prefix = subscription.prefix
                payload = b"%b%b}" % (prefix, data)
            self._deliver(subscription, payload, now)

    def _deliver(self, subscription: Subscription, payload: bytes, now: float) -> None:
        client = subscription.client
        client.outbox.offer(subscription.lane, payload, now)
        self._note_throttle(client)
        self._announce(client)

    def _note_throttle(self, client: Client) -> None:
        deadline = client.outbox.deadline
        if deadline != inf:
            self._throttled.add(client)
            self._throttle_deadline = min(self._throttle_deadline, deadline)

    def _subscribe(self, client: Client, operation: _Operation, now: float) -> None:
        name, type_name = _text(operation, "topic"), _optional_text(operation, "type")
        operation_id = _operation_id(operation)
        wish = Wish(_number(operation, "throttle_rate") / 1000, int(_number(operation, "queue_length")))
        subscription = client.subscriptions.get(absolute(name))
        is_new = subscription is None or operation_id not in subscription.wishes
        if is_new and client.open_subscriptions >= self.limits.subscriptions_per_client:
            raise _RefusedError(f"{name} would be one subscription more than {client.open_subscriptions}")
        topic = self._join_topic(name, type_name, type_needed=False)
        if subscription is None:
            subscription = topic.subscriptions[client] = Subscription(client, topic, _prefix(name))
            client.subscriptions[topic.name] = subscription
        client.open_subscriptions += is_new
        subscription.typed = subscription.typed or type_name is not None
        subscription.wishes[operation_id] = wish
        self._fulfil_wishes(subscription)
        if is_new and topic.latched is not None:
            self._deliver(subscription, b"%b%b}" % (subscription.prefix, topic.latched), now)

    def _fulfil_wishes(self, subscription: Subscription) -> None:
        throttle = min(wish.throttle for wish in subscription.wishes.values())
        queue_length = min(wish.queue_length for wish in subscription.wishes.values())
        if queue_length == 0 and not throttle:
            queue_length = self.limits.queue_length
        client = subscription.client
        client.outbox.adjust(subscription.lane, throttle, min(queue_length, self.limits.longest_queue))
        self._note_throttle(client)
        self._announce(client)

    def _unsubscribe(self, client: Client, operation: _Operation, _now: float) -> None:
        name, operation_id = _text(operation, "topic"), _operation_id(operation)
        subscription = client.subscriptions.get(absolute(name))
        if subscription is None:
            raise _RefusedError(f"{name} is not subscribed by this client")
        if operation_id is None or list(subscription.wishes) == [operation_id]:
            self._stop_hearing(subscription)
        elif operation_id in subscription.wishes:
            del subscription.wishes[operation_id]
            client.open_subscriptions -= 1
            self._fulfil_wishes(subscription)

    # --- services

    def _advertise_service(self, client: Client, operation: _Operation, _now: float) -> None:
        name, type_name = _checked_name(_text(operation, "service")), _text(operation, "type")
        split_type(type_name)
        key = absolute(name)
        if key.startswith(PREFIX):
            raise _RefusedError(f"{name} is the hub's own to offer")
        if key not in client.services and len(client.services) >= self.limits.services_per_client:
            raise _RefusedError(f"{name} would be one service more than {len(client.services)}")
        before = self.graph.services.get(key)
        if before is not None and before.client is not client:
            client.takeovers += 1
            if _is_round(client.takeovers):
                log.warning("%s is now offered by %s, no longer by %s", key, client.node, before.client.node)
            before.client.services.discard(key)
        self.graph.services[key] = Service(key, type_name, client)
        client.services.add(key)

    def _unadvertise_service(self, client: Client, operation: _Operation, _now: float) -> None:
        name = _text(operation, "service")
        if absolute(name) not in client.services:
            raise _RefusedError(f"{name} is not offered by this client")
        client.services.discard(absolute(name))
        del self.graph.services[absolute(name)]

    def _call_service(self, client: Client, operation: _Operation, now: float) -> None:
        name, call_id = _text(operation, "service"), _operation_id(operation)
        try:
            self._start_call(client, name, call_id, operation, now)
        except _RefusedError as error:
            self._answer_failure(client, call_id, name, str(error))

    def _start_call(
        self, client: Client, name: str, call_id: OperationId, operation: _Operation, now: float
    ) -> None:
        key, args = absolute(name), operation.get("args")
        if self._rosapi.offers(key):
            try:
                values = self._rosapi.call(key, {} if args is None else args)
            except RosapiError as error:
                raise _RefusedError(str(error)) from None
            self._answer(client, call_id, name, values)
            return
        service = self.graph.services.get(key)
        if service is None:
            raise _RefusedError(f"Service {name} does not exist")
        server = service.client
        if len(client.asked) >= self.limits.calls_per_client:
            raise _RefusedError(f"this client waits for {len(client.asked)} calls already")
        if len(server.asked_of) >= self.limits.calls_per_client:
            raise _RefusedError(f"{name} has {len(server.asked_of)} calls to answer already")
        timeout = min(_number(operation, "timeout") or inf, self.limits.call_timeout)
        request_id = f"service_request:{key}:{next(self._call_numbers)}"
        request = {
            "op": "call_service",
            "id": request_id,
            "service": key,
            "args": {} if args is None else args,
        }
        payload = orjson.dumps(request)
        if len(payload) > self.limits.message_bytes:
            raise _RefusedError(f"the request for {name} has more than {self.limits.message_bytes} bytes")
        self._calls[request_id] = _Call(client, call_id, name, server, now + timeout)
        client.asked.add(request_id)
        server.asked_of.add(request_id)
        self._calls_deadline = min(self._calls_deadline, now + timeout)
        self._send(server, payload)

    def _service_response(self, client: Client, operation: _Operation, _now: float) -> None:
        key = operation.get("id")
        if not isinstance(key, str) or key not in client.asked_of:
            raise _RefusedError(f"nobody waits for the answer {str(key)[:80]!r}")
        call = self._take_call(key)
        values, result = operation.get("values", {}), operation.get("result", True)
        if result is True and isinstance(values, dict):
            try:
                self._answer(call.caller, call.call_id, call.service, values)
            except _RefusedError as error:
                self._fail_call(call, str(error))
        elif result is True:
            self._fail_call(call, f"{call.service} answered with values that are no JSON object")
        else:
            # The wire has a string here; what a server says beyond that is told as JSON.
            self._fail_call(call, values if isinstance(values, str) else orjson.dumps(values).decode())

    def _take_call(self, key: str) -> _Call:
        call = self._calls.pop(key)
        call.caller.asked.discard(key)
        call.server.asked_of.discard(key)
        return call

    def _answer(self, client: Client, call_id: OperationId, service: str, values: dict[str, Any]) -> None:
        payload = _service_response(call_id, service, values, result=True)
        if len(payload) > self.limits.message_bytes:
            raise _RefusedError(f"the answer of {service} has more than {self.limits.message_bytes} bytes")
        self._send(client, payload)

    def _answer_failure(self, client: Client, call_id: OperationId, service: str, reason: str) -> None:
        # An eighth, as a character can take six bytes; a failure must always get through.
        reason = reason[: self.limits.message_bytes // 8]
        self._send(client, _service_response(call_id, service, reason, result=False))

    def _fail_call(self, call: _Call, reason: str) -> None:
        self._answer_failure(call.caller, call.call_id, call.service, reason)


def _service_response(call_id: OperationId, service: str, values: object, *, result: bool) -> bytes:
    answer = {"op": "service_response", "service": service, "values": values, "result": result}
    if call_id is not None:
        answer["id"] = call_id
    return orjson.dumps(answer)


def _prefix(name: str) -> bytes:
    """The beginning of a message of topic ``name`` on the wire: its JSON and a brace complete it."""
    return b'{"op":"publish","topic":"%b","msg":' % name.encode()


#: Bytes around a topic's name and a message's JSON.
_AROUND: Final = len(_prefix("")) + 1


def _checked_name(name: str) -> str:
    if len(name) > MAX_NAME or _NAME.fullmatch(name) is None:
        raise _RefusedError(f"{name[:80]!r} cannot be a name: letters, digits, _ and / make one")
    return name


def _is_round(count: int) -> bool:
    """Whether to log it: the 1st, 10th, 100th and so on, so that a flood fills no log."""
    return str(count).strip("0") == "1"


def _text(operation: _Operation, field: str) -> str:
    value = operation.get(field)
    if not isinstance(value, str) or not value:
        raise _RefusedError(f"{operation['op']} needs a string in {field}")
    return value


def _optional_text(operation: _Operation, field: str) -> str | None:
    return None if operation.get(field) is None else _text(operation, field)


def _flag(operation: _Operation, field: str) -> bool:
    value = operation.get(field)
    if value is not None and not isinstance(value, bool):
        raise _RefusedError(f"{field} of {operation['op']} is neither true nor false")
    return bool(value)


def _number(operation: _Operation, field: str) -> float:
    """A number that is not negative, 0 when it is not there.

    The reference server takes integers alone and ignores the whole operation for ``0.0``; no client relies
    on that.
    """
    value = operation.get(field)
    if value is None:
        return 0
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < _HUGE:
        raise _RefusedError(f"{field} of {operation['op']} is no number from 0 up")
    return value


def _operation_id(operation: _Operation) -> OperationId:
    value = operation.get("id")
    if isinstance(value, bool) or not isinstance(value, str | int | None):
        raise _RefusedError(f"id of {operation['op']} is neither a string nor an integer")
    if isinstance(value, str) and len(value) > _LONGEST_ID:
        raise _RefusedError(f"id of {operation['op']} has more than {_LONGEST_ID} characters")
    return value
