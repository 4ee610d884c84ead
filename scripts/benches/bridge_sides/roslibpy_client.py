"""roslibpy as a client under measurement, which reads commands of scripts/bench bridge from standard input.

It runs in roslibpy's own environment, so it does not import this project. ROSLIBPY_TRANSPORT selects the transport.
"""

from __future__ import annotations

import json
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import roslibpy

LIMIT = 60
TYPE = "std_msgs/Float64MultiArray"
ACK_EVERY = 50


def publish(ros: roslibpy.Ros, topic: str, values: int, count: int) -> dict[str, Any]:
    """Publish as fast as possible; the last message is marked."""
    publisher = roslibpy.Topic(ros, topic, TYPE)
    message = roslibpy.Message({"data": [(at + 1) / 7.0 for at in range(values)]})
    for _ in range(count):
        publisher.publish(message)
    publisher.publish(roslibpy.Message({"data": [-1.0]}))
    return {}


def receive(ros: roslibpy.Ros, topic: str, count: int, compression: str) -> dict[str, Any]:
    """Receive `count` messages, and acknowledge every `ACK_EVERY`-th one."""
    heard, acks = threading.Event(), roslibpy.Topic(ros, topic + "/heard", TYPE)
    seen = [0, 0.0]

    def on_message(message: Any) -> None:
        seen[0] += 1
        seen[1] += message["data"][-1]
        if seen[0] % ACK_EVERY == 0:
            acks.publish(roslibpy.Message({"data": [seen[0]]}))
        if seen[0] == count:
            heard.set()

    roslibpy.Topic(ros, topic, TYPE, queue_length=1000, compression=compression).subscribe(on_message)
    ros.get_time()
    print_answer({"ready": True})
    if not heard.wait(LIMIT):
        raise TimeoutError(f"{seen[0]} of {count} messages came")
    return {"sum": seen[1]}


def round_trip(ros: roslibpy.Ros, topic: str, values: int, count: int, compression: str) -> dict[str, Any]:
    """Publish and receive one message after the other, and return the microseconds of each."""
    back: queue.SimpleQueue[Any] = queue.SimpleQueue()
    publisher = roslibpy.Topic(ros, topic, TYPE)
    listener = roslibpy.Topic(ros, topic, TYPE, compression=compression)
    publisher.advertise()
    listener.subscribe(back.put)
    ros.get_time()
    data, times = [(at + 1) / 7.0 for at in range(values)], []
    for _ in range(count):
        started = time.perf_counter_ns()
        publisher.publish(roslibpy.Message({"data": data}))
        back.get(timeout=LIMIT)
        times.append((time.perf_counter_ns() - started) / 1e3)
    listener.unsubscribe()
    publisher.unadvertise()
    return {"us": times}


COMMANDS: dict[str, Callable[..., dict[str, Any]]]
COMMANDS = {"publish": publish, "receive": receive, "round_trip": round_trip}


def print_answer(answer: dict[str, Any]) -> None:
    """Print one line of JSON."""
    print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    host, port = sys.argv[1].removeprefix("ws://").split(":")
    ros = roslibpy.Ros(host, int(port))
    ros.run(LIMIT)
    print_answer({"connected": True})
    for line in sys.stdin:
        command, cpu = json.loads(line), time.process_time()
        answer = COMMANDS[command.pop("do")](ros, **command)
        print_answer(answer | {"cpu_s": time.process_time() - cpu})
    ros.terminate()
