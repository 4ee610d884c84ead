"""This project's client under measurement, which reads commands of scripts/bench bridge from standard input."""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import uvloop

from bridge.client import Ros, connect

LIMIT = 60
TYPE = "std_msgs/Float64MultiArray"
ACK_EVERY = 50


def message_of(count: int) -> dict[str, Any]:
    """Return a message of `count` fractions, in an array if they are more than 16, otherwise in a list."""
    values = (np.arange(count) + 1) / 7.0
    return {"data": values if count > 16 else values.tolist()}


async def publish(ros: Ros, topic: str, values: int, count: int) -> dict[str, Any]:
    """Publish as fast as possible; the last message is marked."""
    publisher = await ros.advertise(topic, TYPE)
    message = message_of(values)
    for _ in range(count):
        await publisher.publish(message)
    await publisher.publish({"data": [-1.0]})
    return {}


async def receive(ros: Ros, topic: str, count: int, compression: Any) -> dict[str, Any]:
    """Receive `count` messages, and acknowledge every `ACK_EVERY`-th one."""
    acks = await ros.advertise(topic + "/heard", TYPE)
    arrays: Any = "numpy" if compression == "cbor" else "list"
    listener = ros.subscribe(
        topic, TYPE, queue_length=1000, queue_size=1000, compression=compression, arrays=arrays
    )
    await ros.call("/rosapi/get_time")
    print_answer({"ready": True})
    total, seen = 0.0, 0
    async with asyncio.timeout(LIMIT):
        async for message in listener:
            total += message.msg["data"][-1]
            seen += 1
            if seen % ACK_EVERY == 0:
                await acks.publish({"data": [seen]})
            if seen == count:
                break
    return {"sum": float(total)}


async def round_trip(ros: Ros, topic: str, values: int, count: int, compression: Any) -> dict[str, Any]:
    """Publish and receive one message after the other, and return the microseconds of each."""
    publisher = await ros.advertise(topic, TYPE)
    arrays: Any = "numpy" if compression == "cbor" else "list"
    listener = ros.subscribe(topic, TYPE, compression=compression, arrays=arrays)
    await ros.call("/rosapi/get_time")
    message, times = message_of(values), []
    for _ in range(count):
        started = time.perf_counter_ns()
        await publisher.publish(message)
        await listener.next(LIMIT)
        times.append((time.perf_counter_ns() - started) / 1e3)
    await listener.close()
    await publisher.close()
    return {"us": times}


def print_answer(answer: dict[str, Any]) -> None:
    """Print one line of JSON."""
    print(json.dumps(answer), flush=True)


async def main() -> None:
    """Execute the command in each line until end of file."""
    do: dict[str, Callable[..., Awaitable[dict[str, Any]]]]
    do = {"publish": publish, "receive": receive, "round_trip": round_trip}
    lines = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    async with connect(sys.argv[1]) as ros:
        print_answer({"connected": True})
        while line := await lines.readline():
            command, cpu = json.loads(line), time.process_time()
            answer = await do[command.pop("do")](ros, **command)
            print_answer(answer | {"cpu_s": time.process_time() - cpu})


if __name__ == "__main__":
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(main())
