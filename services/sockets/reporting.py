"""Reports of a process about itself: on its status socket, over HTTP, and to the service manager.

    get_status ──▶ Report ──▶ NAME.status.sock   one JSON object per connection
                          ──▶ NAME.http.sock     /metrics /healthz /readyz, and /frames/N of a master
                          ──▶ --metrics          the same over TCP
                          ──▶ NOTIFY_SOCKET      readiness, and signs of life

Processing of frames only updates counters; everything else happens when something is requested.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import os
import socket
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any

import msgspec

from pcie_shim.endpoint import Endpoint, listen, parse_endpoint, remove_listener
from pcie_shim.errors import PcieShimError
from services.errors import SettingsError
from services.sockets.http_server import Response, refused, serve_http
from services.sockets.records import VERSION
from services.sockets.status import ProcessStatus, StageLatency
from services.supervision.parent import leave_private_directory
from services.supervision.service_manager import ServiceManager
from terminal.health import in_thread, resources, serve_health
from terminal.output import say
from terminal.private_directory import HTTP_SUFFIX

STUCK_S = 30.0
"""Seconds without progress after which a process with one blocking thread counts as stuck."""
_SAMPLE_EVERY = 1.0
_SAMPLES = 6
"""Number of samples, one per second: a rate covers the last five seconds."""
_RENDER_EVERY = 1.0
"""Seconds for which the text of `/metrics` is reused, so that requests cannot slow the frames."""

GetStatus = Callable[[], ProcessStatus]
"""Function that returns the status of a process; identity, rate, CPU time and memory are added here."""


def http_socket(directory: Path, name: str) -> Path:
    """Return the path of the HTTP socket of a process."""
    return directory.absolute() / f"{name}{HTTP_SUFFIX}"


class Report:
    """The status of a process with its identity, rate, CPU time, memory and latencies.

    Args:
        name: Name of the process.
        get_status: Returns its status.
        is_alive: Returns whether it makes progress; needed only if this is not evident from an answer.
        stages: Returns the latencies of the stages of its frames.
        frame: Returns a frame, or a sentence if it is not known.
    """

    def __init__(
        self,
        name: str,
        get_status: GetStatus,
        *,
        is_alive: Callable[[], bool] = lambda: True,
        stages: Callable[[], list[StageLatency]] = list,
        frame: Callable[[int], msgspec.Struct | str] | None = None,
    ) -> None:
        self._name = name
        self._get_status = get_status
        self._is_alive = is_alive
        self._stages = stages
        self._frame = frame
        self._started = time.monotonic()
        self._samples: deque[tuple[float, float, int]] = deque(maxlen=_SAMPLES)
        self._rendering = asyncio.Lock()
        self._metrics, self._rendered = b"", 0.0

    def sample(self, manager: ServiceManager) -> None:
        """Take a sample for the rate, and report to the service manager."""
        status = self._get_status()
        completed = status.frames.completed if status.frames is not None else 0
        self._samples.append((time.monotonic(), time.process_time(), completed))
        manager.report(status.why, ready=status.ready, alive=self._is_alive())

    def status(self) -> ProcessStatus:
        """Return the whole status."""
        status, now, cpu_s = self._get_status(), time.monotonic(), time.process_time()
        frames = status.frames
        percent = 0.0
        if self._samples and (elapsed := now - self._samples[0][0]) > 0:
            percent = 100 * (cpu_s - self._samples[0][1]) / elapsed
        if frames is not None:
            frames = msgspec.structs.replace(frames, rate=self._rate(now, frames.completed))
        return msgspec.structs.replace(
            status,
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

    def answer(self) -> bytes:
        """Return the whole status as JSON."""
        return msgspec.json.encode(self.status())

    async def respond(self, path: str) -> Response:
        """Return the response to an HTTP request."""
        if path == "/healthz":
            alive = self._is_alive()
            status = HTTPStatus.OK if alive else HTTPStatus.SERVICE_UNAVAILABLE
            return Response(status, b"alive\n" if alive else b"stuck\n")
        if path == "/readyz":
            state = self._get_status()
            status = HTTPStatus.OK if state.ready else HTTPStatus.SERVICE_UNAVAILABLE
            return Response(status, f"{state.why}\n".encode())
        if path == "/metrics":
            return await self._respond_metrics()
        if path.startswith("/frames/") and self._frame is not None:
            return self._respond_frame(path.removeprefix("/frames/"))
        return refused(HTTPStatus.NOT_FOUND)

    def _respond_frame(self, text: str) -> Response:
        if self._frame is None or not (text.isascii() and text.isdigit() and len(text) < 16):
            return refused(HTTPStatus.NOT_FOUND)
        found = self._frame(int(text))
        if isinstance(found, str):
            return Response(HTTPStatus.NOT_FOUND, found.encode())
        return Response(HTTPStatus.OK, msgspec.json.encode(found), "application/json")

    async def _respond_metrics(self) -> Response:
        async with self._rendering:
            if not self._metrics or time.monotonic() >= self._rendered + _RENDER_EVERY:
                # the import takes a tenth of a second, and only scraped processes need it
                loop = asyncio.get_running_loop()
                metrics = await loop.run_in_executor(
                    None, importlib.import_module, "services.sockets.metrics"
                )
                parts = []
                for family in metrics.families(self.status()):
                    parts.append(metrics.exposition(family))
                    await asyncio.sleep(0)  # a frame need not wait for the whole text
                self._metrics, self._rendered = b"".join(parts), time.monotonic()
            return Response(HTTPStatus.OK, self._metrics, "text/plain; version=0.0.4; charset=utf-8")


def _check(directory: Path | None) -> None:
    if directory is not None and not directory.is_dir():
        raise SettingsError(
            f"BM_RUN_DIRECTORY: {directory} is not a folder; create it, or name an existing one"
        )


def check_metrics(metrics: str, *, insecure: bool) -> None:
    """Raise a SettingsError if other machines could read metrics, and that was not permitted."""
    if metrics and not insecure and not parse_endpoint(metrics).is_loopback:
        raise SettingsError(
            f"--metrics {metrics} lets everybody on that network read the state of this process; "
            "use a loopback address, or give --insecure if that is intended"
        )


def shifted(metrics: str, ports: int) -> str:
    """Return an address for metrics some ports further, for another process of the same run."""
    if not metrics:
        return ""
    endpoint = parse_endpoint(metrics)
    return str(Endpoint(host=endpoint.host, port=endpoint.port + ports))


@contextlib.asynccontextmanager
async def serve_status(
    directory: Path | None, name: str, get_status: GetStatus, *, metrics: str = "", **more: Any
) -> AsyncIterator[None]:
    """Report in the running loop within the context; `more` is passed to `Report`.

    Without a directory, which must exist, there are no sockets in it; without `metrics` nothing is served
    over TCP. A socket that cannot be opened only causes a warning, because it must not end a robot's run.
    """
    _check(directory)
    report, manager = Report(name, get_status, **more), ServiceManager()
    endpoints = [Endpoint(path=str(http_socket(directory, name)))] if directory is not None else []
    if metrics:
        endpoints.append(parse_endpoint(metrics))
    with contextlib.ExitStack() as sockets:
        async with serve_health(directory, name, report.answer):
            tasks = [asyncio.ensure_future(_keep_sampling(report, manager))]
            for endpoint in endpoints:
                listener = _listener(endpoint, name)
                if listener is not None:
                    sockets.callback(remove_listener, endpoint, listener)
                    local_only = bool(endpoint.host) and endpoint.is_loopback
                    tasks.append(
                        asyncio.ensure_future(serve_http(listener, report.respond, local_only=local_only))
                    )
            try:
                yield
            finally:
                manager.stopping()
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)


def _listener(endpoint: Endpoint, name: str) -> socket.socket | None:
    try:
        return listen(endpoint)
    except PcieShimError as error:
        say(f"{name}: warning: its metrics cannot be read: {error}")
        return None


async def _keep_sampling(report: Report, manager: ServiceManager) -> None:
    while True:
        report.sample(manager)
        await asyncio.sleep(_SAMPLE_EVERY)


@contextlib.contextmanager
def serve_status_in_thread(
    directory: Path | None, name: str, get_status: GetStatus, **more: Any
) -> Iterator[None]:
    """Report from a thread within the context, for a process with one blocking thread."""
    try:
        with in_thread(lambda: serve_status(directory, name, get_status, **more)):
            yield
    finally:
        leave_private_directory()
