"""A frame of the mini-cluster: its input, the result of each board, and its output."""

from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from machines.bm1 import StopReason


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameInput:
    """Readings and settings of a frame.

    Attributes:
        addresses: One table address per sensor column, in the order of the model; None for a missing reading.
            With inputs per cell or replicas: an array of integers in the `input_shape` of the whole machine,
            addresses or codes, with -1 in all lines of a missing reading.
        prior_address: Row of the prior's table (prior select); with replicas one for all, or a tuple with one
            for each.
        prior_codes: uint16[total lines], a written prior; with replicas the same for all, or uint16[replicas, total
            lines]; None: the image's own.
        target_count: Count that stops the machines (thesis figure 3.3: number of target samples).
        max_cycles: Maximum number of cycles.
        bank: Set of seeds from which the RNGs restart.
        stop: `slices`: all boards stop at the end of the slice in which the first one overflows; `own`: each
            independently.
    """

    addresses: tuple[int | None, ...] | npt.NDArray[np.integer]
    prior_address: int | tuple[int, ...] = 0
    prior_codes: npt.NDArray[np.uint16] | None = None
    target_count: int
    max_cycles: int
    bank: int = 0
    stop: Literal["slices", "own"] = "slices"


class BoardResult(msgspec.Struct, frozen=True, array_like=True, tag="board"):
    """The counts of a board; its MessagePack form is part of a record between the services.

    Attributes:
        words: One count per line of the board, 32 bits each, little-endian, as received; replica after
            replica.
        cycles: Cycles of its machine; with replicas, of the longest-running one.
        reason: Stop reason; IMPOSSIBLE boards did not run and have no weight. With replicas, their
            `joint_reason`, or SLICE if all of them were stopped because of other boards.
        replica_cycles: Cycles of each replica; empty if the board has a single machine.
        replica_reasons: Stop reason of each replica; empty if the board has a single machine.
    """

    words: bytes
    cycles: int
    reason: StopReason
    replica_cycles: tuple[int, ...] = ()
    replica_reasons: tuple[StopReason, ...] = ()

    @property
    def counts(self) -> npt.NDArray[np.uint32]:
        """A copy of the counts of the board: uint32[lines], with replicas uint32[replicas, lines]."""
        counts = np.frombuffer(self.words, "<u4").astype(np.uint32)
        return counts.reshape(len(self.replica_cycles), -1) if self.replica_cycles else counts


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameOutput:
    """The results of a frame, and its durations in nanoseconds (thesis figure 4.5).

    Attributes:
        boards: One result per board, in the order of the partition.
        register_writes_ns: Posting settings, sensors, starts and resumes.
        compute_ns: Waiting for the boards, including their computing and the transport.
        reads_ns: Copying the results.
        boards_compute_ns: Computing time of the slowest board, summed over the slices. The rest of
            `compute_ns` is transport, or other boards on the same core.
        slices: Number of slices.
    """

    boards: tuple[BoardResult, ...]
    register_writes_ns: int
    compute_ns: int
    reads_ns: int
    boards_compute_ns: int
    slices: int
