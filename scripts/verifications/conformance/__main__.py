"""Tests of the hub with other clients: roslibpy's own suites, typical uses of roslib (scripts/verify conformance)."""

import argparse
import asyncio
import os
import re
import shutil
import time
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from bridge.client import GoalRequest, connect
from scripts.running.flags import ScriptParser
from scripts.running.patience import FACTOR
from scripts.running.stand import Stand, temporary_stand
from scripts.verifications.checks import Tally
from scripts.verifications.installation import install_node_packages, install_roslibpy

NODE_SCRIPT: Final = Path(__file__).with_name("roslib.mjs")
LIMIT: Final = 240 * FACTOR
"""Time limit of one suite, in seconds."""
PORT_OF_THE_SUITES: Final = "9090"
"""Port of the server in the files of the suites. In the copies that run here, the hub's port replaces it."""
SUITES: Final = {
    "1": (
        *("ros1/test_topic.py", "ros1/test_ros.py", "ros1/test_service.py", "ros1/test_param.py"),
        *("ros1/test_rosapi.py", "ros1/test_core.py", "ros1/test_actionlib.py", "test_transport.py"),
    ),
    "2": (
        *("ros2/test_topic.py", "ros2/test_ros.py", "ros2/test_rosapi.py", "ros2/test_core.py"),
        *("ros2/test_actions.py", "test_transport.py"),
    ),
}
TRANSPORTS: Final = ("twisted", "asyncio")
STEP: Final = 0.3
"""Seconds per number of the Fibonacci server: the suites cancel a goal of ten numbers after two seconds."""


async def fibonacci(goal: GoalRequest) -> dict[str, Any]:
    """Execute a goal of roslibpy's tests of ROS 2: one number of the sequence per step."""
    sequence = [0, 1]
    while len(sequence) <= goal.values["order"]:
        if goal.canceling:
            goal.cancel({"sequence": sequence})
            break
        sequence.append(sequence[-1] + sequence[-2])
        goal.feed_back({"sequence": sequence})
        await asyncio.sleep(STEP)
    return {"sequence": sequence}


async def roslibpy(ros_version: str, transport: str, stand: Stand) -> str | None:
    """Run roslibpy's suites, and return what failed, or None."""
    clients, folder = install_roslibpy(), stand.folder
    shutil.copytree(clients / "source" / "tests", folder / "tests")
    async with connect(stand.uri) as ros:
        if ros_version == "2":
            await ros.advertise_action("/fibonacci", "example_interfaces/action/Fibonacci", fibonacci)
        for file in (folder / "tests").glob("ros?/*.py"):
            file.write_text(
                re.sub(rf"\b{PORT_OF_THE_SUITES}\b", str(urlsplit(stand.uri).port), file.read_text())
            )
        python = str(clients / "venv" / "bin" / "python")
        pytest = (python, "-m", "pytest", "-q", "-rfE", "-p", "no:cacheprovider")
        flags = ("-c", os.devnull, "--rootdir", str(folder), "--timeout", str(60 * FACTOR))
        suites = (f"tests/{suite}" for suite in SUITES[ros_version])
        return await failure_of(stand, f"ROSLIBPY_TRANSPORT={transport}", *pytest, *flags, *suites)


async def roslib(ros_version: str, stand: Stand) -> str | None:
    """Run the checks of roslib.mjs, and return what failed, or None."""
    module = install_node_packages("roslib", NODE_SCRIPT.parent) / "roslib" / "dist" / "RosLib.js"
    return await failure_of(stand, "node", str(NODE_SCRIPT), str(module), stand.uri, ros_version)


async def failure_of(stand: Stand, *command: str) -> str | None:
    """Run a suite in the stand's folder, print its last line, and if it failed, return its lines about failures."""
    await stand.start("suite", "", "/usr/bin/env", "-C", str(stand.folder), *command)
    try:
        async with asyncio.timeout(LIMIT):
            code = await stand.wait("suite")
    except TimeoutError:
        return f"it did not end within {LIMIT:g} s"
    lines = stand.log("suite").read_text().strip().splitlines() or ["it said nothing"]
    print(f"     {lines[-1]}")
    failed = [line for line in lines if line.startswith(("FAIL", "ERROR"))]
    return "\n     ".join(failed or lines[-1:]) if code else None


async def verify(arguments: argparse.Namespace) -> int:
    """Run everything, each suite on its own hub."""
    tally = Tally()
    runs: dict[tuple[str, str], Callable[[Stand], Awaitable[str | None]]] = {}
    for version in ("1", "2"):
        for transport in TRANSPORTS:
            runs[version, f"roslibpy, {transport}, ROS {version}"] = partial(roslibpy, version, transport)
        runs[version, f"roslib on Node, ROS {version}"] = partial(roslib, version)
    for (version, name), run in runs.items():
        if arguments.only in name:
            began = time.monotonic()
            async with temporary_stand() as stand:
                await stand.start_hub("--ros-version", version)
                tally.report(name, began, await run(stand))
    return tally.end()


if __name__ == "__main__":
    parser = ScriptParser("scripts/verify conformance", __doc__)
    parser.flag("--only", "runs with this in their names, such as roslibpy", "")
    parser.run(verify, 1800 * FACTOR)
