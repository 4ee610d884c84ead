"""Comparison of this client with roslibpy on one hub, and of the hub with a model of the reference server.

A bare socket neither encodes nor decodes messages. The measured paths are:
published:  client -> hub -> bare socket
received:   bare socket -> hub -> client
round trip: client -> hub -> client
servers:    bare socket -> hub or model -> bare socket
All clients and servers take turns within one run, so that noise on the machine affects each of them equally.
"""

from __future__ import annotations

import asyncio
import json
import os
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from itertools import count
from pathlib import Path
from typing import Any, Final

from scripts.benches.bare import advertise, bare, publish, settled, soon, subscribe
from scripts.running.flags import ScriptParser
from scripts.running.script import print_table, run_script
from scripts.running.stand import temporary_stand
from scripts.verifications.installation import install_roslibpy
from services.errors import StackError

SIDES = Path(__file__).with_name("bridge_sides")
SMALL, LARGE = 6, 1024
TURNS = 3
IN_FLIGHT = 32
"""Number of messages in flight when servers are compared."""
WINDOW = {SMALL: 400, LARGE: 100}
"""Maximum number of messages by which a receiving client lags, by number of values: so few that the hub drops none."""
COUNTS = {SMALL: (12_000, 12_000, 600), LARGE: (1_000, 2_000, 200)}
"""Counts of messages to publish, receive and echo in a turn, by number of values; each count takes 50 ms or more."""
SERVER_MESSAGES = {"hub": 100_000, "Tornado double": 8_000}
SERVER_TURNS = 5
# Bytes of a published message that are searched for the mark of the last one.
_BEGINNING: Final = 128
OURS, CBOR = "ours", "ours, CBOR"
THEIRS: Final = ("roslibpy, twisted", "roslibpy, asyncio")
QUANTITIES = ("published/s", "CPU us each", "received/s", "CPU us each ", "round trip us")

Figures = defaultdict[tuple[int, str], defaultdict[str, list[float]]]
"""Measurements: first by the number of values and the measured quantity, then by client."""
Drops = defaultdict[tuple[str, int], int]
"""Number of messages that the hub dropped because the receiving socket was slow, by client and array length."""


async def server_rate(uri: str, number: int) -> float:
    """Return how many messages of 64 bytes pass from one bare client to another in a second, with 32 in flight."""
    async with bare(uri) as publisher, bare(uri) as subscriber:
        subscriber.send(subscribe("/load", queue_length=1000))
        await settled(subscriber)
        publisher.send(advertise("/load"))
        await settled(publisher)
        one = publish("/load", [0.5, 12.25, 7.0])
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        subscriber.count, sent = 0, IN_FLIGHT

        def again(came: int, _last: bytes) -> None:
            nonlocal sent
            more = min(came, number - sent)
            sent += more
            publisher.send(one * more)
            if subscriber.count >= number and not done.done():
                done.set_result(None)

        subscriber.on_frames = again
        started = time.perf_counter()
        publisher.send(one * IN_FLIGHT)
        await soon(done, f"the last message through {uri}")
        return number / (time.perf_counter() - started)


class Child:
    """A client under measurement, in its own process."""

    def __init__(self, name: str, process: asyncio.subprocess.Process) -> None:
        self.name = name
        self._process = process

    async def answer(self) -> Any:
        """Return the next answer."""
        assert self._process.stdout is not None
        while line := await soon(self._process.stdout.readline(), f"an answer of {self.name}"):
            if line.startswith(b"{"):  # other lines are printed by the library itself
                return json.loads(line)
        raise StackError(f"{self.name} ended in the middle of a measurement")

    def send(self, **command: Any) -> None:
        """Start a measurement."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(command).encode() + b"\n")


@asynccontextmanager
async def client(name: str, uri: str) -> AsyncIterator[Child]:
    """Run a client's process while the context is open."""
    command, environment = [sys.executable, str(SIDES / "our_client.py")], dict(os.environ)
    if name in THEIRS:
        python = str(install_roslibpy() / "venv" / "bin" / "python")
        command = [python, str(SIDES / "roslibpy_client.py")]
        environment["ROSLIBPY_TRANSPORT"] = name.removeprefix("roslibpy, ")
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(*command, uri, env=environment, stdin=pipe, stdout=pipe)
    try:
        child = Child(name, process)
        await child.answer()
        yield child
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


async def published(child: Child, uri: str, topic: str, values: int, number: int) -> tuple[float, float, int]:
    """Return the messages per second that arrive from the client, its CPU microseconds per message, and the losses."""
    async with bare(uri) as counter:
        counter.send(subscribe(topic, queue_length=1000))
        await settled(counter)
        last: asyncio.Future[float] = asyncio.get_running_loop().create_future()

        def look(_came: int, payload: bytes) -> None:
            # only where the numbers begin: searching all of a large message takes longer than reading it
            if b"[-1" in payload[:_BEGINNING] and not last.done():
                last.set_result(time.perf_counter())

        counter.on_frames, counter.count = look, 0
        started = time.perf_counter()
        child.send(do="publish", topic=topic, values=values, count=number)
        ended = await soon(last, f"the last message that {child.name} published")
        cpu = (await child.answer())["cpu_s"]
        return counter.count / (ended - started), 1e6 * cpu / number, number + 1 - counter.count


async def received(
    child: Child, uri: str, topic: str, values: int, number: int, form: str
) -> tuple[float, float]:
    """Return the messages per second that the client receives, and the CPU microseconds per message."""
    async with bare(uri) as publisher:
        publisher.send(advertise(topic) + subscribe(f"{topic}/heard"))
        await settled(publisher)
        child.send(do="receive", topic=topic, count=number, compression=form)
        await child.answer()
        one, sent = publish(topic, [(at + 1) / 7.0 for at in range(values)]), 0

        def send_until(limit: int) -> None:
            nonlocal sent
            more = max(0, min(limit, number) - sent)
            sent += more
            publisher.send(one * more)

        publisher.on_frames = lambda _came, last: send_until(
            int(json.loads(last)["msg"]["data"][0]) + WINDOW[values]
        )
        started = time.perf_counter()
        send_until(WINDOW[values])
        cpu = (await child.answer())["cpu_s"]
        return number / (time.perf_counter() - started), 1e6 * cpu / number


async def measure_turn(name: str, uri: str, topics: Iterator[str], found: Figures, drops: Drops) -> None:
    """Measure a client, whose process lives for one turn."""
    async with client(name, uri) as child:
        for values, (out, into, trips) in COUNTS.items():
            *rates, dropped = await published(child, uri, next(topics), values, out)
            drops[name, values] += dropped
            for column, form in ((name, "none"), (CBOR, "cbor"))[: 2 if name == OURS else 1]:
                figures = (*rates, *await received(child, uri, next(topics), values, into, form))
                child.send(do="round_trip", topic=next(topics), values=values, count=trips, compression=form)
                times = (await child.answer())["us"][trips // 10 :]  # the first ones are warm-up
                for quantity, figure in zip(QUANTITIES, (*figures, statistics.median(times)), strict=True):
                    found[values, quantity][column].append(figure)


async def bench() -> int:
    """Measure everything, and print the table."""
    servers: defaultdict[str, list[float]] = defaultdict(list)
    found: Figures = defaultdict(lambda: defaultdict(list))
    drops: Drops = defaultdict(int)
    topics = (f"/bench/turn{number}" for number in count())
    async with temporary_stand() as stand:
        await stand.start_hub()
        python = install_roslibpy() / "venv" / "bin" / "python"
        tornado = await stand.start("tornado", r"ws://\S+", str(python), str(SIDES / "tornado_server.py"))
        for _ in range(SERVER_TURNS):
            for name, uri in {"hub": stand.uri, "Tornado double": tornado}.items():
                servers[name].append(await server_rate(uri, SERVER_MESSAGES[name]))
        await stand.end("tornado")
        for _ in range(TURNS):
            for name in (OURS, *THEIRS):
                await measure_turn(name, stand.uri, topics, found, drops)
    show(servers, found, drops)
    return 0


def show(servers: dict[str, list[float]], found: Figures, drops: Drops) -> None:
    """Print each client's medians, and the ratio of ours to those of roslibpy's better transport."""
    columns = (OURS, CBOR, *THEIRS)
    rates = {name: statistics.median(each) for name, each in servers.items()}
    rows = []
    for (values, quantity), by_client in found.items():
        middle = {name: statistics.median(by_client[name]) for name in columns}
        best = (max if quantity.endswith("/s") else min)(middle[name] for name in THEIRS)
        ratios = [middle[OURS] / best, middle[CBOR] / best]
        figures = [
            f"{middle[name]:,.0f}" if middle[name] >= 100 else f"{middle[name]:.1f}" for name in columns
        ]
        rows.append((str(values), quantity, *figures, *(f"{ratio:.2f}" for ratio in ratios)))
    print_table(
        "clients on the hub (float64 values in a message; medians)",
        ("values", "", *columns, "ours to roslibpy", "CBOR to roslibpy"),
        rows,
        left=0,
    )
    for (name, values), dropped in drops.items():
        if dropped:
            number = TURNS * (COUNTS[values][0] + 1)
            print(
                f"The hub dropped {dropped:,} of {number:,} messages of {values} values that {name} published, because "
                "the counting socket was slower; published/s counts those that arrived."
            )
    ratio = rates["hub"] / rates["Tornado double"]
    print(
        f"messages of 64 bytes a second, {IN_FLIGHT} in flight: hub {rates['hub']:,.0f}, "
        f"Tornado double {rates['Tornado double']:,.0f}; ratio {ratio:.1f}"
    )
    print(
        "The Tornado double is this project's own: the reference server's design for one type, without ROS."
    )


def main() -> int:
    """Parse the flags and measure."""
    parser = ScriptParser(
        prog="scripts/bench bridge",
        description="Compare rosbridge clients on the hub, and the hub with a model of the reference server.",
    )
    parser.parse_args()
    return run_script(bench, 300)


if __name__ == "__main__":
    sys.exit(main())
