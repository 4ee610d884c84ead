"""Cycle time if a subscriber and a publisher are started for each message, compared with a single start.

The thesis's script probably started both for each message.

client --reading--> hub --> subscriber -> master -> pcie-app -> 4 boards -> pcie-app -> master -> publisher --> hub --> client
                            `-- started for each message, or once ------------------------------'
"""

import argparse
import statistics
import time
from collections import defaultdict

from bridge.client import Publication, Ros, Subscription, connect
from casestudies.boat.sensors import SENSORS_TOPIC, SENSORS_TYPE
from posteriors.frame_report import read_frame_report
from scripts.benches.cycle import ALL_READINGS, Times, add_seed, message, quantile, readings, until_read
from scripts.running.flags import ScriptParser
from scripts.running.script import print_table
from scripts.running.stand import temporary_stand

RUNS = {"each message": ("--start-each-message",), "once": ()}
"""Flags of `master`: subscriber and publisher started for each message, or once."""
THESIS = {"rosbridge": 98.74, "computing": 1.24, "PCIe": 0.01}
"""The shares of figure 4.5 in percent."""
TURN = 5
"""Number of messages in a turn, after which the other run is measured."""
STAGES = {"compute": "computing", "register_writes": "PCIe", "reads": "PCIe"}
PAUSE = 0.005


class Run:
    """A master, and the times of its cycles (us), each from the end of the previous cycle."""

    def __init__(
        self, ros: Ros, topic: str, publication: Publication, results: Subscription, frames: Subscription
    ) -> None:
        self._ros, self._topic, self._publication = ros, topic, publication
        self._results, self._frames = results, frames
        self.times: Times = defaultdict(list)

    async def cycle(self, reading: dict[str, int]) -> None:
        """Publish a reading once its topic has a subscriber, and wait for the result."""
        started = time.perf_counter_ns()
        await until_read(self._ros, self._topic, PAUSE)
        await self._publication.publish(message(reading))
        frame = await self._frames.next(timeout=60)
        await self._results.next(timeout=60)
        whole = (time.perf_counter_ns() - started) / 1e3
        stages = read_frame_report(frame.msg, frame.received_ns).stages
        shares = dict.fromkeys(THESIS, 0.0)
        for stage, part in STAGES.items():
            shares[part] += getattr(stages, stage)
        shares["rosbridge"] = whole - sum(shares.values())
        for part, spent in (shares | {"cycle": whole}).items():
            self.times[part].append(spent)


async def bench(arguments: argparse.Namespace) -> int:
    """Run both masters in turns, and print the table."""
    runs: dict[str, Run] = {}
    async with temporary_stand() as stand:
        await stand.start_hub()
        async with connect(stand.uri) as ros:
            results = ros.subscribe("/BMresults", "std_msgs/Float64MultiArray")
            frames = ros.subscribe("/bm/frame", "diagnostic_msgs/DiagnosticArray")
            for name, flags in RUNS.items():
                at = f"master{len(runs)}"
                topic = f"{SENSORS_TOPIC}_{at}"
                options = ("--thesis",)
                await stand.start_boat_master(*ALL_READINGS, *flags, name=at, topic=topic, options=options)
                runs[name] = Run(ros, topic, await ros.advertise(topic, SENSORS_TYPE), results, frames)
            some = readings(arguments.seed, arguments.messages + 1)
            for each in runs.values():
                await each.cycle(some[-1])
                each.times.clear()  # that was the warm-up
            for first in range(0, arguments.messages, TURN):
                for each in runs.values():
                    for reading in some[first : min(first + TURN, arguments.messages)]:
                        await each.cycle(reading)
    show(runs, arguments)
    return 0


def show(runs: dict[str, Run], arguments: argparse.Namespace) -> None:
    """Print the table on standard output."""
    cycles = {name: run.times["cycle"] for name, run in runs.items()}
    means = {name: statistics.fmean(times) for name, times in cycles.items()}
    rows = [
        ("cycle, mean, ms", *(f"{mean / 1e3:.2f}" for mean in means.values()), ""),
        ("cycle, 99 %, ms", *(f"{quantile(times, 0.99) / 1e3:.2f}" for times in cycles.values()), ""),
    ]
    for part, share in THESIS.items():
        sums = (100 * sum(run.times[part]) / sum(run.times["cycle"]) for run in runs.values())
        rows.append((f"{part}, % of the cycles", *(f"{each:.2f}" for each in sums), f"{share:.2f}"))
    print_table(
        f"subscriber and publisher started for each message, or once: {arguments.messages} messages",
        ("", *runs, "thesis"),
        rows,
    )
    each, once = means.values()
    print(
        f"a cycle with starts takes {each / once:.1f} times as long as one without; rosbridge is all but computing and PCIe, "
        f"boards are emulated; seed {arguments.seed}"
    )


if __name__ == "__main__":
    parser = ScriptParser(
        "scripts/bench thesis",
        "Compare a subscriber and a publisher for each message, as probably in the thesis, with those of a usual run.",
    )
    parser.flag("--messages", "number of messages", 25)
    add_seed(parser)
    parser.run(bench, 600)
