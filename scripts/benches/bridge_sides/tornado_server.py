"""A model of the reference server rosbridge_suite, for scripts/bench bridge: Tornado, threads, message classes.

rosbridge_suite needs ROS, but this model does not. The model does the work of rosbridge_suite for one message type:

- Tornado reads the message. A queue passes the message to the connection's thread.
- The connection's thread parses the message, checks every field against its type, and fills a message object.
- The message object is serialised and sent through a socket, as between ROS nodes.
- The subscription's thread reads the bytes, creates a message object, and writes the values as JSON.
- The JSON text is passed to Tornado's loop, because only the loop may use the connections.

The model omits all other work of rosbridge_suite, so it is faster than rosbridge_suite.

The program prints the URI of the server. It runs in an environment with Tornado, so it does not import this project.
"""

from __future__ import annotations

import asyncio
import json
import queue
import socket
import struct
import threading
from collections import defaultdict
from typing import Any

import tornado.httpserver
import tornado.ioloop
import tornado.netutil
import tornado.web
import tornado.websocket

FIELDS = {
    "Dimension": {"label": "string", "size": "uint32", "stride": "uint32"},
    "Layout": {"dim": "Dimension[]", "data_offset": "uint32"},
    "Float64MultiArray": {"layout": "Layout", "data": "float64[]"},
}
PYTHON_TYPES = {"string": (str,), "uint32": (int,), "float64": (int, float)}


class Message:
    """A ROS message with an attribute for each field, initially its default."""

    layout: Message
    data: list[float]
    data_offset: int

    def __init__(self, kind: str) -> None:
        self.fields = FIELDS[kind]
        for name, of in self.fields.items():
            default: Any = [] if of.endswith("[]") else "" if of == "string" else 0
            setattr(self, name, Message(of) if of in FIELDS else default)


def filled(message: Message, values: dict[str, Any]) -> Message:
    """Return a message filled from JSON, or raise an error for a value that does not fit its type."""
    for name, value in values.items():
        setattr(message, name, fitting(message.fields[name], value))
    return message


def fitting(kind: str, value: Any) -> Any:
    """Return a value converted to a field's type."""
    if kind.endswith("[]"):
        return [fitting(kind[:-2], item) for item in value]
    if kind in FIELDS:
        return filled(Message(kind), value)
    if not isinstance(value, PYTHON_TYPES[kind]):
        raise TypeError(kind)
    return value


def taken_out(value: Any) -> Any:
    """Return a message as plain dictionaries and lists, for JSON."""
    if isinstance(value, Message):
        return {name: taken_out(getattr(value, name)) for name in value.fields}
    return [taken_out(item) for item in value] if isinstance(value, list) else value


subscribers: dict[str, list[socket.socket]] = defaultdict(list)
lock = threading.Lock()


class Connection(tornado.websocket.WebSocketHandler):
    """One client: a queue, the thread that empties it, and a thread for each of its subscriptions."""

    def open(self, *_args: str) -> None:
        """Start the thread."""
        self.loop = tornado.ioloop.IOLoop.current()
        self.set_nodelay(True)
        self.incoming: queue.Queue[str | bytes | None] = queue.Queue()
        threading.Thread(target=self.work, daemon=True).start()

    def on_message(self, message: str | bytes) -> None:
        """Queue the message for the thread."""
        self.incoming.put(message)

    def on_close(self) -> None:
        """End the thread."""
        self.incoming.put(None)

    def check_origin(self, _origin: str) -> bool:
        """Accept every origin."""
        return True

    def work(self) -> None:
        """Perform the operations in the queue, as far as measurements use them."""
        while (text := self.incoming.get()) is not None:
            operation = json.loads(text)
            if operation["op"] == "publish":
                message = filled(Message("Float64MultiArray"), operation["msg"])
                count = len(message.data)  # as ROS 1 sends it, without dimensions
                body = struct.pack(f"<III{count}d", 0, message.layout.data_offset, count, *message.data)
                with lock:
                    those = list(subscribers[operation["topic"]])
                for each in those:
                    each.sendall(struct.pack("<I", len(body)) + body)
            elif operation["op"] == "subscribe":
                mine, theirs = socket.socketpair()
                with lock:
                    subscribers[operation["topic"]].append(theirs)
                threading.Thread(target=self.listen, args=(mine, operation["topic"]), daemon=True).start()
            elif operation["op"] == "call_service":
                self.send({"op": "service_response", "id": operation.get("id"), "values": {}, "result": True})

    def listen(self, source: socket.socket, topic: str) -> None:
        """Forward the messages of a topic."""
        reader = source.makefile("rb")
        while size := reader.read(4):
            body, message = reader.read(struct.unpack("<I", size)[0]), Message("Float64MultiArray")
            _, message.layout.data_offset, count = struct.unpack_from("<III", body)
            message.data = list(struct.unpack_from(f"<{count}d", body, 12))
            self.send({"op": "publish", "topic": topic, "msg": taken_out(message)})

    def send(self, operation: dict[str, Any]) -> None:
        """Encode an operation in this thread, and let the loop send it."""
        self.loop.add_callback(self.hand_out, json.dumps(operation))

    def hand_out(self, text: str) -> None:
        """Send an encoded operation to the client; called in the loop's thread."""
        if self.ws_connection is not None:
            self.write_message(text)


async def main() -> None:
    """Serve on a free port of loopback."""
    sockets = tornado.netutil.bind_sockets(0, "127.0.0.1")
    server = tornado.httpserver.HTTPServer(tornado.web.Application([(r"/.*", Connection)]))
    server.add_sockets(sockets)
    print(f"ws://127.0.0.1:{sockets[0].getsockname()[1]}", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())
