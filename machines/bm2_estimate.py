"""Estimates from a BM2's samples on all boards: posterior, standard error, number of effective samples, and R-hat."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from machines.bm2 import BM2Parameters, BM2StopReason, unpack_all

BATCHES_MIN: Final = 20
"""Minimum number of batches from which `batch_effective_samples` makes an estimate. With fewer, it returns NaN."""

AGREE: Final = 1.1
"""Maximum R-hat at which boards count as agreeing on one distribution (Gelman and Rubin 1992)."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BoardSamples:
    """The samples that one board has drawn in a frame.

    Attributes:
        reason: The board's last stop reason.
        counts: uint32[batches, values], the number of samples with each joint value of the searched variables. Each
            row counts the samples from the start of the frame to the end of the batch.
        values: int[samples], the index of each sample's joint value. The index is -1 if a variable has an unused code.
            `values` is None if the board does not stream samples.
    """

    reason: BM2StopReason
    counts: npt.NDArray[np.integer]
    values: npt.NDArray[np.integer] | None = None


@dataclass(frozen=True, slots=True)
class ChainEstimate:
    """The estimate of a frame from the chains of all boards.

    Attributes:
        posterior: float64[values], over the joint values of the searched variables, or None if all boards are left out.
        error: float64[values], the standard error of the posterior. A value whose effective samples are unknown has the
            error NaN. If boards disagree, the error is at least the standard error of the mean over the boards.
        effective_samples: Number of effective samples, summed over the boards, for the value with the smallest sum. It
            is NaN if it cannot be estimated, for example if all samples of a board have the same value.
        r_hat: The largest R-hat of all values. It is NaN for a single board, or if a board has too few samples.
        left_out: Indices of the boards that are left out, because they timed out or have no valid sample.
    """

    posterior: Floats | None
    error: Floats | None
    effective_samples: float
    r_hat: float
    left_out: tuple[int, ...]


def searched_counts(parameters: BM2Parameters, results: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    """Return the counts of the searched variables' joint values: integers[..., product of cardinalities], row-major.

    `results` is integers[..., result_words]. If a machine has no joint histogram, only one variable may be searched.
    The histogram of this variable then has the counts.
    """
    first = parameters.histogram_words
    if not parameters.joint_words:
        (variable,) = parameters.searched
        first = sum(1 << bits for bits in parameters.bits[:variable])
    # the codes of the first searched variable are the slowest axis
    sizes = [1 << parameters.bits[variable] for variable in parameters.searched]
    codes = np.arange(first, first + math.prod(sizes)).reshape(sizes)
    used = codes[tuple(slice(parameters.cardinalities[variable]) for variable in parameters.searched)]
    return results[..., used.ravel()]


def searched_values(parameters: BM2Parameters, stream: npt.NDArray[np.uint32]) -> npt.NDArray[np.int64]:
    """Return for each state in `stream` the index of the searched variables' joint value: int64[samples].

    `stream` is uint32[samples, state_words]. If a code in a state stands for no value, the index is -1.
    """
    codes = unpack_all(parameters.cardinalities, stream)
    values = np.zeros(len(stream), dtype=np.int64)
    for variable in parameters.searched:
        values = values * parameters.cardinalities[variable] + codes[:, variable]
    return np.where((codes >= parameters.cardinalities).any(axis=1), -1, values)


def estimate(chains: Sequence[BoardSamples]) -> ChainEstimate:
    """Return the estimate of the posterior from the chains of all boards.

    A board is left out if it timed out or has no sample. The counts of the remaining boards are added. Normally, all
    boards have drawn the same number of samples, and thus have the same weight. If a board reached its maximum number
    of cycles, the numbers of samples may differ. Then each board's counts are divided by their sum before they are
    added, so that all boards still have the same weight.
    """
    left_out = tuple(
        board
        for board, chain in enumerate(chains)
        if chain.reason is BM2StopReason.OPS_TIMEOUT or not chain.counts[-1].any()
    )
    counted = [chain for board, chain in enumerate(chains) if board not in left_out]
    if not counted:
        return ChainEstimate(None, None, math.nan, math.nan, left_out)
    weights = [chain.counts[-1].astype(np.float64) for chain in counted]
    if any(chain.reason is BM2StopReason.MAX_CYCLES for chain in chains):
        weights = [own / own.sum() for own in weights]
    posterior: Floats = np.sum(weights, axis=0)
    posterior /= posterior.sum()
    effective = np.sum([_effective_samples_of(chain) for chain in counted], axis=0)
    r_hat = math.nan
    if len(counted) > 1:
        halves = np.concatenate([_halves(chain) for chain in counted])
        if halves.sum(axis=1).min() >= 2:
            r_hat = float(split_r_hat(halves).max())
    error = standard_error(posterior, effective)
    if r_hat > AGREE:
        # a chain that has not mixed cannot tell its error from its own samples
        means = [chain.counts[-1] / chain.counts[-1].sum() for chain in counted]
        error = np.fmax(error, np.sqrt(np.var(means, axis=0, ddof=1) / len(means)))
    return ChainEstimate(posterior, error, float(effective.min()), r_hat, left_out)


def standard_error(probabilities: Floats, effective: Floats | float) -> Floats:
    """Return the standard error of probabilities that are estimated from `effective` independent samples."""
    # Laplace's rule: a value that was never seen has an error, too
    smooth = (effective * probabilities + 1) / (effective + 2)
    return np.asarray(np.sqrt(smooth * (1 - smooth) / effective))


def effective_samples(values: npt.NDArray[np.integer], size: int) -> Floats:
    """Return for each value the number of effective samples of the value's indicator: float64[size].

    The method is Geyer's initial positive sequence (1992). `values` is integers[samples] below `size`. The result is at
    most the number of samples, and equal to it for a value that all samples or no samples have.
    """
    samples = len(values)
    padded = 1 << (2 * samples - 1).bit_length()  # so that the correlations do not wrap around
    effective = np.full(size, float(samples))
    counts = np.bincount(values, minlength=size)
    for value in np.flatnonzero((counts > 0) & (counts < samples)):
        deviations = (values == value) - counts[value] / samples
        correlations = np.fft.irfft(np.abs(np.fft.rfft(deviations, padded)) ** 2, padded)
        correlations = correlations[: samples // 2 * 2] / correlations[0]
        pairs = correlations[0::2] + correlations[1::2]
        ends = np.flatnonzero(pairs <= 0)
        time = 2 * pairs[: ends[0] if len(ends) else None].sum() - 1
        effective[value] = samples / max(time, 1)
    return effective


def batch_effective_samples(counts: npt.NDArray[np.integer]) -> Floats:
    """Estimate the effective number of samples for each value from the means of a chain's batches: float64[values].

    `counts` is integers[batches, values]. `counts[batch, value]` is the number of samples with this value from the
    start of the first batch to the end of this batch. An estimate is at most the number of all samples. It equals that
    number if the value has the same share in every batch. It is NaN if fewer than `BATCHES_MIN` batches have samples.
    """
    of_batch = np.diff(counts.astype(np.float64), axis=0, prepend=0)
    of_batch = of_batch[of_batch.any(axis=1)]
    batches, values = of_batch.shape
    if batches < BATCHES_MIN:
        return np.full(values, np.nan)
    sizes = of_batch.sum(axis=1, keepdims=True)
    total = sizes.sum()
    means = of_batch.sum(axis=0) / total
    squares = ((sizes / total * (of_batch / sizes - means)) ** 2).sum(axis=0) * batches / (batches - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        effective: Floats = np.fmin(means * (1 - means) / squares, total)  # total for 0 / 0
    return effective


def split_r_hat(counts: npt.NDArray[np.integer]) -> Floats:
    """Return for each value the split R-hat of the value's indicator (Gelman et al. 2013): float64[values].

    `counts` is integers[halves of chains, values], with 2 or more samples in each half. If an indicator is constant
    within every half, R-hat is 1 if all halves agree, otherwise infinite.
    """
    n = counts.sum(axis=1, keepdims=True).astype(np.float64)
    means = counts / n
    within: Floats = (n / (n - 1) * means * (1 - means)).mean(axis=0)
    between: Floats = means.var(axis=0, ddof=1)
    length = n.mean()
    with np.errstate(divide="ignore", invalid="ignore"):
        r_hat: Floats = np.sqrt((length - 1) / length + between / within)
    r_hat[within == 0] = np.where(between[within == 0] > 0, np.inf, 1.0)
    return r_hat


def _effective_samples_of(chain: BoardSamples) -> Floats:
    if np.count_nonzero(chain.counts[-1]) == 1:
        # a chain that is stuck looks the same as a certain answer
        return np.full(chain.counts.shape[1], np.nan)
    if chain.values is None:
        return batch_effective_samples(chain.counts)
    return effective_samples(chain.values[chain.values >= 0], chain.counts.shape[1])


def _halves(chain: BoardSamples) -> npt.NDArray[np.integer]:
    """Return the counts of each half of a chain: half of its samples, or without a stream, half of its batches."""
    counts = chain.counts
    if chain.values is not None:
        used = chain.values[chain.values >= 0]
        counts = np.stack(
            [np.bincount(part, minlength=counts.shape[1]) for part in (used[: len(used) // 2], used)]
        )
    first, last = counts[len(counts) // 2 - 1], counts[-1]
    return np.stack([first, last - first])
