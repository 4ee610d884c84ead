"""Simulated stereo cameras. They publish rendered pairs of images on two topics, and the true disparity on a third."""

import asyncio
import time
from itertools import count as numbers
from typing import Annotated

import numpy as np
import typer

from casestudies import DEFAULT_URI, Seed, Uri
from casestudies.disparity.images import IMAGE_TYPE, image_message
from casestudies.disparity.model import LEFT_TOPIC, RIGHT_TOPIC, TRUTH_TOPIC
from casestudies.disparity.scene import Scene
from terminal.command_line import CommandLine
from terminal.output import say
from terminal.signals import run_async


async def publish_pairs(
    uri: str, *, seed: int, rate: float, width: int, height: int, count: int | None = None
) -> None:
    """Publish `count` pairs, or endlessly if `count` is None. Raises a BridgeError if no server answers."""
    from bridge.stamps import header
    from casestudies.topics import LossyPublication, connected

    async with connected("disparity-cameras", "a pair was published", uri) as (ros, readiness):
        version = await ros.detect_ros_version()
        left, right, truth = [
            LossyPublication(await ros.advertise(topic, IMAGE_TYPE))
            for topic in (LEFT_TOPIC, RIGHT_TOPIC, TRUTH_TOPIC)
        ]
        scene = Scene(seed)
        begin = time.monotonic()
        for number in numbers() if count is None else range(count):
            # in a thread: a large one takes seconds
            pair = await asyncio.to_thread(scene.pair, number, width, height)
            head = header(time.time_ns(), "left_camera", version)
            seen = np.where(pair.occluded, np.nan, pair.disparity)
            await truth.publish(image_message(seen, head, "32FC1"))  # first, for who waits for the pair
            await left.publish(image_message(pair.left, head, "mono8"))
            if await right.publish(image_message(pair.right, head, "mono8")):
                readiness.record()
            await asyncio.sleep(begin + (number + 1) / rate - time.monotonic())


app = CommandLine()


@app.command(epilog="`disparity-cameras --uri ws://127.0.0.1:9090 --seed 7 --rate 2`")
def disparity_cameras(
    seed: Seed,
    uri: Uri = DEFAULT_URI,
    rate: Annotated[float, typer.Option(min=0.01, max=1000, help="Pairs per second.")] = 2.0,
    width: Annotated[int, typer.Option(min=16, max=1024, help="Pixels across.")] = 160,
    height: Annotated[int, typer.Option(min=16, max=1024, help="Pixels down.")] = 120,
    count: Annotated[int | None, typer.Option(min=1, help="Exit after this many pairs.")] = None,
) -> int:
    """Publish stereo pairs of a simulated scene, and the true disparity."""
    say(f"disparity-cameras: seed {seed}, {rate:g} pairs of {width} x {height} pixels a second, {uri}")
    return run_async(publish_pairs(uri, seed=seed, rate=rate, width=width, height=height, count=count))


if __name__ == "__main__":
    app()
