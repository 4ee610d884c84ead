"""Tests of other projects on the hub: roslibpy's own suites, and roslib on Node (see scripts/conformance)."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import re
import shutil
import socket
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from scripts.other_clients.fibonacci_server import fibonacci_server
from scripts.other_clients.installation import install_roslib, install_roslibpy
from scripts.running.flags import ScriptParser, output_file
from scripts.running.processes import Process, run_script

NODE_SCRIPT = Path(__file__).with_name("conformance_roslib.mjs")
SUITE_LIMIT = 240
PORT_OF_THE_SUITES = "9090"
"""Port in the suites' files, replaced by a free one in the copies that run here."""

SUITES = {
    "1": (
        *("ros1/test_topic.py", "ros1/test_ros.py", "ros1/test_service.py", "ros1/test_param.py"),
        *("ros1/test_rosapi.py", "ros1/test_core.py", "ros1/test_actionlib.py", "test_transport.py"),
    ),
    "2": (
        *("ros2/test_topic.py", "ros2/test_ros.py", "ros2/test_rosapi.py", "ros2/test_core.py"),
        *("ros2/test_actions.py", "test_transport.py"),
    ),
}
TRANSPORTS = ("twisted", "asyncio")


@dataclass(frozen=True)
class Outcome:
    """The outcome of one test: `passed`, `failed` or `skipped`, with the reason if not passed."""

    client: str
    ros_version: str
    test: str
    outcome: str
    why: str = ""


def free_port() -> int:
    """Return a free port on loopback."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


async def output_of(command: list[str], environment: dict[str, str], cwd: Path) -> tuple[int, str]:
    """Run a suite, and return its exit code (-1 after the time limit) and its output."""
    process = await asyncio.create_subprocess_exec(
        *command,
        cwd=cwd,
        env=os.environ | environment,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    assert process.stdout is not None
    printed = bytearray()

    async def read(stream: asyncio.StreamReader) -> None:
        while chunk := await stream.read(1 << 16):
            printed.extend(chunk)

    code = -1
    try:
        async with asyncio.timeout(SUITE_LIMIT):
            await read(process.stdout)
            code = await process.wait()
    except TimeoutError:
        printed.extend(f"\nit did not end within {SUITE_LIMIT} s".encode())
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    return code, printed.decode("utf-8", "replace")


def last_line(text: str) -> str:
    """Return the last line that is not blank."""
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "it said nothing")


def cases_of(report: Path) -> Iterator[tuple[str, str, str]]:
    """Return the outcome of each test from pytest's XML."""
    for case in ET.parse(report).getroot().iter("testcase"):  # noqa: S314 - our own pytest wrote it
        name = f"{case.get('classname', '').removeprefix('tests.').replace('.', '/')}::{case.get('name')}"
        outcome, why = "passed", ""
        for child in case:
            if child.tag in {"failure", "error"}:
                outcome, why = "failed", (child.get("message") or last_line(child.text or "")).splitlines()[0]
            elif child.tag == "skipped" and outcome == "passed":
                outcome, why = "skipped", child.get("message") or ""
        yield name, outcome, why


async def roslibpy_suites(folder: Path, ros_version: str, transport: str, work: Path) -> list[Outcome]:
    """Run roslibpy's suites for one ROS version and transport on their own hub."""
    client = f"roslibpy, {transport}"
    port, copy = free_port(), work / f"suites-{ros_version}-{transport}"
    shutil.copytree(folder / "source" / "tests", copy / "tests")
    for file in (copy / "tests").glob("ros?/*.py"):
        file.write_text(re.sub(rf"\b{PORT_OF_THE_SUITES}\b", str(port), file.read_text()))
    hub = Process("hub", work / f"hub-{ros_version}-{transport}.log")
    try:
        await hub.start("hub", "--port", str(port), "--ros-version", ros_version)
        await hub.line(r"ws://\S+")
        report = copy / "report.xml"
        pytest = [str(folder / "venv" / "bin" / "python"), "-m", "pytest", "-q", "-p", "no:cacheprovider"]
        pytest += ["-c", os.devnull, "--rootdir", str(copy), "--timeout", "60", f"--junitxml={report}"]
        async with fibonacci_server(f"ws://127.0.0.1:{port}"):
            code, printed = await output_of(
                [*pytest, *(f"tests/{suite}" for suite in SUITES[ros_version])],
                {"ROSLIBPY_TRANSPORT": transport},
                copy,
            )
    finally:
        await hub.end()
    outcomes = [Outcome(client, ros_version, *case) for case in cases_of(report)] if report.exists() else []
    if code not in {0, 1} or not outcomes:
        outcomes.append(Outcome(client, ros_version, "the run itself", "failed", last_line(printed)))
    return outcomes


async def roslib_script(module: Path, ros_version: str, work: Path) -> list[Outcome]:
    """Run the checks of conformance_roslib.mjs on their own hub."""
    hub = Process("hub", work / f"hub-{ros_version}-roslib.log")
    try:
        await hub.start("hub", "--port", "0", "--ros-version", ros_version)
        uri = (await hub.line(r"ws://\S+"))[0]
        code, printed = await output_of(["node", str(NODE_SCRIPT), str(module), uri, ros_version], {}, work)
    finally:
        await hub.end()
    outcomes, ended = [], False
    for line in printed.splitlines():
        try:
            said = json.loads(line)
            if said == "end":
                ended = True
            else:
                outcome = "passed" if said["ok"] else "failed"
                outcomes.append(Outcome("roslib, Node", ros_version, said["test"], outcome, said["why"]))
        except (ValueError, TypeError, KeyError):
            continue  # printed by roslib itself
    if code or not ended:
        outcomes.append(Outcome("roslib, Node", ros_version, "the run itself", "failed", last_line(printed)))
    return outcomes


async def check(arguments: argparse.Namespace) -> int:
    """Run everything, print the table, and return 1 if a test failed."""
    versions = [arguments.ros_version] if arguments.ros_version else ["1", "2"]
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory(prefix="conformance-rosbayes-") as folder:
        work = Path(folder)
        if arguments.only in {None, "roslibpy"}:
            clients = install_roslibpy()
            for version in versions:
                for transport in TRANSPORTS:
                    outcomes += await roslibpy_suites(clients, version, transport, work)
        if arguments.only in {None, "roslib"}:
            module = install_roslib()
            for version in versions:
                outcomes += await roslib_script(module, version, work)
    show(outcomes)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps([asdict(each) for each in outcomes], indent=2) + "\n")
    return int(any(each.outcome == "failed" for each in outcomes))


def show(outcomes: list[Outcome]) -> None:
    """Print the table and the last line."""
    table = Table(title="the hub under other projects' tests")
    for column in ("client", "ROS", "test", "outcome", "why"):
        table.add_column(column, overflow="fold")
    colours = {"passed": "green", "failed": "bold red", "skipped": "yellow"}
    before = None
    for each in outcomes:
        if before not in {None, (each.client, each.ros_version)}:
            table.add_section()
        before = (each.client, each.ros_version)
        shown = f"[{colours[each.outcome]}]{each.outcome}[/]"
        table.add_row(each.client, each.ros_version, escape(each.test), shown, escape(each.why))
    # in a file, the table is as wide as its longest line
    console = Console() if sys.stdout.isatty() else Console(width=200)
    console.print(table)
    count = {kind: sum(each.outcome == kind for each in outcomes) for kind in colours}
    if count["skipped"]:
        print(
            f"{count['skipped']} skipped by the suites themselves (each transport's tests run with it alone)"
        )
    print(f"{count['passed']} passed, {count['failed']} failed")


def main() -> int:
    """Parse the flags and run the tests."""
    parser = ScriptParser(
        prog="scripts/conformance", description="The hub under the tests of other projects."
    )
    parser.add_argument("--only", choices=("roslibpy", "roslib"), shown="both", help="one client")
    parser.add_argument("--ros-version", choices=("1", "2"), shown="both", help="the hub as one ROS version")
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write all outcomes")
    arguments = parser.parse_args()
    return run_script(lambda: check(arguments), 1800)


if __name__ == "__main__":
    sys.exit(main())
