"""Measurements of the dashboard: display of 50 posteriors a second, delay after a drag, cost to a cycle.

display  this process -- 50 posteriors a second, 64 x 64 --> hub --> dashboard --> Chromium, one window and two
drag     mouse in Chromium --> dashboard --> hub --> boat-simulator --> ... --> master --> hub --> dashboard --> Chromium
cycle    a stack with a dashboard and a plain WebSocket reader, compared with a stack without a dashboard

The part `cycle` does without Chromium, because Chromium takes a core of its own.
"""

import argparse
import asyncio
import contextlib
import multiprocessing
import os
import random
import statistics
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Final

import numpy as np
from websockets.sync.client import connect as connect_plainly

from bridge.client import Ros, connect
from posteriors import BoardReport, FrameReport, StageTimes
from posteriors.frame_report import FRAME_TOPIC, FRAME_TYPE, VariableReading, write_frame_report
from posteriors.posterior import RESULTS_TOPIC, RESULTS_TYPE
from scripts.benches.cycle import Measured, add_seed, cpu_us, in_turns, quantile, readings
from scripts.running.browser import Browser, Visit, browser
from scripts.running.flags import ScriptParser
from scripts.running.script import print_table
from scripts.running.stand import Stand, temporary_stand

HZ: Final = 50
SIDE: Final = 64
WARM_UP: Final = 3.0
"""Seconds of results before a measurement."""
DRAGS: Final = 20
SAMPLES: Final = 10
"""Number of intervals in the measurement of memory."""
TURN: Final = 10
"""Number of cycles in a turn, after which the other stack is measured."""
LIMIT: Final = 24 * 3600.0
"""Time limit in seconds, longer than any sensible `--minutes`."""
PARTS: Final = ("cycle", "drag", "display")

Rows = list[tuple[str, str, str]]
"""Rows of the table: quantity, figure and aim."""


async def publish(ros: Ros, sent: dict[int, float]) -> None:
    """Until cancelled, publish results like a stack, and store the Unix time of each in `sent`, in ms, by number."""
    axis, posteriors = np.arange(SIDE), []
    for turn in np.linspace(0, 2 * np.pi, HZ, endpoint=False):
        x, y = SIDE / 2 + SIDE / 3 * np.cos(turn), SIDE / 2 + SIDE / 3 * np.sin(turn)
        values = np.exp(-((axis - x) ** 2 + (axis[:, None] - y) ** 2) / 40).ravel()
        posteriors.append((values / values.sum()).tolist())
    reports = await ros.advertise(FRAME_TOPIC, FRAME_TYPE)
    results = await ros.advertise(RESULTS_TOPIC, RESULTS_TYPE)
    dim = [{"label": name, "size": SIDE, "stride": SIDE ** (2 - at)} for at, name in enumerate("yx")]
    boards = [
        BoardReport(name=f"board {at}", stopped="overflow", cycles=9, counts_total=9) for at in range(4)
    ]
    values = {f"D{at}": VariableReading(12.0, 12, 3.0) for at in range(6)}
    stages = StageTimes(**{each.name: 100.0 for each in fields(StageTimes)})
    began = time.perf_counter()
    while True:
        number, now = len(sent) + 1, time.time_ns()
        report = FrameReport(
            stamp_ns=now, received_ns=now, sent_ns=now, number=number, outcome="posterior", cycles=1000,
            counts_total=255, stages=stages, boards=tuple(boards), readings=values,
        )  # fmt: skip
        sent[number] = now / 1e6
        with ros.together():
            await reports.publish(write_frame_report(report, 1))
            await results.publish({"layout": {"dim": dim, "data_offset": 0}, "data": posteriors[number % HZ]})
        await asyncio.sleep(max(0.0, began + number / HZ - time.perf_counter()))


async def display(stand: Stand, chromium: Browser, arguments: argparse.Namespace) -> Rows:
    """Measure display and CPU time with one window and with two, then the memory of dashboard and browser."""
    sent: dict[int, float] = {}
    async with connect(stand.uri, check_types=False) as ros:
        publishing = asyncio.create_task(publish(ros, sent))
        visits: list[Visit] = []
        rows: Rows = []
        for name, shown_aim, age_aim, cpu_aim in (
            ("one window", "at least 45", "50 ms", ""), ("two windows", "", "", "40 %"),
        ):  # fmt: skip
            visits.append(await chromium.open(stand.url))
            await asyncio.sleep(WARM_UP)
            begin, used, began = len(sent), cpu_us([stand.pid("dashboard")]), time.perf_counter()
            await asyncio.sleep(arguments.seconds)
            share = (cpu_us([stand.pid("dashboard")]) - used) / 1e6 / (time.perf_counter() - began)
            end = len(sent)
            await visits[0].frame_above(end)
            paints = {each["number"]: each["at"] for each in await visits[0].page.evaluate("window.paints")}
            ages = [at - sent[number] for number, at in paints.items() if begin < number <= end]
            late = f"{statistics.median(ages):.0f} ms, {quantile(ages, 0.95):.0f} ms"
            rows += [
                (f"shown of {HZ} a second, {name}", f"{HZ * len(ages) / (end - begin):.1f}", shown_aim),
                (f"age when painted, {name}: median, 95 %", late, age_aim),
                (f"CPU of the dashboard, {name}", f"{share:.0%} of a core", cpu_aim),
            ]
        await visits[1].close()
        rows += await memory(visits[0], stand.pid("dashboard"), arguments.minutes)
        publishing.cancel()
    return rows


def mib_of(pid: int) -> float:
    """Return the resident memory of a process in MiB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


async def memory(visit: Visit, pid: int, minutes: float) -> Rows:
    """Measure the memory of dashboard and browser for some minutes.

    The rows compare the end of this time with the middle.
    """
    await visit.page.evaluate("window.paints.push = () => 0")  # what this bench keeps is not the page's
    session = await visit.page.context.new_cdp_session(visit.page)
    taken: dict[str, list[float]] = {}
    for sample in range(SAMPLES + 1):
        await asyncio.sleep(60 * minutes / SAMPLES if sample else 0)
        await session.send("HeapProfiler.collectGarbage")
        heap, counters = [
            await session.send(name) for name in ("Runtime.getHeapUsage", "Memory.getDOMCounters")
        ]
        figures = {"MiB of the dashboard": mib_of(pid), "MiB of the browser's heap": heap["usedSize"] / 2**20}
        for name, figure in {**figures, "nodes in the browser": counters["nodes"]}.items():
            taken.setdefault(name, []).append(figure)
        print(
            f"minute {sample * minutes / SAMPLES:g}:",
            *(f"{name} {each[-1]:,.1f};" for name, each in taken.items()),
            file=sys.stderr,
        )
    half = SAMPLES // 2
    return [
        (
            f"{name}, after {minutes:g} minutes / half of them",
            f"{each[-1]:,.1f} / {each[half]:,.1f} = {each[-1] / each[half]:.2f}",
            "1",
        )
        for name, each in taken.items()
    ]


async def drags(stand: Stand, chromium: Browser, chance: random.Random) -> Rows:
    """Measure the time from the drop until a posterior is painted at the boat, by the browser's clock."""
    async with connect(stand.uri) as ros:
        # an unlucky reading would add the time until the next one
        await ros.call("/boat/noise", {"data": False}, timeout=30)
    visit = await chromium.open(stand.url)
    times = []
    for number in range(DRAGS):
        goal = (0.5 if number % 2 else 0.25, chance.uniform(0.4, 0.7))  # far from the previous one
        dropped = await visit.drag(goal, steps=1)
        times.append(await visit.mean_near(goal) - dropped)
    figures = f"{statistics.median(times):.0f} ms, {max(times):.0f} ms"
    return [("drop of the boat to its posterior: median, longest", figures, "200 ms")]


def read(url: str) -> None:
    """Read the WebSocket at `url` as the page would, until the server ends."""
    with connect_plainly(f"{url.replace('http', 'ws', 1)}/live", max_size=None) as socket:
        for _ in socket:
            socket.send(".")  # the page's acknowledgement


async def cycles(plain: Stand, beside: Stand, frames: int, seed: int) -> Rows:
    """Compare the cycle times of two stacks in short turns. Only `beside` has a dashboard, which a client reads."""
    async with connect(plain.uri) as one, connect(beside.uri) as other:
        # a process of its own, as a browser is
        reader = multiprocessing.get_context("spawn").Process(target=read, args=(beside.url,), daemon=True)
        reader.start()
        sides = [await Measured.of_stack(ros) for ros in (other, one)]
        with_it, without, ratio = await in_turns(sides, readings(seed, frames), TURN, HZ)
        reader.kill()
    figures = f"{with_it:,.0f} / {without:,.0f}, {ratio:.3f}"
    return [(f"cycle at {HZ} a second, with the dashboard / without, us, ratio", figures, "at most 1.05")]


async def bench(arguments: argparse.Namespace) -> int:
    """Measure part after part, and print the table."""
    rows: Rows = []
    only = arguments.only or PARTS
    async with contextlib.AsyncExitStack() as stack:
        if "cycle" in only:
            async with temporary_stand() as plain, temporary_stand() as beside:
                for stand in (plain, beside):
                    await stand.start_hub()
                    await stand.start_boat_master()
                await beside.start_dashboard()
                rows += await cycles(plain, beside, arguments.frames, arguments.seed)
        if set(only) - {"cycle"}:
            chromium = await stack.enter_async_context(browser())
        if "drag" in only:
            async with temporary_stand() as boat:
                await boat.start_hub()
                await boat.start_boat_master()
                await boat.start_boat()
                await boat.start_dashboard()
                rows += await drags(boat, chromium, random.Random(arguments.seed))
        if "display" in only:
            async with temporary_stand() as source:
                await source.start_hub()
                await source.start_dashboard()
                rows += await display(source, chromium, arguments)
    print_table(
        f"dashboard; display: {HZ} posteriors a second of {SIDE} x {SIDE}, otherwise the boat's 32 x 32",
        ("", "measured", "aim"),
        rows,
    )
    cores = len(os.sched_getaffinity(0))
    print(f"{cores} cores, shared by all processes and the browser; seed {arguments.seed}")
    return 0


if __name__ == "__main__":
    parser = ScriptParser(
        "scripts/bench dashboard", "Measure what the dashboard shows, how late, and what it costs the stack."
    )
    parser.flag("--seconds", "duration of each measurement of the display", 20.0)
    parser.flag("--minutes", "duration of the measurement of memory", 2.0)
    parser.flag("--frames", "number of cycles with and without the dashboard", 500)
    add_seed(parser)
    parser.flag("--only", "one part; repeat for more", choices=PARTS, action="append", shown="all")
    parser.run(bench, LIMIT)
