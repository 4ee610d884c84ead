"""The time of a cycle by lines, sensors and the size of the readings' message (thesis 2.1.2, 4.3).

client --reading of n bytes--> hub --> master and its services --> one board of l lines and c columns --> ... --> client

One size varies at a time. The lines of a larger machine repeat the lines of the smallest machine, so machines differ
only in size. The two readings of a sensor are nearly equally probable, so even frames of 30 sensors have a posterior.
"""

import argparse
import json
import os
import random
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from bridge.client import connect
from scripts.benches.cycle import ALL_READINGS, Measured, message, quantile
from scripts.running.script import print_table
from scripts.running.stand import Stand, temporary_stand
from terminal.output import write_json
from terminal.pictures import new_figure, save_figure
from toolchain.building.build import build_deployment
from toolchain.building.machine import plan_machine
from toolchain.building.options import BuildOptions
from toolchain.models import Known, Model, dimension

LINES, SENSORS, PADDING = (64, 256, 1024, 4096), (2, 6, 14, 30), (0, 1_000, 10_000, 100_000, 400_000)
"""The sizes to measure; PADDING is the number of bytes added to each message."""
BASE = 1024, 6, 0
"""The base problem: lines, sensors and padding, of which each series of measurements varies one."""
NEARLY_EVEN = 0.45, 0.55
"""Bounds between which the probability of a reading of 1 is drawn, for each sensor and line."""
TYPE = "bench_msgs/Readings"
PARTS = {
    "rosbridge": ("wire_in", "rosbridge_in", "rosbridge_out", "wire_out"),
    "hops": ("local_hops", "waited"),
    "registers": ("register_writes", "reads"),
    "boards": ("compute",),
}
"""Parts of a frame's time. The time of a part is the sum of the listed stages. The boards are emulated."""


class Point(NamedTuple):
    """Measurements of one problem: medians over the problem's frames, but 10th percentiles for times."""

    lines: int
    sensors: int
    padding: int
    size: int
    """Bytes of a message as JSON."""
    cycles: float
    link_bytes: float
    cycle_us: float
    parts_us: dict[str, float]
    """Times in microseconds, by the names in `PARTS`."""
    lost: int
    """Frames without a posterior, of those whose stages were measured."""


def problems() -> list[tuple[int, int, int]]:
    """Return lines, sensors and padding of every problem; the base problem occurs once."""
    lines, sensors, padding = BASE
    first = [(each, sensors, padding) for each in LINES] + [(lines, each, padding) for each in SENSORS]
    return list(dict.fromkeys(first + [(lines, sensors, each) for each in PADDING]))


def model(lines: int, sensors: int) -> Model:
    """Return a model whose first columns and lines are the same in every size."""
    chance = np.random.default_rng(1).uniform(*NEARLY_EVEN, (max(SENSORS), min(LINES)))
    tables = np.stack([1 - chance, chance], axis=1)[:, :, np.arange(lines) % min(LINES)]
    known = tuple(Known(name=f"s{at}", table=tables[at]) for at in range(sensors))
    return Model(name="sizes", searched=(dimension("x", size=lines),), known=known)


async def measure(stand: Stand, problem: tuple[int, int, int], arguments: argparse.Namespace) -> Point:
    """Build a problem's machine, run it, and measure its frames."""
    lines, sensors, padding = problem
    topic = f"/sizes/of_{lines}_{sensors}_{padding}"
    options = BuildOptions(uri=stand.uri, topic=topic, type=TYPE, max_cycles=1 << 20)
    name = f"{lines}_{sensors}_{padding}"
    build_deployment(plan_machine(model(lines, sensors), options), stand.folder / name)
    chance = random.Random(arguments.seed)
    some: list[dict[str, Any]] = [
        {f"s{at}": chance.randrange(2) for at in range(sensors)} | {"padding": "x" * padding}
        for _ in range(arguments.frames)
    ]
    flags = (*ALL_READINGS, "--topic-bytes", str(2 * max(PADDING)))
    await stand.start_master(stand.folder / name, *flags, name=f"master-{name}", boards=1)
    async with connect(stand.uri) as ros:
        measured = await Measured.of_stack(ros, topic, TYPE)
        # a lost frame has no result to wait for: their number is known before results are awaited alone
        await measured.stages(ros, some[:10])
        measured.times.clear()  # that was the warm-up
        await measured.stages(ros, some)
        if not measured.lost:
            await measured.one_by_one(some)
    await stand.end(f"master-{name}")
    times = measured.times
    parts = {
        part: [sum(of_frame) for of_frame in zip(*(times[stage] for stage in stages), strict=True)]
        for part, stages in PARTS.items()
    }
    return Point(
        lines=lines,
        sensors=sensors,
        padding=padding,
        size=len(json.dumps(message(some[0]))),
        cycles=median(times["cycles"]),
        link_bytes=median(times["link_bytes"]),
        # other processes only slow a frame down
        cycle_us=quantile(times["cycle"], 0.1),
        parts_us={part: quantile(values, 0.1) for part, values in parts.items()},
        lost=measured.lost,
    )


async def bench_sizes(arguments: argparse.Namespace) -> int:
    """Measure every problem, and print the tables."""
    async with temporary_stand() as stand:
        await stand.start_hub()
        points = [await measure(stand, problem, arguments) for problem in problems()]
    show(points, arguments)
    if arguments.json:
        write_json(arguments.json, {"points": [each._asdict() for each in points]})
    if arguments.picture:
        draw(arguments.picture, points)
    return 0


def varied(points: Sequence[Point]) -> dict[str, list[Point]]:
    """Return, for each size, the points in which only this size differs from `BASE`."""
    lines, sensors, padding = BASE
    return {
        "lines": [each for each in points if each[1:3] == (sensors, padding)],
        "sensors": sorted(each for each in points if (each.lines, each.padding) == (lines, padding)),
        "size": [each for each in points if each[:2] == (lines, sensors)],
    }


def show(points: Sequence[Point], arguments: argparse.Namespace) -> None:
    """Print the table, and which of the thesis's claims hold."""
    rows = []
    for each in points:
        sizes = each.lines, each.sensors, each.size, each.cycles, each.link_bytes
        figures = *sizes, each.cycle_us, *each.parts_us.values(), each.lost
        rows.append([f"{figure:.0f}" for figure in figures])
    print_table(
        f"one cycle by the size of the problem, the fastest tenth of {arguments.frames} frames in us",
        ("lines", "sensors", "bytes", "cycles", "link B", "cycle", *PARTS, "lost"),
        rows,
        left=0,
    )
    along = varied(points)
    cycles = {name: [each.cycles for each in those] for name, those in along.items()}
    same = len(set(cycles["lines"])) == 1
    grows = cycles["sensors"] == sorted(cycles["sensors"])
    print(
        f"lines: a frame takes {min(cycles['lines']):,.0f} to {max(cycles['lines']):,.0f} cycles with {LINES[0]} to {LINES[-1]} "
        f"lines; that their number does not matter (thesis 2.1.2.1) {'holds' if same else 'does NOT hold'}"
    )
    print(
        f"sensors: {cycles['sensors'][0]:,.0f} cycles with {SENSORS[0]}, {cycles['sensors'][-1]:,.0f} with {SENSORS[-1]}; that "
        f"more columns take longer (thesis 2.1.2.1, 4.3) {'holds' if grows else 'does NOT hold'}: a cycle passes all columns "
        "at once, but a one must come out of each of them, so that a line counts more rarely"
    )
    print(
        f"stages of emulated boards grow with lines and sensors, as cycles do not; {len(os.sched_getaffinity(0))} cores, seed {arguments.seed}"
    )


def draw(path: Path, points: Sequence[Point]) -> None:
    """Draw the times of `PARTS` against each size, and the cycles on a second axis."""
    figure = new_figure(12, 4.2)
    titles = {"lines": "lines", "sensors": "sensors", "size": "bytes of a message"}
    for axes, (name, those) in zip(figure.subplots(1, 3, sharey=True), varied(points).items(), strict=True):
        sizes = [getattr(each, name) for each in those]
        for part, colour in zip(PARTS, ("#4477aa", "#bbbbbb", "#ccbb44", "#ee6677"), strict=True):
            axes.loglog(sizes, [each.parts_us[part] for each in those], marker="o", color=colour, label=part)
        axes.set_xlabel(titles[name])
        axes.set_xticks(
            sizes, [f"{size / 1000:.3g}k" if size >= 10_000 else str(size) for size in sizes], minor=False
        )
        axes.set_xticks([], minor=True)
        if name == "lines":
            axes.set_ylabel("us")
        beside = axes.twinx()
        beside.plot(
            sizes, [each.cycles for each in those], color="black", linestyle="--", label="cycles of BM1"
        )
        beside.set_ylim(0, 1.1 * max(each.cycles for each in points))
        if name == "size":
            beside.set_ylabel("cycles")
    handles = [line for each in (axes, beside) for line in each.get_lines()]
    figure.legend(
        handles, [line.get_label() for line in handles], loc="outside lower center", ncols=5, frameon=False
    )
    save_figure(figure, path)
