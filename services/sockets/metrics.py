"""Metrics of a process for Prometheus, served by `prometheus_client`.

    scraper ──▶ thread of start_http_server ──▶ event loop: get_status ──▶ families

Importing this module takes a tenth of a second. Therefore `reporting` imports it only if `--metrics` is given.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from itertools import accumulate
from typing import Final

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from pcie_shim.endpoint import Endpoint
from services.sockets.status import BUCKETS_S, ProcessStatus
from terminal.output import warn

_ANSWER_TIME: Final = 2.0
"""Seconds in which the event loop must return the status."""

_Family = tuple[type[CounterMetricFamily | GaugeMetricFamily], str, str, str, Mapping[str, float]]
"""Kind, name, help, second label after `process` (or empty), and the numbers, one for each value of that label."""


@contextlib.asynccontextmanager
async def serve_metrics(
    address: Endpoint, name: str, get_status: Callable[[], ProcessStatus]
) -> AsyncIterator[None]:
    """Serve metrics within the context.

    If the port is occupied, the function only prints a warning, because missing metrics must not end a robot's run.
    """
    # a registry of its own: the default one adds metrics of Python under names that are not ours
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_StatusCollector(get_status))
    try:
        server, thread = start_http_server(address.port, address.host, registry)
    except OSError as error:
        warn(f"its metrics cannot be read at {address}: {error.strerror or error}", name=name)
        yield
        return
    # it would print a traceback for each client that resets its connection
    server.handle_error = lambda *_: None  # type: ignore[method-assign]  # of this server alone
    try:
        yield
    finally:
        await asyncio.to_thread(server.shutdown)  # takes up to half a second
        server.server_close()
        thread.join()


class _StatusCollector(Collector):
    """Collector of metrics from the status. A request's thread asks the event loop, which owns the status."""

    def __init__(self, get_status: Callable[[], ProcessStatus]) -> None:
        # The function may be called only in the loop, whose state it reads.
        self._get_status = get_status
        self._loop = asyncio.get_running_loop()

    def collect(self) -> Iterable[Metric]:
        answer: Future[ProcessStatus] = Future()
        # a process that is about to end, or whose loop is stuck, has no metrics
        with contextlib.suppress(RuntimeError, TimeoutError):
            self._loop.call_soon_threadsafe(lambda: answer.set_result(self._get_status()))
            return families(answer.result(_ANSWER_TIME))
        return []


def families(status: ProcessStatus) -> Iterator[Metric]:
    """Yield the metric families of a process."""
    info = GaugeMetricFamily(
        "rosbayes_process", "The process, and its deployment.", labels=["process", "version", "deployment"]
    )
    info.add_metric([status.name, status.version, status.deployment], 1)
    yield info
    for kind, name, meaning, label, values in _numbers(status):
        family = kind(f"rosbayes_{name}", meaning, labels=["process", label] if label else ["process"])
        for key, value in values.items():
            family.add_metric([status.name, key] if label else [status.name], float(value))
        yield family
    if status.stages:
        yield _latencies(status)


def _numbers(status: ProcessStatus) -> Iterator[_Family]:
    gauge, counter = GaugeMetricFamily, CounterMetricFamily
    yield gauge, "ready", "Whether the process is ready.", "", {"": status.ready}
    yield counter, "cpu_seconds", "CPU time, user and system.", "", {"": status.cpu_s}
    yield gauge, "memory_bytes", "Resident memory.", "", {"": status.memory_bytes}
    yield gauge, "uptime_seconds", "Time since the start.", "", {"": status.uptime_s}
    if (frames := status.frames) is not None:
        items = "Messages, readings, frames or results that"
        yield counter, "frames_received", f"{items} arrived.", "", {"": frames.received}
        yield counter, "frames_completed", f"{items} were completed.", "", {"": frames.completed}
        yield counter, "frames_lost", f"{items} were lost.", "reason", frames.lost
        yield counter, "frames_without_topic", "Frames computed without this topic.", "topic", frames.without
        if (age := frames.last_age_s) is not None:
            yield gauge, "last_frame_age_seconds", "Time since the last completed one.", "", {"": age}
    # families without samples would only confuse: a board has no rosbridge server
    if links := {link.uri: link for link in status.connections}:
        connected = {uri: link.state == "connected" for uri, link in links.items()}
        yield gauge, "rosbridge_connected", "Whether the server is connected.", "uri", connected
        reconnections = {uri: link.reconnections for uri, link in links.items()}
        yield counter, "rosbridge_reconnections", "Reconnections to the server.", "uri", reconnections
    if peers := status.peers:
        restarts = {peer.name: peer.restarts for peer in peers}
        yield counter, "child_restarts", "Restarts of the child by the master.", "child", restarts
        ready = {peer.name: peer.ready for peer in peers}
        yield gauge, "child_ready", "Whether the child is ready.", "child", ready
    if boards := {str(board.index): board for board in status.boards}:
        usable = {index: board.state in {"programmed", "blank"} for index, board in boards.items()}
        yield gauge, "board_usable", "Whether the board answers.", "board", usable
        restarts = {index: board.restarts for index, board in boards.items()}
        yield counter, "board_restarts", "Restarts of the board.", "board", restarts
    if (hub := status.hub) is not None:
        counted = {"clients": hub.clients, "topics": hub.topics, "services": hub.services}
        yield gauge, "hub", "Numbers of clients, topics and services.", "kind", counted


def _latencies(status: ProcessStatus) -> Metric:
    family = HistogramMetricFamily(
        "rosbayes_stage_seconds",
        "Duration of each stage of published frames; `frame` is the whole.",
        labels=["process", "stage"],
    )
    bounds = [*(f"{bound:g}" for bound in BUCKETS_S), "+Inf"]
    for stage in status.stages:
        buckets = zip(bounds, accumulate(stage.buckets), strict=True)
        family.add_metric([status.name, stage.stage], list(buckets), stage.sum_s)
    return family
