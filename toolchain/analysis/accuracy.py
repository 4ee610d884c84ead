"""Accuracy of a machine's posteriors compared with exact inference. The quantisation loss is also reported separately.

Each frame has three posteriors over the lines (values of the searched variables). The first is exact inference from
the model's probabilities. The second is exact inference from the machine's codes. The third comes from the machine's
counts. The first and the second differ by the quantisation loss. The second and the third differ by the sampling loss.

Means over frames have confidence intervals. A frame without a posterior counts in a mean: its total variation is 1,
and its most probable line counts as wrong.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import StopReason
from machines.parameters import RngReset
from toolchain.analysis.emulation import EmulatedBoards, Inputs, WrittenPrior, addressed_chances
from toolchain.analysis.readings import Readings
from toolchain.cluster import Run, Work, in_order, in_this_process
from toolchain.deployment.filter import Filter
from toolchain.errors import BuildError, ModelError
from toolchain.models.model import Model, exact_posterior, fuse

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
    """Return a statistic with a percentile bootstrap interval. Frames (the first axis of `values`) are resampled."""
    chosen = np.random.default_rng(0).integers(0, len(values), (RESAMPLES, len(values)))
    drawn = np.asarray(values)[chosen].reshape(RESAMPLES, -1)
    low, high = np.quantile(statistic(drawn, axis=1), [(1 - LEVEL) / 2, (1 + LEVEL) / 2]).tolist()
    return Interval(float(statistic(values.reshape(-1), axis=0)), low, high)


def share_of_frames(share: float, frames: int) -> Interval:
    """Return a share of frames with a Wilson interval. This interval is valid even if the share is 0 or 1."""
    square = _NORMAL_95**2 / frames
    middle = (share + square / 2) / (1 + square)
    half = _NORMAL_95 / (1 + square) * math.sqrt(share * (1 - share) / frames + square / (4 * frames))
    return Interval(share, max(0.0, middle - half), min(1.0, middle + half))


EXPECTED_COUNT: Final = 5.0
"""A line gets a z-score if its expected count is at least this. Lower counts are not approximately normal."""

_TIE: Final = 1e-9
_LOST: Final = (1.0, math.nan, 0.0)
"""Total variation, KL and agreement of a run without a posterior."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """Distances between the two posteriors of a frame, `ours` and `theirs`, averaged over frames.

    Attributes:
        total_variation: Half the sum of absolute differences, from 0 to 1. A frame without a posterior counts as 1.
        map_agreement: Share of all frames in which both posteriors exist and have an equal most probable line.
        alone: A second `Difference`, averaged over only the frames with a posterior, or None if no frame has one.
        kl_bits: KL(ours || theirs) in bits. Only `alone` has it, because a frame without a posterior has no KL;
            elsewhere it is None. The opposite direction, KL(theirs || ours), is infinite if a count is 0.
    """

    total_variation: Interval
    map_agreement: Interval
    kl_bits: Interval | None = None
    alone: "Difference | None" = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ZScores:
    """Statistics of the z-scores of equation 2.1: z = (n - c p) / sqrt(c p (1 - p)).

    A line counts in a cycle with probability p, and has the count n after a run of c cycles.

    Attributes:
        cycles: Length c of each run. All runs have the same length.
        counts: Number of z-scores.
        draws: Number of independent sequences of random numbers. There is one per bank of seeds, or one per reading if
            generators are never reset. The intervals of `rms` and `mean` are bootstrapped over these sequences.
        rms: Root mean square of the z-scores. It is 1 for independent bits. If the variance of the counts is v times
            that of independent bits, the root mean square is sqrt(v).
        mean: Mean of the z-scores. It is 0 if the counts are unbiased.
        beyond_three: Share of z-scores below -3 or above 3. It is 0.0027 for a normal distribution.
    """

    cycles: int
    counts: int
    draws: int
    rms: Interval
    mean: Interval
    beyond_three: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Cycles:
    """Statistics over frames and banks of seeds. The cycles of a frame are those of the board that runs longest."""

    median: Interval
    percentile_95: Interval
    worst: int

    @classmethod
    def of(cls, lengths: NDArray[np.float64]) -> Self:
        """Return the statistics of the frames' cycles, float64[frames] or float64[frames, banks]."""
        return cls(
            median=bootstrap(lengths, np.median),
            percentile_95=bootstrap(lengths, lambda a, **k: np.quantile(a, 0.95, **k)),
            worst=int(lengths.max()),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Accuracy and cycles of a machine on some readings.

    Attributes:
        posteriors: Number of requested posteriors: one per frame, or one per replica of a frame.
        banks: Number of seed sets with which each reading was run.
        impossible: Share of the requested posteriors for which no line can count, because every line has a code 0.
        without: Share of runs without a posterior, including runs in which all counts remained 0.
        overflow: Share of runs that ended with an overflow.
        machine: Difference of the machine from the model, or None without a model.
        quantising: Difference between the model and exact inference on the codes, or None without a model.
        sampling: Difference of the machine from exact inference on the machine's codes.
        z: Counts compared with equation 2.1, or None if no line's expected count is high enough.
    """

    frames: int
    posteriors: int
    banks: int
    impossible: float
    without: float
    overflow: float
    machine: Difference | None
    quantising: Difference | None
    sampling: Difference | None
    z: ZScores | None
    cycles: Cycles


def measure(
    boards: EmulatedBoards,
    readings: Readings,
    model: Model | None,
    *,
    banks: int = 4,
    replicas: int = 1,
    own: Filter | None = None,
    advance: Callable[[], None] = lambda: None,
    run: Run = in_this_process,
) -> Accuracy:
    """Run a machine on readings, and compare the machine's posteriors with exact inference.

    A frame consists of `replicas` successive readings, one per replica. The readings are run one by one on a machine
    without replicas. With equal seeds, such a machine and a replica give the same counts. The cycles of the frame are
    the cycles of the longest run. `advance` is called after every reading.

    The posteriors are compared with exact inference from the machine's codes. With a `model`, they are also compared
    with exact inference from the model. If a reading is impossible in the model, exact inference gives no posterior
    for the reading.

    `own` is the filter of a deployment. With `own`, the readings are a sequence. Each reading is run only once, and not
    with several banks of seeds. Each posterior is compared with the posterior of the exact filter.

    Raises:
        BuildError: There are fewer readings than replicas.
        ModelError: No reading is possible in the model.
    """
    if len(readings) < replicas:
        raise BuildError(
            f"a frame of {replicas} replicas needs {replicas} readings, but there are {len(readings)} ({readings.source})"
        )
    parameters = boards.parameters
    banks = 1 if own is not None else banks
    banks = max(1, min(banks, parameters.rng_banks if parameters.rng_reset is RngReset.BANK else banks))
    if own is not None or parameters.rng_reset is RngReset.FREE:
        run = in_this_process  # a frame depends on the frames before it
    frames = len(readings) // replicas
    job = _Frames(boards, readings, model, banks, replicas, own)
    found: list[_Reading] = in_order(run, job, range(frames * replicas), advance)
    if not any(each.is_likely for each in found):
        raise ModelError(f"none of the readings ({readings.source}) is possible in the model")
    lengths, z = np.array([each.lengths for each in found]), None
    if (lengths > 0).any():
        # the z-score of a count uses the cycles of single replicas
        usual = int(np.median(lengths[lengths > 0]))
        priors = {place: each.prior for place, each in enumerate(found) if each.is_possible}
        z = _z_scores(_Counts(boards, readings, priors, usual), run)
    differences = np.reshape([each.differences for each in found], (frames, replicas, -1, 2, 3))
    sampling, *others = map(_summary, np.moveaxis(differences, 2, 0))
    quantising, machine = others or (None, None)
    return Accuracy(
        frames=frames,
        posteriors=len(found),
        banks=banks,
        impossible=sum(not each.is_possible for each in found) / len(found),
        without=sum(each.without for each in found) / lengths.size,
        overflow=sum(each.overflow for each in found) / lengths.size,
        machine=machine,
        quantising=quantising,
        sampling=sampling,
        z=z,
        cycles=Cycles.of(lengths.reshape(frames, replicas, banks).max(axis=1)),
    )


class _Reading(NamedTuple):
    """Results of a reading. The boards ran the reading once with each bank of seeds.

    Attributes:
        is_likely: Whether the reading is possible according to the model. True if there is no model.
        is_possible: Whether at least one line can count according to the codes.
        lengths: Cycles of the run with each bank.
        without: Number of runs without a posterior.
        overflow: Number of runs that ended with an overflow.
        prior: uint16[lines], the prior that the filter wrote for this reading, or None without a filter.
        differences: Results of `_differences`. The first compares the machine with exact inference from the codes.
            If there is a model, the second compares the codes with the model, and the third compares the machine
            with the model.
    """

    is_likely: bool
    is_possible: bool
    lengths: list[int]
    without: int
    overflow: int
    prior: WrittenPrior
    differences: list[NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class _Frames:
    """The job of running the readings: piece n runs the reading at index n, a replica of frame n // `replicas`."""

    boards: EmulatedBoards
    readings: Readings
    model: Model | None
    banks: int
    replicas: int
    own: Filter | None

    def prepare(self) -> Work:
        """Return the function that runs a reading with every bank, and compares it with exact inference."""
        boards, model, own = self.boards, self.model, self.own
        belief = None if own is None else own.transition.start

        def measured(place: int) -> _Reading:
            nonlocal belief
            exact = prior = None
            if own is not None and belief is not None:
                belief, prior = own.transition.after(belief), own.predict()
            if model is not None:
                addresses, row = self.readings.of_model(place)
                with suppress(ModelError):
                    exact = exact_posterior(model, addresses, prior_address=row, prior=belief)
            inputs, prior_row = self.readings.of_machine(place, boards.machines[0])
            likelihood = _line_probabilities(boards, inputs, prior_row, prior)
            codes = fuse(likelihood, ()) if likelihood.any() else None
            first = place // self.replicas * self.banks
            numbers = [(first + each) % boards.parameters.rng_banks for each in range(self.banks)]
            ran = [boards.run(inputs, prior_row, bank, prior) for bank in numbers]
            posteriors = [each.posterior for each in ran]
            if own is not None:
                own.update(posteriors[-1])
                belief = belief if exact is None else exact
            differences = [_differences(posteriors, codes)]
            if model is not None:
                differences += [_differences([codes], exact), _differences(posteriors, exact)]
            return _Reading(
                is_likely=model is None or exact is not None,
                is_possible=codes is not None,
                lengths=[each.length for each in ran],
                without=sum(each is None for each in posteriors),
                overflow=sum(StopReason.OVERFLOW in each.reasons for each in ran),
                prior=prior,
                differences=differences,
            )

        return measured


def _differences(
    ours: Sequence[NDArray[np.float64] | None], theirs: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Return mean total variation, KL and agreement, float64[2, 3]: over all runs, and over those with a posterior.

    The second row is NaN if no run has a posterior.
    """
    runs = [_difference(each, theirs) for each in ours if each is not None and theirs is not None]
    every = [*runs, *[_LOST] * (len(ours) - len(runs))]
    return np.array([np.mean(every, axis=0), np.mean(runs or [(math.nan,) * 3], axis=0)])


def _summary(pairs: NDArray[np.float64]) -> Difference:
    """Average results of `_differences`, float64[frames, replicas, 2, 3], over the replicas, and then over frames."""
    every, alone, of_alone = pairs[:, :, 0].mean(axis=1), pairs[:, :, 1], None
    alone = np.nanmean(alone[~np.isnan(alone).all(axis=(1, 2))], axis=1)
    if len(alone):
        of_alone = Difference(
            total_variation=bootstrap(alone[:, 0], np.mean),
            map_agreement=share_of_frames(float(alone[:, 2].mean()), len(alone)),
            kl_bits=bootstrap(alone[:, 1], np.mean),
        )
    return Difference(
        total_variation=bootstrap(every[:, 0], np.mean),
        map_agreement=share_of_frames(float(every[:, 2].mean()), len(every)),
        alone=of_alone,
    )


def _line_probabilities(
    boards: EmulatedBoards, inputs: Inputs, prior_address: int, prior: WrittenPrior
) -> NDArray[np.float64]:
    """Return the probability that each line of all boards counts in a cycle: float64[lines]."""
    parts = zip(boards.machines, boards.parts(inputs, prior), strict=True)
    chances = [addressed_chances(machine, own, prior_address, codes) for machine, (own, codes) in parts]
    return np.concatenate([np.prod(each, axis=0) for each in chances])


def _difference(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> tuple[float, float, float]:
    variation = 0.5 * float(np.abs(ours - theirs).sum())
    held = ours > 0
    # A code above 0 never stands for a probability of 0; such a 0 can only be an underflow of doubles.
    ratio = ours[held] / np.maximum(theirs[held], np.finfo(np.float64).tiny)
    divergence = max(0.0, float(ours[held] @ np.log2(ratio)))
    same = (theirs >= theirs.max() * (1 - _TIE)) & (ours >= ours.max() * (1 - _TIE))
    return variation, divergence, float(same.any())


@dataclass(frozen=True, slots=True)
class _Counts:
    """The job of comparing counts with equation 2.1: piece n is the reading at index n, run for `cycles` cycles."""

    boards: EmulatedBoards
    readings: Readings
    priors: dict[int, WrittenPrior]
    cycles: int

    def prepare(self) -> Work:
        """Return the function that sums z^2, z, 1 and |z| > 3 over the z-scores of a reading's counts: float64[4]."""

        def compared(place: int) -> NDArray[np.float64]:
            boards, prior, cycles = self.boards, self.priors[place], self.cycles
            addresses, row = self.readings.of_machine(place, boards.machines[0])
            chance = _line_probabilities(boards, addresses, row, prior)
            ran = boards.run_for(addresses, row, place % boards.parameters.rng_banks, cycles, prior)
            looked_at = (chance * cycles >= EXPECTED_COUNT) & (chance < 1)
            p = chance[looked_at]
            z = (np.concatenate(ran.counts)[looked_at] - cycles * p) / np.sqrt(cycles * p * (1 - p))
            return np.array([(z**2).sum(), z.sum(), len(z), (np.abs(z) > 3).sum()])

        return compared


def _z_scores(job: _Counts, run: Run) -> ZScores | None:
    # Frames with the same bank share all random numbers, so a bank is one draw for all of them.
    p = job.boards.parameters
    draws = len(job.readings) if p.rng_reset is RngReset.FREE else p.rng_banks
    drawn: dict[int, NDArray[np.float64]] = {}
    found = in_order(run, job, list(job.priors), lambda: None)
    for place, sums in zip(job.priors, found, strict=True):
        if sums[2]:
            drawn[place % draws] = drawn.get(place % draws, 0) + sums
    if not drawn:
        return None
    table = np.array(list(drawn.values()))
    counts = int(table[:, 2].sum())
    return ZScores(
        cycles=job.cycles,
        counts=counts,
        draws=len(table),
        # the bootstrap draws whole rows of four sums, and puts them one after the other
        rms=bootstrap(table, lambda a, axis: np.sqrt(a[..., ::4].sum(axis) / a[..., 2::4].sum(axis))),
        mean=bootstrap(table, lambda a, axis: a[..., 1::4].sum(axis) / a[..., 2::4].sum(axis)),
        beyond_three=int(table[:, 3].sum()) / counts,
    )
