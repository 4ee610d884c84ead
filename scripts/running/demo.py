"""The demo: the processes of a case are started in order and ended together (see scripts/demo)."""

from __future__ import annotations

import argparse
import asyncio
import math
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bridge.discovery import announced_uri
from scripts.running.flags import ScriptParser
from scripts.running.patience import FACTOR
from scripts.running.processes import BOAT_TOPIC, BOAT_TYPE, ROOT, Process, Screen, build, run_script

LIMIT = 180.0 * FACTOR
"""Time limit of the demo, in seconds."""
PORT = "9090"
"""Port of the hub in a demo that runs until Ctrl-C."""
FIRST_RESULT = r"^ *[0-9]+ "
"""A viewer's line for a frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A case study as the demo runs it; its commands get `--uri` besides their options."""

    name: str
    topic: str
    type: str
    boards: int
    options: Sequence[str] = ()
    """Options of the build."""
    viewer: str
    publishers: Mapping[str, Sequence[str]]
    """The commands on the robot's side with their options, in the order of their start."""


def boat(rates: Sequence[str], *, array: bool) -> Case:
    """Return the boat on four boards; with `array`, its readings are plain arrays."""
    flags = ["--array"] if array else []
    return Case(
        name="boat",
        topic=BOAT_TOPIC,
        type="std_msgs/Float64MultiArray" if array else BOAT_TYPE,
        boards=4,
        options=("--set", "array=true") if array else (),
        viewer="boat-viewer",
        publishers={"boat-normaliser": flags, "boat-simulator": [*rates, *flags]},
    )


def sprinkler(rates: Sequence[str], count: int) -> Case:
    """Return the sprinkler on two chains, with a bank of seeds for each frame, so that no frame repeats another."""
    options = {"machine": "bm2", "samples": 50_000, "stream": 4096, "rng-banks": min(max(count, 16), 256)}
    return Case(
        name="sprinkler",
        topic="/sprinkler/grass",
        type="std_msgs/UInt8",
        boards=2,
        options=[text for name, value in options.items() for text in (f"--{name}", str(value))],
        viewer="sprinkler-viewer",
        publishers={"sprinkler-garden": rates},
    )


async def demo(arguments: argparse.Namespace) -> int:
    """Build, start everything, wait for the viewer's last picture, and end everything."""
    started = time.monotonic()
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)  # noqa: ASYNC240 - nothing else runs yet
    deployment = out / "deployment"
    rates = ["--rate", str(arguments.rate)]
    if arguments.seed is not None:
        rates += ["--seed", str(arguments.seed)]
    array = arguments.uri is not None  # a real server accepts only installed message types
    case = sprinkler(rates, arguments.count) if arguments.sprinkler else boat(rates, array=array)
    screen = Screen()
    # the page shows what the viewer prints, whose lines would hide the page's address
    shown = {"master"} if arguments.dashboard else {case.viewer, "master"}
    processes = {
        name: Process(name, out / f"{name}.log", show=screen.show if name in shown else None)
        for name in ("hub", case.viewer, "master", *case.publishers, "dashboard")
    }
    hub, viewer, master, *_ = processes.values()
    saying = asyncio.create_task(screen.say_what_it_waits_for())
    try:
        uri = arguments.uri
        screen.waits_for = "building the deployment"
        if uri is None:
            screen.show(
                f"starting the hub (the embedded rosbridge server), building the {case.name}'s deployment ..."
            )
            await hub.start("hub", "--port", PORT if arguments.stay else "0")
            uri = (await hub.line(r"ws://\S+"))[0]
        else:
            uri = await announced_uri(uri)  # once, instead of in each process
            screen.show(f"using the rosbridge server at {uri}, building the {case.name}'s deployment ...")
        count = () if arguments.stay else ("--count", str(arguments.count))
        # before the first result, the deployment is built and kernels are compiled
        await viewer.start(
            *(case.viewer, "--uri", uri, *count, "--out", str(out), "--first-timeout", str(LIMIT))
        )
        building = asyncio.create_task(
            build(case.name, deployment, uri, case.topic, case.type, *case.options, boards=case.boards)
        )
        await asyncio.gather(building, viewer.line("listening"))
        screen.waits_for = "waiting for results; a first start compiles kernels"
        await master.start("master", "--loop", *count, "-d", str(deployment), "--uri", uri)
        for name, options in case.publishers.items():
            await processes[name].start(name, "--uri", uri, *options)
        if arguments.dashboard:
            # after the first posterior, which does not wait for the installation
            await viewer.line(FIRST_RESULT)
            screen.show("installing the page in the browser, if that was not done before ...")
            await install_dashboard(out / "installation.log")
            await processes["dashboard"].start("dashboard", "--uri", uri, "-d", str(deployment))
            address = await processes["dashboard"].line(r"http://\S+")
            saying.cancel()
            screen.show(f"open {address[0]} in a browser; on the page, drag the boat")
        await master.succeed()
        screen.waits_for = "drawing the pictures"
        await viewer.succeed()
        screen.show(f"done in {time.monotonic() - started:.1f} s; pictures are in {out}")
        screen.show("to watch it live in a browser, and to drag the boat: scripts/demo --dashboard")
    finally:
        saying.cancel()
        await asyncio.gather(*(process.end() for process in reversed(processes.values())))
    return 0


async def install_dashboard(log: Path) -> None:
    """Install the packages of the page into this environment, unless they are there.

    Raises:
        StackError: pip cannot install them.
    """
    installing = Process("installation", log)
    await installing.start(
        "/bin/bash", "-c", f". {shlex.quote(str(ROOT / 'scripts' / 'environment'))} dashboard"
    )
    await installing.succeed()


def main() -> int:
    """Parse the flags and run the demo."""
    parser = ScriptParser(
        prog="scripts/demo", description="Run a case study from end to end, without a robot: the boat."
    )
    parser.add_argument("--sprinkler", action="store_true", help="run the sprinkler instead, on two BM2")
    parser.add_argument(
        "--uri", metavar="ws://HOST:PORT|robot:NAME", shown="the embedded hub", help="a rosbridge server"
    )
    parser.add_argument("--count", type=int, default=25, help="number of frames")
    parser.add_argument(
        "--stay",
        action="store_true",
        help=f"run until Ctrl-C, with the hub on port {PORT}, so that `listen` and others can connect",
    )
    parser.add_argument(
        "--dashboard",
        action="store_true",
        help="run until Ctrl-C, as --stay, with a page in the browser on port 8080",
    )
    parser.add_argument("--rate", type=float, default=10.0, help="readings per second")
    parser.add_argument("--seed", type=int, shown="a new one each time", help="seed of what is simulated")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=ROOT / "out", help="folder for pictures and logs"
    )
    arguments = parser.parse_args()
    if arguments.count < 1:
        parser.error("--count must be 1 or more")
    arguments.stay |= arguments.dashboard
    arguments.out = arguments.out.resolve()
    return run_script(lambda: demo(arguments), math.inf if arguments.stay else LIMIT)


if __name__ == "__main__":
    sys.exit(main())
