"""One frame as the mini-cluster computes it: its input, each board's result, its output."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from machines.bm1 import StopReason


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameInput:
    """One frame's readings and settings.

    Attributes:
        addresses: One table address per sensor column, in the model's order; None is a missing reading. For cells with
            inputs of their own, and for replicas: an array of integers of the whole machine's `input_shape`,
            addresses or codes, with -1 in all lines of a missing reading.
        prior_address: Row of the prior's table (prior select); with replicas one for all, or a tuple of one each.
        prior_codes: uint16[total lines], a written prior; with replicas the same for all, or uint16[replicas, total
            lines]; None: the image's own.
        target_count: Count that stops the machines (thesis figure 3.3: number of target samples).
        max_cycles: Most cycles, whatever the counts.
        bank: Set of seeds from which the RNGs restart.
        stop: `slices`: all boards stop in the slice in which the first one overflows; `own`: each for itself.
    """

    addresses: tuple[int | None, ...] | npt.NDArray[np.integer]
    prior_address: int | tuple[int, ...] = 0
    prior_codes: npt.NDArray[np.uint16] | None = None
    target_count: int
    max_cycles: int
    bank: int = 0
    stop: Literal["slices", "own"] = "slices"


class BoardResult(msgspec.Struct, frozen=True, array_like=True, tag="board"):
    """One board's counts; its MessagePack form is a part of a record between the services.

    Attributes:
        words: One count per line of the board, 32 bits each, little-endian, as they came; replica after replica.
        cycles: Cycles that its machine ran; of replicas the one that ran longest.
        reason: Why it stopped; IMPOSSIBLE boards ran nothing and have no weight. Of replicas the `joint_reason`
            of theirs, or SLICE where all of them were stopped by other boards'.
        replica_cycles: Cycles of each replica; empty where the board holds one machine.
        replica_reasons: Why each replica stopped; empty likewise.
    """

    words: bytes
    cycles: int
    reason: StopReason
    replica_cycles: tuple[int, ...] = ()
    replica_reasons: tuple[StopReason, ...] = ()

    @property
    def counts(self) -> npt.NDArray[np.uint32]:
        """uint32[lines of the board], with replicas uint32[replicas, lines of the board]; a copy."""
        counts = np.frombuffer(self.words, "<u4").astype(np.uint32)
        return counts.reshape(len(self.replica_cycles), -1) if self.replica_cycles else counts


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameOutput:
    """A frame's results and the time of its parts (thesis figure 4.5), in nanoseconds.

    Attributes:
        boards: One result per board, in the order of the partition.
        register_writes_ns: Posting settings, sensors, starts and resumes.
        compute_ns: Waiting for the boards, which includes their computing and the link's transport.
        reads_ns: Copying the results.
        boards_compute_ns: The boards' own computing: the slowest board of each slice, summed. The rest of
            `compute_ns` is transport, and waiting of boards that share a core.
        slices: Number of rounds of starting or resuming and waiting.
    """

    boards: tuple[BoardResult, ...]
    register_writes_ns: int
    compute_ns: int
    reads_ns: int
    boards_compute_ns: int
    slices: int
