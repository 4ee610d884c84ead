"""The hub under load: hundreds of clients, some of which read slowly, and clients that attack it.

Every message contains its time of sending, from which fast subscribers in this process compute its delay. The
clients are bare sockets (see `scripts.benches.bridge`) and share the machine with the hub, so the figures are
those of both.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import statistics
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from scripts.benches.bridge import TYPE, Bare, bare, frame, settled
from scripts.running.flags import ScriptParser, output_file
from scripts.running.processes import Process, run_script

TOPICS = 200
PUBLISHERS = 50
SLOW = 50
RATE = 2000
"""Messages per second over all topics."""
SLOT = 0.01
PROBE_HZ = 100
MEGABYTE = 1 << 20


def _resident(process: int) -> int:
    """Return the bytes of memory that a process occupies."""
    pages = Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


@dataclass
class Delays:
    """Delays of a phase, in milliseconds, and messages delivered per second."""

    milliseconds: list[float] = field(default_factory=list)
    per_second: float = 0.0

    def summary(self) -> dict[str, float]:
        """Return the median, the 99th percentile, the maximum and the rate."""
        taken = sorted(self.milliseconds) or [float("nan")]
        return {
            "p50_ms": statistics.median(taken),
            "p99_ms": taken[int(0.99 * (len(taken) - 1))],
            "max_ms": taken[-1],
            "delivered_per_s": self.per_second,
        }


def subscribe(topic: int, **options: Any) -> bytes:
    """Return the frame that subscribes to a topic of the load."""
    return frame({"op": "subscribe", "topic": f"/load/t{topic}", "type": TYPE, **options})


async def publish_for(publishers: list[Bare], seconds: float) -> None:
    """Publish on all topics in turn, at the bench's rate."""
    end, topic = time.perf_counter() + seconds, 0
    while time.perf_counter() < end:
        slot_end = time.perf_counter() + SLOT
        for _ in range(int(RATE * SLOT)):
            topic = (topic + 1) % TOPICS
            message = {"data": [time.perf_counter(), 0.5, 0.25]}
            operation = {"op": "publish", "topic": f"/load/t{topic}", "msg": message}
            publishers[topic % len(publishers)].send(frame(operation))
        await asyncio.sleep(max(0.0, slot_end - time.perf_counter()))


async def phase(readers: list[Bare], publishers: list[Bare], seconds: float) -> Delays:
    """Measure the fast readers while messages are published on all topics."""
    delays = Delays()
    for reader in readers:
        reader.on_frames = lambda _count, last: _take(delays, last)
        reader.count = 0
    began = time.perf_counter()
    await publish_for(publishers, seconds)
    await asyncio.sleep(0.5)
    delays.per_second = sum(reader.count for reader in readers) / (time.perf_counter() - began - 0.5)
    return delays


def _take(delays: Delays, last: bytes) -> None:
    if b'"data":[' in last:
        sent = float(last.split(b'"data":[', 1)[1].split(b",", 1)[0].rstrip(b"]}"))
        delays.milliseconds.append(1e3 * (time.perf_counter() - sent))


async def crowd(uri: str, hub: int, clients: int, seconds: float) -> dict[str, Any]:
    """Measure the fast clients alone, and with clients that read almost nothing."""
    numbers = random.Random(1)
    before = _resident(hub)
    async with AsyncExitStack() as stack:
        publishers = [await stack.enter_async_context(bare(uri)) for _ in range(PUBLISHERS)]
        for topic in range(TOPICS):
            operation = {"op": "advertise", "topic": f"/load/t{topic}", "type": TYPE}
            publishers[topic % PUBLISHERS].send(frame(operation))
        quick = [await stack.enter_async_context(bare(uri)) for _ in range(clients - PUBLISHERS - SLOW)]
        for reader in quick:
            reader.send(b"".join(subscribe(numbers.randrange(TOPICS)) for _ in range(2)))
        await settled(quick[-1])
        alone = await phase(quick, publishers, seconds)
        slow = [await stack.enter_async_context(bare(uri)) for _ in range(SLOW)]
        for reader in slow:
            reader.send(b"".join(subscribe(numbers.randrange(TOPICS)) for _ in range(20)))
        await settled(slow[-1])
        reading = asyncio.ensure_future(_read_slowly(slow))
        beside = await phase(quick, publishers, seconds)
        per_client = (_resident(hub) - before) / clients
        reading.cancel()
    return {
        "clients": clients,
        "topics": TOPICS,
        "published_per_s": RATE,
        "quick alone": alone.summary(),
        "quick beside slow": beside.summary(),
        "memory_per_client_kb": per_client / 1024,
    }


async def _read_slowly(readers: list[Bare]) -> None:
    """Let each reader read for a moment every second."""
    for reader in readers:
        reader.pause()
    while True:
        for reader in readers:
            reader.resume()
            await asyncio.sleep(1 / len(readers))
            reader.pause()


# --- attacks


@asynccontextmanager
async def probed(uri: str) -> AsyncIterator[Delays]:
    """Measure the delays of messages between two well-behaved clients."""
    delays = Delays()
    async with bare(uri) as publisher, bare(uri) as subscriber:
        topic = f"/probe/{time.perf_counter_ns()}"
        subscriber.send(frame({"op": "subscribe", "topic": topic, "type": TYPE, "queue_length": 1000}))
        await settled(subscriber)
        publisher.send(frame({"op": "advertise", "topic": topic, "type": TYPE}))
        await settled(publisher)
        subscriber.on_frames = lambda _count, last: _take(delays, last)

        async def send() -> None:
            while True:
                message = {"data": [time.perf_counter(), 1.0]}
                publisher.send(frame({"op": "publish", "topic": topic, "msg": message}))
                await asyncio.sleep(1 / PROBE_HZ)

        sending = asyncio.ensure_future(send())
        try:
            yield delays
            await asyncio.sleep(0.3)
        finally:
            sending.cancel()


async def _sized_arrays(uri: str, stack: AsyncExitStack) -> Callable[[], Awaitable[None]]:
    """Publish numbers where the type has bytes, with a CBOR subscriber."""
    reader = await stack.enter_async_context(bare(uri))
    kind = "sensor_msgs/Image"
    reader.send(frame({"op": "subscribe", "topic": "/image", "type": kind, "compression": "cbor"}))
    attacker = await stack.enter_async_context(bare(uri))
    attacker.send(frame({"op": "advertise", "topic": "/image", "type": kind}))
    one = frame({"op": "publish", "topic": "/image", "msg": {"data": 1_000_000_000}})
    return _repeated(attacker, one * 8)


async def _small_fragments(uri: str, stack: AsyncExitStack) -> Callable[[], Awaitable[None]]:
    """Publish large messages to readers that request tiny fragments."""
    for _ in range(20):
        reader = await stack.enter_async_context(bare(uri))
        options = {"type": TYPE, "fragment_size": 16}
        reader.send(frame({"op": "subscribe", "topic": "/large", **options}))
    attacker = await stack.enter_async_context(bare(uri))
    attacker.send(frame({"op": "advertise", "topic": "/large", "type": TYPE}))
    one = frame({"op": "publish", "topic": "/large", "msg": {"data": [0.123456789] * 60_000}})
    return _repeated(attacker, one, pause=0.5)


async def _unread_answers(uri: str, stack: AsyncExitStack) -> Callable[[], Awaitable[None]]:
    """Request large parameters repeatedly without reading the answers."""
    attackers = [await stack.enter_async_context(bare(uri)) for _ in range(20)]
    value = json.dumps("x" * 500_000)
    set_param = {"op": "call_service", "service": "/rosapi/set_param", "args": {"name": "/p", "value": value}}
    attackers[0].send(frame(set_param))
    await settled(attackers[0])
    for attacker in attackers:
        attacker.pause()
    ask = frame({"op": "call_service", "service": "/rosapi/get_param", "args": {"name": "/p", "default": ""}})

    async def attack() -> None:
        for attacker in attackers:
            attacker.send(ask * 64)
        await asyncio.sleep(1)

    return attack


async def _brackets(uri: str, stack: AsyncExitStack) -> Callable[[], Awaitable[None]]:
    """Publish many empty arrays, which take long to parse."""
    attacker = await stack.enter_async_context(bare(uri))
    attacker.send(frame({"op": "advertise", "topic": "/deep", "type": TYPE}))
    payload = b'{"op":"publish","topic":"/deep","msg":{"data":[' + b"[]," * 300_000 + b"[]]}}"
    one = b"\x81\xff" + len(payload).to_bytes(8, "big") + bytes(4) + payload
    return _repeated(attacker, one, pause=0.1)


async def _resubscriptions(uri: str, stack: AsyncExitStack) -> Callable[[], Awaitable[None]]:
    """Repeat one of thousands of subscribe operations."""
    attacker = await stack.enter_async_context(bare(uri))
    for at in range(4000):
        attacker.send(frame({"op": "subscribe", "id": str(at), "topic": "/many", "type": TYPE}))
    await settled(attacker)
    return _repeated(attacker, frame({"op": "subscribe", "id": "7", "topic": "/many", "type": TYPE}) * 64)


async def _listings(uri: str, stack: AsyncExitStack) -> Callable[[], Awaitable[None]]:
    """List thousands of topics."""
    attacker = await stack.enter_async_context(bare(uri))
    for at in range(4000):
        attacker.send(frame({"op": "advertise", "topic": f"/listed/{at}", "type": TYPE}))
    await settled(attacker)
    return _repeated(attacker, frame({"op": "call_service", "service": "/rosapi/topics"}) * 8)


async def _silent_connections(uri: str, stack: AsyncExitStack) -> Callable[[], Awaitable[None]]:
    """Hold hundreds of silent connections."""
    host, _, port = uri.removeprefix("ws://").rpartition(":")
    for _ in range(300):
        _, writer = await asyncio.open_connection(host, int(port))
        stack.callback(writer.close)

    async def attack() -> None:
        await asyncio.sleep(1)

    return attack


def _repeated(attacker: Bare, data: bytes, pause: float = 0.02) -> Callable[[], Awaitable[None]]:
    async def attack() -> None:
        attacker.send(data)
        await asyncio.sleep(pause)

    return attack


ATTACKS = {
    "numbers for bytes": _sized_arrays,
    "tiny fragments": _small_fragments,
    "unread answers": _unread_answers,
    "empty arrays": _brackets,
    "resubscriptions": _resubscriptions,
    "listings": _listings,
    "silent connections": _silent_connections,
}


async def attacked(uri: str, hub: int, seconds: float) -> dict[str, dict[str, float]]:
    """Measure the delays of two other clients and the hub's memory growth during each attack."""
    found = {}
    async with probed(uri) as quiet:
        await asyncio.sleep(seconds)
    found["none"] = quiet.summary() | {"growth_mb": 0.0}
    for name, prepare in ATTACKS.items():
        before = peak = _resident(hub)
        async with AsyncExitStack() as stack:
            attack = await prepare(uri, stack)
            async with probed(uri) as delays:
                end = time.perf_counter() + seconds
                while time.perf_counter() < end:
                    await attack()
                    peak = max(peak, _resident(hub))
        found[name] = delays.summary() | {"growth_mb": (peak - before) / MEGABYTE}
        await asyncio.sleep(1)
    return found


async def bench(arguments: argparse.Namespace) -> int:
    """Measure, print the tables, and write the JSON file."""
    with tempfile.TemporaryDirectory(prefix="bench-rosbayes-") as folder:
        hub = Process("hub", Path(folder, "hub"))
        try:
            await hub.start("hub", "--port", "0", "--clients", str(arguments.clients + 100))
            uri = (await hub.line(r"ws://\S+"))[0]
            process = hub.pid
            found: dict[str, Any] = {"crowd": await crowd(uri, process, arguments.clients, arguments.seconds)}
            found["attacks"] = await attacked(uri, process, min(arguments.seconds, 5.0))
        finally:
            await hub.end()
    show(found)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found, indent=2) + "\n")
    return 0


def show(found: dict[str, Any]) -> None:
    """Print the tables."""
    out = Console() if sys.stdout.isatty() else Console(width=110)
    load = found["crowd"]
    table = Table(
        title=f"{load['clients']} clients, {load['topics']} topics, {load['published_per_s']} messages a second"
    )
    for column in ("readers", "delivered/s", "p50 ms", "p99 ms", "max ms"):
        table.add_column(column, justify="left" if column == "readers" else "right")
    for name in ("quick alone", "quick beside slow"):
        row = load[name]
        table.add_row(name, f"{row['delivered_per_s']:,.0f}", *(f"{row[key]:.1f}" for key in list(row)[:3]))
    out.print(table)
    print(f"memory per client: {load['memory_per_client_kb']:.0f} kB")
    table = Table(title=f"two other clients, {PROBE_HZ} messages a second, during an attack")
    for column in ("attack", "p50 ms", "p99 ms", "max ms", "hub grew by MB"):
        table.add_column(column, justify="left" if column == "attack" else "right")
    for name, row in found["attacks"].items():
        table.add_row(name, *(f"{row[key]:.1f}" for key in ("p50_ms", "p99_ms", "max_ms", "growth_mb")))
    out.print(table)


def main() -> int:
    """Parse the flags and measure."""
    parser = ScriptParser(
        prog="scripts/bench load",
        description="Measure the hub with many clients, with slow readers, and under attack.",
    )
    parser.add_argument("--clients", type=int, default=500, help="number of clients")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of each phase in seconds")
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write all figures")
    arguments = parser.parse_args()
    return run_script(lambda: bench(arguments), 600)


if __name__ == "__main__":
    sys.exit(main())
