"""The hub with hundreds of clients, of which some read slowly or attack it, and `master --loop` at full rate.

Every message to the hub's clients contains its time of sending, from which subscribers in this process compute its
delay. The clients are bare sockets and share the machine with the hub, so the figures are those of both. All ratios
are of delays, rates and memory within this run.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import sys
import tempfile
import time
from collections import deque
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from bridge.client import connect
from scripts.benches.bare import Bare, advertise, bare, frame, frame_of, publish, settled, subscribe
from scripts.benches.cycle import BOAT_FLAGS, WINDOW, message, processes_of, quantile, readings
from scripts.running.flags import ScriptParser, output_file
from scripts.running.processes import BOAT_TOPIC, BOAT_TYPE, Process, build, run_script

TOPICS, PUBLISHERS, SLOW = 200, 50, 50
RATE = 2000
"""Messages per second over all topics."""
SLOT = 0.01
PROBE_HZ = 100
ATTACK_SECONDS = 5.0
WARM_UP = 200
"""Readings before the first minute."""


def resources(pids: dict[str, list[int]]) -> tuple[float, int]:
    """Return the resident MiB and the descriptors of processes by command."""
    all_ = [Path(f"/proc/{pid}") for group in pids.values() for pid in group]
    pages = sum(int((each / "statm").read_text().split()[1]) for each in all_)
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20, sum(
        len(list((each / "fd").iterdir())) for each in all_
    )


@dataclass
class Delays:
    """Milliseconds of all messages of a phase, and their number per second."""

    milliseconds: list[float] = field(default_factory=list)
    per_second: float = 0.0

    def take(self, _count: int, last: bytes) -> None:
        """Add the delay of a message."""
        if b'"data":[' in last:
            sent = float(last.split(b'"data":[', 1)[1].split(b",", 1)[0].rstrip(b"]}"))
            self.milliseconds.append(1e3 * (time.perf_counter() - sent))

    def quantiles(self) -> tuple[float, float, float]:
        """Return the median, the 99th percentile and the maximum."""
        return (quantile(self.milliseconds, 0.5), quantile(self.milliseconds, 0.99), max(self.milliseconds))


# --- many clients


async def phase(readers: list[Bare], publishers: list[Bare], seconds: float) -> Delays:
    """Measure the readers while messages are published on all topics in turn, at the bench's rate."""
    delays, topic = Delays(), 0
    for reader in readers:
        reader.on_frames, reader.count = delays.take, 0
    end = time.perf_counter() + seconds
    while (began := time.perf_counter()) < end:
        for _ in range(int(RATE * SLOT)):
            topic = (topic + 1) % TOPICS
            data = [time.perf_counter(), 0.5, 0.25]
            publishers[topic % len(publishers)].send(publish(f"/load/t{topic}", data))
        await asyncio.sleep(max(0.0, began + SLOT - time.perf_counter()))
    await settled(publishers[0])
    delays.per_second = sum(reader.count for reader in readers) / seconds
    return delays


async def read_slowly(readers: list[Bare]) -> None:
    """Let each reader read for a moment every second."""
    for reader in readers:
        reader.transport.pause_reading()
    while True:
        for reader in readers:
            reader.transport.resume_reading()
            await asyncio.sleep(1 / len(readers))
            reader.transport.pause_reading()


async def crowd(uri: str, clients: int, seconds: float) -> dict[str, Delays]:
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
        found = {"readers alone": await phase(quick, publishers, seconds)}
        reading = asyncio.ensure_future(read_slowly(await join(stack, SLOW, 20)))
        found["readers beside slow ones"] = await phase(quick, publishers, seconds)
        reading.cancel()
    return found


# --- attacks


class Attack(NamedTuple):
    """What an attacker repeats, on each of some connections."""

    once: bytes = b""
    again: bytes = b""
    pause: float = 0.02
    connections: int = 1
    readers: bytes = b""
    """What twenty other connections send once; they read what comes."""
    reads: bool = True
    silent: int = 0
    """Number of connections that send nothing."""


def call(service: str, **args: Any) -> bytes:
    """Return the frame that calls a service."""
    return frame({"op": "call_service", "service": service, "args": args})


def image(data: int) -> bytes:
    """Return the frame that publishes a number where the type has bytes."""
    return frame({"op": "publish", "topic": "/image", "msg": {"data": data}})


ATTACKS = {
    "numbers for bytes": Attack(
        advertise("/image", "sensor_msgs/Image"),
        image(1_000_000_000) * 8,
        readers=subscribe("/image", type="sensor_msgs/Image", compression="cbor"),
    ),
    "tiny fragments": Attack(
        advertise("/large"),
        publish("/large", [0.123456789] * 60_000),
        pause=0.5,
        readers=subscribe("/large", fragment_size=16),
    ),
    "unread answers": Attack(
        call("/rosapi/set_param", name="/p", value=json.dumps("x" * 500_000)),
        call("/rosapi/get_param", name="/p", default="") * 64,
        pause=1.0,
        connections=20,
        reads=False,
    ),
    "empty arrays": Attack(
        advertise("/deep"),
        frame_of(b'{"op":"publish","topic":"/deep","msg":{"data":[' + b"[]," * 300_000 + b"[]]}}"),
        pause=0.1,
    ),
    "resubscriptions": Attack(
        b"".join(subscribe("/many", id=str(at)) for at in range(4000)), subscribe("/many", id="7") * 64
    ),
    "listings": Attack(
        b"".join(advertise(f"/listed/{at}") for at in range(4000)), call("/rosapi/topics") * 8
    ),
    "silent connections": Attack(pause=0.1, silent=300),
}


@asynccontextmanager
async def probed(uri: str) -> AsyncIterator[Delays]:
    """Measure the delays of messages between two well-behaved clients."""
    delays, topic = Delays(), f"/probe/{time.perf_counter_ns()}"
    async with bare(uri) as publisher, bare(uri) as subscriber:
        subscriber.send(subscribe(topic, queue_length=1000))
        await settled(subscriber)
        publisher.send(advertise(topic))
        await settled(publisher)
        subscriber.on_frames = delays.take

        async def send() -> None:
            while True:
                publisher.send(publish(topic, [time.perf_counter(), 1.0]))
                await asyncio.sleep(1 / PROBE_HZ)

        sending = asyncio.ensure_future(send())
        try:
            yield delays
        finally:
            sending.cancel()
        await settled(publisher)


async def attacked(
    uri: str, hub: dict[str, list[int]], attack: Attack, seconds: float
) -> tuple[Delays, float]:
    """Return the delays of two other clients and the MiB by which the hub grows during an attack."""
    before = peak = resources(hub)[0]
    async with AsyncExitStack() as stack:
        for _ in range(20 if attack.readers else 0):
            (await stack.enter_async_context(bare(uri))).send(attack.readers)
        host, _, port = uri.removeprefix("ws://").rpartition(":")
        for _ in range(attack.silent):
            stack.callback((await asyncio.open_connection(host, int(port)))[1].close)
        attackers = [await stack.enter_async_context(bare(uri)) for _ in range(attack.connections)]
        attackers[0].send(attack.once)
        await settled(attackers[0])
        for each in attackers if not attack.reads else ():
            each.transport.pause_reading()
        async with probed(uri) as delays:
            end = time.perf_counter() + seconds
            while time.perf_counter() < end:
                for each in attackers:
                    each.send(attack.again)
                await asyncio.sleep(attack.pause)
                peak = max(peak, resources(hub)[0])
    return delays, peak - before


# --- the master at full rate


@dataclass
class Minute:
    """One minute: results per second, cycle times, and the resources of all processes at its end."""

    per_second: float
    p50_us: float
    p99_us: float
    mib: float
    descriptors: int


async def minutes_of(uri: str, hub: int, master: Process, count: int) -> list[Minute]:
    """Keep some readings of the boat in flight, and measure minute by minute."""
    pids = {"hub": [hub], **processes_of(master.pid)}
    some, minutes = readings(1, 1000), []
    async with connect(uri) as ros:
        results = ros.subscribe("/BMresults", "std_msgs/Float64MultiArray")
        publication = await ros.advertise(BOAT_TOPIC, BOAT_TYPE)
        sent: deque[int] = deque()
        for minute in range(count + 1):
            taken: list[float] = []
            began = time.perf_counter()
            while len(taken) < WARM_UP if minute == 0 else time.perf_counter() - began < 60:
                while len(sent) < WINDOW:
                    sent.append(time.perf_counter_ns())
                    await publication.publish(message(random.choice(some)))
                await results.next(timeout=30)
                taken.append((time.perf_counter_ns() - sent.popleft()) / 1e3)
            if minute:
                rate = len(taken) / (time.perf_counter() - began)
                minutes.append(Minute(rate, quantile(taken, 0.5), quantile(taken, 0.99), *resources(pids)))
                print(f"minute {minute}: {rate:.0f} results per second", file=sys.stderr)
    return minutes


# --- the bench


async def bench(arguments: argparse.Namespace) -> int:
    """Measure, print the tables, and write the JSON file."""
    with tempfile.TemporaryDirectory(prefix="bench-rosbayes-") as folder:
        where = Path(folder)
        hub, master = Process("hub", where / "hub.log"), Process("master", where / "master.log")
        try:
            await hub.start("hub", "--port", "0", "--clients", str(arguments.clients + 100))
            uri = (await hub.line(r"ws://\S+"))[0]
            pids = {"hub": [hub.pid]}
            found = {
                name: (each, 0.0)
                for name, each in (await crowd(uri, arguments.clients, arguments.seconds)).items()
            }
            seconds = min(arguments.seconds, ATTACK_SECONDS)
            found["two clients alone"] = await attacked(uri, pids, Attack(pause=0.1), seconds)
            for name, attack in ATTACKS.items():
                found[f"attack: {name}"] = await attacked(uri, pids, attack, seconds)
            minutes: list[Minute] = []
            if arguments.minutes:
                await build("boat", where / "boat", uri, BOAT_TOPIC, BOAT_TYPE)
                await master.start("master", "-d", str(where / "boat"), "--uri", uri, *BOAT_FLAGS)
                await master.line("pcie-app: 4 boards")
                minutes = await minutes_of(uri, hub.pid, master, arguments.minutes)
        finally:
            await asyncio.gather(master.end(), hub.end())
    show(found, minutes, arguments)
    return 0


def show(
    found: dict[str, tuple[Delays, float]], minutes: list[Minute], arguments: argparse.Namespace
) -> None:
    """Print the tables, and write the JSON file."""
    out = Console(width=None if sys.stdout.isatty() else 110)
    table = Table(title=f"the hub with {arguments.clients} clients, and under attack: delays of others")
    for column in ("", "per second", "p50 ms", "p99 ms", "max ms", "p99 to alone", "hub grew by MiB"):
        table.add_column(column, justify="right" if column else "left")
    written: dict[str, Any] = {"hub": {}, "minutes": [asdict(each) for each in minutes]}
    alone = 1.0
    for name, (delays, grown) in found.items():
        p50, p99, most = delays.quantiles()
        alone = p99 if name.endswith("alone") else alone
        rate = f"{delays.per_second:,.0f}" if delays.per_second else ""
        table.add_row(
            name, rate, f"{p50:.1f}", f"{p99:.1f}", f"{most:.1f}", f"{p99 / alone:.1f}", f"{grown:.1f}"
        )
        written["hub"][name] = {"p50_ms": p50, "p99_ms": p99, "p99_to_alone": p99 / alone, "grown_mib": grown}
    out.print(table)
    if minutes:
        first, last = asdict(minutes[0]), asdict(minutes[-1])
        table = Table(title=f"master --loop at full rate for {len(minutes)} minutes")
        for column in ("", "first minute", "last minute", "last to first"):
            table.add_column(column, justify="right" if column else "left")
        for name in first:
            table.add_row(
                name, f"{first[name]:,.0f}", f"{last[name]:,.0f}", f"{last[name] / first[name]:.2f}"
            )
        out.print(table)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(written, indent=2) + "\n")


def main() -> int:
    """Parse the flags and measure."""
    parser = ScriptParser(
        prog="scripts/bench load",
        description="Measure the hub with many clients and under attack, and master --loop at full rate.",
    )
    parser.add_argument("--clients", type=int, default=500, help="number of clients of the hub")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of each phase in seconds")
    parser.add_argument("--minutes", type=int, default=5, help="minutes of master --loop; 0 for none")
    parser.add_argument("--json", type=output_file, help="write all figures")
    arguments = parser.parse_args()
    if arguments.clients <= PUBLISHERS + SLOW:
        parser.error(f"--clients must be more than {PUBLISHERS + SLOW}")
    return run_script(lambda: bench(arguments), 600 + 60 * arguments.minutes)


if __name__ == "__main__":
    sys.exit(main())
