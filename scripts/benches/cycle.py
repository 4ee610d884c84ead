"""Cycle time, from a reading's publication to its result's arrival, compared with an echo's (the floor).

processes  client --reading--> hub --> subscriber -> master -> pcie-app -> 4 boards -> pcie-app -> master -> publisher --> hub --> client
fused      client --reading--> hub --> master --------------> 4 boards --------------> master -----------------------> hub --> client
floor      client --reading--> hub --> echo -----------------------------------------------------------------------> hub --> client
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
from typing import Any

from rich.console import Console
from rich.table import Table

from bridge.client import Publication, Ros, Subscription, connect
from bridge.stamps import header, header_stamp_ns
from scripts.running.flags import ScriptParser, output_file
from scripts.running.processes import BOAT_TOPIC, BOAT_TYPE, Process, build, run_script

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
LINES = 32 * 32
BOUND = 2.5
"""Limit of the cycle time, as a multiple of the floor plus computing on the boards."""
WINDOW = 4
"""Number of readings in flight when frames per second are measured."""
TOPICS = {"processes": BOAT_TOPIC, "fused": BOAT_TOPIC + "_fused"}


@dataclass
class Measured:
    """Microseconds of each cycle and its stages, CPU microseconds per frame by command, frames per second."""

    cycle: list[float] = field(default_factory=list)
    stages: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in STAGES})
    cpu: dict[str, float] = field(default_factory=dict)
    per_second: float = 0.0


def readings(seed: int, count: int) -> list[dict[str, int]]:
    """Return readings of boats at random positions, without noise, rounded as by the normaliser."""
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
    """Return a reading as the normaliser publishes it."""
    return {"header": header(time.time_ns(), "map"), **reading}


async def one_by_one(
    publication: Publication, answers: Subscription, some: list[dict[str, int]], times: list[float]
) -> None:
    """Publish readings, each after the answer to the previous one, and record the times."""
    for reading in some:
        started = time.perf_counter_ns()
        await publication.publish(message(reading))
        await answers.next(timeout=10)
        times.append((time.perf_counter_ns() - started) / 1e3)


async def per_second(publication: Publication, answers: Subscription, some: list[dict[str, int]]) -> float:
    """Return answers per second with WINDOW readings in flight."""
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
    """Return the user and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def cpu_of(pids: dict[str, list[int]]) -> dict[str, float]:
    """Return the user and system time of all processes so far, by command."""
    return {command: sum(map(cpu_seconds, all_)) for command, all_ in pids.items()}


def processes_of(master: int) -> dict[str, list[int]]:
    """Return the process numbers of the master and its descendants, by command."""
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
    ros: Ros, publication: Publication, results: Subscription, some: list[dict[str, int]], measured: Measured
) -> None:
    """Return the stages of some frames.

    The stages on the wire are measured with this client's clock, which the host shares: from the reading's
    stamp to its receipt by the subscriber, and from the start of the publication to the result's arrival
    here.
    """
    frames = ros.subscribe("/bm/frame", "diagnostic_msgs/DiagnosticArray")
    await asyncio.sleep(0.05)
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


def quantile(values: list[float], share: float) -> float:
    """Return the quantile of the values."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


async def measure(
    ros: Ros,
    echo: Process,
    masters: dict[str, Process],
    stacks: dict[str, Measured],
    some: list[dict[str, int]],
    floor: list[float],
    each_turn: int,
) -> float:
    """Measure the echo and the stacks in turns, and append the microseconds to `stacks` and `floor`.

    Returns:
        Answers of the echo per second.
    """
    to_echo = await ros.advertise("/bench/reading", BOAT_TYPE)
    publications = {name: await ros.advertise(TOPICS[name], BOAT_TYPE) for name in stacks}
    results = ros.subscribe("/BMresults", "std_msgs/Float64MultiArray")
    echoes = ros.subscribe("/bench/echo", "std_msgs/Float64MultiArray")
    await echo.line("listening")
    for master in masters.values():
        await master.line("pcie-app: 4 boards")
    await asyncio.sleep(0.5)
    warm = some[: max(20, len(some) // 10)]
    await one_by_one(to_echo, echoes, warm, [])
    for name in stacks:
        await one_by_one(publications[name], results, warm, [])
    pids = {name: processes_of(master.pid) for name, master in masters.items()}
    before = {name: cpu_of(pids[name]) for name in stacks}
    for at in range(0, len(some), each_turn):
        turn = some[at : at + each_turn]
        await one_by_one(to_echo, echoes, turn, floor)
        for name, measured in stacks.items():
            await one_by_one(publications[name], results, turn, measured.cycle)
        # not in the timed turns, because subscribing to /bm/frame is work for the hub and the client
        for name, measured in stacks.items():
            await collect_stages(ros, publications[name], results, turn[: len(turn) // 4 + 1], measured)
    for name, measured in stacks.items():
        used = cpu_of(pids[name])
        measured.cpu = {
            command: (seconds - before[name][command])
            / len(measured.cycle + measured.stages["compute"])
            * 1e6
            for command, seconds in used.items()
        }
    floor_per_second = await per_second(to_echo, echoes, some)
    for name, measured in stacks.items():
        measured.per_second = await per_second(publications[name], results, some)
    return floor_per_second


async def bench(arguments: argparse.Namespace) -> int:
    """Measure in turns, so that noise affects all alike; print the table and write the JSON file."""
    console = Console(stderr=True)
    seed = arguments.seed if arguments.seed is not None else random.randrange(2**32)
    some = readings(seed, arguments.frames)
    floor: list[float] = []
    stacks = {"processes": Measured(), "fused": Measured()}
    with tempfile.TemporaryDirectory(prefix="bench-rosbayes-") as folder:
        where = Path(folder)
        hub, echo = (Process(name, where / f"{name}.log") for name in ("hub", "echo"))
        masters = {name: Process(f"master ({name})", where / f"{name}.log") for name in stacks}
        try:
            await hub.start("hub", "--port", "0")
            uri = (await hub.line(r"ws://\S+"))[0]
            await echo.start(sys.executable, "-P", "-m", "scripts.benches.echo", uri, str(LINES))
            for name, master in masters.items():
                await build("boat", where / f"boat-{name}", uri, TOPICS[name], BOAT_TYPE)
                flags = ["--fused"] if name == "fused" else []
                await master.start(
                    *("master", "--loop", "-d", str(where / f"boat-{name}"), "--uri", uri, "--queue", "all"),
                    *flags,
                )
            async with connect(uri) as ros:
                floor_per_second = await measure(ros, echo, masters, stacks, some, floor, arguments.turn)
        finally:
            await asyncio.gather(*(process.end() for process in (*masters.values(), echo, hub)))
    figures = {
        "frames": len(some),
        "seed": seed,
        "cores": len(os.sched_getaffinity(0)),
        "floor": {
            "median_us": statistics.median(floor),
            "p99_us": quantile(floor, 0.99),
            "per_second": floor_per_second,
        },
        **{name: summary(measured, statistics.median(floor)) for name, measured in stacks.items()},
    }
    show(figures)
    console.print("times of the stages are medians; rosbridge out is encoding and sending alone", style="dim")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")
    return 0


def summary(measured: Measured, floor: float) -> dict[str, Any]:
    """Return a stack's microseconds, frames per second, and ratio to the floor without computing."""
    cycle = statistics.median(measured.cycle)
    compute = statistics.median(measured.stages["compute"])
    return {
        "median_us": cycle,
        "p99_us": quantile(measured.cycle, 0.99),
        "per_second": measured.per_second,
        "compute_us": compute,
        "machines_us": statistics.median(measured.stages["boards_compute"]),
        "ratio": cycle / (floor + compute),
        "ratio_beyond_compute": (cycle - compute) / floor,
        "stages_us": {name: statistics.median(values) for name, values in measured.stages.items()},
        "cpu_us_per_frame": measured.cpu,
    }


def show(figures: dict[str, Any]) -> None:
    """Print the table on standard output."""
    stacks = ("processes", "fused")
    table = Table(title=f"one cycle, {figures['frames']} frames, 32 x 32 cells on four boards")
    for column in ("", "floor (echo)", *stacks):
        table.add_column(column, justify="right" if column else "left")

    def row(title: str, key: str) -> None:
        table.add_row(title, *(f"{figures[name][key]:.0f}" for name in ("floor", *stacks)))

    row("median, us", "median_us")
    row("99 %, us", "p99_us")
    row("frames a second", "per_second")
    table.add_row("boards' computing, us", "", *(f"{figures[name]['compute_us']:.0f}" for name in stacks))
    table.add_row(
        "of it, the slowest machine, us", "", *(f"{figures[name]['machines_us']:.0f}" for name in stacks)
    )
    for title, key in (
        ("median / (floor + boards' computing)", "ratio"),
        ("(median - boards' computing) / floor", "ratio_beyond_compute"),
    ):
        table.add_row(title, "1", *(f"{figures[name][key]:.2f}" for name in stacks))
    table.add_section()
    for stage in STAGES:
        if stage != "boards_compute":
            table.add_row(
                f"{stage.replace('_', ' ')}, us",
                "",
                *(f"{figures[name]['stages_us'][stage]:.0f}" for name in stacks),
            )
    table.add_section()
    for command in sorted({command for name in stacks for command in figures[name]["cpu_us_per_frame"]}):
        used = (figures[name]["cpu_us_per_frame"].get(command) for name in stacks)
        table.add_row(f"CPU of {command}, us", "", *("" if each is None else f"{each:.0f}" for each in used))
    out = Console()
    out.print(table)
    out.print(
        f"aim: a cycle takes at most {BOUND:g} times what floor and boards take; {figures['cores']} cores, "
        f"seed {figures['seed']}"
    )


def main() -> int:
    """Parse the flags and measure."""
    parser = ScriptParser(
        prog="scripts/bench cycle",
        description="Compare the time from a reading to its result with that of an echo.",
    )
    parser.add_argument("--frames", type=int, default=1000, help="number of readings")
    parser.add_argument(
        "--turn",
        type=int,
        default=50,
        help="readings of one turn, after which another alternative is measured",
    )
    parser.add_argument(
        "--seed", type=int, shown="a new one each time", help="seed of the positions of the boat"
    )
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write all figures")
    arguments = parser.parse_args()
    if min(arguments.frames, arguments.turn) < 1:
        parser.error("--frames and --turn must be 1 or more")
    return run_script(lambda: bench(arguments), 300)


if __name__ == "__main__":
    sys.exit(main())
