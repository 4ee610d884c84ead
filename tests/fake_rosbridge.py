"""A fake rosbridge server for tests: scripted, and able to be silent, late and wrong, to refuse and to vanish.

Its HTTP answers identify it as a fake: `Server: FakeRosbridge, a test double`. It shares no code with `bridge`, and
uses only `websockets` and the standard library's json. It has no message types, so it does not check them.

    async with FakeRosbridge() as fake:
        ...                                  # clients at fake.uri, in this process or in others
        await fake.wait_for_op("subscribe", topic="/boat/sensors")
        await fake.publish("/boat/sensors", {"D1": 5})
        await fake.vanish()                  # every connection is cut, nothing listens
        await fake.come_back()               # on the same port

It behaves as real servers do (A: rosbridge_suite on ROS 1, B: on ROS 2, R: rosbridge-server-rs):

* a subscription without a type, to a topic that nobody has advertised, is forgotten (A, B, R);
* a `throttle_rate` that is not an int ends a subscription (A and B silently, R with a status);
* errors are not reported (A, B), unless `statuses` (R: `{"op": "status", "level": "error", "id": ...}`);
* a client that subscribes to a topic by two ids gets its first message twice (B);
* type names of the ROS 2 form are refused (A), with `ros=1`; rosapi, if present, answers as in that ROS version;
* a subscription made before a best-effort publisher started never hears it (B: `MultiSubscriber.__init__` in
  rosbridge_library/internal/subscribers.py chooses the reliability once), for topics of `start_best_effort`;
* a type with an array of fixed length is never sent as CBOR (A, B: `extract_cbor_values` in
  rosbridge_library/internal/cbor_conversion.py fails on it), for topics in `fails_as_cbor`;
* a topic that `topics_glob` does not allow is neither advertised nor subscribed, which only the server's log reports
  (A, B: rosbridge_library/capabilities/advertise.py), for topics in `refused_topics`.
"""

import asyncio
import contextlib
import itertools
import json
import socket
import time
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from tests.patience import PATIENCE

SERVER = "FakeRosbridge, a test double"


@dataclass(frozen=True)
class Received:
    """One operation that a client sent; `op` is None if it was not a JSON object."""

    op: dict[str, Any] | None
    raw: str


@dataclass(eq=False)
class _Client:
    connection: ServerConnection
    advertised: dict[str, set[Any]] = field(default_factory=dict)
    subscribed: dict[str, dict[Any, dict[str, Any]]] = field(default_factory=dict)
    heard: set[str] = field(default_factory=set)
    services: set[str] = field(default_factory=set)


def _slashed(name):
    return name if isinstance(name, str) and name.startswith("/") else f"/{name}"


@dataclass(eq=False, repr=False, kw_only=True)
class FakeRosbridge:
    """A fake server on a port of this machine.

    Attributes (all may be changed while it runs):
        silent: reads everything and answers pings, but sends nothing else.
        delay: seconds by which everything that it sends is late.
        refuses: an HTTP status with which new connections are refused, None to take them.
        max_size: the largest message that it takes; a larger one ends the connection with 1009.
        received: all that clients sent, in order.
        connections: how many connections were ever made.
    """

    port: int = 0
    ros: int = 2
    rosapi: bool = False
    statuses: bool = False
    silent: bool = False
    delay: float = 0.0
    refuses: int | None = None
    max_size: int | None = None

    def __post_init__(self):
        self.received = []
        self.connections = 0
        self.types = {}
        self.services = {}
        self.fails_as_cbor = set()
        self.refused_topics = set()
        self._best_effort = {}
        self._begun = {}
        self._clients = set()
        self._server = None
        self._place = None
        self._numbers = itertools.count(1)
        self._calls = {}
        self._news = asyncio.Event()
        self._late = set()

    # Coming and going

    @property
    def uri(self):
        return f"ws://127.0.0.1:{self.port}"

    async def __aenter__(self):
        await self.come_back()
        return self

    async def __aexit__(self, *_exception):
        await self.vanish()
        if self._place is not None:
            self._place.close()

    async def come_back(self):
        """Listen, again if it vanished, without any earlier state."""
        assert self._server is None, "it is here already"
        if self._place is None:
            # bound and never listening: while nobody serves there, nobody else is given the port
            self._place = socket.socket()
            self._place.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._place.bind(("127.0.0.1", self.port))
            self.port = self._place.getsockname()[1]
        self.types.clear()
        self._server = await serve(
            self._talk,
            "127.0.0.1",
            self.port,
            compression=None,
            ping_interval=None,
            max_size=self.max_size,
            process_request=self._answer_http,
            server_header=SERVER,
            reuse_address=True,
        )

    async def vanish(self):
        """Cut every connection without a closing handshake, and stop listening."""
        for task in self._late:
            task.cancel()
        server, self._server = self._server, None
        if server is not None:
            server.close(close_connections=False)
        await self.cut()
        if server is not None:
            await asyncio.wait_for(server.wait_closed(), PATIENCE)

    async def cut(self):
        """Cut every connection without a closing handshake, but continue listening."""
        for client in list(self._clients):
            client.connection.transport.abort()
        await self._until(lambda: not self._clients, PATIENCE, "all connections to be gone")

    async def hang_up(self, code=1001):
        """Close every connection with a closing handshake."""
        for client in list(self._clients):
            await client.connection.close(code)

    def freeze(self):
        """Stop reading from the present connections, even pings, as if the Wi-Fi were lost."""
        for client in self._clients:
            client.connection.transport.pause_reading()

    def thaw(self):
        for client in self._clients:
            client.connection.transport.resume_reading()

    async def _answer_http(self, connection, _request):
        if self.refuses is None:
            return None
        return connection.respond(HTTPStatus(self.refuses), "the fake refuses\n")

    # Queries and messages of a test

    def start_best_effort(self, topic, type_name):
        """Begin publishing a topic best-effort: only subscriptions made from now on hear it."""
        self.types[_slashed(topic)] = type_name
        self._best_effort[_slashed(topic)] = time.monotonic()

    def ops(self, op, **fields):
        """Return the received operations of one kind, with the given fields."""
        return [
            received.op
            for received in self.received
            if received.op is not None
            and received.op.get("op") == op
            and all(received.op.get(name) == value for name, value in fields.items())
        ]

    async def wait_for_op(self, op, *, count=1, timeout=PATIENCE, **fields):
        """Wait for a number of operations of one kind, with the given fields, and return the last."""
        await self._until(lambda: len(self.ops(op, **fields)) >= count, timeout, f"{count} {op} {fields}")
        return self.ops(op, **fields)[count - 1]

    async def wait_for_connections(self, count, timeout=PATIENCE):
        """Wait until a number of connections has been made."""
        await self._until(lambda: self.connections >= count, timeout, f"{count} connections")

    async def _until(self, condition, timeout, what):
        try:
            async with asyncio.timeout(timeout):
                while not condition():
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            raise AssertionError(
                f"the fake waited {timeout} s for {what}; it received {[r.raw[:200] for r in self.received]}"
            ) from None

    def know(self, topic, type_name):
        """Register a topic as if a ROS node had advertised it."""
        self.types[_slashed(topic)] = type_name

    async def publish(self, topic, msg):
        """Publish as a ROS node would, and return the number of clients that got it."""
        reached, topic = 0, _slashed(topic)
        for client in list(self._clients):
            times = self._times(client, topic)
            reached += times > 0
            for _ in range(times):
                await self._say(client, {"op": "publish", "topic": topic, "msg": msg})
        return reached

    def serve(self, service, handler):
        """Serve a service: the handler returns the values, or a str to refuse, or None never to answer."""
        self.services[_slashed(service)] = handler

    async def say(self, data):
        """Send any text to every client."""
        for client in list(self._clients):
            await self._say(client, data)

    # The server

    async def _talk(self, connection):
        client = _Client(connection)
        self._clients.add(client)
        self.connections += 1
        self._news.set()
        try:
            with contextlib.suppress(ConnectionClosed):
                async for raw in connection:
                    await self._hear(client, raw if isinstance(raw, str) else raw.decode("utf-8", "replace"))
        finally:
            self._clients.discard(client)
            self._news.set()

    async def _hear(self, client, raw):
        try:
            op = json.loads(raw)
        except ValueError:
            op = None
            reason = "no JSON"
        else:
            reason = "" if isinstance(op, dict) else "no object"
        self.received.append(Received(op if isinstance(op, dict) else None, raw))
        self._news.set()
        if not isinstance(op, dict):
            await self._complain(client, reason)
            return
        method = getattr(self, f"_op_{op.get('op')}", None)
        if method is None:
            await self._complain(client, f"unknown operation {op.get('op')!r}")
        else:
            await method(client, op)

    async def _complain(self, client, reason, **names):
        if self.statuses:
            await self._say(client, {"op": "status", "level": "error", "msg": reason, **names})

    async def _say(self, client, data):
        if isinstance(data, dict):
            data = json.dumps(data)
        if self.delay:
            task = asyncio.create_task(self._say_late(client, data))
            self._late.add(task)
            task.add_done_callback(self._late.discard)
        else:
            await self._send(client, data)

    async def _say_late(self, client, data):
        await asyncio.sleep(self.delay)
        await self._send(client, data)

    async def _send(self, client, data):
        if not self.silent:
            with contextlib.suppress(ConnectionClosed):
                await client.connection.send(data)

    def _is_type(self, type_name):
        parts = type_name.split("/") if isinstance(type_name, str) else []
        return all(parts) and (len(parts) == 2 or (len(parts) == 3 and self.ros == 2))

    async def _op_advertise(self, client, op):
        topic, type_name = _slashed(op.get("topic")), op.get("type")
        if topic in self.refused_topics:
            await self._complain(client, "install the package of its type", id=op.get("id"))
            return
        if not self._is_type(type_name):
            await self._complain(client, f"cannot load type {type_name!r}")
            return
        if _bare(self.types.setdefault(topic, type_name)) != _bare(type_name):
            await self._complain(client, "topic type mismatch")
            return
        client.advertised.setdefault(topic, set()).add(op.get("id"))

    async def _op_unadvertise(self, client, op):
        client.advertised.pop(_slashed(op.get("topic")), None)

    async def _op_publish(self, client, op):
        topic, msg = _slashed(op.get("topic")), op.get("msg")
        if not isinstance(msg, dict):
            await self._complain(client, "no message")
        elif topic not in self.types:
            await self._complain(client, f"{topic} is not advertised")
        else:
            await self.publish(topic, msg)

    def _times(self, client, topic):
        """Return how often a client gets a message: mostly once or never."""
        subscriptions = client.subscribed.get(topic, {})
        if not subscriptions or self._best_effort.get(topic, 0.0) > self._begun[topic]:
            return 0
        if topic in self.fails_as_cbor and any(
            each.get("compression") == "cbor" for each in subscriptions.values()
        ):
            return 0
        first = topic not in client.heard
        client.heard.add(topic)
        return 2 if first and len(subscriptions) > 1 else 1

    async def _op_subscribe(self, client, op):
        topic, type_name = _slashed(op.get("topic")), op.get("type")
        if topic in self.refused_topics:
            return
        if type_name is None and topic not in self.types:
            await self._complain(client, f"type is required: {topic} is not known")
        elif type_name is not None and not self._is_type(type_name):
            await self._complain(client, f"cannot load type {type_name!r}")
        elif type_name is not None and _bare(self.types.get(topic, type_name)) != _bare(type_name):
            await self._complain(client, "topic type mismatch")
        elif any(type(op.get(name, 0)) is not int for name in ("throttle_rate", "queue_length")):
            await self._complain(client, "throttle_rate must be an int")
        else:
            if not any(each.subscribed.get(topic) for each in self._clients):
                self._begun[topic] = time.monotonic()
            client.subscribed.setdefault(topic, {})[op.get("id")] = op

    async def _op_unsubscribe(self, client, op):
        topic = _slashed(op.get("topic"))
        subscriptions = client.subscribed.get(topic, {})
        if op.get("id") is None:
            subscriptions.clear()
        subscriptions.pop(op.get("id"), None)
        client.heard.discard(topic)

    async def _op_advertise_service(self, client, op):
        client.services.add(_slashed(op.get("service")))

    async def _op_unadvertise_service(self, client, op):
        client.services.discard(_slashed(op.get("service")))

    async def _op_call_service(self, client, op):
        service, args = _slashed(op.get("service")), op.get("args") or {}
        handler = self.services.get(service) or (self._rosapi(service) if self.rosapi else None)
        if handler is not None:
            values = handler(args)
            if values is not None:
                await self._respond(client, op, values, ok=not isinstance(values, str))
            return
        for server in self._clients:
            if service in server.services:
                call = f"service_request:{service}:{next(self._numbers)}"
                self._calls[call] = (client, op)
                await self._say(server, {"op": "call_service", "id": call, "service": service, "args": args})
                return
        await self._respond(client, op, f"Service {service} does not exist", ok=False)

    async def _op_service_response(self, client, op):
        """Pass an answer on like the reference server, in rosbridge_library/capabilities/service_response.py.

        `service_response_msg_fields` there requires `result`, and `values` that are an object; an answer without
        them is dropped, so the caller waits. Whatever `result` is, the object becomes the service's response.
        """
        values, result = op.get("values"), op.get("result")
        if not isinstance(values, dict) or not isinstance(result, bool):
            await self._complain(client, "service_response: values is not a dict, or result not a bool")
            return
        caller, call = self._calls.pop(op.get("id") or "", (None, {}))
        if caller is not None:
            await self._respond(caller, call, values, ok=True)

    async def _respond(self, client, call, values, *, ok):
        answer = {"op": "service_response", "service": call.get("service"), "values": values, "result": ok}
        if "id" in call:
            answer["id"] = call["id"]
        await self._say(client, answer)

    # rosapi

    def _rosapi(self, service):
        topics = {**self.types, "/rosout": "rosgraph_msgs/Log" if self.ros == 1 else "rcl_interfaces/msg/Log"}

        def publishers(args):
            topic = _slashed(args.get("topic"))
            published = topic in self._best_effort or any(topic in c.advertised for c in self._clients)
            return {"publishers": ["/fake"] if published else []}

        known = {
            "/rosapi/topics": lambda _args: {"topics": list(topics), "types": list(topics.values())},
            "/rosapi/topic_type": lambda args: {"type": topics.get(_slashed(args.get("topic")), "")},
            "/rosapi/publishers": publishers,
        }
        if self.ros == 2:
            known["/rosapi/get_ros_version"] = lambda _args: {"version": 2, "distro": "fake"}
        return known.get(service)


def _bare(type_name):
    parts = type_name.split("/")
    return parts[0], parts[-1]
