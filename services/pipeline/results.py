"""Results as ROS messages: the posterior on /BMresults and the frame's own data on /bm/frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt
import orjson

from bridge.stamps import header
from machines.bm1 import StopReason
from machines.posterior import joint_posterior, posterior_of_lines
from pcie_shim.host.frame import BoardResult
from services.sockets.records import FrameResult, Publish
from toolchain.deployment import Deployment

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


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(list[BoardResult])


def encode_boards(boards: Sequence[BoardResult]) -> msgspec.Raw:
    """Return the boards' part of a `FrameResult`, which the master passes on as it is."""
    return msgspec.Raw(_encoder.encode(boards))


class Inferred:
    """What the counts of a result come to.

    Attributes:
        boards: What each board returned.
        posterior: float64[all lines], the joint posterior; None when no line of any board counted. Of replicas
            float64[replicas * all lines], one posterior after the other, zeros for a replica that has none; None when
            none has.
        totals: the sum of each board's counts.
        best: the most probable place in the posterior; -1 without one.
    """

    def __init__(self, result: FrameResult) -> None:
        boards = self.boards = _decoder.decode(result.boards)
        if boards and boards[0].replica_cycles:
            self._of_replicas()
            return
        counts = np.frombuffer(b"".join([board.words for board in boards]), dtype="<u4")
        lines = [len(board.words) // 4 for board in boards]
        self.totals: list[int] = []
        self.posterior: npt.NDArray[np.float64] | None = None
        if lines and all(lines):
            starts = [0, *accumulate(lines[:-1])]
            self.totals = np.add.reduceat(counts, starts, dtype=np.uint64).tolist()
            self.posterior = posterior_of_lines(counts, lines, [board.cycles for board in boards])
        self.best = -1 if self.posterior is None else int(self.posterior.argmax())

    def _of_replicas(self) -> None:
        boards, replicas = self.boards, len(self.boards[0].replica_cycles)
        # each board has its lines of every replica
        counts = [np.frombuffer(board.words, dtype="<u4").reshape(replicas, -1) for board in boards]
        self.totals = [int(of_board.sum(dtype=np.uint64)) for of_board in counts]
        joints = [
            joint_posterior(
                [of_board[replica] for of_board in counts],
                [board.replica_cycles[replica] for board in boards],
            )
            for replica in range(replicas)
        ]
        lines = sum(of_board.shape[1] for of_board in counts)
        self.posterior = None
        if any(joint is not None for joint in joints):
            self.posterior = np.concatenate([np.zeros(lines) if joint is None else joint for joint in joints])
        self.best = -1 if self.posterior is None else int(self.posterior.argmax())


def posterior_layout(deployment: Deployment) -> dict[str, Any]:
    """`layout` of a Float64MultiArray: dimensions labelled with the searched variables, row-major strides.

    Where there are replicas, they are the first dimension, labelled `replica`.
    """
    dimensions = []
    stride = deployment.machine.results
    for dimension in deployment.result_dimensions:
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


class FrameReport:
    """What /bm/frame says of a frame (outputs: number, cycles, reasons, times): its text is made once, and filled in.

    It goes out before every result, so its cost is every frame's.
    """

    def __init__(self, deployment: Deployment, ros_version: Literal[1, 2], generation: int = 0) -> None:
        self._ros_version = ros_version
        name = orjson.dumps(deployment.name).decode().replace("%", "%%")
        self._frame = _status(
            "%d",
            '"rosbayes: frame"',
            '"%s"',
            name,
            {
                "number": "%d",
                "published": "%s",
                "cycles": "%d",
                "counts_total": "%d",
                "generation": str(generation),
                "received_ns": "%d",
                "sent_ns": "%d",
                "rosbridge_in_us": "%.1f",
                "local_hops_us": "%.1f",
                "waited_us": "%.1f",
                "register_writes_us": "%.1f",
                "compute_us": "%.1f",
                "reads_us": "%.1f",
                "boards_compute_us": "%.1f",
                "rosbridge_out_us": "%.1f",
            },
        )
        self._board = _status(
            "0",
            '"rosbayes: board %d"',
            '"%s"',
            '"board%d"',
            {"cycles": "%d", "counts_total": "%d", "reason": "%s"},
        )
        self._board_of_replicas = _status(
            "0",
            '"rosbayes: board %d"',
            '"%s"',
            '"board%d"',
            {
                "cycles": "%d",
                "counts_total": "%d",
                "reason": "%s",
                "replica_cycles": "%s",
                "replica_reasons": "%s",
            },
        )

    def message(self, publish: Publish, inferred: Inferred, times: Times, sent_ns: int) -> dict[str, Any]:
        """The DiagnosticArray that precedes a result.

        Args:
            publish: the result, and its reading's stamps.
            inferred: what its counts come to.
            times: where its time went.
            sent_ns: Unix time.
        """
        result = publish.result
        totals = inferred.totals
        published = inferred.posterior is not None
        if published:
            overall = "posterior"
        elif all(board.reason is StopReason.IMPOSSIBLE for board in inferred.boards):
            overall = "no posterior: the readings are impossible for every line"
        else:
            overall = "no posterior: no line counted within max_cycles"
        statuses = [
            self._frame
            % (
                0 if published else 1,
                overall,
                result.number,
                "true" if published else "false",
                max((board.cycles for board in inferred.boards), default=0),
                sum(totals),
                publish.received_ns,
                sent_ns,
                times.rosbridge_in,
                times.local_hops,
                times.waited,
                times.register_writes,
                times.compute,
                times.reads,
                times.boards_compute,
                times.rosbridge_out,
            )
        ]
        for index, (board, total) in enumerate(zip(inferred.boards, totals, strict=True)):
            words = REASON_WORDS[board.reason]
            said = (index, words, index, board.cycles, total, words)
            if board.replica_cycles:
                cycles = ",".join(map(str, board.replica_cycles))
                reasons = ",".join(REASON_WORDS[reason] for reason in board.replica_reasons)
                statuses.append(self._board_of_replicas % (*said, cycles, reasons))
            else:
                statuses.append(self._board % said)
        return {
            "header": header(publish.stamp_ns, "bm", self._ros_version),
            "status": orjson.Fragment(f"[{','.join(statuses)}]"),
        }


def _status(level: str, name: str, message: str, hardware_id: str, values: dict[str, str]) -> str:
    """A DiagnosticStatus as JSON, whose parts may be what `%` fills in: numbers, or words without quotes."""
    pairs = ",".join(f'{{"key":"{key}","value":"{value}"}}' for key, value in values.items())
    return f'{{"level":{level},"name":{name},"message":{message},"hardware_id":{hardware_id},"values":[{pairs}]}}'
