"""Real processes for the integration tests, and a robot that speaks rosbridge without any code of ours.

Robot (websockets + json) <--> hub (a process) <--> master and its children (processes)
"""

import asyncio
import contextlib
import fcntl
import inspect
import json
import os
import re
import subprocess
import sys
import time
import uuid
from pathlib import Path

import numpy as np
import psutil
import pytest
import websockets

from machines.kind import FrameInput
from machines.posterior import joint_posterior
from pcie_shim.programming_file import read_image
from tests.command_runner import invoke
from tests.patience import PROCESS_PATIENCE, PRODUCT_LIMITS
from tests.pcie_shim.boards import expected, two_ports
from toolchain.commands import main
from toolchain.deployment import load_deployment
from toolchain.deployment.address import to_address

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
MARK = "ROSBAYES_TEST_RUN"
PID_MAX = int(Path("/proc/sys/kernel/pid_max").read_text())
LOOP = ("master", "--loop")
PROGRAMMED = "pcie-app: 4 boards"
"""Part of the line that is printed once the boards are ready."""
READING = {"D1": 71, "D2": 50, "D3": 50, "B1": 45, "B2": 0, "B3": 90}
"""Readings of a boat in the middle of the map."""


async def until(true, why=str):
    """Wait until a function, or what it returns awaited, returns something that is true; return that."""
    deadline = time.monotonic() + PROCESS_PATIENCE
    pause = 0.02
    while True:
        found = true()
        if inspect.isawaitable(found):
            found = await found
        if found:
            return found
        assert time.monotonic() < deadline, why()
        await asyncio.sleep(pause)
        pause = min(1.2 * pause, 0.25)  # looking costs what a slow machine needs for the processes


def environment_of(where, run):
    """The environment of a test's processes."""
    limits = {name: str(seconds) for name, seconds in PRODUCT_LIMITS.items()}
    return dict(os.environ) | limits | {MARK: run, "TMPDIR": str(where), "XDG_RUNTIME_DIR": ""}


class Running:
    """A command of ours as a process, its output in files."""

    def __init__(self, where, run, *command, environment=None):
        self.name = Path(command[0]).name
        self._out = where / f"{self.name}-{uuid.uuid4().hex[:6]}.out"
        self._err = self._out.with_suffix(".err")
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self.process = subprocess.Popen(
                [str(BIN / command[0]), *command[1:]],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                env=environment_of(where, run) | (environment or {}),
                start_new_session=True,
            )

    @property
    def out(self):
        return self._out.read_text()

    @property
    def err(self):
        return self._err.read_text()

    async def end(self):
        """Its exit code."""
        await until(lambda: self.process.poll() is not None, lambda: f"{self.name} did not end: {self.err}")
        return self.process.returncode

    async def says(self, pattern):
        """Wait for a line on its standard error."""

        def said():
            ended = self.process.poll() is not None
            found = re.search(pattern, self.err)
            assert found or not ended, f"{self.name} ended: {self.err}"
            return found

        found = await until(said, lambda: f"{self.name} never said {pattern!r}: {self.err}")
        assert found is not None
        return found

    def send(self, number):
        self.process.send_signal(number)


class Stage:
    """Starts processes for one test, and knows all that came from them."""

    def __init__(self, where):
        self.where = where
        self.run = uuid.uuid4().hex
        self.running = []
        self.robots = []
        self.runs = where / "runs"
        self.runs.mkdir(mode=0o700)
        self._places = []

    def start(self, *command, environment=None):
        running = Running(self.where, self.run, *command, environment=environment)
        self.running.append(running)
        return running

    @property
    def environment(self):
        """The environment of the processes."""
        return environment_of(self.where, self.run)

    def place(self):
        """A port that is free, and the next one; nobody else is given them before the test's end."""
        return two_ports(self._places)

    async def hub(self, port=0, ros_version="1"):
        """A hub and its address; another one may follow it at its port."""
        port = port or self.place()
        hub = self.start("hub", "--port", str(port), "--ros-version", ros_version)
        return hub, (await hub.says(r"ws://\S+"))[0]

    def processes(self):
        """Live processes of this test, by command name; a board forked by `board` counts as a board."""
        found = {}
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                if process.environ().get(MARK) == self.run and process.status() != psutil.STATUS_ZOMBIE:
                    name = next(
                        (
                            Path(part).name
                            for part in process.cmdline()[:3]
                            if Path(part).parent == BIN and "python" not in part
                        ),
                        "?",
                    )
                    found.setdefault(name, []).append(process)
        return found

    def boards(self):
        """The processes of the boards in their order, without that from which they were forked."""
        found = {each.pid: each for each in self.processes()["board"]}
        parent = next(pid for pid in {each.ppid() for each in found.values()} if pid in found)
        first = found.pop(parent)
        # process numbers begin again from below now and then
        return sorted(found.values(), key=lambda each: (each.pid - first.pid) % PID_MAX)

    async def loop(self, boat, *options, environment=None):
        """Start a hub, a robot that publishes and a master in --loop, and wait for the first results."""
        hub, uri = await self.hub()
        publishing = Robot(uri)
        self.robots.append(publishing)
        await publishing.connect()
        await publishing.keep_publishing()
        command = (*LOOP, "-d", str(boat), "--uri", uri, *options)
        master = self.start(*command, environment={"BM_RUN_DIRECTORY": str(self.runs)} | (environment or {}))
        await publishing.have(3)
        return hub, publishing, master

    async def status(self, name, wanted=bool):
        """Wait for a status of a process in the run directory that is as wanted."""
        found = {}

        async def is_wanted():
            with contextlib.suppress(OSError, ValueError):
                found.update(await status_of(self.runs, name))
            return bool(found) and wanted(found)

        await until(is_wanted, lambda: f"{name}: {found}")
        return found

    def start_boards(self):
        """Start four boards; return the folder of their sockets, and their endpoints."""
        sockets = self.where / "s"
        sockets.mkdir(mode=0o700)
        self.start("board", "--boards", "4", "--directory", str(sockets))
        return sockets, endpoints_in(sockets)

    async def restarted(self, role, times=1):
        """Wait until the master has restarted a service so many times."""
        await self.status(
            "master",
            lambda status: any(
                peer["name"] == role and peer["restarts"] >= times for peer in status["peers"]
            ),
        )

    async def board_is_back(self, times=1):
        """Wait until boards have failed so many times, and pcie-app has all of them again."""
        await self.status(
            "pcie-app",
            lambda status: status["ready"] and sum(board["restarts"] for board in status["boards"]) >= times,
        )

    async def nothing_left(self, *except_for):
        """All processes but the named have ended; a killed master leaves its status socket."""

        def left():
            files = [
                str(path)
                for path in self.where.glob("rosbayes-*/*")
                if path.name.split(".")[0] not in (*except_for, "master")
            ]
            return sorted(set(self.processes()) - set(except_for)) + files

        await until(lambda: not left(), lambda: f"left: {left()}")

    async def end_all(self):
        for robot in self.robots:
            await robot.close()
        for all_ in self.processes().values():
            for process in all_:
                with contextlib.suppress(psutil.Error):
                    process.kill()
        for running in self.running:
            running.process.wait(PROCESS_PATIENCE)
        for place in self._places:
            place.close()


class Robot:
    """A rosbridge client of plain websockets and json; publishes readings and collects results."""

    def __init__(self, uri, topics=()):
        self.uri = uri
        self.topics = dict(topics)
        """Other topics that it hears, and their types."""
        self.heard = {topic: [] for topic in self.topics}
        self.results = []
        self.frames = []
        self.order = []
        self.paired = []
        """Each result with its report, which comes just before it; the first result may have come without."""
        self._report = None
        self._tasks = []
        self._collecting = None
        self._publishing = None
        self._socket = None

    async def __aenter__(self):
        await self.connect()
        return self

    async def connect(self):
        if self._socket is not None:
            await self._socket.close()
        self._socket = await websockets.connect(
            self.uri, max_size=1 << 22, open_timeout=PROCESS_PATIENCE, ping_interval=None
        )
        for topic, type_ in (
            ("/BMresults", "std_msgs/Float64MultiArray"),
            ("/bm/frame", "diagnostic_msgs/DiagnosticArray"),
            *self.topics.items(),
        ):
            await self._socket.send(json.dumps({"op": "subscribe", "topic": topic, "type": type_}))
        await self._socket.send(
            json.dumps({"op": "advertise", "topic": "/boat/sensors", "type": "boat_msgs/Sensors"})
        )
        self._collecting = asyncio.ensure_future(self._collect(self._socket))
        self._tasks.append(self._collecting)

    async def lost(self):
        """Wait until the server is gone, and all that it sent is here."""
        async with asyncio.timeout(PROCESS_PATIENCE):
            await asyncio.wait([self._collecting])

    async def __aexit__(self, *_):
        await self.close()

    async def close(self):
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._socket is not None:
            await self._socket.close()

    async def _collect(self, socket):
        with contextlib.suppress(websockets.ConnectionClosed):
            async for text in socket:
                message = json.loads(text)
                if message.get("topic") in self.heard:
                    self.heard[message["topic"]].append(message["msg"])
                elif message.get("op") == "publish":
                    self.order.append(message["topic"])
                    if message["topic"] == "/bm/frame":
                        self._report = message["msg"]
                        self.frames.append(message["msg"])
                        continue
                    self.results.append(message["msg"])
                    if self._report is not None:
                        self.paired.append((self._report, message["msg"]))
                    self._report = None

    async def publish(self, **values):
        """Publish a reading; its stamp."""
        stamp_ns = time.time_ns()
        stamp = dict(zip(("sec", "nanosec"), divmod(stamp_ns, 10**9), strict=True))
        msg = {"header": {"stamp": stamp, "frame_id": "map"}, **values}
        await self._socket.send(json.dumps({"op": "publish", "topic": "/boat/sensors", "msg": msg}))
        return stamp_ns

    async def keep_publishing(self, **values):
        """Publish in the background until the test is over; a lost server is waited for."""

        async def publish():
            while True:
                try:
                    await self.publish(**values or READING)
                except (websockets.ConnectionClosed, OSError):
                    with contextlib.suppress(OSError, websockets.WebSocketException):
                        await self.connect()
                await asyncio.sleep(0.05)

        self._publishing = asyncio.ensure_future(publish())
        self._tasks.append(self._publishing)

    def stop_publishing(self):
        """Publish no more in the background."""
        self._publishing.cancel()

    async def have(self, count):
        """Wait until so many results have come."""
        await until(lambda: len(self.results) >= count, lambda: f"{len(self.results)} results of {count}")


def stamp_of(message):
    """A message's stamp in ns, as either ROS writes it."""
    stamp = message["header"]["stamp"]
    seconds, rest = stamp.get("sec", stamp.get("secs")), stamp.get("nanosec", stamp.get("nsecs"))
    return seconds * 10**9 + rest


def endpoints_in(folder):
    """Four boards' endpoints, as --boards takes them."""
    return ",".join(f"unix:{folder}/board{at}.sock" for at in range(4))


def right_posteriors(folder):
    """The posteriors of READING, by bank."""
    deployment = load_deployment(folder)
    parts = [read_image(deployment.image_path(at)) for at in range(len(deployment.boards))]
    addresses = tuple(to_address(each, READING[each.name]) for each in deployment.variables)
    machine = deployment.machine
    posteriors = []
    for bank in range(machine.rng_banks):
        given = FrameInput(
            addresses=addresses, target_count=machine.target_count, max_cycles=machine.max_cycles, bank=bank
        )
        outcome = expected(parts, given)
        posteriors.append(
            joint_posterior([np.array(each[0], np.uint32) for each in outcome], [each[1] for each in outcome])
        )
    return posteriors


def only_error(running):
    """The last line of standard error, which has the only error."""
    assert "Traceback" not in running.err
    assert running.err.count("error: ") == 1, running.err
    return running.err.splitlines()[-1]


async def until_rosapi(uri, question, is_wanted, **args):
    """Wait until rosapi's answer at a hub is as wanted."""
    async with asyncio.timeout(PROCESS_PATIENCE), websockets.connect(uri, open_timeout=None) as asking:
        while True:
            call = {"op": "call_service", "service": f"/rosapi/{question}", "args": args}
            await asking.send(json.dumps(call))
            if is_wanted(json.loads(await asking.recv())["values"]):
                return
            await asyncio.sleep(0.02)


def inferred(folder, rows, where):
    """The posteriors that `toolchain infer` computes for readings, a row per frame, in the order of the variables."""
    names = [variable.name for variable in load_deployment(folder).variables]
    lines = [",".join("" if value is None else str(value) for value in row) for row in [names, *rows]]
    (where / "recording.csv").write_text("\n".join(lines) + "\n")
    ended = invoke(main.app, ("infer", where / "recording.csv", "-d", folder, "-o", where / "posteriors.npz"))
    assert ended.exit_code == 0, ended.output
    with np.load(where / "posteriors.npz") as arrays:
        posteriors = arrays["probabilities"].reshape(len(rows), -1)
    return [each.tolist() for each in posteriors if not np.isnan(each).any()]


async def until_subscribed(uri, topic):
    """Wait until somebody hears a topic at a hub."""
    await until_rosapi(uri, "subscribers", lambda answer: answer["subscribers"], topic=topic)


async def status_of(runs, name):
    """Return the status of a process of a run."""
    reader, writer = await asyncio.open_unix_connection(runs / f"{name}.status.sock")
    try:
        return json.loads(await reader.read())
    finally:
        writer.close()


@pytest.fixture
async def stage(tmp_path_factory):
    # short: a socket's path has 99 bytes
    made = Stage(tmp_path_factory.mktemp("run"))
    yield made
    await made.end_all()


@pytest.fixture
async def robot(stage):
    """A robot at a hub, which publishes whatever it is told to."""
    _, uri = await stage.hub()
    async with Robot(uri) as robot:
        yield robot


def toolchain(*arguments):
    ended = invoke(main.app, arguments)
    assert ended.exit_code == 0, ended.output


def build(model, directory, *options):
    """A deployment, built by the command line in this process."""
    topic = ("--uri", "ws://127.0.0.1:9090", "--topic", "/boat/sensors", "--type", "boat_msgs/Sensors")
    toolchain("build", model, "-o", directory, *topic, *options)
    return directory


def build_boat(directory, *options, cells=8, partitions=4):
    """The boat on a square map of few cells, for four boards or another number of them."""
    size = ("--set", f"width={cells}", "--set", f"height={cells}")
    return build(ROOT / "casestudies/boat", directory, "--partitions", str(partitions), *size, *options)


CORRIDOR = """
import numpy as np
from toolchain.models.model import Known, Model, dimension

def known(name, step=1.0, values=256, **more):
    likely = np.full((values, 4), 0.2 / (values - 1))
    likely[2 * np.arange(4), np.arange(4)] = 0.8  # reading number 2 s in place s
    return Known(name=name, table=likely, step=step, **more)

def model():
    return Model(name="corridor", searched=(dimension("s", size=4),), known=({known}))
"""


def build_corridor(where, known, sources, *options):
    """A robot in one of four places, its variables and sources as Python and TOML."""
    case = where / "corridor"
    case.mkdir(exist_ok=True)
    (case / "model.py").write_text(CORRIDOR.replace("{known}", known))
    (where / "sources.toml").write_text(sources)
    toolchain("build", case, "-o", where / "out", "--sources", where / "sources.toml", *options)
    return where / "out"


def the_boat(tmp_path_factory):
    """A folder that the first of all workers makes; nobody changes it."""
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    folder, done = shared / "boat-8x8", shared / "boat-8x8.done"
    with (shared / "boat-8x8.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            build_boat(folder, "--set", "on_missing=error")  # an incomplete reading is bad input
            done.touch()
    return folder


@pytest.fixture(scope="session")
def boat(tmp_path_factory):
    """The boat on 8 x 8 cells, four boards."""
    return the_boat(tmp_path_factory)
