"""A simulated garden instead of a robot. Rain, sprinkler and grass of each morning are drawn from the model."""

import asyncio
import random
import time
from collections.abc import Iterator
from itertools import islice
from typing import Annotated

import typer

from casestudies import DEFAULT_URI, Seed, Uri
from casestudies.sprinkler.model import GRASS_TOPIC, ON, RAIN, TYPE, WET
from terminal.command_line import CommandLine
from terminal.output import say
from terminal.signals import run_async


def mornings(seed: int) -> Iterator[tuple[int, int, int]]:
    """Yield R, S and G of one morning after another, drawn from the model. Equal seeds give equal mornings."""
    draw = random.Random(seed).random
    while True:
        r = int(draw() < RAIN)
        s = int(draw() < ON[r])
        yield r, s, int(draw() < WET[s][r])


async def publish_mornings(uri: str, *, seed: int, rate: float, count: int | None = None) -> None:
    """Publish whether the grass is wet, for `count` mornings, or until cancelled if `count` is None.

    Raises a BridgeError if no server answers at the URI.
    """
    from casestudies.topics import LossyPublication, connected

    async with connected("sprinkler-garden", "the grass was published", uri) as (ros, readiness):
        grass = LossyPublication(await ros.advertise(GRASS_TOPIC, TYPE))
        begin = time.monotonic()
        for step, (*_, wet) in enumerate(islice(mornings(seed), count), start=1):
            if await grass.publish({"data": wet}):
                readiness.record()
            await asyncio.sleep(begin + step / rate - time.monotonic())


app = CommandLine()


@app.command(epilog="`sprinkler-garden --uri ws://127.0.0.1:9090 --seed 7 --rate 10`")
def sprinkler_garden(
    seed: Seed,
    uri: Uri = DEFAULT_URI,
    rate: Annotated[float, typer.Option(min=0.01, max=10_000, help="Mornings per second.")] = 10.0,
    count: Annotated[int | None, typer.Option(min=1, help="Exit after this many mornings.")] = None,
) -> int:
    """Publish whether the grass is wet, morning after morning."""
    say(f"sprinkler-garden: seed {seed}, {rate:g} mornings a second on {GRASS_TOPIC}, {uri}")
    return run_async(publish_mornings(uri, seed=seed, rate=rate, count=count))


if __name__ == "__main__":
    app()
