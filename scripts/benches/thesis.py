"""One message after another as probably in the thesis, with a subscriber and a publisher for each, and with those of a usual run.

client --reading--> hub --> subscriber -> master -> pcie-app -> 4 boards -> pcie-app -> master -> publisher --> hub --> client
                            `-- started for each message, or once ------------------------------'
"""

from __future__ import annotations

import argparse
import asyncio
import random
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bridge.client import Publication, Ros, Subscription, connect
from casestudies.boat.sensors import SENSORS_TOPIC, SENSORS_TYPE
from casestudies.demo import build
from scripts.benches.cycle import BOAT_FLAGS, Times, message, quantile, readings
from scripts.running.flags import ScriptParser
from scripts.running.script import run_script
from terminal.processes import Process

RUNS = {"each message": ["--start-each-message"], "once": []}
"""Flags of `master`: subscriber and publisher started for each message, or once."""
THESIS = {"rosbridge": 98.74, "computing": 1.24, "PCIe": 0.01}
"""The shares of figure 4.5 in percent."""
TURN = 5
"""Number of messages in a turn, after which the other run is measured."""
STAGES = {"compute": "computing", "register_writes": "PCIe", "reads": "PCIe"}
PAUSE = 0.005


class Run:
    """A master, and the times of its cycles (us), each from the end of the one before it."""

    def __init__(
        self, ros: Ros, topic: str, publication: Publication, results: Subscription, frames: Subscription
    ) -> None:
        self._ros, self._topic, self._publication = ros, topic, publication
        self._results, self._frames = results, frames
        self.times: Times = defaultdict(list)

    async def _until_read(self) -> None:
        while True:
            answer = await self._ros.call("/rosapi/subscribers", {"topic": self._topic}, timeout=60)
            if answer["subscribers"]:
                return
            await asyncio.sleep(PAUSE)

    async def cycle(self, reading: dict[str, int]) -> None:
        """Publish a reading as soon as somebody reads it, and wait for its result."""
        started = time.perf_counter_ns()
        await self._until_read()
        await self._publication.publish(message(reading))
        frame = await self._frames.next(timeout=60)
        await self._results.next(timeout=60)
        whole = (time.perf_counter_ns() - started) / 1e3
        values = {
            pair["key"]: float(pair["value"])
            for pair in frame.msg["status"][0]["values"]
            if pair["key"].endswith("_us")
        }
        shares = dict.fromkeys(THESIS, 0.0)
        for stage, part in STAGES.items():
            shares[part] += values[f"{stage}_us"]
        shares["rosbridge"] = whole - sum(shares.values())
        for part, spent in (shares | {"cycle": whole}).items():
            self.times[part].append(spent)


async def bench(arguments: argparse.Namespace) -> int:
    """Run both masters in turns, and print the table."""
    seed = arguments.seed if arguments.seed is not None else random.randrange(2**32)
    with tempfile.TemporaryDirectory(prefix="bench-rosbayes-") as folder:
        where = Path(folder)
        hub = Process("hub", where / "hub.log")
        masters = {name: Process(f"master ({name})", where / f"{name}.log") for name in RUNS}
        runs: dict[str, Run] = {}
        try:
            await hub.start("hub", "--port", "0")
            uri = (await hub.line(r"ws://\S+"))[0]
            async with connect(uri) as ros:
                results = ros.subscribe("/BMresults", "std_msgs/Float64MultiArray")
                frames = ros.subscribe("/bm/frame", "diagnostic_msgs/DiagnosticArray")
                for name, flags in RUNS.items():
                    at = len(runs)
                    topic, deployment = f"{SENSORS_TOPIC}{at}", where / f"boat{at}"
                    await build("boat", deployment, uri, topic, SENSORS_TYPE, "--thesis")
                    (own := where / f"run{at}").mkdir(mode=0o700)
                    where_to = ("-d", str(deployment), "--uri", uri, "--run-directory", str(own))
                    await masters[name].start("master", *BOAT_FLAGS, *flags, *where_to)
                    runs[name] = Run(ros, topic, await ros.advertise(topic, SENSORS_TYPE), results, frames)
                for master in masters.values():
                    await master.line("pcie-app: 4 boards")
                some = readings(seed, arguments.messages + 1)
                for each in runs.values():
                    await each.cycle(some[-1])
                    each.times.clear()  # that was the warm-up
                for first in range(0, arguments.messages, TURN):
                    for each in runs.values():
                        for reading in some[first : min(first + TURN, arguments.messages)]:
                            await each.cycle(reading)
        finally:
            await asyncio.gather(*(process.end() for process in (*masters.values(), hub)))
    show(runs, seed, arguments)
    return 0


def show(runs: dict[str, Run], seed: int, arguments: argparse.Namespace) -> None:
    """Print the table on standard output."""
    table = Table(
        title=f"subscriber and publisher started for each message, or once: {arguments.messages} messages"
    )
    for column in ("", *runs, "thesis"):
        table.add_column(column, justify="right" if column else "left")
    cycles = {name: run.times["cycle"] for name, run in runs.items()}
    means = {name: statistics.fmean(times) for name, times in cycles.items()}
    table.add_row("cycle, mean, ms", *(f"{mean / 1e3:.2f}" for mean in means.values()), "")
    table.add_row("cycle, 99 %, ms", *(f"{quantile(times, 0.99) / 1e3:.2f}" for times in cycles.values()), "")
    for part, share in THESIS.items():
        sums = (100 * sum(run.times[part]) / sum(run.times["cycle"]) for run in runs.values())
        table.add_row(f"{part}, % of the cycles", *(f"{each:.2f}" for each in sums), f"{share:.2f}")
    Console().print(table)
    each, once = means.values()
    print(
        f"a cycle with starts takes {each / once:.1f} times as long as one without; rosbridge is all but computing and PCIe, "
        f"boards are emulated; seed {seed}"
    )


def main() -> int:
    """Parse the flags and measure."""
    parser = ScriptParser(
        prog="scripts/bench thesis",
        description="Compare a subscriber and a publisher for each message, as probably in the thesis, with those of a usual run.",
    )
    parser.add_argument("--messages", type=int, default=25, help="number of messages")
    parser.add_argument(
        "--seed", type=int, shown="a new one each time", help="seed of the positions of the boat"
    )
    arguments = parser.parse_args()
    if arguments.messages < 1:
        parser.error("--messages must be 1 or more")
    return run_script(lambda: bench(arguments), 600)


if __name__ == "__main__":
    sys.exit(main())
