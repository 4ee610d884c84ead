"""The status of a process in the text format of Prometheus."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import accumulate

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric

from services.sockets.status import BUCKETS_S, ProcessStatus


def families(status: ProcessStatus) -> Iterator[Metric]:
    """Return the metrics of a process, each family in turn."""
    process = [status.name]
    yield _info(status)
    yield _gauge("rosbayes_ready", "Whether the process is ready.", [((), status.ready)], process)
    yield _counter("rosbayes_cpu_seconds", "CPU time, user and system.", [((), status.cpu_s)], process)
    yield _gauge("rosbayes_memory_bytes", "Resident memory.", [((), status.memory_bytes)], process)
    yield _gauge("rosbayes_uptime_seconds", "Time since the start.", [((), status.uptime_s)], process)
    frames = status.frames
    if frames is not None:
        yield _counter(
            "rosbayes_frames_received",
            "Messages, readings, frames or results that arrived.",
            [((), frames.received)],
            process,
        )
        completed = [((), frames.completed)]
        yield _counter(
            "rosbayes_frames_completed",
            "Readings, frames or results that were completed.",
            completed,
            process,
        )
        lost = [((str(reason),), count) for reason, count in frames.lost.items()]
        yield _counter(
            "rosbayes_frames_lost",
            "Messages, readings, frames or results that were lost.",
            lost,
            process,
            "reason",
        )
        without = [((topic,), count) for topic, count in frames.without.items()]
        yield _counter(
            "rosbayes_frames_without_topic", "Frames computed without this topic.", without, process, "topic"
        )
        if frames.last_age_s is not None:
            yield _gauge(
                "rosbayes_last_frame_age_seconds",
                "Time since the last completed one.",
                [((), frames.last_age_s)],
                process,
            )
    links = [((link.uri,), link) for link in status.connections]
    if links:
        yield _gauge(
            "rosbayes_rosbridge_connected",
            "Whether the server is connected.",
            [(labels, link.state == "connected") for labels, link in links],
            process,
            "uri",
        )
        yield _counter(
            "rosbayes_rosbridge_reconnections",
            "Reconnections to the server.",
            [(labels, link.reconnections) for labels, link in links],
            process,
            "uri",
        )
    peers = [((peer.name,), peer) for peer in status.peers]
    if peers:
        restarts = [(labels, peer.restarts) for labels, peer in peers]
        yield _counter(
            "rosbayes_child_restarts", "Restarts of the child by the master.", restarts, process, "child"
        )
        ready = [(labels, peer.ready) for labels, peer in peers]
        yield _gauge("rosbayes_child_ready", "Whether the child is ready.", ready, process, "child")
    boards = [((str(board.index),), board) for board in status.boards]
    if boards:
        usable = [(labels, board.state in {"programmed", "blank"}) for labels, board in boards]
        yield _gauge("rosbayes_board_usable", "Whether the board answers.", usable, process, "board")
        restarts = [(labels, board.restarts) for labels, board in boards]
        yield _counter("rosbayes_board_restarts", "Restarts of the board.", restarts, process, "board")
    if status.hub is not None:
        counted = [
            (("clients",), status.hub.clients),
            (("topics",), status.hub.topics),
            (("services",), status.hub.services),
        ]
        yield _gauge("rosbayes_hub", "Numbers of clients, topics and services.", counted, process, "kind")
    if status.stages:
        yield _histogram(status)


def _info(status: ProcessStatus) -> Metric:
    labels = ["process", "version", "deployment"]
    info = GaugeMetricFamily("rosbayes_process", "The process, and its deployment in force.", labels=labels)
    info.add_metric([status.name, status.version, status.deployment], 1)
    return info


def _gauge(
    name: str, help_: str, values: Iterable[tuple[tuple[str, ...], float]], process: list[str], *labels: str
) -> Metric:
    family = GaugeMetricFamily(name, help_, labels=["process", *labels])
    for more, value in values:
        family.add_metric([*process, *more], float(value))
    return family


def _counter(
    name: str, help_: str, values: Iterable[tuple[tuple[str, ...], float]], process: list[str], *labels: str
) -> Metric:
    family = CounterMetricFamily(name, help_, labels=["process", *labels])
    for more, value in values:
        family.add_metric([*process, *more], float(value))
    return family


def _histogram(status: ProcessStatus) -> Metric:
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


def exposition(family: Metric) -> bytes:
    """Return a family in the text format."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_One(family))
    return generate_latest(registry)


class _One:
    """A collector of one family."""

    def __init__(self, family: Metric) -> None:
        self._family = family

    def collect(self) -> list[Metric]:
        return [self._family]
