"""The hub with hundreds of clients, and `master --loop` at full rate.

Some clients read slowly or attack the hub. Every message contains the time when it was sent, so subscribers in this
process can compute its delay. The clients are bare sockets on the machine of the hub, so the delays include the CPU
time of the clients and of the hub.
"""

import argparse
import asyncio
import json
import random
import sys
import time
from collections import deque
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from bridge.client import connect
from casestudies.boat.sensors import SENSORS_TOPIC, SENSORS_TYPE
from scripts.benches.bare import Bare, advertise, bare, frame, publish, settled, subscribe
from scripts.benches.cycle import ALL_READINGS, WINDOW, message, processes_of, quantile, readings, until_read
from scripts.benches.dashboard import mib_of
from scripts.running.flags import ScriptParser
from scripts.running.script import print_table
from scripts.running.stand import temporary_stand
from services.errors import SettingsError

TOPICS, PUBLISHERS, SLOW = 200, 50, 50
RATE, SLOT = 2000, 0.01
"""Messages per second over all topics, and interval in seconds; the messages of an interval are published at once."""
PROBE_HZ = 100
LIMIT = 24 * 3600.0
"""Time limit in seconds, beyond any sensible `--minutes`."""
WARM_UP = 200
"""Number of readings before the first measured minute."""


@dataclass
class Row:
    """A phase of the bench: delays of all messages in ms, their number per second, and MiB of the processes.

    Ratios are relative to the first phase of the same part.
    """

    part: str
    name: str
    ms: list[float] = field(default_factory=list)
    per_second: float = 0.0
    mib: float = 0.0

    def take(self, _count: int, last: bytes) -> None:
        """Add the delay of a message."""
        if b'"data":[' in last:
            sent = float(last.split(b'"data":[', 1)[1].split(b",", 1)[0].rstrip(b"]}"))
            self.ms.append(1e3 * (time.perf_counter() - sent))


# --- many clients


async def phase(row: Row, readers: list[Bare], publishers: list[Bare], seconds: float, hub: int) -> Row:
    """Measure the readers while messages are published on all topics in turn, at the bench's rate."""
    topic = 0
    for reader in readers:
        reader.on_frames = row.take
    end = time.perf_counter() + seconds
    while (began := time.perf_counter()) < end:
        for _ in range(int(RATE * SLOT)):
            topic = (topic + 1) % TOPICS
            data = [time.perf_counter(), 0.5, 0.25]
            publishers[topic % len(publishers)].send(publish(f"/load/t{topic}", data))
        await asyncio.sleep(max(0.0, began + SLOT - time.perf_counter()))
    await settled(publishers[0])
    row.per_second, row.mib = len(row.ms) / seconds, mib_of(hub)
    return row


async def read_slowly(readers: list[Bare]) -> None:
    """Let each reader read for a moment every second."""
    for reader in readers:
        reader.transport.pause_reading()
    while True:
        for reader in readers:
            reader.transport.resume_reading()
            await asyncio.sleep(1 / len(readers))
            reader.transport.pause_reading()


async def crowd(uri: str, hub: int, clients: int, seconds: float) -> list[Row]:
    """Measure the fast clients alone, and with clients that read almost nothing."""
    numbers = random.Random(1)

    async def join(stack: AsyncExitStack, number: int, topics: int) -> list[Bare]:
        those = [await stack.enter_async_context(bare(uri)) for _ in range(number)]
        for each in those:
            each.send(b"".join(subscribe(f"/load/t{numbers.randrange(TOPICS)}") for _ in range(topics)))
        await settled(those[-1])
        return those

    async with AsyncExitStack() as stack:
        publishers = await join(stack, PUBLISHERS, 0)
        for topic in range(TOPICS):
            publishers[topic % PUBLISHERS].send(advertise(f"/load/t{topic}"))
        quick = await join(stack, clients - PUBLISHERS - SLOW, 2)
        alone = await phase(Row("many clients", "alone"), quick, publishers, seconds, hub)
        reading = asyncio.ensure_future(read_slowly(await join(stack, SLOW, 20)))
        beside = await phase(Row("many clients", "beside slow readers"), quick, publishers, seconds, hub)
        reading.cancel()
    return [alone, beside]


# --- attacks


class Attack(NamedTuple):
    """An attacker: its message at the start, its message after each pause, and its other connections."""

    once: bytes = b""
    again: bytes = b""
    pause: float = 0.02
    readers: bytes = b""
    """Message that twenty other connections send once; then they read everything that arrives."""
    reads: bool = True
    silent: int = 0
    """Number of connections that send nothing."""


def call(service: str, **args: Any) -> bytes:
    """Return the frame that calls a service."""
    return frame({"op": "call_service", "service": service, "args": args})


EMPTY_ARRAYS = b'{"op":"publish","topic":"/deep","msg":{"data":[' + b"[]," * 300_000 + b"[]]}}"
PARAMETER = json.dumps("x" * 500_000)
ATTACKS = {
    "none": Attack(),
    "tiny fragments": Attack(
        advertise("/large"), publish("/large", [0.1] * 60_000), 0.5, subscribe("/large", fragment_size=16)
    ),
    "unread answers": Attack(
        call("/rosapi/set_param", name="/p", value=PARAMETER),
        call("/rosapi/get_param", name="/p", default="") * 1000,
        pause=1.0,
        reads=False,
    ),
    "empty arrays": Attack(advertise("/deep"), frame(EMPTY_ARRAYS), 0.1),
    "listings": Attack(
        b"".join(advertise(f"/listed/{at}") for at in range(4000)), call("/rosapi/topics") * 8
    ),
    "silent connections": Attack(silent=300),
}


@asynccontextmanager
async def probed(uri: str, row: Row) -> AsyncIterator[None]:
    """Measure the delays of messages between two well-behaved clients."""
    topic = f"/probe/{time.perf_counter_ns()}"
    async with bare(uri) as publisher, bare(uri) as subscriber:
        subscriber.send(subscribe(topic, queue_length=1000))
        await settled(subscriber)
        publisher.send(advertise(topic))
        await settled(publisher)
        subscriber.on_frames = row.take

        async def send() -> None:
            while True:
                publisher.send(publish(topic, [time.perf_counter(), 1.0]))
                await asyncio.sleep(1 / PROBE_HZ)

        sending = asyncio.ensure_future(send())
        yield
        sending.cancel()
        await settled(publisher)


async def attacked(uri: str, hub: int, name: str, seconds: float) -> Row:
    """Measure two well-behaved clients, and the hub's maximum memory, during a third client's attack."""
    row, attack = Row("under attack", name), ATTACKS[name]
    async with AsyncExitStack() as stack:
        for _ in range(20 if attack.readers else 0):
            (await stack.enter_async_context(bare(uri))).send(attack.readers)
        host, _, port = uri.removeprefix("ws://").rpartition(":")
        for _ in range(attack.silent):
            stack.callback((await asyncio.open_connection(host, int(port)))[1].close)
        attacker = await stack.enter_async_context(bare(uri))
        attacker.send(attack.once)
        await settled(attacker)
        if not attack.reads:
            attacker.transport.pause_reading()
        async with probed(uri, row):
            end = time.perf_counter() + seconds
            while time.perf_counter() < end:
                attacker.send(attack.again)
                await asyncio.sleep(attack.pause)
                row.mib = max(row.mib, mib_of(hub))
    row.per_second = len(row.ms) / seconds
    return row


# --- the master at full rate


async def minutes_of(uri: str, hub: int, master: int, count: int) -> list[Row]:
    """Keep some of the boat's readings in flight, and measure each minute."""
    pids = [hub, *(pid for group in processes_of(master).values() for pid in group)]
    some, rows = readings(1, 1000), []
    async with connect(uri) as ros:
        results = ros.subscribe("/BMresults", "std_msgs/Float64MultiArray")
        publication = await ros.advertise(SENSORS_TOPIC, SENSORS_TYPE)
        await until_read(ros, SENSORS_TOPIC)
        sent: deque[float] = deque()
        for minute in range(count + 1):
            row = Row("master --loop", f"minute {minute}")
            began = time.perf_counter()
            while len(row.ms) < WARM_UP if minute == 0 else time.perf_counter() - began < 60:
                while len(sent) < WINDOW:
                    sent.append(time.perf_counter())
                    await publication.publish(message(random.choice(some)))
                await results.next(timeout=30)
                row.ms.append(1e3 * (time.perf_counter() - sent.popleft()))
            row.per_second, row.mib = len(row.ms) / (time.perf_counter() - began), sum(map(mib_of, pids))
            rows.append(row)
            print(f"{row.part}, {row.name}: {row.per_second:.0f} results per second", file=sys.stderr)
    return rows[1:]


async def bench(arguments: argparse.Namespace) -> int:
    """Measure, and print the table."""
    if arguments.clients <= PUBLISHERS + SLOW:
        raise SettingsError(f"--clients must be more than {PUBLISHERS + SLOW}, not {arguments.clients}")
    async with temporary_stand() as stand:
        await stand.start_hub("--clients", str(arguments.clients + 100))
        hub = stand.pid("hub")
        rows = await crowd(stand.uri, hub, arguments.clients, arguments.seconds)
        rows += [await attacked(stand.uri, hub, name, arguments.seconds) for name in ATTACKS]
        if arguments.minutes:
            await stand.start_boat_master(*ALL_READINGS)
            rows += await minutes_of(stand.uri, hub, stand.pid("master"), arguments.minutes)
    columns = ("part", "phase", "per second", "p50 ms", "p99 ms", "max ms", "MiB", "p99 ratio", "MiB ratio")
    shown = []
    first = rows[0]
    for row in rows:
        first = first if row.part == first.part else row
        p99, p50 = quantile(row.ms, 0.99), quantile(row.ms, 0.5)
        ratios = p99 / quantile(first.ms, 0.99), row.mib / first.mib
        figures = (row.per_second, p50, p99, max(row.ms), row.mib, *ratios)
        shown.append((row.part, row.name, *(f"{figure:,.1f}" for figure in figures)))
    print_table("delays, and their ratios to those of the first phase of each part", columns, shown, left=2)
    return 0


if __name__ == "__main__":
    parser = ScriptParser(
        "scripts/bench load",
        "Measure the hub with many clients and under attack, and master --loop at full rate.",
    )
    parser.flag("--clients", "number of clients of the hub", 500)
    parser.flag("--seconds", "duration of each phase in seconds", 5.0)
    parser.flag("--minutes", "minutes of master --loop; 0 for none", 5, type=int)
    parser.run(bench, LIMIT)
