"""Comparison of two computations of one frame with different random numbers (`integrity = twice`)."""

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from machines.parameters import BM1Parameters
from pcie_shim.errors import BoardError
from pcie_shim.host.frame import BoardResult, FrameOutput

BOUND: Final = 6.5
"""Maximum difference of two counts, in standard errors of equation 2.1."""
_STALE_BITS: Final = math.sqrt(2.6)
"""Factor of the standard error for generators that do not make fresh bits for every cycle (machines.md)."""


class DisagreementError(BoardError):
    """Two computations of a frame differ by more than chance explains."""


def compare(first: FrameOutput, second: FrameOutput, parameters: BM1Parameters) -> None:
    """Raise a DisagreementError that names the first board on which two computations disagree."""
    bound = BOUND if parameters.steps_per_clock >= parameters.prob_bits else BOUND * _STALE_BITS
    for board, (one, other) in enumerate(zip(first.boards, second.boards, strict=True)):
        difference = greatest_difference(one, other)
        if difference > bound:
            raise DisagreementError(
                f"two computations of the frame disagree on board {board}: a count differs by {difference:.1f} standard "
                f"errors, and chance explains {bound:.1f} (integrity = twice); the result is withheld",
                board=board,
            )


def greatest_difference(one: BoardResult, other: BoardResult) -> float:
    """Return the greatest difference of two results in standard errors; infinite if only one machine has run."""
    cycles = np.array([each.replica_cycles or (each.cycles,) for each in (one, other)], dtype=np.float64)
    if ((cycles == 0).any(axis=0) != (cycles == 0).all(axis=0)).any():
        return math.inf
    cycles = np.maximum(cycles, 1)[:, :, np.newaxis]
    counts = np.array([np.atleast_2d(each.counts) for each in (one, other)], dtype=np.float64)
    pooled = counts.sum(axis=0) / cycles.sum(axis=0)
    rates: npt.NDArray[np.float64] = counts / cycles
    error = np.sqrt(pooled * (1 - np.minimum(pooled, 1)) * (1 / cycles).sum(axis=0))
    difference = np.abs(rates[0] - rates[1])
    # a difference without any error is infinite, and equal rates agree
    ratio = np.divide(difference, error, out=np.where(difference > 0, math.inf, 0.0), where=error > 0)
    return float(ratio.max())
