"""Verification of the client and of deployments on a real ROS 2 rosbridge server and on the hub (see scripts/verify).

Checks of every operation, and of the server's treatment of each operation:
    this project's client ──▶ server ──▶ this project's client

Checks of a deployment's results, with a plain client (websockets and json):
    plain client ──▶ server ──▶ master ──▶ server ──▶ plain client
"""

import asyncio
import contextlib
import hashlib
import logging
import math
import shutil
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from rosbags.typesys import Stores, get_typestore

from bridge import stamps
from bridge.client import Message, Qos, Ros, State, connect
from bridge.client.protocol import Compression
from bridge.errors import BridgeError, GoalError, NoMessageError, ServiceError
from bridge.names import ros2_type
from casestudies.boat.sensors import MAP_HIGH, MAP_LOW, SENSORS_TOPIC
from casestudies.demo import build
from scripts.running.flags import ScriptParser
from scripts.running.patience import FACTOR
from scripts.running.plain_client import REPORTS, RESULTS, PlainClient
from scripts.running.script import ROOT, reporting_errors, run_script
from scripts.running.stand import Stand, free_port, readings_at
from scripts.verifications import real_rosbridge
from scripts.verifications.checks import CheckError, Tally, expect, within
from services.errors import StackError
from terminal.errors import ProcessError

LIMIT: Final = 600.0 * FACTOR
"""Time limit of the verification, in seconds."""
PATIENCE: Final = 20.0 * FACTOR
"""Timeout in seconds of each wait in a check."""
SILENCE: Final = 1.0
"""Seconds without a message after which a check concludes that none will arrive."""
OUT: Final = ROOT / "out" / "verify"
ARRAY: Final = "std_msgs/Float64MultiArray"
ARRAY_TYPES: Final = {"ros1": ARRAY, "ros2": "std_msgs/msg/Float64MultiArray"}
ULP: Final = 1e-15
"""Relative tolerance, because the real server's JSON loses the last bit of some doubles."""
COUNT: Final = 10
"""Number of results of a `--loop` run."""
LOOP: Final = ("--loop", "--count", str(COUNT))
EVERY: Final = 0.2
"""Seconds between two readings, far more than a cycle takes, so that a stamp identifies its reading."""
FIRST_DATA_TIMEOUT: Final = 2
FARTHEST: Final = 1.5
"""Maximum distance of a posterior's mean from the true cell, in cells."""
SIZE: Final = 32


# Servers and masters


SERVERS: Final = {
    "real": ("python", "-P", "-m", real_rosbridge.__name__, "serve", "PORT"),
    "hub": ("hub", "--host", "127.0.0.1", "--port", "PORT", "--ros-version", "2"),
}
READY: Final = rf"{real_rosbridge.READY}|ws://\S+"


class Server(Stand):
    """A server that can be restarted, with its clients and masters. Each process writes a log of its own."""

    def __init__(self, kind: str, port: int, deployments: dict[str, Path]) -> None:
        super().__init__(OUT / kind)
        self.kind = kind
        self.real = kind == "real"
        self.port = port
        self.uri = f"ws://127.0.0.1:{port}"
        self.deployments = deployments
        self._running = ""
        """The name of the server's process; empty while there is none."""
        self._count = 0

    def _new(self, what: str) -> str:
        self._count += 1
        return f"{what}_{self._count}"

    def topic(self) -> str:
        """Return the name of a topic that was not used before."""
        return self._new("/verify/topic")

    async def serve(self) -> None:
        """Start the server if it does not run, and wait until it serves, or raise a CheckError."""
        if not self._running:
            self._running = self._new("server")
            command = (word.replace("PORT", str(self.port)) for word in SERVERS[self.kind])
            async with within(PATIENCE, "the server did not serve"):
                await self.start(self._running, READY, *command)

    async def stop(self, *, kill: bool = False) -> None:
        """End the server, or kill it as a crash would."""
        if self._running:
            await (self.kill if kill else self.end)(self._running)
            self._running = ""

    def begin_check(self) -> None:
        """Let `tails` show only the logs of the server and of processes that start from now on."""
        self.shown = [self._running] if self._running else []

    @contextlib.asynccontextmanager
    async def clients(self) -> AsyncIterator[tuple[Ros, Ros]]:
        """Connect two clients, a subscriber and a publisher."""
        async with connect(self.uri) as subscriber, connect(self.uri) as publisher:
            yield subscriber, publisher

    async def passed(
        self, msg: dict[str, Any], type_name: str = ARRAY, *, offer: Qos | None = None, **options: Any
    ) -> Message:
        """Send a message through the server, and return it as it arrives."""
        topic = self.topic()
        async with self.clients() as (subscriber, publisher):
            subscription = subscriber.subscribe(topic, type_name, **options)
            publication = await publisher.advertise(topic, type_name, qos=offer)
            await settled(subscriber, publisher)
            receiving = asyncio.create_task(subscription.next(PATIENCE))
            await publication.publish(msg)
            while self.real and not (await asyncio.wait([receiving], timeout=SILENCE))[0]:
                # DDS was still announcing the two to each other, and lost the message
                await publication.publish(msg)
            message = await receiving
            expect(subscriber.unusable == 0, f"{subscriber.unusable} messages could not be used")
            return message

    @contextlib.asynccontextmanager
    async def master(self, form: str, *flags: str) -> AsyncIterator[str]:
        """Run a master during the block, and return the name of its process."""
        name = self._new("master")
        with tempfile.TemporaryDirectory(prefix="run-") as run:
            command = ("master", "-d", str(self.deployments[form]), "--run-directory", run, *flags)
            try:
                await self.start(name, "", *command)
                yield name
            finally:
                await self.end(name)

    async def ended(self, master: str, code: int) -> str:
        """Wait until a master has ended with this exit code, or raise a CheckError, and return its output."""
        async with within(2 * PATIENCE, "the master did not end"):
            got = await self.wait(master)
        output = self.log(master).read_text()
        expect("Traceback" not in output, "the master shows a traceback")
        expect(got == code, f"the master's exit code is {got}, not {code}")
        return output


# Operations of the client


async def settled(*clients: Ros) -> None:
    """Wait until the server has processed earlier requests, and ROS has announced new topics and services."""
    for ros in clients:
        with contextlib.suppress(ServiceError):
            await ros.call("/rosapi/get_time", timeout=PATIENCE)
    await asyncio.sleep(0.3 * FACTOR)


def same(found: Any, wanted: Any) -> None:
    """Check that numbers are equal except for the last bit."""
    expect(np.allclose(found, wanted, rtol=ULP, atol=0), f"{found} came of {wanted}")


async def check_passes(stand: Server, sent: Any, type_name: str = ARRAY, **options: Any) -> None:
    """Check that data arrive with their values, as the kind of sequence that was asked for."""
    found = (await stand.passed({"data": sent}, type_name, **options)).msg["data"]
    is_array = options.get("arrays") == "numpy"
    wanted = np.ndarray if is_array else list if isinstance(sent, np.ndarray) else type(sent)
    expect(type(found) is wanted, f"{type_name}: {type(found).__name__} came, not {wanted.__name__}")
    if isinstance(sent, str | bytes):
        expect(found == sent, f"{type_name}: {found!r:.100} came")
        return
    if is_array and "compression" in options:
        expect(found.dtype == sent.dtype, f"{type_name}: its elements are {found.dtype}")
    same(found, sent)


@contextlib.contextmanager
def failing(error: type[Exception], otherwise: str, naming: str = "") -> Iterator[None]:
    """Check that the block raises `error` with `naming` in the text. Without an error, fail with `otherwise`."""
    try:
        yield
    except error as raised:
        expect(naming in str(raised), f"the error does not name {naming}: {raised}")
    else:
        raise CheckError(otherwise)


async def check_json(stand: Server) -> None:
    """Check messages in JSON: type names in both forms, and values in lists and in NumPy arrays."""
    for type_name in ARRAY_TYPES.values():
        await check_passes(stand, [1, 2.5], type_name)
    values = np.random.default_rng(1).normal(size=1024)
    for sent in (values, values[::-1], values.astype(">f8")):
        await check_passes(stand, sent, arrays="numpy")


async def check_cbor(stand: Server) -> None:
    """Check CBOR with typed arrays of every element type, as lists and as arrays, and with bytes."""
    values = np.random.default_rng(2).normal(size=1024)
    arrays = [values, values.astype("f4")]
    for kind in (np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32, np.uint64):
        # int64 stays below 2^53, which every server passes unchanged
        limits = np.iinfo(kind)
        arrays.append(np.array([max(limits.min, -(2**50)), 5, min(limits.max, 2**50)], kind))
    for sent in arrays:
        element = sent.dtype.name.title().replace("int", "Int").replace("Uint", "UInt")
        await check_passes(stand, sent, f"std_msgs/{element}MultiArray", compression="cbor", arrays="numpy")
    await check_passes(stand, values, compression="cbor")
    await check_passes(stand, b"\x00\x01\xff", "std_msgs/UInt8MultiArray", compression="cbor")


def deserialised(raw: bytes, type_name: str) -> dict[str, Any]:
    """Deserialise a message in CDR (which begins with a header) or in the format of ROS 1."""
    message: Any
    if raw.startswith(b"\0\1\0\0"):
        message = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(raw, ros2_type(type_name))
    else:
        message = get_typestore(Stores.ROS1_NOETIC).deserialize_ros1(raw, ros2_type(type_name))
    return asdict(message)


async def check_raw(stand: Server) -> None:
    """Check messages received with `compression="cbor-raw"`, which rosbags deserialises."""
    values = np.random.default_rng(3).normal(size=100)
    message = await stand.passed({"data": values}, compression="cbor-raw")
    same(deserialised(message.raw, ARRAY)["data"], values)
    stamp = 1_500_000_000_123_456_789
    pose = {"header": stamps.header(stamp, "map"), "pose": {"position": {"x": 1.5}}}
    message = await stand.passed(pose, "geometry_msgs/PoseStamped", compression="cbor-raw")
    found = deserialised(message.raw, "geometry_msgs/PoseStamped")
    expect(stamps.header_stamp_ns(found) == stamp, f"its header is {found['header']}")
    expect(found["header"]["frame_id"] == "map", f"its header is {found['header']}")
    expect(found["pose"]["position"]["x"] == 1.5, f"its pose is {found['pose']}")


async def check_fragments(stand: Server) -> None:
    """Check fragments from the server."""
    await check_passes(stand, "x\u00e4\U0001f600\n" * 500, "std_msgs/String", fragment_size=100)
    values = np.random.default_rng(5).normal(size=500)
    await check_passes(stand, values, compression="cbor", fragment_size=300)


async def check_qos(stand: Server) -> None:
    """Check quality of service: a late subscriber gets latched messages, and an incompatible one gets none."""
    offer = Qos(reliability="best_effort", depth=5)
    same((await stand.passed({"data": [1.5]}, offer=offer)).msg["data"], [1.5])
    for wish in (
        Qos(reliability="best_effort"),
        Qos(history="keep_all"),
        Qos(lifespan=2.5),
        Qos(deadline=math.inf, lifespan=math.inf),
    ):
        same((await stand.passed({"data": [2.5]}, qos=wish)).msg["data"], [2.5])
    kept = Qos(durability="transient_local", reliability="reliable", depth=3)
    async with stand.clients() as (subscriber, publisher):
        topic = stand.topic()
        publication = await publisher.advertise(topic, ARRAY, qos=kept)
        await settled(publisher)
        for number in range(5):
            await publication.publish({"data": [float(number)]})
        await settled(publisher)
        late = subscriber.subscribe(topic, ARRAY, qos=kept, queue_length=10)
        if not stand.real:
            return  # the hub keeps one message, and its topics have no qualities
        found = [(await late.next(PATIENCE)).msg["data"][0] for _ in range(3)]
        expect(found == [2.0, 3.0, 4.0], f"a late reader got {found}")
        topic = stand.topic()
        strict = subscriber.subscribe(topic, ARRAY, qos=Qos(reliability="reliable"))
        publication = await publisher.advertise(topic, ARRAY, qos=Qos(reliability="best_effort"))
        await settled(subscriber, publisher)
        await publication.publish({"data": [1.5]})
        with failing(NoMessageError, "a reliable reader received from a best-effort publisher"):
            await strict.next(SILENCE)


async def check_latch(stand: Server) -> None:
    """Check that a late subscriber gets the last message."""
    topic = stand.topic()
    async with stand.clients() as (subscriber, publisher):
        publication = await publisher.advertise(topic, ARRAY, latch=True)
        await settled(publisher)
        await publication.publish({"data": [7.5]})
        await settled(publisher)
        same((await subscriber.subscribe(topic, ARRAY).next(PATIENCE)).msg["data"], [7.5])


async def check_throttle(stand: Server) -> None:
    """Check a throttle of one message per minute, requested by one of two subscribers to a topic."""
    topic = stand.topic()
    async with stand.clients() as (subscriber, publisher), connect(stand.uri) as other:
        slow = other.subscribe(topic, ARRAY, throttle_rate=60_000)
        fast = subscriber.subscribe(topic, ARRAY, queue_length=100)
        publication = await publisher.advertise(topic, ARRAY)
        await settled(subscriber, other, publisher)
        for number in range(5):
            await publication.publish({"data": [float(number)]})
            same((await fast.next(PATIENCE)).msg["data"], [float(number)])
        same((await slow.next(PATIENCE)).msg["data"], [0.0])
        with failing(NoMessageError, "a throttled reader got a second message"):
            await slow.next(SILENCE)


async def check_services(stand: Server) -> None:
    """Check calls of services that answer, refuse and do not exist."""

    async def serve(args: dict[str, Any]) -> dict[str, Any]:
        if args["depth"] == 99:
            raise ServiceError("too deep")
        return {"result": {"names": args["prefixes"], "prefixes": []}}

    async with stand.clients() as (caller, server):
        service = await server.advertise_service("/verify/list", "rcl_interfaces/srv/ListParameters", serve)
        await settled(server, caller)

        async def ask(number: int) -> None:
            args = {"prefixes": [str(number)], "depth": 1}
            answer = await caller.call("/verify/list", args, PATIENCE)
            expect(answer["result"]["names"] == [str(number)], f"the answer to {number} is {answer}")

        for number in range(20):
            await ask(number)
        # ROS 2 keeps ten requests of a service, and loses further ones
        await asyncio.gather(*map(ask, range(8)))
        with failing(BridgeError, "a refusal came as an answer"):
            await caller.call("/verify/list", {"prefixes": [], "depth": 99}, timeout=2)
        await service.close()
        with failing(ServiceError, "a service that is not there answered"):
            await caller.call("/verify/nowhere", timeout=PATIENCE)


async def check_goal(stand: Server) -> None:
    """Check that a goal for an action without a server ends with an error."""
    async with connect(stand.uri) as ros:
        goal = await ros.send_goal("/verify/fly", "example_interfaces/action/Fibonacci", {"order": 3})
        with failing(GoalError, "it has a result"):
            await goal.result(PATIENCE)
        expect([each async for each in goal] == [], "it has feedback")


async def check_wrong_type(stand: Server) -> None:
    """Check that a subscriber with a wrong type gets an error that contains the server's reason."""
    topic = stand.topic()
    async with stand.clients() as (subscriber, publisher):
        await publisher.advertise(topic, ARRAY)
        await settled(publisher)
        with failing(NoMessageError, "a message of another type came", "type" if stand.real else ""):
            await subscriber.subscribe(topic, "std_msgs/String").next(SILENCE)


async def check_killed(stand: Server) -> None:
    """Check that everything is restored after a server was killed, and that the length of the gap is reported."""
    forms: tuple[Compression, ...] = ("none", "cbor", "cbor-raw")
    topics = {form: stand.topic() for form in forms}
    async with stand.clients() as (subscriber, publisher):
        readers = {
            form: subscriber.subscribe(topic, ARRAY, compression=form) for form, topic in topics.items()
        }
        writers = {form: await publisher.advertise(topic, ARRAY) for form, topic in topics.items()}
        begun = time.monotonic()
        await stand.stop(kill=True)
        await subscriber.wait_for_state(State.RECONNECTING, PATIENCE)
        await asyncio.sleep(0.5)
        await stand.serve()
        for ros in (subscriber, publisher):
            await ros.wait_for_state(State.CONNECTED, 2 * PATIENCE)
        back = time.monotonic() - begun
        await settled(subscriber, publisher)
        for form, writer in writers.items():
            await writer.publish({"data": [1.5]})
            await readers[form].next(PATIENCE)
            blind = readers[form].blind_seconds
            expect(0.5 <= blind <= back + 1, f"{form}: blind for {blind:.2f} s")


# Deployments, seen by a client that shares no code with bridge/


Waiting = Callable[[int], Awaitable[None]]


@dataclass(frozen=True, slots=True)
class Sent:
    """A published reading: the true cell, and the time of publication (Unix time, ns)."""

    column: int
    row: int
    at_ns: int


Received = list[tuple[str, dict[str, Any]]]


def count_of(topic: str, received: Received) -> int:
    """Return the number of messages of a topic."""
    return sum(each == topic for each, _msg in received)


@contextlib.asynccontextmanager
async def robot(stand: Server, received: Received, sent: list[Sent]) -> AsyncIterator[Waiting]:
    """During the block, listen to the stack's topics, and publish the readings of one cell after the other.

    The block gets a function that waits until a number of results and their frames have been received in all.
    """

    def take(topic: str, msg: Any) -> None:
        received.append((topic, msg))
        news.set()

    async def results(count: int) -> None:
        async with within(
            PATIENCE, f"fewer than {count} results and frames came; refused: {client.refused[-1:]}"
        ):
            while min(count_of(RESULTS, received), count_of(REPORTS, received)) < count:
                news.clear()
                await news.wait()

    async def publish() -> None:
        while True:
            number = len(sent)
            # a walk over the map except its rim, where posteriors are cut off
            reading = Sent(5 + 7 * number % 23, 5 + 11 * number % 23, time.time_ns())
            sent.append(reading)
            await client.publish({"data": readings_of(reading.column, reading.row)})
            await asyncio.sleep(EVERY)

    client, news = PlainClient(stand.port, (SENSORS_TOPIC, ARRAY), take), asyncio.Event()
    await client.start()
    await client.connected.wait()
    publishing = asyncio.create_task(publish())
    try:
        yield results
    finally:
        publishing.cancel()
        await asyncio.sleep(2 * EVERY)  # then a surplus result would have arrived
        await client.end()
    expect(not client.refused, f"the server refused an operation: {client.refused[-1:]}")


def readings_of(column: int, row: int) -> list[float]:
    """Return the noiseless readings of the sensors at a cell's centre, in the order of the machine's columns."""
    width = (MAP_HIGH - MAP_LOW) / SIZE
    x, y = (MAP_LOW + width * (index + 0.5) for index in (column, row))
    return list(map(float, readings_at(x, y).values()))


def check_result(msg: dict[str, Any], reading: Sent) -> None:
    """Check a posterior's layout and values, and that its mean is at the true cell."""
    dimensions = [
        {"label": label, "size": SIZE, "stride": stride} for label, stride in (("y", SIZE**2), ("x", SIZE))
    ]
    expect(msg.get("layout") == {"dim": dimensions, "data_offset": 0}, f"its layout is {msg.get('layout')}")
    data = msg["data"]
    expect(len(data) == SIZE * SIZE, f"it has {len(data)} numbers, not {SIZE * SIZE}")
    expect(all(isinstance(p, float) and 0 <= p <= 1 for p in data), "not all are probabilities")
    expect(abs(math.fsum(data) - 1) < 1e-9, f"its sum is {math.fsum(data)!r}, not 1")
    column = math.fsum(p * (line % SIZE) for line, p in enumerate(data))
    row = math.fsum(p * (line // SIZE) for line, p in enumerate(data))
    off = math.hypot(column - reading.column, row - reading.row)
    expect(off <= FARTHEST, f"its mean ({column:.2f}, {row:.2f}) is {off:.2f} cells from {reading}")


def check_frame(msg: dict[str, Any], after: int, sent: list[Sent]) -> tuple[int, Sent]:
    """Check a `/bm/frame`, and return its number and the reading that was published before its stamp."""
    values = {pair["key"]: pair["value"] for pair in msg["status"][0]["values"]}
    expect(values["published"] == "true", f"its {REPORTS} says published = {values['published']}")
    number = int(values["number"])
    expect(number > after and (after > 0 or number == 1), f"its number is {number}, after {after}")
    boards = [board["name"] for board in msg["status"][1:]]
    expect(boards == [f"rosbayes: board {index}" for index in range(4)], f"its boards are {boards}")
    time_ = msg["header"]["stamp"]
    stamp = int(time_.get("sec", time_.get("secs"))) * 10**9 + int(time_.get("nanosec", time_.get("nsecs")))
    before = [each for each in sent if each.at_ns <= stamp]
    expect(bool(before), "its stamp is earlier than every reading")
    return number, before[-1]


def check_received(stand: Server, received: Received, sent: list[Sent], count: int) -> None:
    """Raise a CheckError that names the first result that has a wrong `/bm/frame`, or belongs to another reading."""
    frames, results = ([msg for each, msg in received if each == topic] for topic in (REPORTS, RESULTS))
    for topic, messages in ((REPORTS, frames), (RESULTS, results)):
        expect(len(messages) == count, f"{len(messages)} messages came on {topic}, not {count}")
    if not stand.real:  # DDS transports each topic separately
        order = [topic for topic, _msg in received]
        expect(order == [REPORTS, RESULTS] * count, f"they came in the order {order}")
    number, last = 0, -1
    for at, (frame, result) in enumerate(zip(frames, results, strict=True), start=1):
        try:
            number, reading = check_frame(frame, number, sent)
            expect(sent.index(reading) > last, "its reading is not later than the last one's")
            last = sent.index(reading)
            check_result(result, reading)
        except CheckError as error:
            raise CheckError(f"result {at} of {count}: {error}") from error


async def check_run(stand: Server, form: str, count: int, *flags: str) -> None:
    """Check that a run publishes this number of results, sees them on the wire, and ends with 0."""
    received: Received = []
    sent: list[Sent] = []
    async with stand.master(form, *flags) as master, robot(stand, received, sent) as results:
        output = await stand.ended(master, 0)
        await results(count)
    if "--once" in flags:
        expect("frame 1: " in output, "the master does not print the frame's most probable cell")
    expect("not seen on the wire" not in output, "the master did not see its result on the wire")
    check_received(stand, received, sent, count)


async def check_restart(stand: Server) -> None:
    """Check that a run waits for a server that ends or is killed, and then continues to publish results."""
    received: Received = []
    sent: list[Sent] = []
    async with stand.master("ros2", *LOOP) as master:
        for kill in (False, True):
            async with robot(stand, received, sent) as results:
                await results(count_of(RESULTS, received) + COUNT // 4)
            await stand.stop(kill=kill)
            await asyncio.sleep(0.5)
            await stand.serve()
        async with robot(stand, received, sent) as results:
            await stand.ended(master, 0)
            await results(COUNT)
    check_received(stand, received, sent, COUNT)


async def check_silence(stand: Server) -> None:
    """Check that a topic without a publisher ends the run in time, with exit code 3 and the topic's name."""
    async with stand.master("ros1", "--once", "--first-data-timeout", str(FIRST_DATA_TIMEOUT)) as master:
        output = await stand.ended(master, 3)
    errors = [line for line in output.splitlines() if line.startswith("error: ")]
    expect(len(errors) == 1, f"the master says {len(errors)} errors, not one")
    expect(SENSORS_TOPIC in errors[0], f"the error does not name {SENSORS_TOPIC}: {errors[0]}")


# All of them

Check = Callable[[Server], Awaitable[None]]


CHECKS: Final[dict[str, Check]] = {
    "client: JSON, lists and arrays, type names of either ROS": check_json,
    "client: CBOR, typed arrays of ten kinds, bytes": check_cbor,
    "client: cbor-raw, read by rosbags": check_raw,
    "client: fragments from the server": check_fragments,
    "client: qualities of service": check_qos,
    "client: latch": check_latch,
    "client: throttle": check_throttle,
    "client: services, served and called": check_services,
    "client: a goal for an action that is not there": check_goal,
    "client: a wrong type": check_wrong_type,
    "client: the server killed": check_killed,
    "master --once, deployment with ROS 1 type names": lambda stand: check_run(stand, "ros1", 1, "--once"),
    "master --once, deployment with ROS 2 type names": lambda stand: check_run(stand, "ros2", 1, "--once"),
    f"master --loop --count {COUNT}, ROS 1 type names": lambda stand: check_run(stand, "ros1", COUNT, *LOOP),
    "the server ended, then killed, during --loop, ROS 2 type names": check_restart,
    "a topic without a publisher: exit code 3 and its name": check_silence,
}


def bytes_of(folders: list[Path]) -> str:
    """Return one hash of all files of the deployments."""
    digest = hashlib.sha256()
    for path in sorted(path for folder in folders for path in folder.rglob("*") if path.is_file()):
        digest.update(f"{path}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()


async def verify(kinds: list[str], only: str) -> int:
    """Build the deployments once, then run all checks with them on each server."""
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    logging.getLogger("bridge").setLevel(logging.CRITICAL)  # the checks print everything relevant
    port = free_port()
    deployments = {form: OUT / f"deployment-{form}" for form in ARRAY_TYPES}
    for form, folder in deployments.items():
        uri = f"ws://127.0.0.1:{port}"
        await build("boat", folder, uri, SENSORS_TOPIC, ARRAY_TYPES[form], "--set", "array=true")
    before = bytes_of(list(deployments.values()))
    tally = Tally()
    for kind in kinds:
        stand = Server(kind, port, deployments)
        try:
            for name, check in CHECKS.items():
                if only not in name:
                    continue
                stand.begin_check()
                failed = tally.failed
                errors = (ProcessError, StackError, BridgeError, OSError)
                with tally.check(f"{stand.kind}: {name}", *errors, details=stand.tails):
                    await stand.serve()
                    await check(stand)
                if tally.failed > failed:
                    await stand.stop()  # the next check gets a new server
        finally:
            await stand.stop()
    changed = (
        None if bytes_of(list(deployments.values())) == before else "a run changed a file of a deployment"
    )
    tally.report("the deployments are as built, byte for byte", time.monotonic(), changed)
    return tally.end()


def _again_alone() -> int:
    real_rosbridge.install()
    module = ["-P", "-m", "scripts.verifications.rosbridge"]
    real_rosbridge.become_alone([sys.executable, *module, *sys.argv[1:]])
    return 0


def main() -> int:
    """Parse the flags and run the checks, with the real server in a network of its own."""
    parser = ScriptParser("scripts/verify rosbridge", __doc__)
    parser.flag("--server", "the servers", "both", choices=["real", "hub", "both"])
    parser.flag("--only", "checks with this in their names", "")
    arguments = parser.parse_args()
    kinds = ["real", "hub"] if arguments.server == "both" else [arguments.server]
    if "real" in kinds and not real_rosbridge.network_is_alone():
        return reporting_errors(_again_alone)
    return run_script(lambda: verify(kinds, arguments.only), LIMIT)


if __name__ == "__main__":
    sys.exit(main())
