"""The rosbridge server without a socket: messages of clients in, messages for clients out.

Whoever owns sockets and clocks calls `Broker.connect`, `Broker.receive`, `Broker.wake` and
`Broker.disconnect`, then serves the clients that `Broker.take_ready` names from their outboxes. Nothing here
waits, reads the monotonic clock or raises for what a client sends.

What is wrong is refused as the reference server refuses it: not a word to the client, but for who asked for status
messages (``set_level``); a line in the log, and on ``/rosout`` for who listens there. Only calls and goals are
answered, ``result: false`` with a sentence in ``values``. A client is served on, whatever nonsense it sent before.

Messages are not checked against their types; but what goes out is strict JSON, with ``null`` for every NaN and
infinity that came in.
"""

import contextlib
import itertools
import logging
import time
from collections.abc import Callable
from typing import Any, Final

import orjson

from bridge.codecs.fragments import Reassembler
from bridge.codecs.json_codec import could_be_deeper, decode, depth
from bridge.errors import BridgeError
from bridge.hub.delivery.definitions import Definitions, RosVersion
from bridge.hub.delivery.dispatcher import Delivery
from bridge.hub.delivery.outbox import Outbox
from bridge.hub.graph import Client, Graph
from bridge.hub.handlers.actions import Actions
from bridge.hub.handlers.calls import Calls
from bridge.hub.handlers.rosapi import NODE, ROSOUT, Rosapi
from bridge.hub.handlers.topics import Topics
from bridge.hub.limits import HubLimits
from bridge.hub.operations import Operation, RefusedError, is_round, text
from bridge.stamps import stamp

log = logging.getLogger(__name__)

#: Of ``set_level``: which status messages a client wants. All that the hub has to say are errors.
_LEVELS: Final = {"info": True, "warning": True, "error": True, "none": False}
#: ERROR of rosgraph_msgs/Log, and of rcl_interfaces/msg/Log.
_LOG_ERROR: Final = {1: 8, 2: 40}

_Handler = Callable[[Client, Operation, float], None]


class Broker:
    """All clients of one hub, and what they have between them.

    Attributes:
        limits: what it refuses beyond.
        graph: clients, topics, services and actions at the moment.
    """

    def __init__(
        self,
        limits: HubLimits | None = None,
        *,
        ros_version: RosVersion = 1,
        wall_clock: Callable[[], int] = time.time_ns,
    ) -> None:
        """Start with nobody.

        Args:
            limits: what is refused beyond.
            ros_version: which ROS it plays: how types are written, and what rosapi says.
            wall_clock: nanoseconds since 1970, for ``/rosapi/get_time`` and stamps.
        """
        self.limits = limits or HubLimits()
        self.graph = Graph()
        self._wall_clock = wall_clock
        self._ros_version: RosVersion = ros_version
        self._client_numbers = itertools.count(1)
        definitions = Definitions(ros_version)
        rosapi = Rosapi(self.graph, self.limits, definitions, wall_clock)
        self._delivery = Delivery(self.limits)
        self._topics = Topics(self.graph, self.limits, self._delivery, definitions, self._refuse)
        self._actions = Actions(self.graph, self.limits, self._delivery)
        self._calls = Calls(self.graph, self.limits, self._delivery, rosapi, self._actions.cancel_all)
        self._now = 0.0
        self._operation_id: object = None
        self._telling = False
        self._operations: dict[str, _Handler] = {
            "subscribe": self._topics.subscribe,
            "unsubscribe": self._topics.unsubscribe,
            "advertise": self._topics.advertise,
            "unadvertise": self._topics.unadvertise,
            "call_service": self._calls.call,
            "service_response": self._calls.respond,
            "advertise_service": self._calls.advertise,
            "unadvertise_service": self._calls.unadvertise,
            "advertise_action": self._actions.advertise,
            "unadvertise_action": self._actions.unadvertise,
            "send_action_goal": self._actions.send_goal,
            "cancel_action_goal": self._actions.cancel,
            "action_feedback": self._actions.feed_back,
            "action_result": self._actions.end_goal,
            "set_level": self._set_level,
        }

    @property
    def full(self) -> bool:
        """Whether there are as many clients as may be."""
        return len(self.graph.clients) >= self.limits.clients

    @property
    def deadline(self) -> float:
        """When `wake` has something to do (monotonic seconds), infinity for never."""
        return min(self._calls.deadline, self._delivery.deadline)

    def connect(self, address: str) -> Client:
        """Take a client in, from ``address``; ask `full` before."""
        client = Client(next(self._client_numbers), address, Outbox(self.limits.client_bytes))
        self.graph.clients[client.number] = client
        return client

    def disconnect(self, client: Client) -> None:
        """Forget a client. Calls and goals that it has yet to answer fail now. A second time does nothing."""
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
        self._topics.leave(client)
        self._calls.leave(client)
        self._actions.leave(client)
        self._delivery.forget(client)

    def receive(self, client: Client, data: bytes, now: float) -> None:
        """Do what one message of a client asks for.

        Args:
            client: who sent it.
            data: a whole WebSocket message, text or binary, whatever its content.
            now: monotonic seconds.
        """
        self._now, self._operation_id = now, None
        try:
            self._perform(client, data, now, whole=True)
        except (RefusedError, BridgeError) as error:
            self._refuse(client, str(error), self._operation_id, told=client.wants_status)

    def receive_all(self, client: Client, messages: list[bytes], now: float) -> None:
        """Do what messages of a client ask for, one after the other, as `receive` does for one of them.

        Args:
            client: who sent them.
            messages: whole WebSocket messages, each of at most ``limits.message_bytes``.
            now: monotonic seconds.
        """
        self._now, self._operation_id = now, None
        publish_again = self._topics.publish_again
        for data in messages:
            if not publish_again(client, data, now):
                self.receive(client, data, now)

    def _perform(self, client: Client, data: bytes, now: float, *, whole: bool) -> None:
        """Do what a message asks for, which is no fragment unless it came whole."""
        operation: Any = None
        raw: bytes | None = data
        if len(data) <= self.limits.message_bytes:
            try:  # contextlib.suppress would take as long as a small message
                operation = orjson.loads(data)
            except orjson.JSONDecodeError:
                operation = None
        if (
            type(operation) is not dict
        ):  # too large, no object, no JSON, or NaN in it: decode knows, and reads NaN
            operation = decode(data, max_size=self.limits.message_bytes, max_depth=self.limits.depth)
            raw = None
        # No message can be deeper than its opening brackets are many: most need no walk.
        elif (
            could_be_deeper(data, self.limits.depth)
            and depth(operation, self.limits.depth) > self.limits.depth
        ):
            raise RefusedError(f"a message nested deeper than {self.limits.depth} levels")
        name = operation.get("op")
        self._operation_id = operation.get("id")
        if name == "publish":
            self._topics.publish(client, operation, raw, now)
        elif name == "fragment" and whole:
            self._take_fragment(client, operation, now)
        else:
            handler = self._operations.get(name) if isinstance(name, str) else None
            if handler is None:
                raise RefusedError(f"unknown operation {str(name)[:60]!r}")
            handler(client, operation, now)

    def wake(self, now: float) -> None:
        """Do what is due at ``now``: messages whose throttle is over, calls whose time is over."""
        self._delivery.release(now)
        self._calls.expire(now)

    def take_ready(self) -> list[Client]:
        """The clients that have something to be sent, or are doomed, since this was last asked."""
        return self._delivery.take_ready()

    def _take_fragment(self, client: Client, operation: Operation, now: float) -> None:
        if client.fragments is None:
            client.fragments = Reassembler(max_size=self.limits.message_bytes)
        message = client.fragments.take(operation, now)
        if message is not None:
            self._perform(client, message.encode(), now, whole=False)

    def _set_level(self, client: Client, operation: Operation, _now: float) -> None:
        level = text(operation, "level")
        if level not in _LEVELS:
            raise RefusedError(f"{level[:60]!r} is none of the levels {', '.join(_LEVELS)}")
        client.wants_status = _LEVELS[level]

    # --- what is refused

    def _refuse(self, client: Client, why: str, operation_id: object, *, told: bool = True) -> None:
        client.refused += 1
        if is_round(client.refused):
            log.warning("%s of %s: refused (no. %d): %s", client.node, client.address, client.refused, why)
        if told:
            self._delivery.tell(client, "error", why, operation_id, self._now)
        rosout = self.graph.topics.get(ROSOUT)
        # What cannot be told on /rosout itself is not told there.
        if rosout is not None and rosout.subscriptions and not self._telling:
            self._telling = True
            with contextlib.suppress(RefusedError):
                self._topics.distribute(rosout, self._log_message(f"{client.node}: {why}"), None, self._now)
            self._telling = False

    def _log_message(self, sentence: str) -> dict[str, Any]:
        time_ = stamp(self._wall_clock(), self._ros_version)
        message = {
            "level": _LOG_ERROR[self._ros_version],
            "name": NODE,
            "msg": sentence,
            "file": "",
            "function": "",
            "line": 0,
        }
        if self._ros_version == 2:
            return {"stamp": time_, **message}
        return {"header": {"seq": 0, "stamp": time_, "frame_id": ""}, **message, "topics": []}
