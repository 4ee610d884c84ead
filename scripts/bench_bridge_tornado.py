"""A double of the reference server's design, for scripts/bench bridge: Tornado, threads, json for every message.

It is no rosbridge_suite: that needs ROS. It does what costs there and leaves out the rest, which is all in its favour:
no conversion to ROS messages and back, no ROS transport in between, no checks. As in the reference server, a connection
has a queue that a thread of its own empties; the thread parses a message, and writes it anew for every subscriber; what
is written is handed to Tornado's loop, which alone may touch the sockets.

Prints the port it listens at. Runs in an environment with Tornado, so it imports nothing of this project.
"""

from __future__ import annotations

import asyncio
import json
import queue
import threading
from collections import defaultdict
from typing import Any

import tornado.ioloop
import tornado.web
import tornado.websocket

subscribers: dict[str, list[Connection]] = defaultdict(list)
lock = threading.Lock()


class Connection(tornado.websocket.WebSocketHandler):
    """One client: a queue, and the thread that empties it."""

    def open(self, *_args: str) -> None:
        """Start the thread."""
        self.loop = tornado.ioloop.IOLoop.current()
        self.set_nodelay(True)
        self.incoming: queue.Queue[str | bytes | None] = queue.Queue()
        threading.Thread(target=self.work, daemon=True).start()

    def on_message(self, message: str | bytes) -> None:
        """Leave it to the thread."""
        self.incoming.put(message)

    def on_close(self) -> None:
        """Forget the client, and end its thread."""
        with lock:
            for those in subscribers.values():
                if self in those:
                    those.remove(self)
        self.incoming.put(None)

    def check_origin(self, _origin: str) -> bool:
        """Let everybody in."""
        return True

    def work(self) -> None:
        """Do what each message asks for."""
        while (message := self.incoming.get()) is not None:
            self.perform(json.loads(message))

    def perform(self, operation: dict[str, Any]) -> None:
        """Know the two operations that are measured, and answer calls."""
        if operation["op"] == "publish":
            with lock:
                those = list(subscribers[operation["topic"]])
            for each in those:
                each.send({"op": "publish", "topic": operation["topic"], "msg": operation["msg"]})
        elif operation["op"] == "subscribe":
            with lock:
                subscribers[operation["topic"]].append(self)
        elif operation["op"] == "call_service":
            self.send({"op": "service_response", "id": operation.get("id"), "values": {}, "result": True})

    def send(self, operation: dict[str, Any]) -> None:
        """Write it here, have the loop send it."""
        self.loop.add_callback(self.hand_out, json.dumps(operation))

    def hand_out(self, text: str) -> None:
        """Send, in the loop's thread."""
        if self.ws_connection is not None:
            self.write_message(text)


async def main() -> None:
    """Serve at any free port of loopback."""
    server = tornado.web.Application([(r"/.*", Connection)]).listen(0, "127.0.0.1")
    port = next(iter(server._sockets.values())).getsockname()[1]  # noqa: SLF001 - Tornado tells it nowhere else
    print(f"ws://127.0.0.1:{port}", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())
