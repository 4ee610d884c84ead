"""An echo, whose cycle is the shortest possible: it answers every reading at once with a message of a result's size."""

import asyncio
import sys

import uvloop

from bridge.client import connect


async def echo(uri: str, lines: int) -> None:
    """Answer each reading on /bench/echo with the same message, until the process is ended."""
    answer = {
        "layout": {"dim": [{"label": "line", "size": lines, "stride": lines}], "data_offset": 0},
        "data": [(at + 0.5) * 2 / lines**2 for at in range(lines)],
    }
    async with connect(uri) as ros:
        publication = await ros.advertise("/bench/echo", "std_msgs/Float64MultiArray")
        subscription = ros.subscribe("/bench/reading", "boat_msgs/Sensors")
        print("listening", flush=True)
        async for _ in subscription:
            await publication.publish(answer)


if __name__ == "__main__":
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(echo(sys.argv[1], int(sys.argv[2])))
