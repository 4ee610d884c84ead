"""The cycle with and without the topics for robot tools, measured alternately; each round starts new stacks."""

from __future__ import annotations

import argparse
import contextlib
import os
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Final

from bridge.client import connect
from casestudies.boat.sensors import SENSORS_TOPIC, SENSORS_TYPE
from posteriors.posterior import RESULTS_TOPIC, RESULTS_TYPE
from scripts.benches.cycle import TURN, Measured, readings, until_read
from scripts.running.browser import Stand
from scripts.running.flags import ScriptParser
from scripts.running.script import run_script
from toolchain.deployment import Topics

OFF: Final = "\n[topics]\n" + "".join(f"{key} = false\n" for key in Topics.model_fields)
TOPICS: Final = ("/bm/counts", "/bm/posterior", "/bm/pose", "/bm/decision", "/diagnostics")


async def measure(folder: Path, some: list[dict[str, int]]) -> float:
    """Print the median cycle times with the topics, which a second client reads, and without; return their ratio."""
    async with contextlib.AsyncExitStack() as stack:
        sides = []
        for name, extra in (("on", ""), ("off", OFF)):
            stand = Stand(folder / name)
            stack.push_async_callback(stand.end)
            await stand.start_hub()
            await stand.start_master(extra)
            tool, robot = [await stack.enter_async_context(connect(stand.uri)) for _ in range(2)]
            results = robot.subscribe(RESULTS_TOPIC, RESULTS_TYPE)
            sides.append(Measured(await robot.advertise(SENSORS_TOPIC, SENSORS_TYPE), results, 0))
            await until_read(robot, SENSORS_TOPIC)
            heard = [tool.subscribe(topic) for topic in TOPICS if not extra]
            await tool.call("/rosapi/get_time")  # so that the hub knows the subscriptions
            await sides[-1].one_by_one(some[:TURN])
            sides[-1].times.clear()  # that was the warm-up
            for each in heard:
                await each.next(timeout=30)
        for at in range(0, len(some), TURN):
            for side in sides if at // TURN % 2 else sides[::-1]:
                await side.one_by_one(some[at : at + TURN])
    one, other = (side.times["cycle"] for side in sides)
    turns = [slice(at, at + TURN) for at in range(0, len(some), TURN)]
    # of neighbouring turns, because the load of the machine changes
    ratio = statistics.median(statistics.median(one[turn]) / statistics.median(other[turn]) for turn in turns)
    print(
        f"cycle with the topics / without, us: {statistics.median(one):,.0f} / {statistics.median(other):,.0f}, {ratio:.3f}"
    )
    return ratio


async def bench(arguments: argparse.Namespace) -> int:
    """Measure round after round, and print the median of the ratios."""
    ratios = []
    for seed in range(arguments.rounds):
        with tempfile.TemporaryDirectory(prefix="bench-rosbayes-") as folder:
            ratios.append(await measure(Path(folder), readings(seed, arguments.frames)))
    spread = f"{statistics.median(ratios):.3f} ({min(ratios):.3f} to {max(ratios):.3f})"
    print(f"median ratio {spread}, aim: at most 1.03; {len(os.sched_getaffinity(0))} cores")
    return 0


def main() -> int:
    """Parse the flags and measure."""
    parser = ScriptParser(prog="scripts/bench topics", description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5, help="number of rounds")
    parser.add_argument("--frames", type=int, default=1000, help="number of readings in each round")
    arguments = parser.parse_args()
    return run_script(lambda: bench(arguments), 120.0 * arguments.rounds)


if __name__ == "__main__":
    sys.exit(main())
