"""Cycle time of a stack, compared with the cycle time of an echo (the floor).

A cycle lasts from the publication of a reading to the arrival of its result.

processes  client --reading--> hub --> subscriber -> master -> pcie-app -> 4 boards -> pcie-app -> master -> publisher --> hub --> client
fused      client --reading--> hub --> master --------------> 4 boards --------------> master -----------------------> hub --> client
floor      client --reading--> hub --> echo -----------------------------------------------------------------------> hub --> client
"""

import argparse
import asyncio
import os
import random
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Awaitable, Sequence
from pathlib import Path

from bridge.client import Publication, Ros, Subscription, connect
from bridge.stamps import header, header_stamp_ns
from casestudies.boat.sensors import SENSORS_TOPIC, SENSORS_TYPE
from posteriors.posterior import RESULTS_TOPIC, RESULTS_TYPE
from scripts.running.flags import ScriptParser
from scripts.running.script import print_table
from scripts.running.stand import Stand, readings_at, temporary_stand
from services.errors import SettingsError

STAGES = (
    *("wire_in", "rosbridge_in", "local_hops", "waited", "register_writes", "compute", "reads"),
    *("rosbridge_out", "wire_out"),
)
LINES = 32 * 32
BOUND = 2.5
"""Limit of the cycle time, as a multiple of the echo's cycle time plus computing on the boards."""
WINDOW = 4
"""Number of readings in flight when frames per second are measured."""
TURN = 50
"""Number of readings in a turn, after which another alternative is measured."""
FLOOR, STACKS = "floor (echo)", {"processes": SENSORS_TOPIC, "fused": SENSORS_TOPIC + "_fused"}
ALL_READINGS = ("--queue", "all")

Times = defaultdict[str, list[float]]
"""Times in microseconds, by name of the measured quantity."""


def readings(seed: int, count: int) -> list[dict[str, int]]:
    """Return readings of boats at random positions, without noise, rounded as by the normaliser."""
    chance = random.Random(seed)
    return [readings_at(chance.uniform(-48, 48), chance.uniform(-48, 48)) for _ in range(count)]


def add_seed(parser: ScriptParser) -> None:
    """Add the flag of the seed that `readings` takes."""
    shown, new = "a new one each time", random.randrange(2**32)
    parser.add_argument("--seed", type=int, default=new, shown=shown, help="seed of the boat's positions")


def message(reading: dict[str, int]) -> dict[str, object]:
    """Return a reading as the normaliser publishes it."""
    return {"header": header(time.time_ns(), "map"), **reading}


def quantile(values: list[float], share: float) -> float:
    """Return a quantile of the values; `share` is 0.5 for the median."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def processes_of(pid: int) -> dict[str, list[int]]:
    """Return the ids of a process and its descendants, by command."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    found = {Path(words[1].decode() if b"python" in words[0] else words[0].decode()).name: [pid]}
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        for command, pids in processes_of(int(child)).items():
            found.setdefault(command, []).extend(pids)
    return found


def cpu_us(pids: list[int]) -> float:
    """Return the user and system time of processes so far."""
    ticks = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        ticks += int(fields[11]) + int(fields[12])
    return 1e6 * ticks / os.sysconf("SC_CLK_TCK")


async def until_read(ros: Ros, topic: str, pause: float = 0.05) -> None:
    """Wait until somebody subscribes to a topic: a reading that is published earlier has no result."""
    while True:
        if (await ros.call("/rosapi/subscribers", {"topic": topic}, timeout=60))["subscribers"]:
            return
        await asyncio.sleep(pause)


class Measured:
    """The measured echo or stack: its topics for readings and answers, and the times of its cycles and their stages."""

    def __init__(self, publication: Publication, answers: Subscription, master: int) -> None:
        self._publication, self._answers = publication, answers
        self.times: Times = defaultdict(list)
        self.cpu: dict[str, float] = {}
        self.per_second = 0.0
        self.lost = 0
        """Frames without a posterior, of those whose stages were measured."""
        self._pids = processes_of(master) if master else {}

    @classmethod
    async def of_stack(cls, ros: Ros, topic: str = SENSORS_TOPIC, type_: str = SENSORS_TYPE) -> "Measured":
        """Return the stack that reads a topic, as soon as it has subscribed to the topic."""
        results = ros.subscribe(RESULTS_TOPIC, RESULTS_TYPE)
        publication = await ros.advertise(topic, type_)
        await until_read(ros, topic)
        return cls(publication, results, 0)

    async def one_by_one(self, some: list[dict[str, int]], hz: float = 0.0) -> None:
        """Publish readings, each after the answer to the previous one, and at most `hz` a second unless it is 0."""
        for reading in some:
            started = time.perf_counter_ns()
            await self._publication.publish(message(reading))
            await self._answers.next(timeout=30)
            self.times["cycle"].append((time.perf_counter_ns() - started) / 1e3)
            if hz:
                await asyncio.sleep(max(0.0, started / 1e9 + 1 / hz - time.perf_counter()))

    async def stages(self, ros: Ros, some: list[dict[str, int]]) -> None:
        """Measure the stages of some frames.

        The two stages on the wire are measured with the clock of this computer, on which the whole stack runs.
        `wire_in` lasts from the reading's stamp to the receipt by the subscriber. `wire_out` lasts from the start of
        the publication to the result's arrival here, less `rosbridge_out`. Stages and cycle times are measured in
        separate runs, because a subscription to /bm/frame costs the hub and the client time.
        """
        frames = ros.subscribe("/bm/frame", "diagnostic_msgs/DiagnosticArray")
        await ros.call("/rosapi/get_time")  # so that the hub knows the subscription
        for reading in some:
            await self._publication.publish(message(reading))
            frame = await frames.next(timeout=30)
            values = {pair["key"]: pair["value"] for pair in frame.msg["status"][0]["values"]}
            if values["published"] != "true":
                self.lost += 1
                continue
            result = await self._answers.next(timeout=30)
            for name in STAGES[1:-1]:
                self.times[name].append(float(values[f"{name}_us"]))
            for name in ("cycles", "link_bytes"):
                self.times[name].append(float(values[name]))
            stamp = header_stamp_ns(frame.msg) or 0
            self.times["wire_in"].append((int(values["received_ns"]) - stamp) / 1e3)
            out = result.received_ns - int(values["sent_ns"])
            self.times["wire_out"].append(out / 1e3 - self.times["rosbridge_out"][-1])
        await frames.close()

    async def at_full_rate(self, some: list[dict[str, int]]) -> None:
        """Measure answers per second with WINDOW readings in flight, and the CPU time of each process per answer."""
        before = {command: cpu_us(pids) for command, pids in self._pids.items()}
        started = time.perf_counter()
        for at, reading in enumerate(some):
            await self._publication.publish(message(reading))
            if at >= WINDOW:
                await self._answers.next(timeout=30)
        for _ in range(min(WINDOW, len(some))):
            await self._answers.next(timeout=30)
        self.per_second = len(some) / (time.perf_counter() - started)
        self.cpu = {
            command: (cpu_us(pids) - before[command]) / len(some) for command, pids in self._pids.items()
        }


async def in_turns(
    sides: Sequence[Measured], some: list[dict[str, int]], turn: int = TURN, hz: float = 0.0
) -> tuple[float, float, float]:
    """Return the median cycle times of two stacks, and the median of their ratios, after a warm-up.

    Each ratio is of two neighbouring turns, because the load of the machine changes.
    """
    for side in sides:
        await side.one_by_one(some[:TURN], hz)
        side.times.clear()
    turns = [slice(at, at + turn) for at in range(0, len(some), turn)]
    for at, part in enumerate(turns):
        for side in sides[:: 1 if at % 2 else -1]:
            await side.one_by_one(some[part], hz)
    one, other = (side.times["cycle"] for side in sides)
    ratio = statistics.median(statistics.median(one[part]) / statistics.median(other[part]) for part in turns)
    return statistics.median(one), statistics.median(other), ratio


async def measure(ros: Ros, stand: Stand, some: list[dict[str, int]]) -> dict[str, Measured]:
    """Measure the echo and the stacks in turns, so that noise affects all alike."""
    results = ros.subscribe(RESULTS_TOPIC, RESULTS_TYPE)
    echoes = ros.subscribe("/bench/echo", RESULTS_TYPE)
    all_ = {FLOOR: Measured(await ros.advertise("/bench/reading", SENSORS_TYPE), echoes, 0)}
    for name, topic in STACKS.items():
        all_[name] = Measured(await ros.advertise(topic, SENSORS_TYPE), results, stand.pid(name))
    for topic in ("/bench/reading", *STACKS.values()):
        await until_read(ros, topic)
    for each in all_.values():
        await each.one_by_one(some[: max(20, len(some) // 10)])
        each.times.clear()  # that was the warm-up
    for at in range(0, len(some), TURN):
        turn = some[at : at + TURN]
        for each in all_.values():
            await each.one_by_one(turn)
        for name in STACKS:
            await all_[name].stages(ros, turn[: len(turn) // 4 + 1])
    for each in all_.values():
        await each.at_full_rate(some)
    return all_


async def bench(arguments: argparse.Namespace) -> int:
    """Run everything, and print the table."""
    async with temporary_stand() as stand:
        await stand.start_hub()
        echo = ("-P", "-m", "scripts.benches.echo", stand.uri, str(LINES))
        await stand.start("echo", "listening", sys.executable, *echo)
        for name, topic in STACKS.items():
            flags = (*ALL_READINGS, *(["--fused"] if name == "fused" else []))
            await stand.start_boat_master(*flags, name=name, topic=topic)
        async with connect(stand.uri) as ros:
            all_ = await measure(ros, stand, readings(arguments.seed, arguments.frames))
    show(all_, arguments)
    return 0


def show(all_: dict[str, Measured], arguments: argparse.Namespace) -> None:
    """Print the table on standard output."""
    medians = {
        name: {stage: statistics.median(times) for stage, times in each.times.items()}
        for name, each in all_.items()
    }
    floor = medians[FLOOR]["cycle"]
    rows: dict[str, dict[str, float]] = {
        "median, us": {name: each["cycle"] for name, each in medians.items()},
        "99 %, us": {name: quantile(each.times["cycle"], 0.99) for name, each in all_.items()},
        "frames a second": {name: each.per_second for name, each in all_.items()},
    }
    ratios: dict[str, dict[str, float]] = {"median / (floor + compute)": {}, "(median - compute) / floor": {}}
    for name in STACKS:
        cycle, compute = medians[name]["cycle"], medians[name]["compute"]
        ratios["median / (floor + compute)"][name] = cycle / (floor + compute)
        ratios["(median - compute) / floor"][name] = (cycle - compute) / floor
        for stage in STAGES:
            rows.setdefault(f"{stage.replace('_', ' ')}, us", {})[name] = medians[name][stage]
        for command, used in all_[name].cpu.items():
            rows.setdefault(f"CPU of {command}, us", {})[name] = used
    shown: list[tuple[str, ...] | None] = []
    for of_rows, style in ((ratios, ".2f"), (rows, ".0f")):
        for title, figures in of_rows.items():
            shown.append((title, *(f"{figures[name]:{style}}" if name in figures else "" for name in all_)))
        shown.append(None)
    print_table(f"one cycle, {arguments.frames} frames, 32 x 32 cells on four boards", ("", *all_), shown)
    print(
        f"aim: a cycle takes at most {BOUND:g} times what floor and boards take; times are medians, rosbridge out is "
        f"encoding and sending alone; {len(os.sched_getaffinity(0))} cores, seed {arguments.seed}"
    )


def bench_either(arguments: argparse.Namespace) -> Awaitable[int]:
    """Compare the stack with the echo; with `--sizes`, measure the stack for several sizes of the problem."""
    if arguments.sizes:
        from scripts.benches.sizes import bench_sizes  # which needs this module

        return bench_sizes(arguments)
    if arguments.json or arguments.picture:
        raise SettingsError("--json and --picture need --sizes")
    return bench(arguments)


if __name__ == "__main__":
    parser = ScriptParser(
        "scripts/bench cycle", "Compare the time from a reading to its result with that of an echo."
    )
    parser.flag("--frames", "number of readings", 1000)
    add_seed(parser)
    parser.switch("--sizes", "vary lines, sensors and the message's size instead, without the echo")
    parser.flag("--json", "with --sizes, write all numbers to this file", type=Path)
    parser.flag("--picture", "with --sizes, draw them into this PNG", type=Path)
    parser.run(bench_either, 900)
