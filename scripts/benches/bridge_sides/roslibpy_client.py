"""roslibpy as a client under measurement: commands of scripts/bench bridge on standard input, answers on standard output.

Runs in roslibpy's own environment, so it imports nothing of this project. Transport: ROSLIBPY_TRANSPORT.
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

PATIENCE = 60
TYPE = "std_msgs/Float64MultiArray"
ACK_EVERY = 50


def values_of(count: int) -> list[float]:
    """Numbers as sensors have them, all digits used."""
    return [(at + 1) / 7.0 for at in range(count)]


def publish(ros: roslibpy.Ros, topic: str, values: int, count: int) -> dict[str, Any]:
    """Publish as fast as it goes; the last message says so."""
    publisher = roslibpy.Topic(ros, topic, TYPE)
    message = roslibpy.Message({"data": values_of(values)})
    for _ in range(count):
        publisher.publish(message)
    publisher.publish(roslibpy.Message({"data": [-1.0]}))
    return {}


def receive(ros: roslibpy.Ros, topic: str, count: int, compression: str) -> dict[str, Any]:
    """Hear so many messages; every now and then say how many there were."""
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
    tell("ready")
    if not heard.wait(PATIENCE):
        raise TimeoutError(f"{seen[0]} of {count} messages came")
    return {"sum": seen[1]}


def round_trip(ros: roslibpy.Ros, topic: str, values: int, count: int, compression: str) -> dict[str, Any]:
    """Publish a message and hear it again, one after the other; microseconds of each."""
    back: queue.SimpleQueue[Any] = queue.SimpleQueue()
    publisher = roslibpy.Topic(ros, topic, TYPE)
    listener = roslibpy.Topic(ros, topic, TYPE, compression=compression)
    publisher.advertise()
    listener.subscribe(back.put)
    ros.get_time()
    data, times = values_of(values), []
    for _ in range(count):
        started = time.perf_counter_ns()
        publisher.publish(roslibpy.Message({"data": data}))
        back.get(timeout=PATIENCE)
        times.append((time.perf_counter_ns() - started) / 1e3)
    listener.unsubscribe()
    publisher.unadvertise()
    return {"us": times}


def tell(answer: object) -> None:
    """One line of JSON."""
    print(json.dumps(answer), flush=True)


def main() -> None:
    """Do what each line says until there is none."""
    host, port = sys.argv[1].removeprefix("ws://").split(":")
    ros = roslibpy.Ros(host, int(port))
    ros.run(PATIENCE)
    tell("connected")
    do: dict[str, Callable[..., dict[str, Any]]] = {
        "publish": publish,
        "receive": receive,
        "round_trip": round_trip,
    }
    for line in sys.stdin:
        command, cpu = json.loads(line), time.process_time()
        answer = do[command.pop("do")](ros, **command)
        tell(answer | {"cpu_s": time.process_time() - cpu})
    ros.terminate()


if __name__ == "__main__":
    main()
