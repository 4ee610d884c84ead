"""Accuracy of posteriors, relative to the truth and to a float64 fusion of the same readings."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

REGION_MASS: Final = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Correctness:
    """The accuracy over many frames of one grid; shares are 0..1, distances are in cells.

    Coverage is the share of frames whose true cell lies in the posterior's 95 % region.
    """

    frames: int
    coverage: float
    exact_coverage: float
    mean_distance_median: float
    """Median distance between the posterior's mean and float64's."""
    mean_within_one_cell: float
    """Share of frames in which that distance is at most one cell."""
    total_variation_mean: float
    total_variation_median: float
    truth_distance_median: float
    """Median distance between the posterior's mean and the true cell's centre."""
    exact_truth_distance_median: float


def in_region(true_lines: ArrayLike, posteriors: ArrayLike, mass: float = REGION_MASS) -> NDArray[np.bool_]:
    """Return for each frame whether its true cell lies in the smallest region with this much probability.

    The most probable cells are added first, and cells of equal probability together, so the result does not
    depend on the order of lines. `posteriors` are float64[frames, lines], each summing to 1.
    """
    probabilities = _two_dimensional(posteriors)
    at_truth = np.take_along_axis(probabilities, np.asarray(true_lines)[:, None], axis=1)
    above = np.where(probabilities > at_truth, probabilities, 0.0).sum(axis=1)
    result: NDArray[np.bool_] = (above < mass) & (at_truth[:, 0] > 0)
    return result


def means(posteriors: ArrayLike, width: int) -> NDArray[np.float64]:
    """Return the mean (column, row) of each posterior in cells, float64[frames, 2]; cell 3 has its centre at 3.0.

    Posteriors are float64[frames, lines], row-major.
    """
    probabilities = _two_dimensional(posteriors)
    rows, columns = np.divmod(np.arange(probabilities.shape[1]), width)
    return np.stack([probabilities @ columns, probabilities @ rows], axis=1)


def total_variation(posteriors: ArrayLike, exact: ArrayLike) -> NDArray[np.float64]:
    """Return the total variation distance of each pair of posteriors: float64[frames], 0..1."""
    differences: NDArray[np.float64] = np.abs(_two_dimensional(posteriors) - _two_dimensional(exact))
    halves: NDArray[np.float64] = 0.5 * differences.sum(axis=1)
    return halves


def correctness(true_lines: ArrayLike, posteriors: ArrayLike, exact: ArrayLike, *, width: int) -> Correctness:
    """Return the accuracy of the machine's posteriors, compared with a float64 fusion of the same readings.

    `true_lines` are int[frames], both kinds of posteriors float64[frames, lines]; a row of the grid has `width` cells.

    Raises:
        ValueError: The shapes do not match, or there is no frame.
    """
    lines = np.asarray(true_lines)
    ours, theirs = _two_dimensional(posteriors), _two_dimensional(exact)
    if ours.shape != theirs.shape or lines.shape != ours.shape[:1] or not len(lines):
        raise ValueError(
            f"{lines.shape} true lines, {ours.shape} posteriors and {theirs.shape} exact ones: "
            "each frame needs one of each, and at least one frame"
        )
    true_rows, true_columns = np.divmod(lines, width)
    truth = np.stack([true_columns, true_rows], axis=1)
    our_means, their_means = means(ours, width), means(theirs, width)
    between = np.linalg.norm(our_means - their_means, axis=1)
    variations = total_variation(ours, theirs)
    return Correctness(
        frames=len(lines),
        coverage=float(in_region(lines, ours).mean()),
        exact_coverage=float(in_region(lines, theirs).mean()),
        mean_distance_median=float(np.median(between)),
        mean_within_one_cell=float((between <= 1).mean()),
        total_variation_mean=float(variations.mean()),
        total_variation_median=float(np.median(variations)),
        truth_distance_median=float(np.median(np.linalg.norm(our_means - truth, axis=1))),
        exact_truth_distance_median=float(np.median(np.linalg.norm(their_means - truth, axis=1))),
    )


def _two_dimensional(posteriors: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(posteriors, dtype=np.float64)
    if array.ndim != 2:
        raise ValueError(f"posteriors are float64[frames, lines], not of shape {array.shape}")
    return array
