"""Results as ROS messages: the posterior on /BMresults and the frame's own data on /bm/frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from bridge.stamps import header
from machines.bm1 import StopReason
from machines.posterior import joint_posterior
from services.records import FrameResult, Publish
from toolchain.deployment import Deployment

FRAME_TOPIC = "/bm/frame"
FRAME_TYPE = "diagnostic_msgs/DiagnosticArray"

REASON_WORDS = {
    StopReason.NONE: "not started",
    StopReason.OVERFLOW: "overflow",
    StopReason.MAX_CYCLES: "max cycles",
    StopReason.SLICE: "slice",
    StopReason.IMPOSSIBLE: "impossible",
}


@dataclass(frozen=True, slots=True)
class Times:
    """Where a frame's time went, in microseconds (thesis figure 4.5)."""

    rosbridge_in: float
    local_hops: float
    waited: float
    register_writes: float
    compute: float
    reads: float
    boards_compute: float
    rosbridge_out: float


def counts_of(result: FrameResult) -> list[npt.NDArray[np.uint32]]:
    """The boards' counts as uint32 arrays, one per board, in the order of the lines."""
    return [np.frombuffer(board.counts, dtype="<u4") for board in result.boards]


def posterior_of(result: FrameResult) -> npt.NDArray[np.float64] | None:
    """The joint posterior over all lines, float64, or None when no line of any board counted."""
    return joint_posterior(counts_of(result), [board.cycles for board in result.boards])


def posterior_layout(deployment: Deployment) -> dict[str, Any]:
    """`layout` of a Float64MultiArray: dimensions labelled with the searched variables, row-major strides."""
    dimensions = []
    stride = deployment.machine.lines
    for dimension in deployment.searched:
        dimensions.append({"label": dimension.label, "size": dimension.size, "stride": stride})
        stride //= dimension.size
    return {"dim": dimensions, "data_offset": 0}


def times_of(publish: Publish, now_tick: int, previous_out_ns: int) -> Times:
    """The stages of one frame, from its records."""
    result = publish.result
    boards_ns = result.register_writes_ns + result.compute_ns + result.reads_ns
    between_ns = now_tick - publish.reading_sent_tick - publish.waited_ns - boards_ns
    return Times(
        rosbridge_in=max(0, publish.reading_sent_tick - publish.received_tick) / 1e3,
        local_hops=max(0, between_ns) / 1e3,
        waited=publish.waited_ns / 1e3,
        register_writes=result.register_writes_ns / 1e3,
        compute=result.compute_ns / 1e3,
        reads=result.reads_ns / 1e3,
        boards_compute=result.boards_compute_ns / 1e3,
        rosbridge_out=previous_out_ns / 1e3,
    )


def frame_message(
    deployment: Deployment,
    publish: Publish,
    times: Times,
    *,
    published: bool,
    sent_ns: int,
    ros_version: Literal[1, 2],
) -> dict[str, Any]:
    """The DiagnosticArray that precedes a result: number, cycles, reasons, and times (outputs.md names them)."""
    result = publish.result
    reasons = [StopReason(board.reason) for board in result.boards]
    totals = [int(counts.sum()) for counts in counts_of(result)]
    times_us = [
        ("rosbridge_in_us", times.rosbridge_in),
        ("local_hops_us", times.local_hops),
        ("waited_us", times.waited),
        ("register_writes_us", times.register_writes),
        ("compute_us", times.compute),
        ("reads_us", times.reads),
        ("boards_compute_us", times.boards_compute),
        ("rosbridge_out_us", times.rosbridge_out),
    ]
    values: list[tuple[str, str]] = [
        ("number", str(result.number)),
        ("published", "true" if published else "false"),
        ("cycles", str(max((board.cycles for board in result.boards), default=0))),
        ("counts_total", str(sum(totals))),
        ("received_ns", str(publish.received_ns)),
        ("sent_ns", str(sent_ns)),
        *((name, f"{value:.1f}") for name, value in times_us),
    ]
    ok = 0 if published else 1
    if published:
        overall = "posterior"
    elif all(reason is StopReason.IMPOSSIBLE for reason in reasons):
        overall = "no posterior: the readings are impossible for every line"
    else:
        overall = "no posterior: no line counted within max_cycles"
    statuses = [_status(ok, "rosbayes: frame", overall, deployment.name, values)]
    for index, (board, reason, total) in enumerate(zip(result.boards, reasons, totals, strict=True)):
        words = REASON_WORDS[reason]
        statuses.append(
            _status(
                0,
                f"rosbayes: board {index}",
                words,
                f"board{index}",
                [("cycles", str(board.cycles)), ("counts_total", str(total)), ("reason", words)],
            )
        )
    return {"header": header(publish.stamp_ns, "bm", ros_version), "status": statuses}


def _status(
    level: int, name: str, message: str, hardware_id: str, values: Sequence[tuple[str, str]]
) -> dict[str, Any]:
    return {
        "level": level,
        "name": name,
        "message": message,
        "hardware_id": hardware_id,
        "values": [{"key": key, "value": value} for key, value in values],
    }
