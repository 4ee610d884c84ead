"""The rosbridge server without sockets. It turns the messages of clients into messages for clients.

The owner of sockets and clocks calls `Broker.connect`, `Broker.receive_turn`, `Broker.wake` and
`Broker.disconnect`. After each call, the owner drains the outboxes of the clients that `Broker.take_ready`
returns. The broker never waits, never reads the monotonic clock, and never raises because of data from a client.

The broker refuses invalid operations as the reference server (rosbridge_suite) does. It writes a line to the log
and to `/rosout`, and the client stays connected. Only refused calls and goals are answered, with `result: false`
and a sentence in `values`. For other refused operations, the client gets a status message if it has requested
status messages (`set_level`).

The broker does not check messages against their types. All JSON sent is strict: `null` replaces every NaN and
infinity received.
"""

import contextlib
import itertools
import logging
import time
from collections.abc import Callable
from math import inf
from typing import Any, Final

import orjson

from bridge.codecs.fragments import Reassembler
from bridge.codecs.json_codec import decode, is_deeper
from bridge.errors import BridgeError
from bridge.hub.calls_and_goals import Actions, Calls
from bridge.hub.definitions import MessageDefinitions
from bridge.hub.dispatcher import Dispatcher
from bridge.hub.graph import Client, Graph
from bridge.hub.limits import HubLimits, Operation, RefusedOperationError, is_logged, text
from bridge.hub.outbox import Outbox
from bridge.hub.rosapi import NODE, ROSOUT, Rosapi
from bridge.hub.topics import TURN_WORK, Topics
from bridge.names import RosVersion
from bridge.stamps import stamp

log = logging.getLogger(__name__)

_OPERATION_WORK: Final = 20
# Levels of `set_level`, and whether they include the hub's status messages, which are all errors.
_LEVELS: Final = {"info": True, "warning": True, "error": True, "none": False}
# ERROR of rosgraph_msgs/Log, and of rcl_interfaces/msg/Log.
_LOG_ERROR: Final = {1: 8, 2: 40}

_Handler = Callable[[Client, Operation, float], None]


class Broker:
    """The clients of one hub, and the topics, services and actions that connect them."""

    def __init__(
        self,
        limits: HubLimits | None = None,
        *,
        ros_version: RosVersion = 1,
        wall_clock: Callable[[], int] = time.time_ns,
    ) -> None:
        """Start without clients. `wall_clock` returns nanoseconds since 1970, for `/rosapi/get_time` and stamps."""
        self.limits = limits or HubLimits()
        self.graph = Graph()
        self.definitions = MessageDefinitions(ros_version, wall_clock)
        self._wall_clock = wall_clock
        rosapi = Rosapi(self.graph, self.limits, self.definitions, wall_clock)
        self._dispatcher = Dispatcher(self.limits)
        self.take_ready = self._dispatcher.take_ready
        """Returns the clients marked as ready since the last call. Each client has output, or must be closed."""
        self._topics = Topics(self.graph, self.limits, self._dispatcher, self.definitions, self._refuse)
        self._actions = Actions(self.graph, self.limits, self._dispatcher, self.definitions)
        self._calls = Calls(
            self.graph, self.limits, self._dispatcher, self.definitions, rosapi, self._actions.cancel_all
        )
        # Clients are numbered in the order of connection; a number is not used again.
        self._client_numbers = itertools.count(1)
        # The incomplete messages of each client that has some, and when the first expires, or earlier.
        self._reassembling: dict[Client, Reassembler] = {}
        self._fragment_deadline = inf
        # Time and id of the operation that is being performed, for a refusal anywhere below.
        self._now = 0.0
        self._operation_id: object = None
        # True while a refusal is published on /rosout: if that is refused too, it must not be published again.
        self._logging_to_rosout = False
        self._operations: dict[str, _Handler] = {
            "subscribe": self._topics.subscribe,
            "unsubscribe": self._topics.unsubscribe,
            "advertise": self._topics.advertise,
            "unadvertise": self._topics.unadvertise,
            "call_service": self._calls.ask,
            "service_response": self._calls.respond,
            "advertise_service": self._calls.advertise,
            "unadvertise_service": self._calls.unadvertise,
            "advertise_action": self._actions.advertise,
            "unadvertise_action": self._actions.unadvertise,
            "send_action_goal": self._actions.ask,
            "cancel_action_goal": self._actions.cancel,
            "action_feedback": self._actions.feed_back,
            "action_result": self._actions.end_goal,
            "set_level": self._set_level,
        }

    @property
    def full(self) -> bool:
        """True if the maximum number of clients is connected."""
        return len(self.graph.clients) >= self.limits.clients

    @property
    def deadline(self) -> float:
        """Time at which to call `wake` next, in monotonic seconds. Infinity means never."""
        return self._dispatcher.deadline

    def connect(self, address: str) -> Client:
        """Admit a client from `address`. The caller must first check that the hub is not `full`."""
        client = Client(
            next(self._client_numbers), address, Outbox(self.limits.client_bytes, self.limits.message_bytes)
        )
        self.graph.clients[client.number] = client
        return client

    def disconnect(self, client: Client) -> None:
        """Remove a client, and fail the calls and goals that it has not answered. Ignore a client already removed."""
        if self.graph.clients.pop(client.number, None) is None:
            return
        dropped = sum(subscription.lane.dropped for subscription in client.subscriptions.values())
        if dropped or client.refused:
            log.info(
                "%s of %s left: %d of its operations were refused, %d messages dropped because it was too slow",
                client.node,
                client.address,
                client.refused,
                dropped,
            )
        self._topics.leave(client)
        self._calls.leave(client)
        self._actions.leave(client)
        self._dispatcher.throttled.discard(client)
        self._reassembling.pop(client, None)

    def receive(self, client: Client, data: bytes, now: float) -> None:
        """Perform the operation in a whole WebSocket message, text or binary. An invalid operation is refused."""
        self._now, self._operation_id = now, None
        self._dispatcher.work += _OPERATION_WORK + (len(data) >> 7)
        try:
            self._perform(client, data, now, is_whole=True)
        except BridgeError as error:
            self._refuse(client, str(error), self._operation_id, with_status=client.wants_status)

    def receive_turn(self, client: Client, messages: list[bytes], now: float) -> int:
        """Perform a client's messages in order until their work exceeds `TURN_WORK`.

        Each message must have at most `limits.message_bytes` bytes. Returns the number of messages performed. Call the
        method again with the remaining messages. If the client's outbox is congested, first wait until the client has
        read its answers.
        """
        self._now, self._operation_id = now, None
        dispatcher, outbox = self._dispatcher, client.outbox
        dispatcher.work = number = 0
        while number < len(messages):
            # The client must read first: each operation may cause an answer, which cannot be dropped.
            if outbox.undroppable and outbox.congested:
                break
            number = self._topics.publish_known(client, messages, number, now)
            if number == len(messages) or dispatcher.work > TURN_WORK:
                break
            self.receive(client, messages[number], now)
            number += 1
        return number

    def _perform(self, client: Client, data: bytes, now: float, *, is_whole: bool) -> None:
        """Perform the operation in a message; a reassembled message (`is_whole` is False) must not be a fragment."""
        operation: Any = None
        raw: bytes | None = data
        if len(data) <= self.limits.message_bytes:
            try:  # contextlib.suppress would take as long as a small message
                operation = orjson.loads(data)
            except orjson.JSONDecodeError:
                operation = None
        # Most messages are strict JSON; only the others pay for the lenient attempt.
        if type(operation) is not dict:  # `decode` accepts NaN, and raises for everything else
            operation = decode(data, max_size=self.limits.message_bytes, max_depth=self.limits.depth)
            raw = None
        elif is_deeper(data, self.limits.depth):
            raise RefusedOperationError(f"a message is nested deeper than {self.limits.depth} levels")
        name = operation.get("op")
        self._operation_id = operation.get("id")
        if name == "publish":
            self._topics.publish(client, operation, raw, now)
        elif name == "fragment" and is_whole:
            self._take_fragment(client, operation, now)
        else:
            handler = self._operations.get(name) if isinstance(name, str) else None
            if handler is None:
                raise RefusedOperationError(f"unknown operation {str(name)[:60]!r}")
            handler(client, operation, now)

    def wake(self, now: float) -> None:
        """Release messages that throttles admit at `now`, fail expired calls, and drop expired incomplete messages."""
        throttle_deadline = self._dispatcher.release(now)
        self._calls.expire(now)
        if now >= self._fragment_deadline:
            for client, fragments in list(self._reassembling.items()):
                fragments.expire(now)
                self._note_fragments(client, fragments)
            self._fragment_deadline = min(
                (each.deadline for each in self._reassembling.values()), default=inf
            )
        self._dispatcher.deadline = min(throttle_deadline, self._calls.deadline, self._fragment_deadline)

    def _take_fragment(self, client: Client, operation: Operation, now: float) -> None:
        if client.fragments is None:
            client.fragments = Reassembler(max_size=self.limits.message_bytes)
        try:
            message = client.fragments.take(operation, now)
        finally:
            self._note_fragments(client, client.fragments)
        if message is not None:
            self._perform(client, message, now, is_whole=False)

    def _note_fragments(self, client: Client, fragments: Reassembler) -> None:
        """Schedule the expiry of a client's incomplete messages."""
        if fragments:
            self._reassembling[client] = fragments
            self._fragment_deadline = min(self._fragment_deadline, fragments.deadline)
            self._dispatcher.schedule(self._fragment_deadline)
        else:
            self._reassembling.pop(client, None)

    def _set_level(self, client: Client, operation: Operation, _now: float) -> None:
        level = text(operation, "level")
        if level not in _LEVELS:
            raise RefusedOperationError(f"level {level[:60]!r} is not one of {', '.join(_LEVELS)}")
        client.wants_status = _LEVELS[level]

    # --- refusals

    def _refuse(self, client: Client, why: str, operation_id: object, *, with_status: bool = True) -> None:
        client.refused += 1
        if is_logged(client.refused):
            log.warning("%s of %s: refused (no. %d): %s", client.node, client.address, client.refused, why)
        if with_status:
            self._dispatcher.send_status(client, why, operation_id, self._now)
        # The reference server's refusals appear on /rosout, where ROS users look for them.
        rosout = self.graph.topics.get(ROSOUT)
        # A refusal on /rosout itself is not reported there.
        if rosout is not None and rosout.subscriptions and not self._logging_to_rosout:
            self._logging_to_rosout = True
            with contextlib.suppress(RefusedOperationError):
                self._topics.distribute(rosout, self._log_message(f"{client.node}: {why}"), self._now)
            self._logging_to_rosout = False

    def _log_message(self, sentence: str) -> dict[str, Any]:
        ros_version = self.definitions.ros_version
        time_ = stamp(self._wall_clock(), ros_version)
        message = {
            "level": _LOG_ERROR[ros_version],
            "name": NODE,
            "msg": sentence,
            "file": "",
            "function": "",
            "line": 0,
        }
        if ros_version == 2:
            return {"stamp": time_, **message}
        return {"header": {"seq": 0, "stamp": time_, "frame_id": ""}, **message, "topics": []}
