"""The demo: its processes are started in order and ended together (see scripts/demo)."""

from __future__ import annotations

import argparse
import asyncio
import math
import sys
import time
from pathlib import Path

from bridge.discovery import announced_uri
from scripts.running.flags import ScriptParser
from scripts.running.processes import BOAT_TOPIC, BOAT_TYPE, ROOT, Process, Screen, build, run_script

LIMIT = 180.0
"""Time limit of the demo, in seconds."""
PORT = "9090"
"""Port of the hub in a demo that runs until Ctrl-C."""


async def demo(arguments: argparse.Namespace) -> int:
    """Build, start everything, wait for the viewer's last picture, and end everything."""
    started = time.monotonic()
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)  # noqa: ASYNC240 - nothing else runs yet
    deployment = out / "deployment"
    screen = Screen()
    processes = {
        name: Process(
            name, out / f"{name}.log", show=screen.show if name in {"boat-viewer", "master"} else None
        )
        for name in ("hub", "boat-viewer", "master", "boat-normaliser", "boat-simulator")
    }
    hub, viewer, master, normaliser, simulator = processes.values()
    saying = asyncio.create_task(screen.say_what_it_waits_for())
    try:
        uri = arguments.uri
        screen.waits_for = "building the deployment"
        if uri is None:
            screen.show(
                "starting the hub (the embedded rosbridge server), building the boat's deployment ..."
            )
            await hub.start("hub", "--port", PORT if arguments.stay else "0")
            uri = (await hub.line(r"ws://\S+"))[0]
        else:
            uri = await announced_uri(uri)  # once, instead of in each process
            screen.show(f"using the rosbridge server at {uri}, building the boat's deployment ...")
        count = () if arguments.stay else ("--count", str(arguments.count))
        await viewer.start("boat-viewer", "--uri", uri, *count, "--out", str(out))
        # a real server accepts only installed message types, so the readings are sent as plain arrays there
        array = [] if arguments.uri is None else ["--array"]
        type_ = "std_msgs/Float64MultiArray" if array else BOAT_TYPE
        options = ("--set", "array=true") if array else ()
        building = asyncio.create_task(build("boat", deployment, uri, BOAT_TOPIC, type_, *options))
        await asyncio.gather(building, viewer.line("listening"))
        screen.waits_for = "waiting for results; a first start compiles kernels"
        await master.start("master", "--loop", *count, "-d", str(deployment), "--uri", uri)
        await normaliser.start("boat-normaliser", "--uri", uri, *array)
        seed = ["--seed", str(arguments.seed)] if arguments.seed is not None else []
        await simulator.start("boat-simulator", "--uri", uri, "--rate", str(arguments.rate), *seed, *array)
        await master.succeed()
        screen.waits_for = "drawing the pictures"
        await viewer.succeed()
        screen.show(f"done in {time.monotonic() - started:.1f} s; pictures are in {out}")
    finally:
        saying.cancel()
        await asyncio.gather(*(process.end() for process in reversed(processes.values())))
    return 0


def main() -> int:
    """Parse the flags and run the demo."""
    parser = ScriptParser(
        prog="scripts/demo", description="Run the boat case study from end to end, without a robot."
    )
    parser.add_argument(
        "--uri", metavar="ws://HOST:PORT|robot:NAME", shown="the embedded hub", help="a rosbridge server"
    )
    parser.add_argument("--count", type=int, default=25, help="number of frames")
    parser.add_argument(
        "--stay",
        action="store_true",
        help=f"run until Ctrl-C, with the hub on port {PORT}, so that `listen` and others can connect",
    )
    parser.add_argument("--rate", type=float, default=10.0, help="readings per second")
    parser.add_argument(
        "--seed", type=int, shown="a new one each time", help="seed of the route and of the noise"
    )
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=ROOT / "out", help="folder for pictures and logs"
    )
    arguments = parser.parse_args()
    if arguments.count < 1:
        parser.error("--count must be 1 or more")
    arguments.out = arguments.out.resolve()
    return run_script(lambda: demo(arguments), math.inf if arguments.stay else LIMIT)


if __name__ == "__main__":
    sys.exit(main())
