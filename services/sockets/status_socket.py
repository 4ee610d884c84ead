"""What a process knows of itself, told to whoever connects to its status socket.

Where the setting `run_directory` names a folder, each process listens on `NAME.status.sock` there (0600). A connection
gets one JSON object, a `ProcessStatus`, and is closed; nothing is read from it. Processes on asyncio answer in their
loop, so that an answer says that the loop turns; those with one blocking thread answer from a second thread, which
only reads plain attributes. The work on frames does not wait for it: it counts, and all else is done when somebody asks.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, cast

import msgspec

from pcie_shim.endpoint import Endpoint, listen, remove_listener
from pcie_shim.errors import PcieShimError
from services.errors import SettingsError
from services.supervision.parent import leave_private_directory
from services.version import VERSION
from terminal.logs import say

if TYPE_CHECKING:
    # boards and pcie-app start without the bridge
    from bridge.client import Ros

SUFFIX = ".status.sock"
STATUS_LIMIT = 1 << 20
"""Bytes of the longest status; who asks reads no more."""

_SAMPLE_EVERY = 1.0
_SAMPLES = 6
"""Rates are over the last five seconds."""

_SEND_TIMEOUT = 0.5


class ConnectionStatus(msgspec.Struct, frozen=True):
    """A connection to a rosbridge server: `state` is connecting, connected, reconnecting or closed."""

    uri: str
    state: str
    reconnections: int


class FrameCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Frames as one process sees them.

    `received` and `completed` are messages and complete readings (subscriber), frames asked for and computed
    (pcie-app), results asked for and published (publisher), readings and published results (master). `lost` says
    what became of the others, by reason. `last_number` is that of the last completed one (None: none yet, or the
    subscriber, which knows no numbers), `last_age_s` the seconds since. `rate` is completed ones a second, lately.
    All of it begins anew when a process is restarted.
    """

    received: int
    completed: int
    lost: dict[str, int]
    last_number: int | None
    last_age_s: float | None
    rate: float = 0.0


class BoardStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A board: `state` is starting, blank, programmed, or gone (as pcie-app sees it)."""

    index: int
    endpoint: str
    state: str
    image: str = ""
    restarts: int = 0
    last_cycles: int | None = None
    why: str = ""


class PeerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A process that the master works with; `pid` is 0 for one that it did not start."""

    name: str
    endpoint: str
    pid: int
    restarts: int
    ready: bool


class HubStatus(msgspec.Struct, frozen=True):
    """The hub's own: who is connected, how many topics and services there are."""

    clients: int
    topics: int
    services: int


class ProcessStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One process. `why` says what is awaited while it is not ready, and what it has when it is.

    `deployment` is the hash of the one in force, `generation` how often that has changed since the run began, and
    `folder` where the master has it from.
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


Tell = Callable[[], ProcessStatus]
"""Gives what a process knows now; identity and rate are filled in here."""


def seconds_since(tick: int) -> float | None:
    """The age of a monotonic time in ns; None for 0, which is never."""
    return (time.monotonic_ns() - tick) / 1e9 if tick else None


def connections(rosbridges: Mapping[str, Ros]) -> list[ConnectionStatus]:
    """The state of connections to rosbridge servers, by URI."""
    return [ConnectionStatus(uri, str(ros.state), ros.reconnections) for uri, ros in rosbridges.items()]


def why_not_connected(rosbridges: Mapping[str, Ros]) -> str:
    """The sentence for a process that waits for a rosbridge server; empty when all are connected."""
    if not rosbridges:
        return "waiting for the rosbridge server"
    for uri, ros in rosbridges.items():
        if ros.state != "connected":
            reason = f" ({ros.last_error})" if ros.last_error else ""
            return f"waiting for the rosbridge server at {uri}{reason}"
    return ""


def reasons(counts: Mapping[str, int]) -> dict[str, int]:
    """The losses that there were: a reason without any is not news."""
    return {reason: count for reason, count in dict(counts).items() if count}


class _Answerer:
    """Makes the answer: what the process tells, its identity, and rates from a count taken once a second."""

    def __init__(self, name: str, tell: Tell) -> None:
        self._name = name
        self._tell = tell
        self._started = time.monotonic()
        self._samples: deque[tuple[float, int]] = deque(maxlen=_SAMPLES)

    def sample(self) -> None:
        """Note how many frames there were; called once a second."""
        frames = self._tell().frames
        if frames is not None:
            self._samples.append((time.monotonic(), frames.completed))

    def answer(self) -> bytes:
        """The JSON object."""
        told = self._tell()
        frames = told.frames
        if frames is not None and self._samples:
            at, count = self._samples[0]
            elapsed = time.monotonic() - at
            rate = (frames.completed - count) / elapsed if elapsed > 0 else 0.0
            frames = msgspec.structs.replace(frames, rate=round(rate, 1))
        whole = msgspec.structs.replace(
            told,
            name=self._name,
            pid=os.getpid(),
            version=VERSION,
            uptime_s=round(time.monotonic() - self._started, 3),
            frames=frames,
        )
        return msgspec.json.encode(whole)


def _listen(directory: Path, name: str) -> tuple[Endpoint, socket.socket] | None:
    """The status socket; None, and a warning, where it can't be had: a robot's run does not end by that.

    Raises:
        SettingsError: the folder is none.
    """
    if not directory.is_dir():
        msg = f"BM_RUN_DIRECTORY: {directory} is no folder; make it, or name one that is there"
        raise SettingsError(msg)
    endpoint = Endpoint(path=str(directory.absolute() / f"{name}{SUFFIX}"))
    try:
        return endpoint, listen(endpoint)
    except PcieShimError as error:
        say(f"{name}: warning: its status can't be shown: {error}")
        return None


class _StatusProtocol(asyncio.Protocol):
    """Answers and closes."""

    def __init__(self, answerer: _Answerer) -> None:
        self._answerer = answerer

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """asyncio's: somebody asks."""
        # uvloop's transports are no subclasses of asyncio's, but do what they do
        writing = cast("asyncio.WriteTransport", transport)
        writing.write(self._answerer.answer())
        writing.close()


@contextlib.asynccontextmanager
async def status_served(directory: Path | None, name: str, tell: Tell) -> AsyncIterator[None]:
    """Answer in the running loop while the context lasts; nothing happens without a directory.

    Raises:
        SettingsError: the directory is no folder.
    """
    had = None if directory is None else _listen(directory, name)
    if had is None:
        yield
        return
    endpoint, listener = had
    answerer = _Answerer(name, tell)

    async def sample() -> None:
        while True:
            answerer.sample()
            await asyncio.sleep(_SAMPLE_EVERY)

    server = await asyncio.get_running_loop().create_unix_server(
        lambda: _StatusProtocol(answerer), sock=listener
    )
    sampling = asyncio.ensure_future(sample())
    try:
        yield
    finally:
        sampling.cancel()
        server.close()
        remove_listener(endpoint, listener)


@contextlib.contextmanager
def status_thread(directory: Path | None, name: str, tell: Tell) -> Iterator[None]:
    """Answer from a thread of its own while the context lasts, for a process with one blocking thread.

    Raises:
        SettingsError: the directory is no folder.
    """
    had = None if directory is None else _listen(directory, name)
    if had is None:
        yield
        return
    endpoint, listener = had
    over = threading.Event()
    thread = threading.Thread(
        target=_answer_all, args=(listener, _Answerer(name, tell), over), name="status", daemon=True
    )
    # a signal must find the main thread: it is the one that waits, and would not be woken
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    try:
        thread.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    try:
        yield
    finally:
        over.set()
        with contextlib.suppress(OSError):
            Path(endpoint.path).unlink()
        leave_private_directory()


def _answer_all(listener: socket.socket, answerer: _Answerer, over: threading.Event) -> None:
    listener.settimeout(_SAMPLE_EVERY)
    sampled = 0.0
    with listener:
        while not over.is_set():
            if time.monotonic() >= sampled + _SAMPLE_EVERY:
                answerer.sample()
                sampled = time.monotonic()
            try:
                connection, _ = listener.accept()
            except TimeoutError:
                continue
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                connection.settimeout(_SEND_TIMEOUT)
                connection.sendall(answerer.answer())
