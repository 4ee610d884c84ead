"""Reports of a process about itself: on its status socket, to the service manager, and as metrics.

    get_status ──▶ Report ──▶ NAME.status.sock   one JSON object per connection
                          ──▶ NOTIFY_SOCKET      readiness, and signs of life
                          ──▶ --metrics          HTTP for Prometheus

Processing a frame only updates counters. Other work is done once a second, or when a status is requested.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import msgspec

from services.errors import SettingsError
from services.settings import metrics_endpoint
from services.sockets.records import VERSION
from services.sockets.status import ProcessStatus, StageLatency
from terminal.health import in_thread, resources, serve_health
from terminal.one_line import one_line

STUCK_S = 30.0
"""A board counts as stuck after this many seconds without progress.

A master counts as stuck if one of its child processes does not answer for this many seconds.
"""
_SAMPLE_EVERY = 1.0
_SAMPLES = 6
"""Number of samples, one per second: a rate covers the last five seconds."""

_SOCKET: Final = "NOTIFY_SOCKET"
_WATCHDOG: Final = ("WATCHDOG_USEC", "WATCHDOG_PID")

GetStatus = Callable[[], ProcessStatus]
"""Function that returns the status of a process. `Report` adds the identity, rate, CPU time and memory."""


class ServiceManager:
    """Connection to the service manager that started this process, if any (systemd's sd_notify).

    A slow or absent service manager never delays or ends the process.
    """

    def __init__(self) -> None:
        """Read the service manager's environment variables, and remove them so that child processes do not get them."""
        # Its datagram socket; empty without a service manager.
        self._address = os.environ.pop(_SOCKET, "")
        if self._address.startswith("@"):  # an abstract socket
            self._address = "\0" + self._address[1:]
        microseconds, pid = (os.environ.pop(name, "") for name in _WATCHDOG)
        is_number = microseconds.isascii() and microseconds.isdigit() and len(microseconds) < 20
        # the watchdog may be meant for another process, such as the one that started this one
        expected = pid in {"", str(os.getpid())} and is_number
        self.watchdog_s: float = int(microseconds) / 1e6 if expected else 0.0
        """Seconds within which the service manager expects a sign of life; 0 if it expects none."""
        # What the manager has accepted: readiness is sent once, a status when it changes, both again if not accepted.
        self._ready = False
        self._status = ""

    def report(self, status: str, *, ready: bool, alive: bool) -> None:
        """Send the state of this process to the service manager. If `alive` is True, also send a sign of life."""
        sent = []
        if ready and not self._ready:
            sent.append("READY=1")
        if status != self._status:
            sent.append(f"STATUS={one_line(status)}")
        if alive and self.watchdog_s:
            sent.append("WATCHDOG=1")
        if self._send(*sent):
            self._ready, self._status = self._ready or ready, status

    def stopping(self) -> None:
        """Report that this process is about to end."""
        self._send("STOPPING=1")

    def _send(self, *assignments: str) -> bool:
        """Send assignments; return False if they were not accepted, for example because the manager's queue is full."""
        if self._address and assignments:
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.setblocking(False)
                sender.sendto("\n".join(assignments).encode(), self._address)
                return True
        return False


class Report:
    """The status of a process, with its identity, rate, CPU time, memory and latencies.

    `is_alive` returns whether the process makes progress. Omit `is_alive` if the process can only answer while it makes
    progress. `stages` returns the latencies of the stages that a frame passes in the process.
    """

    def __init__(
        self,
        name: str,
        get_status: GetStatus,
        *,
        is_alive: Callable[[], bool] = lambda: True,
        stages: Callable[[], list[StageLatency]] = list,
    ) -> None:
        # What the process gave; the functions are called in the event loop that serves the status.
        self._name = name
        self._get_status = get_status
        self._is_alive = is_alive
        self._stages = stages
        self._started = time.monotonic()
        # time, CPU time and completed frames of the last seconds, one sample per second
        self._samples: deque[tuple[float, float, int]] = deque(maxlen=_SAMPLES)

    def sample(self, manager: ServiceManager) -> None:
        """Record the CPU time and the number of completed frames, and report to the service manager.

        The status computes the CPU load and the frame rate from these records.
        """
        # not `status`, which would read /proc every second
        status = self._get_status()
        completed = status.frames.completed if status.frames is not None else 0
        self._samples.append((time.monotonic(), time.process_time(), completed))
        manager.report(status.why, ready=status.ready, alive=self._is_alive())

    def status(self) -> ProcessStatus:
        """Return the result of `get_status`, and add what every process reports, such as `pid` and `uptime_s`."""
        status, now, cpu_s = self._get_status(), time.monotonic(), time.process_time()
        alive = self._is_alive()
        frames = status.frames
        percent = 0.0
        if self._samples and (elapsed := now - self._samples[0][0]) > 0:
            percent = 100 * (cpu_s - self._samples[0][1]) / elapsed
        if frames is not None:
            frames = msgspec.structs.replace(frames, rate=self._rate(now, frames.completed))
        return msgspec.structs.replace(
            status,
            ready=status.ready and alive,
            why=status.why if alive else f"it makes no progress ({status.why})",
            alive=alive,
            name=self._name,
            pid=os.getpid(),
            version=VERSION,
            uptime_s=round(now - self._started, 3),
            cpu_percent=round(percent, 1),
            frames=frames,
            stages=self._stages(),
            **resources(),
        )

    def _rate(self, now: float, completed: int) -> float:
        """Return completed frames per second; time before the first one does not count."""
        for at, _, count in self._samples:
            if count and now > at:
                return round((completed - count) / (now - at), 1)
        return 0.0


def _check(directory: Path | None) -> None:
    if directory is not None and not directory.is_dir():
        raise SettingsError(
            f"BM_RUN_DIRECTORY: {directory} is not a folder; create it, or name an existing one"
        )


def check_metrics(metrics: str, *, insecure: bool) -> None:
    """Raise a SettingsError if `insecure` is False and other machines could read the metrics."""
    # a host name counts as another machine, even if it resolves to this one
    if metrics and not insecure and not metrics_endpoint(metrics).is_loopback:
        raise SettingsError(
            f"--metrics {metrics} lets everybody on that network read the state of this process; "
            "use a loopback address, or give --insecure if that is intended"
        )


def shifted(metrics: str, ports: int) -> str:
    """Return the address `metrics` with a port that is higher by `ports`, for another process of the run.

    An empty address stays empty.
    """
    if not metrics:
        return ""
    endpoint = metrics_endpoint(metrics)
    return str(replace(endpoint, port=endpoint.port + ports)).removeprefix("tcp://")


@contextlib.asynccontextmanager
async def serve_status(
    directory: Path | None, name: str, get_status: GetStatus, *, metrics: str = "", **more: Any
) -> AsyncIterator[None]:
    """Report the status from the running event loop within the context. `more` is passed to `Report`.

    If `directory` is None, there is no status socket. Otherwise the directory must exist. If `metrics` is empty, there
    is no HTTP server. If a socket cannot be opened, the process only warns, so that a robot's run does not end.
    """
    _check(directory)
    report, manager = Report(name, get_status, **more), ServiceManager()
    async with contextlib.AsyncExitStack() as serving:
        await serving.enter_async_context(
            serve_health(directory, name, lambda: msgspec.json.encode(report.status()))
        )
        if metrics:
            from services.sockets.metrics import serve_metrics

            await serving.enter_async_context(serve_metrics(metrics_endpoint(metrics), name, report.status))
        sampling = asyncio.ensure_future(_keep_sampling(report, manager))
        try:
            yield
        finally:
            manager.stopping()
            sampling.cancel()
            await asyncio.gather(sampling, return_exceptions=True)


async def _keep_sampling(report: Report, manager: ServiceManager) -> None:
    while True:
        report.sample(manager)
        await asyncio.sleep(_SAMPLE_EVERY)


@contextlib.contextmanager
def serve_status_in_thread(
    directory: Path | None, name: str, get_status: GetStatus, **more: Any
) -> Iterator[None]:
    """While the context is open, serve the status from another thread, for a process whose main thread blocks."""
    with in_thread(lambda: serve_status(directory, name, get_status, **more)):
        yield
