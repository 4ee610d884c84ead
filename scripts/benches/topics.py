"""The cycle with and without the topics for robot tools, measured alternately; each round starts new stacks."""

import argparse
import contextlib
import os
import statistics
from typing import Final

from bridge.client import connect
from scripts.benches.cycle import Measured, in_turns, readings
from scripts.running.flags import ScriptParser
from scripts.running.stand import temporary_stand
from toolchain.deployment import TopicsSection

OFF: Final = "\n[topics]\n" + "".join(f"{key} = false\n" for key in TopicsSection.model_fields)
LIMIT: Final = 24 * 3600.0
"""Time limit of the bench in seconds, long enough for any number of rounds."""
TOPICS: Final = ("/bm/counts", "/bm/posterior", "/bm/pose", "/bm/decision", "/diagnostics")


async def measure(some: list[dict[str, int]]) -> float:
    """Print the median cycle times with and without the topics for robot tools, and return their ratio.

    A client reads the topics.
    """
    async with contextlib.AsyncExitStack() as stack:
        sides = []
        for extra in ("", OFF):
            stand = await stack.enter_async_context(temporary_stand())
            await stand.start_hub()
            await stand.start_boat_master(extra=extra)
            tool, robot = [await stack.enter_async_context(connect(stand.uri)) for _ in range(2)]
            sides.append(await Measured.of_stack(robot))
            if not extra:
                heard = [tool.subscribe(topic) for topic in TOPICS]
            await tool.call("/rosapi/get_time")  # so that the hub knows the subscriptions
        on, off, ratio = await in_turns(sides, some)
        for each in heard:
            await each.next(timeout=30)
    print(f"cycle with the topics / without, us: {on:,.0f} / {off:,.0f}, {ratio:.3f}")
    return ratio


async def bench(arguments: argparse.Namespace) -> int:
    """Measure in several rounds, and print the median of the rounds' ratios."""
    rounds = range(arguments.rounds)
    ratios = [await measure(readings(seed, arguments.frames)) for seed in rounds]
    spread = f"{statistics.median(ratios):.3f} ({min(ratios):.3f} to {max(ratios):.3f})"
    print(f"median ratio {spread}, aim: at most 1.03; {len(os.sched_getaffinity(0))} cores")
    return 0


if __name__ == "__main__":
    parser = ScriptParser("scripts/bench topics", __doc__)
    parser.flag("--rounds", "number of rounds", 5)
    parser.flag("--frames", "number of readings in each round", 1000)
    parser.run(bench, LIMIT)
