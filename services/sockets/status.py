"""Status of a process: its records, read from its status socket (`terminal.health`)."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeVar

import msgspec

from terminal.health import ANSWER_LIMIT, foreign_socket_error, silence_explained

if TYPE_CHECKING:
    # boards and pcie-app start without importing the bridge
    from bridge.client import Ros


class ConnectionStatus(msgspec.Struct, frozen=True):
    """A connection to a rosbridge server: `state` is connecting, connected, reconnecting or closed."""

    uri: str
    state: str
    reconnections: int


class FrameCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Counts of frames in one process.

    `received` and `completed` are messages and complete readings (subscriber), requested and computed frames
    (pcie-app), requested and published results (publisher), readings and published results (master). `lost`
    counts the others by `LossReason`. `last_number` is that of the last completed one (None before the first
    one, and in the subscriber, which does not know numbers), `last_age_s` its age in seconds. `rate` is the
    recent number of completed ones per second. `without` counts the readings that lack a topic which may be
    missing and was alive, by topic (subscriber). All counts start from zero when a process is restarted.
    """

    received: int
    completed: int
    lost: dict[str, int]
    last_number: int | None
    last_age_s: float | None
    rate: float = 0.0
    without: dict[str, int] = msgspec.field(default_factory=dict)


class BoardStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A board: `state` is starting, blank, programmed, or gone (as seen by pcie-app)."""

    index: int
    endpoint: str
    state: str
    image: str = ""
    restarts: int = 0
    last_cycles: int | None = None
    why: str = ""


class PeerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A peer of the master; `pid` is 0 if the master did not start it."""

    name: str
    endpoint: str
    pid: int
    restarts: int
    ready: bool


BUCKETS_S = tuple(digit * 10.0**exponent for exponent in range(-5, 1) for digit in (1, 2, 5))[:17]
"""Upper bounds of the buckets of a latency in seconds, from 10 us to 2 s; the last bucket has none."""


class StageLatency(msgspec.Struct, frozen=True, kw_only=True):
    """The latencies of a stage of frames; `frame` is the whole frame.

    `p50_ms` and `p99_ms` are quantiles over the last 1000 published frames. `frames`, `sum_s` and `buckets`
    cover all of them: a bucket has the number of frames up to its bound in `BUCKETS_S`, without those below.
    """

    stage: str
    p50_ms: float
    p99_ms: float
    frames: int
    sum_s: float
    buckets: list[int]


class HubStatus(msgspec.Struct, frozen=True):
    """Numbers of clients, topics and services of the hub."""

    clients: int
    topics: int
    services: int


class ProcessStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A process. `why` gives the cause while it is not ready, and its state when it is.

    `alive` is false if it answers, but makes no progress (a blocking thread hangs, or a child of the master does).

    `cpu_s` is its user and system time so far, `cpu_percent` that of the last seconds (100 is one core), and
    `memory_bytes` its resident memory.

    `deployment` is the hash of the deployment, and `folder` the folder from which the master has read it.
    """

    ready: bool
    why: str
    alive: bool = True
    name: str = ""
    pid: int = 0
    version: str = ""
    uptime_s: float = 0.0
    cpu_s: float = 0.0
    cpu_percent: float = 0.0
    memory_bytes: int = 0
    deployment: str = ""
    folder: str = ""
    connections: list[ConnectionStatus] = msgspec.field(default_factory=list)
    frames: FrameCounts | None = None
    boards: list[BoardStatus] = msgspec.field(default_factory=list)
    peers: list[PeerStatus] = msgspec.field(default_factory=list)
    hub: HubStatus | None = None
    stages: list[StageLatency] = msgspec.field(default_factory=list)


Reason = TypeVar("Reason", bound=str)


def seconds_since(tick: int) -> float | None:
    """Return the age in seconds of a monotonic time in ns; None for 0, which means never."""
    return (time.monotonic_ns() - tick) / 1e9 if tick else None


def connections(rosbridges: Mapping[str, Ros]) -> list[ConnectionStatus]:
    """Return the state of connections to rosbridge servers, by URI."""
    return [ConnectionStatus(uri, str(ros.state), ros.reconnections) for uri, ros in rosbridges.items()]


def why_not_connected(rosbridges: Mapping[str, Ros]) -> str:
    """Return the sentence for a process that waits for a rosbridge server; empty if all are connected."""
    if not rosbridges:
        return "waiting for the rosbridge server"
    for uri, ros in rosbridges.items():
        if ros.state != "connected":
            if uri in ros.last_error:
                return f"waiting for the rosbridge server: {ros.last_error}"
            reason = f" ({ros.last_error})" if ros.last_error else ""
            return f"waiting for the rosbridge server at {uri}{reason}"
    return ""


def reasons(counts: Mapping[Reason, int]) -> dict[str, int]:
    """Return the counts that are not 0."""
    return {reason: count for reason, count in dict(counts).items() if count}


_decoder = msgspec.json.Decoder(ProcessStatus)
_BACKLOG_EVERY = 0.01
"""Seconds between two attempts to connect to a process that answers nobody at the moment."""


async def read_process_status(path: str, timeout: float) -> ProcessStatus:
    """Return the status of the process at a status socket, or raise a NoHealthError after `timeout` seconds.

    No thread reads it, because Python waits for ever for a thread that has no memory to start.
    """
    data = bytearray()
    loop = asyncio.get_running_loop()
    with silence_explained(path, timeout), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        async with asyncio.timeout(timeout):
            while not _connected(asking, path):
                await asyncio.sleep(_BACKLOG_EVERY)
            while part := await loop.sock_recv(asking, 1 << 16):
                data += part
                if len(data) > ANSWER_LIMIT:
                    raise foreign_socket_error(path)
    try:
        return _decoder.decode(data)
    except (msgspec.MsgspecError, RecursionError):
        raise foreign_socket_error(path) from None


def _connected(asking: socket.socket, path: str) -> bool:
    """Try to connect; False if the backlog is full, for which no event loop can wait."""
    try:
        asking.connect(path)
    except BlockingIOError:
        return False
    return True
