"""Confidence intervals of statistics over frames."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

RESAMPLES: Final = 1000
LEVEL: Final = 0.95
"""Level of all confidence intervals."""

_NORMAL_95: Final = 1.959964


@dataclass(frozen=True, slots=True)
class Interval:
    """A value and its 95 % confidence interval."""

    value: float
    low: float
    high: float


def bootstrap(values: NDArray[np.float64], statistic: Callable[..., NDArray[np.float64]]) -> Interval:
    """Return a statistic over frames (the first axis) with its percentile bootstrap interval over whole frames."""
    chosen = np.random.default_rng(0).integers(0, len(values), (RESAMPLES, len(values)))
    drawn = np.asarray(values)[chosen].reshape(RESAMPLES, -1)
    low, high = np.quantile(statistic(drawn, axis=1), [(1 - LEVEL) / 2, (1 + LEVEL) / 2]).tolist()
    return Interval(float(statistic(values.reshape(-1), axis=0)), low, high)


def bootstrap_rows(rows: NDArray[np.float64], statistic: Callable[[NDArray[np.float64]], float]) -> Interval:
    """Return a statistic of a table's rows with its percentile bootstrap interval; whole rows are drawn."""
    chosen = np.random.default_rng(0).integers(0, len(rows), (RESAMPLES, len(rows)))
    low, high = np.quantile(
        [statistic(rows[each]) for each in chosen], [(1 - LEVEL) / 2, (1 + LEVEL) / 2]
    ).tolist()
    return Interval(statistic(rows), low, high)


def share_of_frames(share: float, frames: int) -> Interval:
    """Return a share of frames with its Wilson interval, which is valid even if all frames agree."""
    square = _NORMAL_95**2 / frames
    middle = (share + square / 2) / (1 + square)
    half = _NORMAL_95 / (1 + square) * math.sqrt(share * (1 - share) / frames + square / (4 * frames))
    return Interval(share, max(0.0, middle - half), min(1.0, middle + half))
