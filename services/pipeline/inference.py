"""Computation of the posterior from the counts of a frame, and the report of the frame."""

from itertools import accumulate

import numpy as np
import numpy.typing as npt

from machines.bm1 import StopReason
from machines.posterior import joint_posterior, posterior_of_lines
from posteriors.frame_report import BoardReport, FrameReport, StageTimes
from services.boards.frames import decode_boards
from services.sockets.records import FrameResult, Publish
from toolchain.deployment import Deployment

REASON_WORDS = {
    StopReason.NONE: "not started",
    StopReason.OVERFLOW: "overflow",
    StopReason.MAX_CYCLES: "max cycles",
    StopReason.SLICE: "slice",
    StopReason.IMPOSSIBLE: "impossible",
}


class Inference:
    """The posterior for the counts of a result.

    Attributes:
        boards: The boards' results.
        posterior: float64[all lines], the joint posterior; None if all counts are 0. With replicas
            float64[replicas * all lines], one posterior after the other, with zeros for a replica without
            one; None if no replica has one.
        totals: The sum of the counts of each board.
        best: The most probable line of the posterior; -1 without one.
    """

    def __init__(self, result: FrameResult) -> None:
        boards = self.boards = decode_boards(result)
        # set by one of the two branches, unless a board has no counts
        self.totals: list[int] = []
        self.posterior: npt.NDArray[np.float64] | None = None
        if boards and boards[0].replica_cycles:
            self._infer_replicas()
        else:
            counts = np.frombuffer(b"".join([board.words for board in boards]), dtype="<u4")
            lines = [len(board.words) // 4 for board in boards]
            if lines and all(lines):
                starts = [0, *accumulate(lines[:-1])]
                self.totals = np.add.reduceat(counts, starts, dtype=np.uint64).tolist()
                self.posterior = posterior_of_lines(counts, lines, [board.cycles for board in boards])
        self.best = -1 if self.posterior is None else int(self.posterior.argmax())

    def _infer_replicas(self) -> None:
        boards, replicas = self.boards, len(self.boards[0].replica_cycles)
        # each board has its own lines of every replica
        counts = [np.frombuffer(board.words, dtype="<u4").reshape(replicas, -1) for board in boards]
        self.totals = [int(of_board.sum(dtype=np.uint64)) for of_board in counts]
        joints = [
            joint_posterior(
                [of_board[replica] for of_board in counts],
                [board.replica_cycles[replica] for board in boards],
            )
            for replica in range(replicas)
        ]
        # a replica without a posterior has zeros, so that the others keep their places
        lines = sum(of_board.shape[1] for of_board in counts)
        if any(joint is not None for joint in joints):
            self.posterior = np.concatenate([np.zeros(lines) if joint is None else joint for joint in joints])


def report_of(
    publish: Publish,
    inference: Inference,
    deployment: Deployment,
    *,
    now: tuple[int, int],
    previous_out_ns: int,
) -> FrameReport:
    """Return the report of a frame.

    `now` is the Unix time and the monotonic time, `previous_out_ns` the duration of sending the previous
    result.
    """
    result = publish.result
    sent_ns, tick = now
    boards_ns = result.register_writes_ns + result.compute_ns + result.reads_ns
    # all times are of one monotonic clock, so what no process has measured was spent between them
    hops_ns = tick - publish.reading_sent_tick - publish.waited_ns - boards_ns
    if published := inference.posterior is not None:
        outcome = "posterior"
    elif all(board.reason is StopReason.IMPOSSIBLE for board in inference.boards):
        outcome = "no posterior: the readings are impossible for every line"
    else:
        outcome = "no posterior: no line counted within max_cycles"
    return FrameReport(
        stamp_ns=publish.stamp_ns,
        outcome=outcome,
        deployment=deployment.name,
        published=published,
        number=result.number,
        cycles=max((board.cycles for board in inference.boards), default=0),
        counts_total=sum(inference.totals),
        received_ns=publish.received_ns,
        sent_ns=sent_ns,
        stages=StageTimes(
            rosbridge_in=max(0, publish.reading_sent_tick - publish.received_tick) / 1e3,
            local_hops=max(0, hops_ns) / 1e3,
            waited=publish.waited_ns / 1e3,
            register_writes=result.register_writes_ns / 1e3,
            compute=result.compute_ns / 1e3,
            reads=result.reads_ns / 1e3,
            boards_compute=result.boards_compute_ns / 1e3,
            rosbridge_out=previous_out_ns / 1e3,
        ),
        boards=tuple(
            BoardReport(
                name=f"board{index}",
                stopped=REASON_WORDS[board.reason],
                cycles=board.cycles,
                counts_total=total,
                replica_cycles=board.replica_cycles,
                replica_stopped=tuple(REASON_WORDS[reason] for reason in board.replica_reasons),
            )
            for index, (board, total) in enumerate(zip(inference.boards, inference.totals, strict=True))
        ),
    )
