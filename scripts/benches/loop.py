"""`master --loop` at full rate for a long time: rate, cycle times, memory and descriptors of each minute."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import sys
import tempfile
import time
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bridge.client import Publication, Subscription, connect
from scripts.benches.cycle import WINDOW, message, processes_of, quantile, readings
from scripts.running.flags import ScriptParser, output_file
from scripts.running.processes import BOAT_TOPIC, BOAT_TYPE, ROOT, Process, build, run_script

WARM_UP = 200
"""Readings before the first minute."""
POSITIONS = 1000
ANSWER_LIMIT = 10.0


@dataclass
class Minute:
    """One minute: results per second, cycle times, and the resources of each process at its end."""

    per_second: float
    p50_us: float
    p99_us: float
    p999_us: float
    memory_kib: dict[str, int] = field(default_factory=dict)
    descriptors: dict[str, int] = field(default_factory=dict)


class Load:
    """Readings of boats, of which a few are always under way."""

    def __init__(self, publication: Publication, results: Subscription, seed: int) -> None:
        self._publication = publication
        self._results = results
        self._readings = readings(seed, POSITIONS)
        self._sent: deque[int] = deque()
        self._at = 0

    async def run(self, *, seconds: float = 0.0, count: int = 0) -> tuple[list[float], float]:
        """Publish for a time, or a number of readings; return the cycle times in microseconds, and the duration."""
        taken: list[float] = []
        began = time.perf_counter()
        while time.perf_counter() - began < seconds or len(taken) < count:
            while len(self._sent) < WINDOW:
                self._sent.append(time.perf_counter_ns())
                await self._publication.publish(message(self._readings[self._at % POSITIONS]))
                self._at += 1
            await self._results.next(timeout=ANSWER_LIMIT)
            taken.append((time.perf_counter_ns() - self._sent.popleft()) / 1e3)
        return taken, time.perf_counter() - began


def resources(pids: dict[str, list[int]]) -> tuple[dict[str, int], dict[str, int]]:
    """Return resident memory in KiB, and descriptors, of all processes by command."""
    memory, descriptors = {}, {}
    for command, processes in pids.items():
        pages = [int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in processes]
        memory[command] = sum(pages) * os.sysconf("SC_PAGE_SIZE") // 1024
        descriptors[command] = sum(len(list(Path(f"/proc/{pid}/fd").iterdir())) for pid in processes)
    return memory, descriptors


@asynccontextmanager
async def stack(*, fused: bool, folder: Path) -> AsyncIterator[tuple[str, dict[str, list[int]]]]:
    """Run a hub, and a master with the boat; yield the URI and the process numbers by command."""
    hub, master = Process("hub", folder / "hub.log"), Process("master", folder / "master.log")
    try:
        await hub.start("hub", "--port", "0")
        uri = (await hub.line(r"ws://\S+"))[0]
        await build("boat", folder / "boat", uri, BOAT_TOPIC, BOAT_TYPE)
        flags = ["--fused"] if fused else []
        await master.start(
            "master", "--loop", "-d", str(folder / "boat"), "--uri", uri, "--queue", "all", *flags
        )
        await master.line("pcie-app: 4 boards")
        await asyncio.sleep(0.5)
        yield uri, {"hub": [hub.pid], **processes_of(master.pid)}
    finally:
        await asyncio.gather(master.end(), hub.end())


async def bench(arguments: argparse.Namespace) -> int:
    """Measure minute by minute, print the table, and write picture and JSON file."""
    seed = arguments.seed if arguments.seed is not None else random.randrange(2**32)
    minutes: list[Minute] = []
    with tempfile.TemporaryDirectory(prefix="bench-rosbayes-") as folder:
        async with stack(fused=arguments.fused, folder=Path(folder)) as (uri, pids), connect(uri) as ros:
            results = ros.subscribe("/BMresults", "std_msgs/Float64MultiArray")
            load = Load(await ros.advertise(BOAT_TOPIC, BOAT_TYPE), results, seed)
            await load.run(count=WARM_UP)
            print("measuring; each minute prints a line ...", file=sys.stderr)
            for number in range(1, arguments.minutes + 1):
                taken, duration = await load.run(seconds=60.0)
                p50, p99, p999 = (quantile(taken, share) for share in (0.5, 0.99, 0.999))
                minute = Minute(len(taken) / duration, p50, p99, p999, *resources(pids))
                minutes.append(minute)
                print(
                    f"minute {number}: {minute.per_second:.0f} results per second, p50 {minute.p50_us:.0f} us, "
                    f"p99.9 {minute.p999_us:.0f} us, {sum(minute.memory_kib.values()) / 1024:.1f} MiB, "
                    f"{sum(minute.descriptors.values())} descriptors",
                    file=sys.stderr,
                )
    show(minutes)
    arguments.picture.parent.mkdir(parents=True, exist_ok=True)
    draw(minutes, arguments.picture)
    print(f"picture: {arguments.picture}")
    if arguments.json is not None:
        found = {"seed": seed, "fused": arguments.fused, "minutes": [asdict(minute) for minute in minutes]}
        arguments.json.write_text(json.dumps(found, indent=2) + "\n")
    return 0


def show(minutes: list[Minute]) -> None:
    """Print the resources of each process at the beginning and at the end."""
    first, last = minutes[0], minutes[-1]
    table = Table(title=f"{len(minutes)} minutes at full rate: after the first and the last minute")
    for column in ("process", "MiB", "MiB", "descriptors", "descriptors"):
        table.add_column(column, justify="left" if column == "process" else "right")
    for command in first.memory_kib:
        table.add_row(
            command,
            *(f"{each.memory_kib[command] / 1024:.1f}" for each in (first, last)),
            *(str(each.descriptors[command]) for each in (first, last)),
        )
    Console().print(table)


def draw(minutes: list[Minute], path: Path) -> None:
    """Draw rate, cycle times, memory and descriptors over the minutes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 7), layout="constrained")
    axes = figure.subplots(2, 2)
    at = range(1, len(minutes) + 1)
    axes[0, 0].plot(at, [minute.per_second for minute in minutes])
    axes[0, 0].set(ylabel="results per second", ylim=(0, None))
    for title, key in (("p50", "p50_us"), ("p99", "p99_us"), ("p99.9", "p999_us")):
        axes[0, 1].plot(at, [getattr(minute, key) / 1e3 for minute in minutes], label=title)
    axes[0, 1].set(ylabel=f"cycle with {WINDOW} readings under way, ms", yscale="log")
    for command in minutes[0].memory_kib:
        axes[1, 0].plot(at, [minute.memory_kib[command] / 1024 for minute in minutes], label=command)
        axes[1, 1].plot(at, [minute.descriptors[command] for minute in minutes], label=command)
    axes[1, 0].set(ylabel="resident memory, MiB", ylim=(0, None))
    axes[1, 1].set(ylabel="descriptors", ylim=(0, None))
    for each in axes.flat:
        each.set_xlabel("minute")
        each.grid(alpha=0.3)
    for each in (axes[0, 1], axes[1, 0]):
        each.legend(fontsize="small")
    figure.savefig(path, dpi=110)


def main() -> int:
    """Parse the flags and measure."""
    parser = ScriptParser(
        prog="scripts/bench loop",
        description="Run master --loop at full rate, and print the figures of each minute.",
    )
    parser.add_argument("--minutes", type=int, default=30, help="minutes to measure")
    parser.add_argument("--fused", action="store_true", help="measure master --fused")
    parser.add_argument(
        "--seed", type=int, shown="a new one each time", help="seed of the positions of the boat"
    )
    parser.add_argument(
        "--picture",
        type=output_file,
        metavar="FILE",
        default=ROOT / "out" / "loop.png",
        help="picture of the figures",
    )
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write all figures")
    arguments = parser.parse_args()
    if arguments.minutes < 1:
        parser.error("--minutes must be 1 or more")
    return run_script(lambda: bench(arguments), 60 * arguments.minutes + 300)


if __name__ == "__main__":
    sys.exit(main())
