"""Cost of `integrity`: frames per second and time of a frame without it, with canaries, and with two computations.

client --reading--> hub --> subscriber -> master -> pcie-app -> 4 boards -> pcie-app -> master -> publisher --> hub --> client
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import statistics
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bridge.client import connect
from scripts.benches.cycle import one_by_one, per_second, quantile, readings
from scripts.running.flags import ScriptParser, output_file
from scripts.running.processes import BOAT_TOPIC, BOAT_TYPE, Process, build, run_script

RULES: dict[str, tuple[str, ...]] = {
    "off": ("--integrity", "off"),
    "canary 100,000": ("--integrity", "canary", "--integrity-frames", "100000"),
    "canary 10,000": ("--integrity", "canary", "--integrity-frames", "10000"),
    "twice": ("--integrity", "twice"),
}


async def measure(
    folder: Path, uri: str, rule: str, some: list[dict[str, int]], *, fused: bool
) -> dict[str, float]:
    """Start a master with a rule, and return its figures."""
    master = Process("master", folder / f"{rule.replace(' ', '-')}.log")
    flags = ["--fused"] if fused else []
    try:
        await master.start(
            *("master", "--loop", "-d", str(folder / "boat"), "--uri", uri, "--queue", "all"),
            *RULES[rule],
            *flags,
        )
        async with connect(uri) as ros:
            publication = await ros.advertise(BOAT_TOPIC, BOAT_TYPE)
            results = ros.subscribe("/BMresults", "std_msgs/Float64MultiArray")
            await master.line("pcie-app: 4 boards")
            await asyncio.sleep(0.5)
            await one_by_one(publication, results, some[: max(20, len(some) // 10)], [])
            times: list[float] = []
            await one_by_one(publication, results, some, times)
            rate = await per_second(publication, results, some)
    finally:
        await master.end()
    return {"per_second": rate, "median_us": statistics.median(times), "p99_us": quantile(times, 0.99)}


async def bench(arguments: argparse.Namespace) -> int:
    """Measure the rules in turns; print the medians over the turns, and write the JSON file."""
    some = readings(arguments.seed, arguments.frames)
    measured: dict[str, list[dict[str, float]]] = {rule: [] for rule in RULES}
    with tempfile.TemporaryDirectory(prefix="bench-rosbayes-") as name:
        folder = Path(name)
        hub = Process("hub", folder / "hub.log")
        try:
            await hub.start("hub", "--port", "0")
            uri = (await hub.line(r"ws://\S+"))[0]
            await build("boat", folder / "boat", uri, BOAT_TOPIC, BOAT_TYPE)
            for _ in range(arguments.turns):
                for rule, each in measured.items():
                    each.append(await measure(folder, uri, rule, some, fused=arguments.fused))
        finally:
            await hub.end()
    figures = {
        rule: {key: statistics.median(one[key] for one in each) for key in each[0]}
        for rule, each in measured.items()
    }
    topology = "fused" if arguments.fused else "processes"
    table = Table(title=f"integrity ({topology}), {arguments.turns} x {arguments.frames} frames")
    for title in ("", "frames a second", "median, us", "99 %, us"):
        table.add_column(title, justify="right" if title else "left")
    for rule, row in figures.items():
        table.add_row(rule, *(f"{value:.0f}" for value in row.values()))
    Console().print(table)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")
    return 0


def main() -> int:
    """Parse the flags and measure."""
    parser = ScriptParser(
        prog="scripts/bench integrity", description="Measure the cost of each value of integrity."
    )
    parser.add_argument("--frames", type=int, default=2000, help="readings of one turn")
    parser.add_argument("--turns", type=int, default=3, help="number of turns of each value")
    parser.add_argument("--fused", action="store_true", help="measure master --fused")
    parser.add_argument(
        "--seed", type=int, default=random.randrange(2**32), help="seed of the positions of the boat"
    )
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write all figures")
    arguments = parser.parse_args()
    if min(arguments.frames, arguments.turns) < 1:
        parser.error("--frames and --turns must be 1 or more")
    return run_script(lambda: bench(arguments), 600)


if __name__ == "__main__":
    sys.exit(main())
