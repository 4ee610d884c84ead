"""Status of a process: its records, reported on and read from its status socket (`terminal.health`).

Processing of frames only updates counters; everything else happens when a status is requested.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import msgspec

from services.errors import SettingsError
from services.sockets.records import VERSION
from services.supervision.parent import leave_private_directory
from terminal.health import foreign_socket_error, read_status, serve_health, serve_health_in_thread

if TYPE_CHECKING:
    # boards and pcie-app start without importing the bridge
    from bridge.client import Ros

_SAMPLES = 6
"""Number of samples, one per second: a rate covers the last five seconds."""


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


class HubStatus(msgspec.Struct, frozen=True):
    """Numbers of clients, topics and services of the hub."""

    clients: int
    topics: int
    services: int


class ProcessStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A process. `why` gives the cause while it is not ready, and its state when it is.

    `deployment` is the hash of the deployment in force, `generation` the number of changes since the start of
    the run, and `folder` the folder from which the master has read it.
    """

    ready: bool
    why: str
    name: str = ""
    pid: int = 0
    version: str = ""
    uptime_s: float = 0.0
    deployment: str = ""
    generation: int = 0
    folder: str = ""
    connections: list[ConnectionStatus] = msgspec.field(default_factory=list)
    frames: FrameCounts | None = None
    boards: list[BoardStatus] = msgspec.field(default_factory=list)
    peers: list[PeerStatus] = msgspec.field(default_factory=list)
    hub: HubStatus | None = None


Reason = TypeVar("Reason", bound=str)
GetStatus = Callable[[], ProcessStatus]
"""Function that returns the status of a process; identity and rate are added here."""


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
            reason = f" ({ros.last_error})" if ros.last_error else ""
            return f"waiting for the rosbridge server at {uri}{reason}"
    return ""


def reasons(counts: Mapping[Reason, int]) -> dict[str, int]:
    """Return the counts that are not 0."""
    return {reason: count for reason, count in dict(counts).items() if count}


class _Answerer:
    """Source of the JSON object: status of the process, identity, and rate from samples."""

    def __init__(self, name: str, get_status: GetStatus) -> None:
        self._name = name
        self._get_status = get_status
        self._started = time.monotonic()
        self._samples: deque[tuple[float, int]] = deque(maxlen=_SAMPLES)

    def sample(self) -> None:
        frames = self._get_status().frames
        if frames is not None:
            self._samples.append((time.monotonic(), frames.completed))

    def answer(self) -> bytes:
        status = self._get_status()
        frames = status.frames
        if frames is not None and self._samples:
            at, count = self._samples[0]
            elapsed = time.monotonic() - at
            rate = (frames.completed - count) / elapsed if elapsed > 0 else 0.0
            frames = msgspec.structs.replace(frames, rate=round(rate, 1))
        whole = msgspec.structs.replace(
            status,
            name=self._name,
            pid=os.getpid(),
            version=VERSION,
            uptime_s=round(time.monotonic() - self._started, 3),
            frames=frames,
        )
        return msgspec.json.encode(whole)


def _check(directory: Path | None) -> None:
    if directory is not None and not directory.is_dir():
        raise SettingsError(
            f"BM_RUN_DIRECTORY: {directory} is not a folder; create it, or name an existing one"
        )


@contextlib.asynccontextmanager
async def serve_status(directory: Path | None, name: str, get_status: GetStatus) -> AsyncIterator[None]:
    """Answer in the running loop within the context; do nothing without a directory, which must exist."""
    _check(directory)
    answerer = _Answerer(name, get_status)
    async with serve_health(directory, name, answerer.answer, answerer.sample):
        yield


@contextlib.contextmanager
def serve_status_in_thread(directory: Path | None, name: str, get_status: GetStatus) -> Iterator[None]:
    """Answer from a thread within the context, for a process with one blocking thread."""
    _check(directory)
    answerer = _Answerer(name, get_status)
    try:
        with serve_health_in_thread(directory, name, answerer.answer, answerer.sample):
            yield
    finally:
        leave_private_directory()


def read_process_status(path: str, timeout: float) -> ProcessStatus:
    """Return the status of the process at a status socket, or raise a NoHealthError."""
    try:
        return msgspec.json.decode(read_status(path, timeout), type=ProcessStatus)
    except (msgspec.MsgspecError, RecursionError):
        raise foreign_socket_error(path) from None
