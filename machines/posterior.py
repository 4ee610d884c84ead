"""From counts to probabilities, over one board or several."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from collections.abc import Sequence


def joint_posterior(
    counts: Sequence[npt.NDArray[np.uint32]], cycles: Sequence[int]
) -> npt.NDArray[np.float64] | None:
    """The posterior over the lines of all boards: p_j proportional to count_j / cycles of its board."""
    shares = [
        count / cycle if cycle else np.zeros(len(count)) for count, cycle in zip(counts, cycles, strict=True)
    ]
    joint = np.concatenate(shares)
    total = joint.sum()
    return joint / total if total > 0 else None
