"""From a reading's publication to its result's arrival, beside the floor of the same client, hub and message sizes.

client --reading--> hub --> subscriber -> master -> pcie-app -> 4 boards -> pcie-app -> master -> publisher --> hub --> client
client --reading--> hub --> echo --------------------------------------------------------------------------> hub --> client
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from processes import BOAT_TOPIC, BOAT_TYPE, Process, build, run_script
from rich.console import Console
from rich.table import Table

from bridge.client import Publication, Ros, Subscription, connect
from bridge.stamps import header, header_stamp_ns

STAGES = (
    "wire_in",
    "rosbridge_in",
    "local_hops",
    "waited",
    "register_writes",
    "compute",
    "reads",
    "boards_compute",
    "rosbridge_out",
    "wire_out",
)
_TICKS = os.sysconf("SC_CLK_TCK")
WINDOW = 4
"""Readings under way at once when frames per second are measured."""


@dataclass
class Measured:
    """Microseconds of each cycle, and of each of its stages."""

    cycle: list[float] = field(default_factory=list)
    floor: list[float] = field(default_factory=list)
    stages: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in STAGES})


def readings(seed: int, count: int) -> list[dict[str, int]]:
    """Readings of boats at random places, without noise but rounded: what the normaliser would publish."""
    import math

    chance = random.Random(seed)
    made = []
    for _ in range(count):
        x, y = chance.uniform(-48, 48), chance.uniform(-48, 48)
        reading = {}
        for beacon, (bx, by) in enumerate(((-50, -50), (-50, 0), (0, -50)), 1):
            reading[f"D{beacon}"] = min(100, round(math.hypot(x - bx, y - by)))
            reading[f"B{beacon}"] = round(math.degrees(math.atan2(y - by, x - bx))) % 360
        made.append(reading)
    return made


def message(reading: dict[str, int]) -> dict[str, object]:
    """A reading as the normaliser publishes it."""
    return {"header": header(time.time_ns(), "map"), **reading}


async def one_by_one(
    publication: Publication, answers: Subscription, some: list[dict[str, int]], times: list[float]
) -> None:
    """Publish, wait for the answer, note the time; a lost answer fails the bench."""
    for reading in some:
        started = time.perf_counter_ns()
        await publication.publish(message(reading))
        await answers.next(timeout=10)
        times.append((time.perf_counter_ns() - started) / 1e3)


async def per_second(publication: Publication, answers: Subscription, some: list[dict[str, int]]) -> float:
    """Answers per second with WINDOW readings under way."""
    started = time.perf_counter()
    under_way = 0
    for reading in some:
        await publication.publish(message(reading))
        under_way += 1
        if under_way == WINDOW:
            await answers.next(timeout=10)
            under_way -= 1
    for _ in range(under_way):
        await answers.next(timeout=10)
    return len(some) / (time.perf_counter() - started)


def cpu_seconds(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def processes_of(master: int) -> dict[str, list[int]]:
    """The process numbers of the master and all that came from it, by command."""
    parents: dict[int, int] = {}
    names: dict[int, str] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                pid = int(entry.name)
                parents[pid] = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
                words = (entry / "cmdline").read_bytes().split(b"\0")
                names[pid] = Path(words[1].decode() if b"python" in words[0] else words[0].decode()).name
            except (OSError, IndexError):
                continue
    found: dict[str, list[int]] = {}
    for pid in parents:
        above = pid
        while above in parents and above != master:
            above = parents[above]
        if above == master:
            found.setdefault(names.get(pid, "?"), []).append(pid)
    return found


async def collect_stages(
    ros: Ros, publication: Publication, some: list[dict[str, int]], measured: Measured
) -> None:
    """The stages of some frames, apart from the timed turns: hearing /bm/frame too is work for hub and client.

    The wire's stages are seen from this client, whose clock the host shares: from the reading's stamp to its
    receipt by the subscriber, and from the publisher's beginning to publish to the result's arrival here.
    """
    frames = ros.subscribe("/bm/frame", "diagnostic_msgs/DiagnosticArray")
    results = ros.subscribe("/BMresults", "std_msgs/Float64MultiArray")
    await asyncio.sleep(0.2)
    for reading in some:
        sent = message(reading)
        await publication.publish(sent)
        frame = await frames.next(timeout=10)
        result = await results.next(timeout=10)
        values = {pair["key"]: pair["value"] for pair in frame.msg["status"][0]["values"]}
        for name in STAGES:
            if f"{name}_us" in values:
                measured.stages[name].append(float(values[f"{name}_us"]))
        stamp = header_stamp_ns(frame.msg) or 0
        measured.stages["wire_in"].append((int(values["received_ns"]) - stamp) / 1e3)
        out = result.received_ns - int(values["sent_ns"])
        measured.stages["wire_out"].append(out / 1e3 - measured.stages["rosbridge_out"][-1])
    await frames.close()
    await results.close()


def quantile(values: list[float], share: float) -> float:
    """The value below which a share of them lies."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


async def bench(arguments: argparse.Namespace) -> int:
    """Measure in turns, so that a noisy machine is noisy for both; print the table, write the JSON."""
    console = Console(stderr=True)
    measured = Measured()
    seed = arguments.seed if arguments.seed is not None else random.randrange(2**32)
    some = readings(seed, arguments.frames)
    with tempfile.TemporaryDirectory(prefix="rosbayes-bench-") as folder:
        where = Path(folder)
        hub, master, echo = (Process(name, where / f"{name}.log") for name in ("hub", "master", "echo"))
        try:
            await hub.start("hub", "--port", "0")
            uri = (await hub.line(r"ws://\S+"))[0]
            await build("boat", where / "boat", uri, BOAT_TOPIC, BOAT_TYPE)
            lines = 32 * 32
            await echo.start(sys.executable, str(Path(__file__).with_name("echo.py")), uri, str(lines))
            await master.start("master", "--loop", "-d", str(where / "boat"), "--uri", uri, "--queue", "all")
            async with connect(uri) as ros:
                to_stack = await ros.advertise(BOAT_TOPIC, BOAT_TYPE)
                to_echo = await ros.advertise("/bench/reading", BOAT_TYPE)
                results = ros.subscribe("/BMresults", "std_msgs/Float64MultiArray")
                echoes = ros.subscribe("/bench/echo", "std_msgs/Float64MultiArray")
                await echo.line("listening")
                await master.line("pcie-app: 4 boards")
                await asyncio.sleep(0.5)
                warm = some[: max(20, len(some) // 10)]
                await one_by_one(to_stack, results, warm, [])
                await one_by_one(to_echo, echoes, warm, [])
                pids = processes_of(master.pid)
                before = {name: sum(map(cpu_seconds, all_)) for name, all_ in pids.items()}
                for at in range(0, len(some), arguments.turn):
                    turn = some[at : at + arguments.turn]
                    await one_by_one(to_echo, echoes, turn, measured.floor)
                    await one_by_one(to_stack, results, turn, measured.cycle)
                cpu = {
                    name: (sum(map(cpu_seconds, all_)) - before[name]) / len(some) * 1e6
                    for name, all_ in pids.items()
                }
                await collect_stages(ros, to_stack, some[: max(50, len(some) // 4)], measured)
                rates = {
                    "floor": await per_second(to_echo, echoes, some),
                    "stack": await per_second(to_stack, results, some),
                }
        finally:
            await asyncio.gather(*(process.end() for process in (master, echo, hub)))
    figures = summary(measured, cpu, rates, seed)
    show(console, figures)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")
    return 0


def summary(
    measured: Measured, cpu: dict[str, float], rates: dict[str, float], seed: int
) -> dict[str, object]:
    """All figures: microseconds, frames per second, ratios."""
    floor, cycle = statistics.median(measured.floor), statistics.median(measured.cycle)
    boards = statistics.median(measured.stages["boards_compute"])
    return {
        "frames": len(measured.cycle),
        "seed": seed,
        "floor_us": {"median": floor, "p99": quantile(measured.floor, 0.99)},
        "cycle_us": {"median": cycle, "p99": quantile(measured.cycle, 0.99)},
        "boards_compute_us": boards,
        "ratio_beyond_boards": (cycle - boards) / floor,
        "bound_us": 2.5 * floor + boards,
        "stages_us": {name: statistics.median(values) for name, values in measured.stages.items()},
        "cpu_us_per_frame": cpu,
        "frames_per_second": rates,
    }


def show(console: Console, figures: dict[str, object]) -> None:
    """Print the table on standard output."""
    floor, cycle = figures["floor_us"], figures["cycle_us"]
    stages, cpu, rates = figures["stages_us"], figures["cpu_us_per_frame"], figures["frames_per_second"]
    assert isinstance(floor, dict)
    assert isinstance(cycle, dict)
    assert isinstance(stages, dict)
    assert isinstance(cpu, dict)
    assert isinstance(rates, dict)
    table = Table(title=f"one cycle, {figures['frames']} frames, 32 x 32 cells on four boards")
    for column in ("", "median us", "99 % us", "frames/s"):
        table.add_column(column, justify="left" if not column else "right")
    table.add_row("floor (echo)", f"{floor['median']:.0f}", f"{floor['p99']:.0f}", f"{rates['floor']:.0f}")
    table.add_row("stack", f"{cycle['median']:.0f}", f"{cycle['p99']:.0f}", f"{rates['stack']:.0f}")
    table.add_row("boards' own computing", f"{figures['boards_compute_us']:.0f}", "", "")
    table.add_section()
    for name, value in stages.items():
        table.add_row(f"stage: {name.replace('_', ' ')}", f"{value:.0f}", "", "")
    table.add_section()
    for name, value in sorted(cpu.items()):
        table.add_row(f"CPU: {name}", f"{value:.0f}", "", "")
    out = Console()
    out.print(table)
    out.print(
        f"(cycle - boards) / floor = {figures['ratio_beyond_boards']:.2f}; "
        f"bound 2.5 x floor + boards = {figures['bound_us']:.0f} us; seed {figures['seed']}"
    )
    console.print("times of the stages are medians; rosbridge out is encoding and sending alone", style="dim")


def main() -> int:
    """Read the flags and measure."""
    parser = argparse.ArgumentParser(prog="scripts/bench cycle", description="One cycle beside its floor.")
    parser.add_argument("--frames", type=int, default=1000, help="readings (1000)")
    parser.add_argument("--turn", type=int, default=50, help="readings before the other one's turn (50)")
    parser.add_argument("--seed", type=int, help="of the boat's places (a new one each time)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures")
    arguments = parser.parse_args()
    if min(arguments.frames, arguments.turn) < 1:
        parser.error("--frames and --turn must be 1 or more")
    return run_script(lambda: bench(arguments), 300)


if __name__ == "__main__":
    sys.exit(main())
