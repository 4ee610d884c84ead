"""Verification of a deployment on a real ROS 2 rosbridge server and on the hub (see scripts/verify).

A plain client (websockets and json, nothing of bridge/) publishes readings of known cells; the messages that
a second plain client receives on /BMresults and /bm/frame are checked.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import hashlib
import json
import math
import os
import shutil
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from casestudies.boat import geometry
from scripts.running.processes import BOAT_TOPIC, ROOT, Process, build
from scripts.verifications.checks import (
    KINDS,
    SERVER_LIMIT,
    CheckError,
    Kind,
    Tally,
    expect,
    on_servers,
    serving,
)
from services.errors import StackError

OUT = ROOT / "out" / "verify"
LIMIT = 300.0
"""Time limit of the verification, in seconds."""
ARRAY_TYPES = {"ros1": "std_msgs/Float64MultiArray", "ros2": "std_msgs/msg/Float64MultiArray"}
RESULT_TOPIC, RESULT_TYPE = "/BMresults", "std_msgs/Float64MultiArray"
FRAME_TOPIC, FRAME_TYPE = "/bm/frame", "diagnostic_msgs/DiagnosticArray"
COUNT = 10
"""Number of results of a `--loop` run."""
EVERY = 0.2
"""Seconds between two readings, far more than a cycle takes, so that a stamp identifies its reading."""
MASTER_LIMIT, RESULT_LIMIT, LAST_WORDS = 40.0, 20.0, 2.0
"""Seconds until a master ends, until results arrive, and until all published messages have arrived."""
FIRST_DATA_TIMEOUT = 2
FARTHEST = 1.5
"""Maximum distance of a posterior's mean from the true cell, in cells."""
SIZE = 32
TAIL = 12
"""Number of lines of a log that are shown when a check fails."""


# Readings


@dataclass(frozen=True, slots=True)
class Sent:
    """A published reading: the true cell, and the time of publication (Unix time, ns)."""

    column: int
    row: int
    at_ns: int


def true_cell(number: int) -> tuple[int, int]:
    """Return the true cell of a reading, on a walk over the map except its rim, where posteriors are cut off."""
    return 5 + 7 * number % 23, 5 + 11 * number % 23


def readings_of(column: int, row: int) -> list[float]:
    """Return the sensors' readings at a cell's centre without noise, in the order of the machine's columns."""
    width = (geometry.MAP_HIGH - geometry.MAP_LOW) / SIZE
    x, y = (geometry.MAP_LOW + width * (index + 0.5) for index in (column, row))
    distances = [
        min(round(geometry.distance(x, y, at)), geometry.LONGEST_DISTANCE) for at in geometry.BEACONS
    ]
    bearings = [round(geometry.bearing(x, y, at)) % 360 for at in geometry.BEACONS]
    return [float(value) for value in distances + bearings]


# A plain rosbridge client


@dataclass(frozen=True, slots=True)
class Received:
    """One message and its arrival (monotonic, s)."""

    topic: str
    msg: dict[str, Any]
    at: float


class PlainClient:
    """A WebSocket for JSON that stores received messages."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.received: list[Received] = []
        self.refused: list[str] = []
        self._news = asyncio.Event()

    async def send(self, **operation: Any) -> None:
        """Send one operation."""
        await self._socket.send(json.dumps(operation))

    async def listen(self) -> None:
        """Store received messages until the connection ends."""
        with contextlib.suppress(ConnectionClosed):
            async for text in self._socket:
                operation = json.loads(text)
                if operation["op"] == "publish":
                    self.received.append(Received(operation["topic"], operation["msg"], time.monotonic()))
                elif operation["op"] == "status":
                    self.refused.append(str(operation["msg"]))
                self._news.set()

    async def results(self, count: int, limit: float = RESULT_LIMIT) -> None:
        """Wait until that many results have arrived.

        Raises:
            CheckError: They do not arrive in time.
        """
        try:
            async with asyncio.timeout(limit):
                while self.count(RESULT_TOPIC) < count:
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            numbers = [
                values_of(received.msg)["number"]
                for received in self.received
                if received.topic == FRAME_TOPIC
            ]
            raise CheckError(
                f"{self.count(RESULT_TOPIC)} of {count} results came on {RESULT_TOPIC} within {limit:g} s; "
                f"frames on {FRAME_TOPIC}: {', '.join(numbers) or 'none'}"
                + (f"; the server answered: {self.refused[-1]}" if self.refused else "")
            ) from None

    def count(self, topic: str) -> int:
        """Return the number of messages received on a topic."""
        return sum(1 for received in self.received if received.topic == topic)


@contextlib.asynccontextmanager
async def plain_client(uri: str) -> AsyncIterator[PlainClient]:
    """Connect, and wait for a server that is starting."""
    async with contextlib.AsyncExitStack() as stack:
        deadline = time.monotonic() + SERVER_LIMIT
        while True:
            try:
                socket = await stack.enter_async_context(
                    connect(uri, open_timeout=5, close_timeout=2, max_size=None)
                )
                break
            except (OSError, InvalidHandshake, TimeoutError) as error:
                if time.monotonic() > deadline:
                    raise CheckError(f"a plain client cannot connect to {uri}: {error}") from error
                await asyncio.sleep(0.1)
        client = PlainClient(socket)
        listening = asyncio.create_task(client.listen())
        try:
            yield client
        finally:
            listening.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await listening


@contextlib.asynccontextmanager
async def listener(uri: str, received: list[Received]) -> AsyncIterator[PlainClient]:
    """Run a client on the stack's topics, and add the received messages to a list at the end."""
    async with plain_client(uri) as client:
        for topic, type_ in ((FRAME_TOPIC, FRAME_TYPE), (RESULT_TOPIC, RESULT_TYPE)):
            # without a given queue length, a server over DDS keeps ten messages
            await client.send(op="subscribe", topic=topic, type=type_, queue_length=1000)
        try:
            yield client
        finally:
            received.extend(client.received)


@contextlib.asynccontextmanager
async def readings(uri: str, sent: list[Sent]) -> AsyncIterator[None]:
    """Publish the reading of one cell after the other while the block runs, and append each to a list."""

    async def publish(client: PlainClient) -> None:
        while True:
            column, row = true_cell(len(sent))
            sent.append(Sent(column, row, time.time_ns()))
            await client.send(op="publish", topic=BOAT_TOPIC, msg={"data": readings_of(column, row)})
            await asyncio.sleep(EVERY)

    async with plain_client(uri) as client:
        await client.send(op="advertise", topic=BOAT_TOPIC, type=ARRAY_TYPES["ros1"])
        publishing = asyncio.create_task(publish(client))
        try:
            yield
        finally:
            publishing.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                await publishing
            expect(not client.refused, f"the server refused a reading: {client.refused[-1:]}")


# Servers and masters


@dataclass(frozen=True, slots=True)
class MasterRun:
    """A running master and its log."""

    process: Process
    log: Path

    async def wait(self, code: int) -> str:
        """Wait until it has ended with this exit code, and return its output.

        Raises:
            CheckError: It ends with another code, or not in time.
        """
        try:
            async with asyncio.timeout(MASTER_LIMIT):
                got = await self.process.wait()
        except TimeoutError:
            raise CheckError(f"the master did not end within {MASTER_LIMIT:g} s") from None
        output = self.log.read_text()
        expect("Traceback" not in output, "the master shows a traceback")
        expect(got == code, f"the master's exit code is {got}, not {code}")
        return output


@dataclass(slots=True)
class Stand:
    """Environment of checks: a server that can be restarted, deployments, and processes of the current check."""

    kind: Kind
    port: int
    folder: Path
    deployments: dict[str, Path]
    notes: list[str] = field(default_factory=list)
    _server: Process | None = None
    _started: int = 0
    _logs: list[Path] = field(default_factory=list)

    @property
    def serves(self) -> bool:
        """True while the server is running."""
        return self._server is not None

    @property
    def uri(self) -> str:
        """The server's URI."""
        return f"ws://127.0.0.1:{self.port}"

    async def start_server(self) -> None:
        """Start or restart the server.

        Raises:
            CheckError: It is not ready in time.
        """
        self._started += 1
        log = self.folder / f"server-{self._started}.log"
        self._logs.append(log)
        self._server = await serving(self.kind, self.port, log)

    async def stop_server(self) -> None:
        """End the server."""
        if self._server is not None:
            await self._server.end()
            self._server = None

    async def kill_server(self) -> None:
        """End the server at once and without notice, as a crash would."""
        if self._server is not None:
            os.kill(self._server.pid, signal.SIGKILL)
        await self.stop_server()

    @contextlib.asynccontextmanager
    async def master(self, check: str, deployment: str, *flags: str) -> AsyncIterator[MasterRun]:
        """Run a master during the block."""
        log = self.folder / f"{check.replace(' ', '-')}.log"
        self._logs.append(log)
        process = Process("master", log)
        await process.start("master", "-d", str(self.deployments[deployment]), *flags)
        try:
            yield MasterRun(process, log)
        finally:
            await process.end()

    def tails(self) -> str:
        """Return the last log lines of the current check."""
        lines = []
        for log in self._logs:
            if log.exists():
                lines += [
                    f"    {log.relative_to(ROOT)}:",
                    *(f"      {line}" for line in log.read_text().splitlines()[-TAIL:]),
                ]
        return "\n".join(lines)

    def next_check(self) -> None:
        """Remove the previous check's results and logs, except those of the running server."""
        self._logs = [self.folder / f"server-{self._started}.log"] if self.serves else []
        self.notes.clear()


# Expected messages


def stamp_ns(header: dict[str, Any]) -> int:
    """Return a header's time, from the keys of ROS 1 or ROS 2."""
    stamp = header["stamp"]
    seconds, nanoseconds = stamp.get("sec", stamp.get("secs")), stamp.get("nanosec", stamp.get("nsecs"))
    return int(seconds) * 10**9 + int(nanoseconds)


def check_result(msg: dict[str, Any], reading: Sent) -> float:
    """Check a posterior's layout and values, and return its mean's distance from the true cell in cells."""
    dimensions = [
        {"label": "y", "size": SIZE, "stride": SIZE * SIZE},
        {"label": "x", "size": SIZE, "stride": SIZE},
    ]
    expect(msg.get("layout") == {"dim": dimensions, "data_offset": 0}, f"its layout is {msg.get('layout')}")
    data = msg["data"]
    expect(len(data) == SIZE * SIZE, f"it has {len(data)} numbers, not {SIZE * SIZE}")
    expect(
        all(isinstance(p, float) and 0 <= p <= 1 for p in data), "it has something else than probabilities"
    )
    expect(abs(math.fsum(data) - 1) < 1e-9, f"its sum is {math.fsum(data)!r}, not 1")
    column = math.fsum(p * (line % SIZE) for line, p in enumerate(data))
    row = math.fsum(p * (line // SIZE) for line, p in enumerate(data))
    off = math.hypot(column - reading.column, row - reading.row)
    expect(
        off <= FARTHEST,
        f"its mean is cell ({column:.2f}, {row:.2f}), {off:.2f} cells from the true cell ({reading.column}, {reading.row})",
    )
    return off


def check_frame(msg: dict[str, Any], after: int, sent: list[Sent]) -> tuple[int, int, Sent]:
    """Check a frame's message, and return its number, its stamp and the reading with this stamp."""
    values = values_of(msg)
    expect(values["published"] == "true", f"its {FRAME_TOPIC} says published = {values['published']}")
    number, stamp = int(values["number"]), stamp_ns(msg["header"])
    expect(number > after and (after > 0 or number == 1), f"its number is {number}, after {after}")
    boards = [board["name"] for board in msg["status"][1:]]
    expect(boards == [f"rosbayes: board {index}" for index in range(4)], f"its boards are {boards}")
    expect(stamp >= sent[0].at_ns, "its stamp is earlier than every reading")
    reading = max((each for each in sent if each.at_ns <= stamp), key=lambda each: each.at_ns)
    late = (stamp - reading.at_ns) / 1e9
    expect(late < EVERY, f"its stamp is {late:.2f} s later than the last reading before it")
    return number, stamp, reading


def values_of(frame: dict[str, Any]) -> dict[str, str]:
    """Return the fields of a frame's message that concern the whole frame."""
    return {pair["key"]: pair["value"] for pair in frame["status"][0]["values"]}


def check_received(stand: Stand, received: list[Received], sent: list[Sent], count: int) -> None:
    """Check the number of results, and that each has a frame message and belongs to its stamp's reading.

    Raises:
        CheckError: A result is wrong; the text has its number.
    """
    frames, results = (
        [each for each in received if each.topic == topic] for topic in (FRAME_TOPIC, RESULT_TOPIC)
    )
    for topic, messages in ((FRAME_TOPIC, frames), (RESULT_TOPIC, results)):
        expect(len(messages) == count, f"{len(messages)} messages came on {topic}, not {count}")
    swapped, number, last_stamp = 0, 0, 0
    offs, delays = [], []
    for at, (frame, result) in enumerate(zip(frames, results, strict=True), start=1):
        try:
            early = received.index(frame) < received.index(result)
            swapped += not early
            expect(early or not stand.kind.keeps_order, f"{FRAME_TOPIC} came after it")
            expect(
                abs(frame.at - result.at) < EVERY,
                f"{FRAME_TOPIC} came {frame.at - result.at:+.2f} s after it",
            )
            number, stamp, reading = check_frame(frame.msg, number, sent)
            expect(stamp > last_stamp, "its stamp is not later than the last one's")
            last_stamp = stamp
            offs.append(check_result(result.msg, reading))
            delays.append((int(values_of(frame.msg)["sent_ns"]) - stamp) / 1e6)
        except CheckError as error:
            raise CheckError(f"result {at} of {count}: {error}") from error
    stand.notes.append(
        f"{count} results, means at most {max(offs):.2f} cells off, "
        f"{sorted(delays)[len(delays) // 2]:.1f} ms from a reading's receipt to its result's publication"
    )
    if swapped:
        stand.notes.append(
            f"{swapped} of {count} results came before their {FRAME_TOPIC}: between topics this server keeps no order"
        )


# The checks


async def check_once(stand: Stand, form: str) -> None:
    """Check that `--once` computes one frame, sees its result on the wire, and ends with 0."""
    received: list[Received] = []
    sent: list[Sent] = []
    async with (
        listener(stand.uri, received) as client,
        stand.master(f"once {form}", form, "--once") as master,
        readings(stand.uri, sent),
    ):
        output = await master.wait(0)
        await client.results(1, LAST_WORDS)
        await asyncio.sleep(2 * EVERY)  # a second one would be wrong
    expect("frame 1: " in output, "the master does not print the frame's most probable cell")
    expect("not seen on the wire" not in output, "the master did not see its result on the wire")
    check_received(stand, received, sent, 1)


async def check_loop(stand: Stand, form: str) -> None:
    """Check that `--loop --count N` publishes N results and ends with 0."""
    received: list[Received] = []
    sent: list[Sent] = []
    async with (
        listener(stand.uri, received) as client,
        stand.master(f"loop {form}", form, "--loop", "--count", str(COUNT)) as master,
        readings(stand.uri, sent),
    ):
        await master.wait(0)
        await client.results(COUNT, LAST_WORDS)
        await asyncio.sleep(2 * EVERY)
    check_received(stand, received, sent, COUNT)


async def check_restart(stand: Stand, form: str) -> None:
    """Check that a run waits for a server that ends or is killed, and then continues to publish results."""
    received: list[Received] = []
    sent: list[Sent] = []
    part = COUNT // 3
    async with stand.master(f"restart {form}", form, "--loop", "--count", str(COUNT)) as master:
        for stop in (stand.stop_server, stand.kill_server):
            async with listener(stand.uri, received) as client:
                async with readings(stand.uri, sent):
                    await client.results(part)
                await asyncio.sleep(2 * EVERY)  # nothing is in flight when the server ends
            await stop()
            await asyncio.sleep(0.5)
            await stand.start_server()
        again = time.monotonic()
        came = sum(1 for each in received if each.topic == RESULT_TOPIC)
        async with listener(stand.uri, received) as client, readings(stand.uri, sent):
            await client.results(1)
            again = time.monotonic() - again
            await master.wait(0)
            await client.results(COUNT - came, LAST_WORDS)
            await asyncio.sleep(2 * EVERY)
    check_received(stand, received, sent, COUNT)
    stand.notes.append(f"the first result came {again:.1f} s after the server was back")


async def check_silence(stand: Stand, form: str) -> None:
    """Check that a topic without a publisher ends the run in time, with exit code 3 and the topic's name."""
    started = time.monotonic()
    timeout = ("--first-data-timeout", str(FIRST_DATA_TIMEOUT))
    async with stand.master(f"silence {form}", form, "--once", *timeout) as master:
        output = await master.wait(3)
    took = time.monotonic() - started
    errors = [line for line in output.splitlines() if line.startswith("error: ")]
    expect(len(errors) == 1, f"the master says {len(errors)} errors, not one")
    expect(BOAT_TOPIC in errors[0], f"the error does not name {BOAT_TOPIC}: {errors[0]}")
    expect(took >= FIRST_DATA_TIMEOUT, f"the master ended after {took:.1f} s, before its time-out")
    stand.notes.append(errors[0])


CHECKS: tuple[tuple[str, Callable[[Stand, str], Awaitable[None]], str], ...] = (
    ("master --once, deployment with ROS 1 type names", check_once, "ros1"),
    ("master --once, deployment with ROS 2 type names", check_once, "ros2"),
    (f"master --loop --count {COUNT}, ROS 1 type names", check_loop, "ros1"),
    ("the server ended, then killed, during --loop, ROS 2 type names", check_restart, "ros2"),
    ("a topic without a publisher: exit code 3 and its name", check_silence, "ros1"),
)


def bytes_of(deployments: dict[str, Path]) -> str:
    """Return a hash of every file of the deployments."""
    digest = hashlib.sha256()
    for folder in deployments.values():
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                digest.update(f"{path}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()


async def run_checks(stand: Stand, tally: Tally) -> None:
    """Run all checks on one server."""
    try:
        for name, check, form in CHECKS:
            started = time.monotonic()
            stand.next_check()
            why, details = None, ""
            try:
                if not stand.serves:
                    await stand.start_server()
                await check(stand, form)
                details = "\n".join(f"    {note}" for note in stand.notes)
            except (CheckError, StackError, ConnectionClosed) as error:
                why, details = str(error), stand.tails()
                await stand.stop_server()  # the next check gets a new one
            tally.report(f"{stand.kind.name}: {name}", started, why, details)
    finally:
        await stand.stop_server()


@contextlib.contextmanager
def only_one() -> Iterator[None]:
    """Hold a lock, because two verifications in this folder would overwrite each other's deployments.

    Raises:
        StackError: Another verification runs.
    """
    OUT.parent.mkdir(exist_ok=True)
    with OUT.with_suffix(".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StackError(f"another scripts/verify runs, and writes to {OUT}: wait for its end") from None
        yield


async def verify(kinds: list[str]) -> int:
    """Build the deployments once, then run all checks with them on each server."""
    with only_one():
        shutil.rmtree(OUT, ignore_errors=True)
        OUT.mkdir()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        deployments = {form: OUT / f"deployment-{form}" for form in ARRAY_TYPES}
        for form, folder in deployments.items():
            await build(
                "boat", folder, f"ws://127.0.0.1:{port}", BOAT_TOPIC, ARRAY_TYPES[form], "--set", "array=true"
            )
        before = bytes_of(deployments)
        tally = Tally()
        for kind in kinds:
            folder = OUT / kind
            folder.mkdir()
            await run_checks(Stand(KINDS[kind], port, folder, deployments), tally)
        changed = None if bytes_of(deployments) == before else "a run changed a file of a deployment"
        tally.report(
            f"the deployments are as built, byte for byte ({' and '.join(kinds)})", time.monotonic(), changed
        )
        print(f"{tally.passed} passed, {tally.failed} failed")
        return 1 if tally.failed else 0


if __name__ == "__main__":
    sys.exit(on_servers("rosbridge", __doc__, verify, LIMIT))
