"""The hub under the tests of other projects: roslibpy's own suites, and roslib on Node. See scripts/conformance."""

from __future__ import annotations

import argparse
import asyncio
import hashlib
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import tarfile
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from processes import Process, run_script
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from services.errors import SettingsError

HERE = Path(__file__).resolve().parent
LOCK = HERE / "conformance.lock"
PACKAGES = HERE / "conformance-roslib"
NODE_SCRIPT = HERE / "conformance_roslib.mjs"
HOME_VARIABLE = "ROSBAYES_CONFORMANCE_HOME"
LAYOUT = "1"
"""Of the folders that are installed: rises when their content changes for the same locks."""
DOWNLOAD_LIMIT = 600
SUITE_LIMIT = 240
OLDEST_NODE = 20
PORT_OF_THE_SUITES = "9090"
"""Written into the suites' files; a free port takes its place in the copies that run here."""

SUITES = {
    "1": (
        *("ros1/test_topic.py", "ros1/test_ros.py", "ros1/test_service.py", "ros1/test_param.py"),
        *("ros1/test_rosapi.py", "ros1/test_core.py", "test_transport.py"),
    ),
    "2": (
        *("ros2/test_topic.py", "ros2/test_ros.py", "ros2/test_rosapi.py", "ros2/test_core.py"),
        "test_transport.py",
    ),
}
TRANSPORTS = ("twisted", "asyncio")


@dataclass(frozen=True)
class Outcome:
    """What came of one test: `passed`, `failed` or `skipped`, and why if not passed."""

    client: str
    ros_version: str
    test: str
    outcome: str
    why: str = ""


def home() -> Path:
    """Where the clients are installed."""
    if chosen := os.environ.get(HOME_VARIABLE):
        return Path(chosen).expanduser().absolute()
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache).absolute() / "rosbayes" / "conformance"


def installed(name: str, *locks: Path) -> tuple[Path, bool]:
    """The folder of what these lock files name, and whether it is complete."""
    digest = hashlib.sha256(LAYOUT.encode() + b"".join(lock.read_bytes() for lock in locks)).hexdigest()[:12]
    folder = home() / f"{name}-{digest}"
    return folder, (folder / ".complete").exists()


def run(*command: str | Path, cwd: Path | None = None) -> None:
    """Run an installer.

    Raises:
        SettingsError: it fails, in its own words, or does not end in time.
    """
    shown = " ".join(str(word) for word in command[:4])
    try:
        subprocess.run(command, cwd=cwd, check=True, capture_output=True, text=True, timeout=DOWNLOAD_LIMIT)
    except subprocess.TimeoutExpired as error:
        msg = f"`{shown} ...` did not end within {DOWNLOAD_LIMIT} s; try again"
        raise SettingsError(msg) from error
    except subprocess.CalledProcessError as error:
        lines = [line for line in error.stderr.splitlines() if re.match(r"(ERROR|npm error)", line)]
        said = (lines or error.stderr.splitlines() or [f"exit code {error.returncode}"])[0]
        msg = f"`{shown} ...` failed: {said}"
        raise SettingsError(msg) from error


def begin(folder: Path, what: str) -> None:
    """An empty folder for an installation, and a line for who waits."""
    print(f"installing {what} into {folder} (once) ...", file=sys.stderr)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)


def install_roslibpy() -> Path:
    """The folder with roslibpy's environment (venv) and its source package (source); made where missing."""
    folder, complete = installed("roslibpy", LOCK)
    if complete:
        return folder
    begin(folder, "roslibpy")
    run(sys.executable, "-m", "venv", folder / "venv")
    pip = (folder / "venv" / "bin" / "python", "-m", "pip", "-q", "--disable-pip-version-check")
    run(*pip, "install", "--require-hashes", "--no-deps", "-r", LOCK)
    # the block of roslibpy alone: its hashes are those of the wheel and of the source package
    block = re.search(r"^roslibpy==(?:.*\\\n)+.*\n", LOCK.read_text(), re.MULTILINE)
    assert block is not None
    (folder / "source.lock").write_text(block[0])
    run(
        *(*pip, "download", "--require-hashes", "--no-deps", "--no-binary", ":all:", "--no-build-isolation"),
        *("-r", folder / "source.lock", "-d", folder),
    )
    (archive,) = folder.glob("roslibpy-*.tar.gz")
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    (unpacked,) = (path for path in folder.glob("roslibpy-*") if path.is_dir())
    unpacked.rename(folder / "source")
    (folder / ".complete").touch()
    return folder


def install_roslib() -> Path:
    """The module of roslib; installed where missing.

    Raises:
        SettingsError: Node is not there, or too old.
    """
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        msg = f"roslib needs Node {OLDEST_NODE} or later with npm, which are not on PATH: install them (Debian: apt-get install nodejs npm), or use --only roslibpy"
        raise SettingsError(msg)
    version = subprocess.run([node, "--version"], capture_output=True, text=True, check=True, timeout=30)
    if int(re.sub(r"^v(\d+).*\n", r"\1", version.stdout)) < OLDEST_NODE:
        msg = f"roslib needs Node {OLDEST_NODE} or later, this is {version.stdout.strip()}: install a newer one, or use --only roslibpy"
        raise SettingsError(msg)
    locks = (PACKAGES / "package.json", PACKAGES / "package-lock.json")
    folder, complete = installed("roslib", *locks)
    if not complete:
        begin(folder, "roslib")
        for lock in locks:
            shutil.copy(lock, folder)
        run(npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", cwd=folder)
        (folder / ".complete").touch()
    return folder / "node_modules" / "roslib" / "dist" / "RosLib.js"


def free_port() -> int:
    """A port of loopback that nobody has at the moment."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


async def output_of(command: list[str], environment: dict[str, str], cwd: Path) -> tuple[int, str]:
    """Run a suite to its end, or until its time is over (then the code is -1): its code, and all it printed."""
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
    """The last line that says something."""
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "it said nothing")


def cases_of(report: Path) -> Iterator[tuple[str, str, str]]:
    """Test, outcome and reason from pytest's XML."""
    for case in ET.parse(report).getroot().iter("testcase"):  # noqa: S314 - pytest wrote it, here
        name = f"{case.get('classname', '').removeprefix('tests.').replace('.', '/')}::{case.get('name')}"
        outcome, why = "passed", ""
        for child in case:
            if child.tag in {"failure", "error"}:
                outcome, why = "failed", (child.get("message") or last_line(child.text or "")).splitlines()[0]
            elif child.tag == "skipped" and outcome == "passed":
                outcome, why = "skipped", child.get("message") or ""
        yield name, outcome, why


async def roslibpy_suites(folder: Path, ros_version: str, transport: str, work: Path) -> list[Outcome]:
    """Run roslibpy's suites for one ROS version and transport on a hub of their own."""
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
    """Run the checks of conformance_roslib.mjs on a hub of their own."""
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
            continue  # what roslib itself prints
    if code or not ended:
        outcomes.append(Outcome("roslib, Node", ros_version, "the run itself", "failed", last_line(printed)))
    return outcomes


async def check(arguments: argparse.Namespace) -> int:
    """Run everything, print the table; 1 if anything failed."""
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
    """The table and the last line on standard output."""
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
    # to a file the table is as wide as its longest line
    console = Console() if sys.stdout.isatty() else Console(width=200)
    console.print(table)
    count = {kind: sum(each.outcome == kind for each in outcomes) for kind in colours}
    if count["skipped"]:
        print(
            f"{count['skipped']} skipped by the suites themselves (each transport's tests run with it alone)"
        )
    print(f"{count['passed']} passed, {count['failed']} failed")


def main() -> int:
    """Read the flags and check."""
    parser = argparse.ArgumentParser(
        prog="scripts/conformance", description="The hub under the tests of other projects."
    )
    parser.add_argument("--only", choices=("roslibpy", "roslib"), help="one client (both)")
    parser.add_argument("--ros-version", choices=("1", "2"), help="the hub as one ROS version (both)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all outcomes")
    arguments = parser.parse_args()
    return run_script(lambda: check(arguments), 1800)


if __name__ == "__main__":
    sys.exit(main())
