"""Verification of the client on a real ROS 2 rosbridge server and on the hub (see scripts/verify).

Publisher and subscriber are both this project's client, so the checks show that a server of another project
understands the client, and the client the server. The codecs are checked against cbor2 and rosbags.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from socket import socket
from typing import Any

import numpy as np

from bridge import stamps
from bridge.client import Message, Qos, Ros, State, connect
from bridge.client.protocol import Compression
from bridge.codecs.serialised import MessageTypes
from bridge.errors import BridgeError, EncodeError, GoalError, NoMessageError, ServiceError
from scripts.running.processes import ROOT, Process
from scripts.verifications.checks import KINDS, CheckError, Kind, Tally, expect, on_servers, serving

LIMIT = 240.0
"""Time limit of the verification, in seconds."""
PATIENCE = 10.0
"""Seconds within which expected messages must arrive."""
SILENCE = 1.0
"""Seconds of silence that show that a message does not arrive."""
ARRAY = "std_msgs/Float64MultiArray"
OUT = ROOT / "out" / "verify-client"
ULP = 1e-15
"""Relative tolerance, because the real server's JSON loses the last bit of some doubles."""


class Stand:
    """A server and its clients."""

    def __init__(self, kind: Kind, port: int) -> None:
        self.kind = kind
        self.port = port
        self.notes: list[str] = []
        self._server: Process | None = None
        self._started = 0
        self._topics = 0

    @property
    def uri(self) -> str:
        """The server's URI."""
        return f"ws://127.0.0.1:{self.port}"

    @property
    def real(self) -> bool:
        """True for a real ROS 2 server."""
        return self.kind is KINDS["real"]

    def topic(self) -> str:
        """Return the name of a topic that was not used before."""
        self._topics += 1
        return f"/verify/topic_{self._topics}"

    async def start(self) -> None:
        """Start the server, and wait until it serves.

        Raises:
            CheckError: It is not ready in time.
        """
        self._started += 1
        log = OUT / f"{self.kind.name.replace(' ', '-')}-{self._started}.log"
        self._server = await serving(self.kind, self.port, log)

    async def stop(self, *, kill: bool = False) -> None:
        """End or kill the server."""
        if self._server is not None:
            if kill:
                os.kill(self._server.pid, signal.SIGKILL)
            await self._server.end()
            self._server = None

    @contextlib.asynccontextmanager
    async def clients(self, **options: Any) -> AsyncIterator[tuple[Ros, Ros]]:
        """Return a subscriber and a publisher."""
        async with connect(self.uri) as subscriber, connect(self.uri, **options) as publisher:
            yield subscriber, publisher

    async def passed(
        self,
        msg: dict[str, Any],
        type_name: str = ARRAY,
        *,
        offer: Qos | None = None,
        fragments_out: int | None = None,
        **options: Any,
    ) -> Message:
        """Return a message as it arrives through the server."""
        topic = self.topic()
        async with self.clients(fragment_size=fragments_out) as (subscriber, publisher):
            subscription = subscriber.subscribe(topic, type_name, **options)
            publication = await publisher.advertise(topic, type_name, qos=offer)
            await settled(subscriber, publisher)
            await publication.publish(msg)
            message = await subscription.next(PATIENCE)
            expect(subscriber.unusable == 0, f"{subscriber.unusable} messages could not be used")
            return message


async def settled(*clients: Ros) -> None:
    """Wait until the server has processed earlier requests, and ROS has announced them."""
    for ros in clients:
        with contextlib.suppress(ServiceError):
            await ros.call("/rosapi/get_time", timeout=PATIENCE)
    await asyncio.sleep(0.3)


def same(found: Any, wanted: Any) -> None:
    """Check that numbers are equal except for the last bit."""
    expect(np.allclose(found, wanted, rtol=ULP, atol=0), f"{found} came of {wanted}")


# The checks


async def check_json(stand: Stand) -> None:
    """Check JSON with both forms of type names, lists and arrays."""
    for type_name in (ARRAY, "std_msgs/msg/Float64MultiArray"):
        same((await stand.passed({"data": [1, 2.5]}, type_name)).msg["data"], [1.0, 2.5])
    values = np.random.default_rng(1).normal(size=1024)
    for sent in (values, values[::-1], values.astype(">f8")):
        message = await stand.passed({"data": sent}, arrays="numpy")
        expect(isinstance(message.msg["data"], np.ndarray), "it is not an array")
        same(message.msg["data"], sent)


async def check_cbor(stand: Stand) -> None:
    """Check CBOR with typed arrays of every element type, as lists and as arrays, and with bytes."""
    values = np.random.default_rng(2).normal(size=1024)
    kinds = {
        "Float64": ("f8", values),
        "Float32": ("f4", values.astype("f4")),
        "Int8": ("i1", np.array([-128, 0, 127], "i1")),
        "Int16": ("i2", np.array([-5, 5], "i2")),
        "Int32": ("i4", np.array([-70000, 5], "i4")),
        "Int64": ("i8", np.array([-(2**40), 5], "i8")),
        "UInt8": ("u1", np.array([0, 7, 255], "u1")),
        "UInt16": ("u2", np.array([0, 65535], "u2")),
        "UInt32": ("u4", np.array([0, 2**32 - 1], "u4")),
        "UInt64": ("u8", np.array([0, 2**50], "u8")),
    }
    for name, (dtype, sent) in kinds.items():
        type_name = f"std_msgs/{name}MultiArray"
        found = (await stand.passed({"data": sent}, type_name, compression="cbor", arrays="numpy")).msg[
            "data"
        ]
        expect(isinstance(found, np.ndarray), f"{name}: {type(found).__name__} came, no array")
        expect(found.dtype == np.dtype(dtype), f"{name}: its elements are {found.dtype}")
        same(found, sent)
    found = (await stand.passed({"data": values}, compression="cbor")).msg["data"]
    expect(type(found) is list, "no list came")
    same(found, values)
    sent_bytes = {"data": b"\x00\x01\xff"}
    found = (await stand.passed(sent_bytes, "std_msgs/UInt8MultiArray", compression="cbor")).msg["data"]
    expect(found == b"\x00\x01\xff", f"{found!r} came")


async def check_raw(stand: Stand) -> None:
    """Check the serialised message with rosbags."""
    types = MessageTypes()
    values = np.random.default_rng(3).normal(size=100)
    message = await stand.passed({"data": values}, compression="cbor-raw")
    same(types.read(message.raw, ARRAY)["data"], values)
    pose = {"header": stamps.header(1_500_000_000_123_456_789, "map"), "pose": {"position": {"x": 1.5}}}
    message = await stand.passed(pose, "geometry_msgs/PoseStamped", compression="cbor-raw")
    found = types.read(message.raw, "geometry_msgs/PoseStamped")
    expect(stamps.header_stamp_ns(found) == 1_500_000_000_123_456_789, f"its header is {found['header']}")
    expect(found["header"]["frame_id"] == "map", f"its header is {found['header']}")
    expect(found["pose"]["position"]["x"] == 1.5, f"its pose is {found['pose']}")


async def check_png(stand: Stand) -> None:
    """Check messages in pictures."""
    values = np.random.default_rng(4).normal(size=500)
    same((await stand.passed({"data": values}, compression="png")).msg["data"], values)


async def check_fragments(stand: Stand) -> None:
    """Check fragments from the server and from the client."""
    text = "x\u00e4\U0001f600\n" * 500
    fragmentings: tuple[dict[str, Any], ...] = (
        {"fragment_size": 100},
        {"fragments_out": 100},
        {"fragment_size": 50, "fragments_out": 50},
    )
    for options in fragmentings:
        found = (await stand.passed({"data": text}, "std_msgs/String", **options)).msg["data"]
        expect(found == text, f"another text came with {options}")
    values = np.random.default_rng(5).normal(size=500)
    compressions: tuple[Compression, ...] = ("png", "cbor")
    for compression in compressions:
        message = await stand.passed({"data": values}, compression=compression, fragment_size=300)
        same(message.msg["data"], values)


async def check_qos(stand: Stand) -> None:
    """Check quality of service: a late subscriber gets latched messages, an incompatible one none."""
    offer = Qos(reliability="best_effort", depth=5)
    same((await stand.passed({"data": [1.5]}, offer=offer)).msg["data"], [1.5])
    for wish in (
        Qos(reliability="best_effort"),
        Qos(history="keep_all"),
        Qos(lifespan=2.5),
        Qos(deadline=math.inf, lifespan=math.inf),
    ):
        same((await stand.passed({"data": [2.5]}, qos=wish)).msg["data"], [2.5])
    topic = stand.topic()
    kept = Qos(durability="transient_local", reliability="reliable", depth=3)
    async with stand.clients() as (subscriber, publisher):
        publication = await publisher.advertise(topic, ARRAY, qos=kept)
        await settled(publisher)
        for number in range(5):
            await publication.publish({"data": [float(number)]})
        await settled(publisher)
        late = subscriber.subscribe(topic, ARRAY, qos=kept, queue_length=10)
        if stand.real:
            found = [(await late.next(PATIENCE)).msg["data"][0] for _ in range(3)]
            expect(found == [2.0, 3.0, 4.0], f"a late reader got {found}")
    if stand.real:
        topic = stand.topic()
        async with stand.clients() as (subscriber, publisher):
            strict = subscriber.subscribe(topic, ARRAY, qos=Qos(reliability="reliable"))
            publication = await publisher.advertise(topic, ARRAY, qos=Qos(reliability="best_effort"))
            await settled(subscriber, publisher)
            await publication.publish({"data": [1.5]})
            try:
                await strict.next(SILENCE)
            except NoMessageError:
                return
            raise CheckError("a reliable reader received from a best-effort publisher")


async def check_latch(stand: Stand) -> None:
    """Check that a late subscriber gets the last message."""
    topic = stand.topic()
    async with stand.clients() as (subscriber, publisher):
        publication = await publisher.advertise(topic, ARRAY, latch=True)
        await settled(publisher)
        await publication.publish({"data": [7.5]})
        await settled(publisher)
        same((await subscriber.subscribe(topic, ARRAY).next(PATIENCE)).msg["data"], [7.5])


async def check_throttle(stand: Stand) -> None:
    """Check a throttle of one message per half second, for one of two subscribers to a topic."""
    topic = stand.topic()
    async with stand.clients() as (subscriber, publisher):
        slow = subscriber.subscribe(topic, ARRAY, throttle_rate=60_000)
        fast = subscriber.subscribe(topic, ARRAY, queue_length=100)
        publication = await publisher.advertise(topic, ARRAY)
        await settled(subscriber, publisher)
        for number in range(5):
            await publication.publish({"data": [float(number)]})
            same((await fast.next(PATIENCE)).msg["data"], [float(number)])
        same((await slow.next(PATIENCE)).msg["data"], [0.0])
        try:
            await slow.next(SILENCE)
        except NoMessageError:
            return
        raise CheckError("a throttled reader got a second message")


async def check_services(stand: Stand) -> None:
    """Check calls of services that answer, refuse and do not exist."""
    type_name = "rcl_interfaces/srv/ListParameters"

    async def serve(args: dict[str, Any]) -> dict[str, Any]:
        if args["depth"] == 99:
            raise ServiceError("too deep")
        return {"result": {"names": args["prefixes"], "prefixes": []}}

    async with stand.clients() as (caller, server):
        service = await server.advertise_service("/verify/list", type_name, serve)
        await settled(server, caller)
        for number in range(20):
            answer = await caller.call("/verify/list", {"prefixes": [str(number)], "depth": 1}, PATIENCE)
            expect(answer["result"]["names"] == [str(number)], f"it answered {answer}")
        # ROS 2 keeps ten requests of a service, and loses further ones.
        answers = await asyncio.gather(
            *(caller.call("/verify/list", {"prefixes": [str(n)], "depth": 1}, PATIENCE) for n in range(8))
        )
        names = [answer["result"]["names"] for answer in answers]
        expect(names == [[str(n)] for n in range(8)], "answers went to the wrong calls")
        try:
            await caller.call("/verify/list", {"prefixes": [], "depth": 99}, timeout=2)
        except BridgeError as error:
            stand.notes.append(f"a refusal: {error}")
        else:
            raise CheckError("a refusal came as an answer")
        await service.close()
        try:
            await caller.call("/verify/nowhere", timeout=PATIENCE)
        except ServiceError as error:
            stand.notes.append(f"a service that is not there: {error}")
        else:
            raise CheckError("a service that is not there answered")


async def check_goal(stand: Stand) -> None:
    """Check that a goal for an action without a server ends with an error."""
    async with connect(stand.uri) as ros:
        goal = await ros.send_goal("/verify/fly", "example_interfaces/action/Fibonacci", {"order": 3})
        try:
            await goal.result(PATIENCE)
        except GoalError as error:
            stand.notes.append(str(error))
        else:
            raise CheckError("it has a result")
        expect([each async for each in goal] == [], "it has feedback")


async def check_silence(stand: Stand) -> None:
    """Check that the error of a wait contains the server's message about a wrong type."""
    topic = stand.topic()
    async with stand.clients() as (subscriber, publisher):
        await publisher.advertise(topic, ARRAY)
        await settled(publisher)
        subscription = subscriber.subscribe(topic, "std_msgs/String")
        try:
            await subscription.next(SILENCE)
        except NoMessageError as error:
            stand.notes.append(str(error))
            expect(not stand.real or "type" in str(error), f"the reason is missing: {error}")
        else:
            raise CheckError("a message of another type came")


async def check_nan(stand: Stand) -> None:
    """Check that messages that the server would drop silently are refused, and the error names the place."""
    topic = stand.topic()
    async with stand.clients() as (_subscriber, publisher):
        publication = await publisher.advertise(topic, ARRAY)
        try:
            await publication.publish({"data": np.array([1.5, math.nan])})
        except EncodeError as error:
            expect("data[1]" in str(error), f"the place is not named: {error}")
        else:
            raise CheckError("a NaN left")


async def check_restart(stand: Stand) -> None:
    """Check that everything is restored after a server is killed, and that the gap's length is reported."""
    forms: tuple[Compression, ...] = ("none", "cbor", "cbor-raw", "png")
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
        await stand.start()
        for ros in (subscriber, publisher):
            await ros.wait_for_state(State.CONNECTED, 2 * PATIENCE)
        back = time.monotonic() - begun
        await settled(subscriber, publisher)
        for form, writer in writers.items():
            await writer.publish({"data": [1.5]})
            message = await readers[form].next(PATIENCE)
            expect(
                0.5 <= message.blind_seconds <= back + 1, f"{form}: blind for {message.blind_seconds:.2f} s"
            )
        stand.notes.append(
            f"blind for {message.blind_seconds:.2f} s, {subscriber.reconnections} reconnection"
        )


CHECKS: tuple[tuple[str, Callable[[Stand], Awaitable[None]]], ...] = (
    ("JSON, lists and arrays, type names of either ROS", check_json),
    ("CBOR: typed arrays of ten kinds, bytes", check_cbor),
    ("cbor-raw, read by rosbags", check_raw),
    ("PNG", check_png),
    ("fragments, both ways", check_fragments),
    ("qualities of service", check_qos),
    ("latch", check_latch),
    ("throttle", check_throttle),
    ("services, served and called", check_services),
    ("a goal for an action that is not there", check_goal),
    ("a wrong type", check_silence),
    ("NaN", check_nan),
    ("the server killed", check_restart),
)


async def verify(kinds: list[str]) -> int:
    """Run all checks on each server."""
    OUT.mkdir(parents=True, exist_ok=True)
    logging.getLogger("bridge").setLevel(logging.CRITICAL)  # the checks print everything relevant
    tally = Tally()
    for name in kinds:
        with socket() as free:
            free.bind(("127.0.0.1", 0))
            stand = Stand(KINDS[name], free.getsockname()[1])
        try:
            await stand.start()
            for title, check in CHECKS:
                started, why = time.monotonic(), None
                stand.notes.clear()
                try:
                    await check(stand)
                except (CheckError, BridgeError) as error:
                    why = f"{type(error).__name__}: {error}"
                tally.report(
                    f"{stand.kind.name}: {title}",
                    started,
                    why,
                    "\n".join(f"    {note}" for note in stand.notes),
                )
        finally:
            await stand.stop()
    print(f"{tally.passed} passed, {tally.failed} failed")
    return 1 if tally.failed else 0


if __name__ == "__main__":
    sys.exit(on_servers("client", __doc__, verify, LIMIT))
