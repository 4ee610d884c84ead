"""Start times of the demo and of `master --once`: seconds from the command to the end of each step.

demo      hub, viewer ─┬─▶ deployment ─▶ master ─▶ first posterior ─▶ pictures
                       └─▶ simulator
master    imports ─▶ boards listen ─▶ programmed ─▶ first posterior ─▶ exit
                └──▶ services listen ─▶ connected
"""

import argparse
import asyncio
import os
import statistics
import time
from collections.abc import Mapping
from pathlib import Path

from casestudies.boat.sensors import SENSORS_TOPIC, SENSORS_TYPE
from casestudies.demo import build
from scripts.running.flags import ScriptParser
from scripts.running.script import print_table
from scripts.running.stand import temporary_stand
from terminal.errors import ProcessError
from terminal.processes import own_command

LIMIT = 900.0
"""Time limit, in seconds."""
LOOK_EVERY = 0.002
"""Seconds between two checks for files."""
LINES = {
    "first line": "",
    "publisher connected": "publisher: ",
    "subscriber connected": "subscriber: ",
    "boards programmed": "pcie-app: ",
    "first posterior": "    1 ",
    "first posterior ": "frame 1: ",
    "last posterior": " results, median",
    "pictures": "done in",
}
"""A step is over when a line contains its text."""
MASTER = {
    **{f"{role} listens": f"run/{role}.sock" for role in ("subscriber", "publisher", "pcie-app")},
    "board 0 listens": "run/board0.sock",
    "boards listen": "run/board3.sock",
}
"""A step is over when its file exists in the folder of the measurement."""
DEMO = {"deployment written": "deployment/deployment.toml"}
"""The only step of the demo, and the file that ends it."""


async def steps(folder: Path, files: Mapping[str, str], *command: str, **variables: str) -> dict[str, float]:
    """Run a command, and return the seconds from its start to each step.

    A step in `files` is reached when the step's file exists in `folder`.

    Raises:
        ProcessError: The command failed.
    """
    run = folder / "run"
    run.mkdir(parents=True, mode=0o700)
    began, times = time.monotonic(), {}
    process = await asyncio.create_subprocess_exec(
        *own_command(command[0]),
        *command[1:],
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        env={**os.environ, "BM_RUN_DIRECTORY": str(run), **variables},
    )

    async def look() -> None:
        while waiting := [step for step in files if step not in times]:
            for step in waiting:
                if (folder / files[step]).exists():
                    times[step] = time.monotonic() - began
            await asyncio.sleep(LOOK_EVERY)

    looking = asyncio.create_task(look())
    said, silence, newest = "", 0.0, began
    assert process.stdout is not None
    while chunk := (await process.stdout.read(1 << 16)).decode(errors="replace"):
        now = time.monotonic()
        said, silence, newest = said + chunk, max(silence, now - newest), now
        for step, text in LINES.items():
            if text in said:
                times.setdefault(step.strip(), now - began)
    looking.cancel()
    if code := await process.wait():
        raise ProcessError(f"{command[0]} ended with exit code {code}: {said.splitlines()[-1:]}")
    return times | {"exit": time.monotonic() - began, "(longest silence)": silence}


def show(title: str, rounds: list[dict[str, float]]) -> None:
    """Print the median of each step, in the order of the first round, with the first round beside it."""
    rows = [
        (step, f"{first:.2f}", f"{statistics.median(each.get(step, first) for each in rounds):.2f}")
        for step, first in sorted(rounds[0].items(), key=lambda item: (item[0].startswith("("), item[1]))
    ]
    print_table(title, ("step", "first round, s", "median, s"), rows)


async def bench(arguments: argparse.Namespace) -> int:
    """Measure the demo, then `master --once` with compiled kernels, then one run that compiles them."""
    async with temporary_stand() as stand:
        rounds = []
        for at in range(arguments.rounds):
            out = stand.folder / f"demo{at}"
            rounds.append(await steps(out, DEMO, "rosbayes", "demo", "--out", str(out)))
        show("rosbayes demo, 25 frames", rounds)
        await stand.start_hub()
        deployment = stand.folder / "deployment"
        await build("boat", deployment, stand.uri, SENSORS_TOPIC, SENSORS_TYPE)
        await stand.start_boat()
        once = ("master", "--once", "-d", str(deployment))
        rounds = [await steps(stand.folder / f"once{at}", MASTER, *once) for at in range(arguments.rounds)]
        show("master --once", rounds)
        kernels = str(stand.folder / "kernels")
        cold = await steps(stand.folder / "cold", MASTER, *once, NUMBA_CACHE_DIR=kernels)
        show("master --once, which compiles the kernels", [cold])
    return 0


if __name__ == "__main__":
    parser = ScriptParser(
        "scripts/bench start", "Print when each step of the start of the demo and of master --once is over."
    )
    parser.flag("--rounds", "number of starts of each", 5)
    parser.run(bench, LIMIT)
