"""Comparison of rosbridge clients on one hub, and of the hub with a server of the reference server's design.

The peer of each measured client or server is a bare socket, which does not encode or decode:
published:  client -> hub -> bare socket
received:   bare socket -> hub -> client
round trip: client -> hub -> client
Everything is measured in turns within one run, so that noise on the machine affects all alike.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

from rich.console import Console
from rich.table import Table

from scripts.running.flags import ScriptParser, output_file
from scripts.running.processes import ROOT, Process, run_script
from scripts.verifications.installation import install_roslib, install_roslibpy
from services.errors import StackError

Result = TypeVar("Result")

SIDES = Path(__file__).with_name("bridge_sides")
TYPE = "std_msgs/Float64MultiArray"
PATIENCE = 30.0
SMALL, LARGE = 6, 1024
SIZES = (1, 4, 16, 64, 256, 1024, 4096)
TURNS = 3
IN_FLIGHT = 32
"""Number of messages in flight when servers are compared."""
WINDOW = {SMALL: 400, LARGE: 100}
"""Messages by which a receiving client may lag, by their number of values: fewer than the hub would drop."""
COUNTS = {SMALL: (12_000, 12_000, 600), LARGE: (1_000, 2_000, 200)}
"""Messages to publish, receive and send in round trips per turn, by number of values (50 ms or more).
"""
PER_SIZE = 40
SERVER_MESSAGES = {"hub": 100_000, "Tornado double": 8_000}
SERVER_TURNS = 5


class Bare(asyncio.Protocol):
    """A WebSocket client with negligible cost: frames are encoded once, and only counted when received."""

    def __init__(self) -> None:
        self.ready: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.count = 0
        self.on_frames: Callable[[int, bytes], None] | None = None
        self._rest = b""
        self._transport: asyncio.Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Request a WebSocket."""
        self._transport = cast("asyncio.Transport", transport)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = ["GET / HTTP/1.1", "Host: localhost", "Upgrade: websocket", "Connection: Upgrade"]
        lines += [f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13", "", ""]
        self._transport.write("\r\n".join(lines).encode())

    def data_received(self, data: bytes) -> None:
        """Count whole frames, and call `on_frames` with their number and the last one's payload."""
        data = self._rest + data
        if not self.ready.done():
            head, separator, data = data.partition(b"\r\n\r\n")
            if not separator:
                self._rest = head
                return
            self.ready.set_result(None)
        at = came = 0
        last = b""
        while len(data) - at >= 2:
            length, body = data[at + 1], at + 2
            if length >= 126:
                body += 2 if length == 126 else 8
                length = int.from_bytes(data[at + 2 : body], "big") if body <= len(data) else len(data)
            if body + length > len(data):
                break
            if data[at] & 15 in {1, 2}:
                came += 1
                last = data[body : body + length]
            at = body + length
        self._rest = data[at:]
        self.count += came
        if came and self.on_frames is not None:
            self.on_frames(came, last)

    def send(self, frames: bytes) -> None:
        """Send encoded frames."""
        self._transport.write(frames)

    def pause(self) -> None:
        """Stop reading."""
        self._transport.pause_reading()

    def resume(self) -> None:
        """Resume reading."""
        self._transport.resume_reading()

    def close(self) -> None:
        """Close the connection."""
        self._transport.abort()


async def soon(awaited: Awaitable[Result], what: str) -> Result:
    """Wait for an awaitable, for a limited time.

    Raises:
        StackError: It did not complete in time.
    """
    try:
        async with asyncio.timeout(PATIENCE):
            return await awaited
    except TimeoutError:
        raise StackError(f"{what} did not come within {PATIENCE:.0f} s") from None


def frame(operation: dict[str, Any]) -> bytes:
    """Return a masked frame (with a mask of zeros)."""
    payload = json.dumps(operation, separators=(",", ":")).encode()
    size = len(payload)
    if size < 126:
        header = bytes((0x81, 0x80 | size))
    elif size < 1 << 16:
        header = b"\x81\xfe" + size.to_bytes(2, "big")
    else:
        header = b"\x81\xff" + size.to_bytes(8, "big")
    return header + bytes(4) + payload


@asynccontextmanager
async def bare(uri: str) -> Any:
    """Connect a bare client to a server."""
    host, _, port = uri.removeprefix("ws://").rpartition(":")
    _, client = await asyncio.get_running_loop().create_connection(Bare, host, int(port))
    try:
        await soon(client.ready, f"the connection to {uri}")
        yield client
    finally:
        client.close()


async def settled(client: Bare) -> None:
    """Return when the server has processed everything that this client sent."""
    answered: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    client.on_frames = lambda _count, _last: None if answered.done() else answered.set_result(None)
    client.send(frame({"op": "call_service", "id": "s", "service": "/rosapi/get_time", "args": {}}))
    await soon(answered, "the answer to a call")
    client.on_frames = None


def message_of(values: int) -> dict[str, list[float]]:
    """Return a message of numbers such as sensors measure, with all digits significant."""
    return {"data": [(at + 1) / 7.0 for at in range(values)]}


# --- servers


async def server_rate(uri: str, count: int) -> float:
    """Return messages of 64 bytes per second from one bare client to another, with 32 in flight."""
    loop = asyncio.get_running_loop()
    async with bare(uri) as publisher, bare(uri) as subscriber:
        subscriber.send(frame({"op": "subscribe", "topic": "/load", "type": TYPE, "queue_length": 1000}))
        await settled(subscriber)
        publisher.send(frame({"op": "advertise", "topic": "/load", "type": TYPE}))
        await settled(publisher)
        one = frame({"op": "publish", "topic": "/load", "msg": {"data": [0.5, 12.25, 7.0]}})
        done: asyncio.Future[None] = loop.create_future()
        subscriber.count, sent = 0, IN_FLIGHT

        def again(came: int, _last: bytes) -> None:
            nonlocal sent
            more = min(came, count - sent)
            sent += more
            if more:
                publisher.send(one * more)
            if subscriber.count >= count and not done.done():
                done.set_result(None)

        subscriber.on_frames = again
        started = time.perf_counter()
        publisher.send(one * IN_FLIGHT)
        await soon(done, f"the last message through {uri}")
        return count / (time.perf_counter() - started)


# --- clients


@dataclass(frozen=True)
class Kind:
    """A client to be measured: its name, its command, and the forms in which it takes messages."""

    name: str
    command: tuple[str, ...]
    environment: dict[str, str] = field(default_factory=dict)
    forms: tuple[str, ...] = ("none", "cbor")


class Rate(NamedTuple):
    """Messages per second, and microseconds of the client's CPU time for each."""

    per_s: float
    cpu_us: float


class Child:
    """A client under measurement, in its own process."""

    def __init__(self, kind: Kind, process: asyncio.subprocess.Process) -> None:
        self.kind = kind
        self._process = process

    async def answer(self) -> Any:
        """Return the next answer."""
        assert self._process.stdout is not None
        while True:
            line = await soon(self._process.stdout.readline(), f"an answer of {self.kind.name}")
            if not line:
                raise StackError(f"{self.kind.name} ended in the middle of a measurement")
            try:
                return json.loads(line)
            except ValueError:
                continue  # printed by the library itself

    def send(self, **command: Any) -> None:
        """Start a measurement."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(command).encode() + b"\n")


@asynccontextmanager
async def child_of(kind: Kind, uri: str) -> Any:
    """Run a client within the context."""
    process = await asyncio.create_subprocess_exec(
        *kind.command,
        uri,
        env=os.environ | kind.environment,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        limit=1 << 20,
    )
    try:
        child = Child(kind, process)
        await child.answer()
        yield child
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


async def published(child: Child, uri: str, topic: str, values: int, count: int) -> Rate:
    """Measure the messages that the client publishes."""
    async with bare(uri) as counter:
        counter.send(frame({"op": "subscribe", "topic": topic, "type": TYPE, "queue_length": 1000}))
        await settled(counter)
        last: asyncio.Future[float] = asyncio.get_running_loop().create_future()

        def look(_came: int, payload: bytes) -> None:
            if b"[-1" in payload and not last.done():
                last.set_result(time.perf_counter())

        counter.on_frames, counter.count = look, 0
        started = time.perf_counter()
        child.send(do="publish", topic=topic, values=values, count=count)
        ended = await soon(last, f"the last message that {child.kind.name} published")
        cpu = (await child.answer())["cpu_s"]
        return Rate(float(counter.count / (ended - started)), 1e6 * cpu / count)


async def received(child: Child, uri: str, topic: str, values: int, count: int, form: str) -> Rate:
    """Measure the messages that the client receives."""
    async with bare(uri) as publisher:
        publisher.send(frame({"op": "advertise", "topic": topic, "type": TYPE}))
        publisher.send(frame({"op": "subscribe", "topic": f"{topic}/heard", "type": TYPE}))
        await settled(publisher)
        child.send(do="receive", topic=topic, count=count, compression=form)
        await child.answer()
        one, sent = frame({"op": "publish", "topic": topic, "msg": message_of(values)}), 0

        def send_until(limit: int) -> None:
            nonlocal sent
            more = min(limit, count) - sent
            if more > 0:
                sent += more
                publisher.send(one * more)

        publisher.on_frames = lambda _came, last: send_until(
            int(json.loads(last)["msg"]["data"][0]) + WINDOW[values]
        )
        started = time.perf_counter()
        send_until(WINDOW[values])
        cpu = (await child.answer())["cpu_s"]
        return Rate(count / (time.perf_counter() - started), 1e6 * cpu / count)


async def round_trips(child: Child, topic: str, values: int, count: int, form: str) -> list[float]:
    """Return the microseconds of consecutive round trips."""
    child.send(do="round_trip", topic=topic, values=values, count=count, compression=form)
    times: list[float] = (await child.answer())["us"]
    return times[count // 10 :]  # the first ones are warm-up


def kinds() -> list[Kind]:
    """Return all clients, and install those of other projects that are missing."""
    python = str(install_roslibpy() / "venv" / "bin" / "python")
    roslibpy = (python, str(SIDES / "roslibpy_client.py"))
    return [
        Kind("ours", (sys.executable, str(SIDES / "ours.py"))),
        *(
            Kind(f"roslibpy, {transport}", roslibpy, {"ROSLIBPY_TRANSPORT": transport}, ("none",))
            for transport in ("twisted", "asyncio")
        ),
        Kind("roslib, Node", ("node", str(SIDES / "roslib_client.mjs"), str(install_roslib()))),
    ]


def topics() -> Iterator[str]:
    """Return a new topic for each measurement."""
    number = 0
    while True:
        number += 1
        yield f"/bench/turn{number}"


# --- the bench


def codec() -> dict[str, float]:
    """Return the microseconds to encode and decode 1024 doubles as JSON (standard library) and CBOR (ours)."""
    import numpy as np

    from bridge.codecs import cbor_codec

    message = {"op": "publish", "topic": "/t", "msg": message_of(LARGE)}
    as_array = message | {"msg": {"data": np.array(message_of(LARGE)["data"])}}

    def best_of(work: Callable[[], object]) -> float:
        times = []
        for _ in range(300):
            started = time.perf_counter_ns()
            work()
            times.append((time.perf_counter_ns() - started) / 1e3)
        return statistics.median(times)

    return {
        "json": best_of(lambda: json.loads(json.dumps(message))),
        "cbor": best_of(lambda: cbor_codec.decode(cbor_codec.encode(as_array), arrays="numpy")),
    }


async def bench(arguments: argparse.Namespace) -> int:
    """Measure everything, print the tables, and write the picture and the JSON file."""
    clients, found = kinds(), Figures()
    with tempfile.TemporaryDirectory(prefix="bench-rosbayes-") as folder:
        hub, tornado = (Process(name, Path(folder, name)) for name in ("hub", "tornado"))
        try:
            await hub.start("hub", "--port", "0")
            await tornado.start(clients[1].command[0], str(SIDES / "tornado_server.py"))
            uris = {
                "hub": (await hub.line(r"ws://\S+"))[0],
                "Tornado double": (await tornado.line(r"ws://\S+"))[0],
            }
            for _ in range(SERVER_TURNS):
                for name, uri in uris.items():
                    found.servers.setdefault(name, []).append(await server_rate(uri, SERVER_MESSAGES[name]))
            await tornado.end()
            await measure_clients(clients, uris["hub"], found)
        finally:
            await asyncio.gather(hub.end(), tornado.end())
    found.codec = codec()
    summary = found.summary()
    show(summary)
    picture = ROOT / "out" / "bridge-round-trip.png"
    if draw(summary["round_trip_us_by_values"], picture):
        print(f"round trips by size: {picture.relative_to(ROOT)}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(summary, indent=2) + "\n")
    return 0


@dataclass
class Figures:
    """All measurements, by client, form and number of values."""

    servers: dict[str, list[float]] = field(default_factory=dict)
    published: dict[tuple[str, int], list[Rate]] = field(default_factory=dict)
    received: dict[tuple[str, str, int], list[Rate]] = field(default_factory=dict)
    times: dict[tuple[str, str, int], list[float]] = field(default_factory=dict)
    by_size: dict[tuple[str, str], dict[int, list[float]]] = field(default_factory=dict)
    codec: dict[str, float] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """Return the medians and the ratios that have targets."""
        median = statistics.median
        rows = [
            {
                "client": name,
                "form": form,
                "values": values,
                "published_per_s": middle(self.published[name, values]).per_s if form == "none" else None,
                "published_cpu_us": middle(self.published[name, values]).cpu_us if form == "none" else None,
                "received_per_s": middle(rates).per_s,
                "received_cpu_us": middle(rates).cpu_us,
                "round_trip_us": median(self.times[name, form, values]),
                "round_trip_p99_us": sorted(self.times[name, form, values])[
                    int(0.99 * len(self.times[name, form, values]))
                ],
            }
            for (name, form, values), rates in self.received.items()
        ]
        servers = {name: median(rates) for name, rates in self.servers.items()}
        return {
            "servers_per_s": servers,
            "clients": rows,
            "codec_us": self.codec,
            "ratios": self.ratios()
            | {
                "hub to Tornado double": servers["hub"] / servers["Tornado double"],
                "CBOR to stdlib json, 1024 doubles": self.codec["cbor"] / self.codec["json"],
            },
            "round_trip_us_by_values": {
                f"{name}, {'CBOR' if form == 'cbor' else 'JSON'}": {
                    str(values): median(times) for values, times in sizes.items()
                }
                for (name, form), sizes in self.by_size.items()
            },
        }

    def ratios(self) -> dict[str, float]:
        """Return this project's client's rate relative to the better of roslibpy's transports."""
        median, theirs = (
            statistics.median,
            [name for name, _ in self.published if name.startswith("roslibpy")],
        )
        found = {}
        for values in (SMALL, LARGE):
            out, into = (
                [middle(rates) for rates in their]
                for their in (
                    [self.published[name, values] for name in theirs],
                    [self.received[name, "none", values] for name in theirs],
                )
            )
            trip = min(median(self.times[name, "none", values]) for name in theirs)
            ours = middle(self.published["ours", values])
            found[f"published, {values} values"] = ours.per_s / max(rate.per_s for rate in out)
            found[f"CPU of publishing, {values} values"] = ours.cpu_us / min(rate.cpu_us for rate in out)
            for form, word in (("none", ""), ("cbor", " as CBOR")):
                ours = middle(self.received["ours", form, values])
                found[f"received{word}, {values} values"] = ours.per_s / max(rate.per_s for rate in into)
                found[f"CPU of receiving{word}, {values} values"] = ours.cpu_us / min(
                    rate.cpu_us for rate in into
                )
                found[f"round trip{word}, {values} values"] = median(self.times["ours", form, values]) / trip
        return found


def middle(rates: list[Rate]) -> Rate:
    """Return the medians of both figures."""
    return Rate(*map(statistics.median, zip(*rates, strict=True)))


async def measure_clients(clients: list[Kind], uri: str, found: Figures) -> None:
    """Measure all clients in turns; the process of a client lives for one turn."""
    names = topics()
    for turn in range(TURNS):
        for kind in clients:
            async with child_of(kind, uri) as child:
                for values, (out, into, trips) in COUNTS.items():
                    rate = await published(child, uri, next(names), values, out)
                    found.published.setdefault((kind.name, values), []).append(rate)
                    for form in kind.forms:
                        key = kind.name, form, values
                        rate = await received(child, uri, next(names), values, into, form)
                        found.received.setdefault(key, []).append(rate)
                        times = await round_trips(child, next(names), values, trips, form)
                        found.times.setdefault(key, []).extend(times)
                if turn:
                    continue
                for form in kind.forms:
                    found.by_size[kind.name, form] = {
                        values: await round_trips(child, next(names), values, PER_SIZE, form)
                        for values in SIZES
                    }


def show(summary: dict[str, Any]) -> None:
    """Print the tables."""
    out = Console() if sys.stdout.isatty() else Console(width=110)
    servers = Table(title=f"messages of 64 bytes a second, {IN_FLIGHT} in flight")
    servers.add_column("server")
    servers.add_column("per second", justify="right")
    for name, rate in summary["servers_per_s"].items():
        servers.add_row(name, f"{rate:,.0f}")
    out.print(servers)
    table = Table(title="clients on the hub (float64 values in a message; medians)")
    columns = (
        "client",
        "form",
        "values",
        "published/s",
        "CPU us",
        "received/s",
        "CPU us",
        "round trip us",
        "99 % us",
    )
    for column in columns:
        table.add_column(column, justify="left" if column in {"client", "form"} else "right")
    for row in sorted(summary["clients"], key=lambda row: row["values"]):
        form = "CBOR" if row["form"] == "cbor" else "JSON"
        out_figures = (
            f"{row[key]:{style}}" if row[key] is not None else ""
            for key, style in (("published_per_s", ",.0f"), ("published_cpu_us", ".1f"))
        )
        figures = f"{row['received_per_s']:,.0f}", f"{row['received_cpu_us']:.1f}"
        times = f"{row['round_trip_us']:,.0f}", f"{row['round_trip_p99_us']:,.0f}"
        table.add_row(row["client"], form, str(row["values"]), *out_figures, *figures, *times)
    out.print(table)
    ratios = Table(title="ratios (ours to the better of roslibpy's transports, unless stated otherwise)")
    ratios.add_column("of what")
    ratios.add_column("ratio", justify="right")
    for name, ratio in summary["ratios"].items():
        ratios.add_row(name, f"{ratio:.2f}")
    out.print(ratios)
    print(
        "The Tornado double is this project's own: the reference server's design for one type, without the rest of ROS."
    )


def draw(by_values: dict[str, dict[str, float]], path: Path) -> bool:
    """Draw round-trip time against message size; return False without matplotlib."""
    try:
        import matplotlib as mpl
    except ImportError:
        print("no picture: install matplotlib (pip install matplotlib)", file=sys.stderr)
        return False
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    for name, times in by_values.items():
        style = "--" if name.endswith("CBOR") else "-"
        axes.plot([int(values) for values in times], list(times.values()), style, marker="o", label=name)
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="float64 values in a message",
        ylabel="round trip client, hub, client (us, median)",
        xticks=SIZES,
        xticklabels=[str(size) for size in SIZES],
    )
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=150)
    return True


def main() -> int:
    """Parse the flags and measure."""
    parser = ScriptParser(
        prog="scripts/bench bridge",
        description="Compare rosbridge clients on the hub, and the hub with a model of the reference server.",
    )
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write all figures")
    arguments = parser.parse_args()
    return run_script(lambda: bench(arguments), 300)


if __name__ == "__main__":
    sys.exit(main())
