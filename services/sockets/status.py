"""Records for the status of processes, and requests for the status of one process or of all processes in a run."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar
from urllib.parse import urlsplit

import msgspec

from terminal.health import ANSWER_LIMIT, SUFFIX, NoHealthError, foreign_socket_error, silence_explained

if TYPE_CHECKING:
    # boards and pcie-app start without importing the bridge
    from bridge.client import Ros

Reason = TypeVar("Reason", bound=str)

ANSWER_TIME = 1.0
"""Seconds in which a process must answer a request for its status."""
_AT_ONCE = 256
"""Maximum number of processes asked for their status at the same time."""
_ORDER = ("hub", "master", "subscriber", "publisher", "pcie-app")


# --- records ----------------------------------------------------------------------------------------

# They are the format of the status sockets. A field that only some kinds of processes have gets a default.


class ConnectionStatus(msgspec.Struct, frozen=True):
    """A connection to a rosbridge server."""

    uri: str
    # connecting, connected, reconnecting or closed
    state: str
    reconnections: int


class FrameCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Counts of frames in one process since the start of the process."""

    # Subscriber: messages, and complete readings. Master: readings, and published results. pcie-app: requested, and
    # computed frames. Publisher: requested, and published results.
    received: int
    completed: int
    # Readings or results that were lost, by `LossReason`.
    lost: dict[str, int]
    # Of the last completed frame: its number (None before the first one, and in the subscriber, which does not know
    # numbers), and its age.
    last_number: int | None
    last_age_s: float | None
    # Completed frames per second; `Report` adds it, because a process only counts.
    rate: float = 0.0
    # Of the subscriber: readings without a topic that may be missing and was alive, by topic.
    without: dict[str, int] = msgspec.field(default_factory=dict)

    @classmethod
    def of(
        cls,
        received: int,
        completed: int,
        lost: Mapping[Reason, int],
        last: tuple[int, int],
        without: Mapping[str, int] | None = None,
    ) -> FrameCounts:
        """Return the counts.

        `last` is the number and the monotonic time (ns) of the last frame. Each of the two is 0 if it is unknown.
        """
        number, tick = last
        return cls(
            received=received,
            completed=completed,
            lost={str(reason): count for reason, count in lost.items() if count},
            last_number=number or None,
            last_age_s=(time.monotonic_ns() - tick) / 1e9 if tick else None,
            without=dict(without or {}),
        )


class BoardStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The state of a board, reported by the board's own process or by pcie-app."""

    index: int
    endpoint: str
    # starting, blank, programmed, or (for pcie-app) gone, with the reason in `why`
    state: str
    image: str = ""
    restarts: int = 0
    last_cycles: int | None = None
    why: str = ""


class PeerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A service as its master sees it."""

    name: str
    endpoint: str
    # 0 if the master did not start it
    pid: int
    restarts: int
    ready: bool


BUCKETS_S = tuple(digit * 10.0**exponent for exponent in range(-5, 1) for digit in (1, 2, 5))[:17]
"""Upper bounds in seconds of the latency histogram's buckets, from 10 us to 2 s. A last bucket has no upper bound."""


class StageLatency(msgspec.Struct, frozen=True, kw_only=True):
    """The latencies of one stage of processing a frame. The stage named `frame` is the whole processing."""

    stage: str
    # quantiles over the last 1000 published frames
    p50_ms: float
    p99_ms: float
    # Over all published frames; a bucket counts those up to its bound in `BUCKETS_S` and above the bound before.
    frames: int
    sum_s: float
    buckets: list[int]


class HubStatus(msgspec.Struct, frozen=True):
    """The hub's port, and its numbers of clients, topics and services."""

    clients: int
    topics: int
    services: int
    port: int = 0


class ProcessStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The status of a process."""

    # Whether it does its work; `why` is its state if it does, otherwise the cause.
    ready: bool
    why: str
    # False if it answers, but makes no progress: a blocking thread hangs, or a child of the master does.
    alive: bool = True
    # `Report` adds who it is and what it uses. CPU time is user and system time so far, and the percentage is over
    # the last seconds (100 is one core); the memory is resident memory.
    name: str = ""
    pid: int = 0
    version: str = ""
    uptime_s: float = 0.0
    cpu_s: float = 0.0
    cpu_percent: float = 0.0
    memory_bytes: int = 0
    # The hash of its deployment, and, only for the master, the folder from which it was read.
    deployment: str = ""
    folder: str = ""
    connections: list[ConnectionStatus] = msgspec.field(default_factory=list)
    frames: FrameCounts | None = None
    boards: list[BoardStatus] = msgspec.field(default_factory=list)
    peers: list[PeerStatus] = msgspec.field(default_factory=list)
    hub: HubStatus | None = None
    stages: list[StageLatency] = msgspec.field(default_factory=list)


class SilentProcess(msgspec.Struct, frozen=True):
    """A process whose status is unknown.

    Either its status socket gave no usable answer, or it has no status socket and the master waits for the process.
    """

    name: str
    why: str


class StackStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The status of all processes of a run."""

    directory: str
    ready: bool
    # a sentence for each process that is not ready, the silent ones last
    why: list[str]
    processes: list[ProcessStatus]
    silent: list[SilentProcess]


# --- what processes say -----------------------------------------------------------------------------


def connections(rosbridges: Mapping[str, Ros]) -> list[ConnectionStatus]:
    """Return the state of each rosbridge connection. The keys of `rosbridges` are the URIs of the servers."""
    return [ConnectionStatus(uri, str(ros.state), ros.reconnections) for uri, ros in rosbridges.items()]


def why_not_connected(rosbridges: Mapping[str, Ros]) -> str:
    """Return a sentence that names the rosbridge server the process waits for, or "" if all are connected."""
    if not rosbridges:
        return "waiting for the rosbridge server"
    for uri, ros in rosbridges.items():
        if ros.state != "connected":
            if uri in ros.last_error:
                return f"waiting for the rosbridge server: {ros.last_error}"
            reason = f" ({ros.last_error})" if ros.last_error else ""
            return f"waiting for the rosbridge server at {uri}{reason}"
    return ""


# --- asking -----------------------------------------------------------------------------------------

_decoder = msgspec.json.Decoder(ProcessStatus)
_BACKLOG_EVERY = 0.01
"""Seconds between two attempts to connect to a process whose backlog is full."""


async def read_process_status(path: str, timeout: float) -> ProcessStatus:
    """Return the status that a process reports at its status socket.

    Raises a NoHealthError if no valid status arrives within `timeout` seconds. The function uses no thread,
    because Python waits for ever for a thread that cannot start for lack of memory.
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
    """Try to connect without blocking. Return False if the server's backlog is full; the caller can then try again."""
    try:
        asking.connect(path)
    except BlockingIOError:
        return False
    return True


def _status_sockets(directory: Path) -> list[Path]:
    return list(directory.glob(f"*{SUFFIX}"))


async def _ask(path: Path, turns: asyncio.Semaphore) -> ProcessStatus | SilentProcess:
    name = path.name.removesuffix(SUFFIX)
    try:
        async with turns:
            return msgspec.structs.replace(await read_process_status(str(path), ANSWER_TIME), name=name)
    except NoHealthError as error:
        return SilentProcess(name, f"it {error}")


def _sort_key(name: str) -> tuple[int, int, str]:
    """Return the sort key of a process: services in the order in which a frame passes them, then boards by number."""
    if name in _ORDER:
        return _ORDER.index(name), 0, name
    digits = name.removeprefix("board")
    return len(_ORDER), int(digits) if digits.isascii() and digits.isdigit() else 1 << 30, name


def _is_foreign_hub(process: ProcessStatus, others: Iterable[ProcessStatus]) -> bool:
    """Return whether a process is a hub at whose port no other process has a connection."""
    ports = {urlsplit(connection.uri).port for each in others for connection in each.connections}
    # None is a robot's name or a default port, which says nothing
    return process.hub is not None and bool(ports) and not {None, process.hub.port} & ports


async def ask_stack(directory: Path, *, shared: bool = False) -> StackStatus:
    """Return the status of the processes in a run directory, queried in parallel.

    If several runs share the directory (`shared`), the result leaves out a hub to which no process is connected.
    The query of up to 256 processes takes at most about a second.
    """
    turns = asyncio.Semaphore(_AT_ONCE)
    answers = await asyncio.gather(*(_ask(path, turns) for path in _status_sockets(directory)))
    processes = [each for each in answers if isinstance(each, ProcessStatus)]
    if shared:
        processes = [each for each in processes if not _is_foreign_hub(each, processes)]
    silent = [each for each in answers if isinstance(each, SilentProcess)]
    # a service that the master has not started may have no status socket at all
    answered = {each.name for each in answers}
    silent.extend(
        SilentProcess(peer.name, f"the master waits for it at {peer.endpoint}")
        for process in processes
        for peer in process.peers
        if peer.name not in answered and not peer.ready
    )
    processes.sort(key=lambda each: _sort_key(each.name))
    silent.sort(key=lambda each: _sort_key(each.name))
    why = [f"{each.name}: {each.why}" for each in processes if not each.ready]
    why += [f"{each.name}: {each.why}" for each in silent]
    return StackStatus(
        directory=str(directory),
        ready=bool(processes) and not why,
        why=why,
        processes=processes,
        silent=silent,
    )
