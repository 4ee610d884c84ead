"""Accuracy of a machine's posteriors compared with exact inference, apart from the quantisation loss.

Each frame has three posteriors: of the model (float64), of the codes (float64), and of the machine (counts). The
difference between codes and model is the quantisation loss, that between machine and codes the sampling loss. Means
over frames have confidence intervals. A frame without a posterior is not left out of a mean: its total variation is 1,
and its most probable line is wrong.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import BM1Machine, Start, addressed_codes
from machines.encode import decode_code
from machines.parameters import RngReset
from toolchain.analysis.emulation import EmulatedBoards, Inputs, inputs_of_boards, priors_of_boards
from toolchain.analysis.readings import Readings
from toolchain.cluster import Run, Work, in_this_process
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


EXPECTED_COUNT: Final = 5.0
"""Minimum expected count of a line to get a z-score, because lower counts are not approximately normal."""

_TIE: Final = 1e-9
_LOST: Final = (1.0, math.nan, 0.0)
"""Total variation, KL and agreement of a run without a posterior."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """Distances between posteriors, averaged over frames.

    Attributes:
        total_variation: Half the sum of absolute differences, 0 to 1; 1 for a frame without a posterior.
        map_agreement: Share of frames in which the most probable line is the same; it is not without a posterior.
        kl_bits: KL(ours || theirs) in bits; None where frames without a posterior count. (KL(theirs || ours) is
            infinite if a count is 0.)
        alone: The same over the frames with a posterior alone; None if there are none.
    """

    total_variation: Interval
    map_agreement: Interval
    kl_bits: Interval | None = None
    alone: "Difference | None" = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ZScores:
    """Counts of runs of a fixed length compared with equation 2.1: (n - c p) / sqrt(c p (1 - p)).

    Attributes:
        cycles: The length c.
        draws: Number of independent draws of random numbers, the banks, for the intervals.
        rms: Root mean square: 1 for independent bits, 1.6 if the variance is 2.6 times as large.
        mean: 0 if the counts are unbiased.
        beyond_three: Share beyond -3 or 3; 0.0027 for a normal distribution.
    """

    cycles: int
    counts: int
    draws: int
    rms: Interval
    mean: Interval
    beyond_three: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Cycles:
    """Cycles of the longest-running board, over frames and banks."""

    median: Interval
    percentile_95: Interval
    worst: int

    @classmethod
    def of(cls, lengths: NDArray[np.float64]) -> Self:
        """Return the statistics of frames, [frames] or [frames, banks]."""
        return cls(
            median=bootstrap(lengths, np.median),
            percentile_95=bootstrap(lengths, lambda a, **k: np.quantile(a, 0.95, **k)),
            worst=int(lengths.max()),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Accuracy and cycles of a machine on some readings.

    Attributes:
        posteriors: Number of posteriors: one per frame, or one per replica of a frame.
        banks: Number of seed sets with which each was run.
        impossible: Share of posteriors for which no line can count.
        without: Share of runs without a posterior, including those whose counts remained 0.
        overflow: Share of runs that ended with an overflow.
        machine: The machine against the model; None without a model.
        quantising: Exact inference on the codes against the model; None without a model.
        sampling: The machine against exact inference on its codes.
        z: Counts compared with equation 2.1; None if no line counts often enough.
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


_Posterior: TypeAlias = NDArray[np.float64] | None


class _Differences:
    """Differences of many frames, total variation, KL and agreement; runs and replicas of a frame are averaged."""

    def __init__(self) -> None:
        self.every: dict[int, list[NDArray[np.float64]]] = {}
        self.alone: dict[int, list[NDArray[np.float64]]] = {}

    def add(self, frame: int, ours: Sequence[_Posterior], theirs: _Posterior) -> None:
        runs = [_difference(each, theirs) for each in ours if each is not None and theirs is not None]
        lost = [_LOST] * (len(ours) - len(runs))
        self.every.setdefault(frame, []).append(np.mean([*runs, *lost], axis=0))
        if runs:
            self.alone.setdefault(frame, []).append(np.mean(runs, axis=0))

    def take(self, other: "_Differences") -> None:
        """Add the differences of other frames."""
        self.every |= other.every
        self.alone |= other.alone

    def summary(self) -> Difference | None:
        if not self.every:
            return None
        alone = None
        if self.alone:
            variation, divergence, same = _columns(self.alone)
            alone = Difference(
                total_variation=bootstrap(variation, np.mean),
                map_agreement=share_of_frames(float(same.mean()), len(same)),
                kl_bits=bootstrap(divergence, np.mean),
            )
        variation, _, same = _columns(self.every)
        return Difference(
            total_variation=bootstrap(variation, np.mean),
            map_agreement=share_of_frames(float(same.mean()), len(same)),
            alone=alone,
        )


def _columns(frames: dict[int, list[NDArray[np.float64]]]) -> NDArray[np.float64]:
    """Return total variation, KL and agreement of each frame, averaged over its replicas: float64[3, frames]."""
    return np.array([np.mean(frames[frame], axis=0) for frame in sorted(frames)]).T


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
    """Run a machine on readings and compare its posteriors with exact inference.

    A replica has the same counts as a single machine with the same bank, so a single machine is run for all
    replicas: successive readings, one per replica, form a frame, which ends when the last one ends. Without a
    `model`, only the codes are known. Readings that are impossible in the model have no posterior. `advance` is
    called after every reading. With the filter `own`, the readings are a sequence, in which every frame has one bank, and
    the machine is compared with the exact filter.

    Raises:
        BuildError: Fewer readings than replicas.
        ModelError: No frame is possible in the model.
    """
    if len(readings) < replicas:
        raise BuildError(
            f"a frame of {replicas} replicas needs {replicas} readings, but there are {len(readings)} ({readings.source})"
        )
    parameters = boards.parameters
    banks = 1 if own is not None else banks
    banks = max(1, min(banks, parameters.rng_banks if parameters.rng_reset is RngReset.BANK else banks))
    if own is not None or parameters.rng_reset is RngReset.FREE:
        run = in_this_process  # a frame depends on those before
    frames = _Frames(boards, readings, model, banks, replicas, own)
    found = _Results(banks)

    def keep(_: int, result: _Results) -> None:
        found.take(result)
        for _ in range(replicas):
            advance()

    run(frames, range(len(readings) // replicas), keep)
    if found.unlikely == found.posteriors:
        raise ModelError(f"none of the readings ({readings.source}) is possible in the model")
    return found.summary(boards, readings, run)


@dataclass(frozen=True, slots=True)
class _Frames:
    """The job of running the readings: piece n is frame n, whose result is that of this frame alone."""

    boards: EmulatedBoards
    readings: Readings
    model: Model | None
    banks: int
    replicas: int
    own: Filter | None

    def prepare(self) -> Work:
        """Return the function that runs the readings of a frame."""
        belief = None if self.own is None else self.own.transition.start

        def measured(frame: int) -> _Results:
            nonlocal belief
            found = _Results(self.banks)
            for place in range(frame * self.replicas, (frame + 1) * self.replicas):
                exact = codes = None
                if self.own is not None and belief is not None:
                    belief, codes = self.own.transition.after(belief), self.own.predict()
                if self.model is not None:
                    addresses, row = self.readings.of_model(place)
                    try:
                        exact = exact_posterior(self.model, addresses, prior_address=row, prior=belief)
                    except ModelError:
                        found.unlikely += 1
                last = found.add(
                    self.boards, self.readings, place, frame, exact, codes, compare=self.model is not None
                )
                if self.own is not None:
                    self.own.update(last)
                    belief = belief if exact is None else exact
            return found

        return measured


@dataclass(slots=True)
class _Results:
    """Results of some readings; `lengths` are cycles with each bank, by frame and replica.

    `places` are those of the readings that are possible in the codes, with their written prior.
    """

    banks: int
    of_machine: _Differences = field(default_factory=_Differences)
    of_codes: _Differences = field(default_factory=_Differences)
    of_sampling: _Differences = field(default_factory=_Differences)
    lengths: dict[int, list[list[int]]] = field(default_factory=dict)
    places: dict[int, NDArray[np.uint16] | None] = field(default_factory=dict)
    unlikely: int = 0
    """Readings that are impossible in the model."""
    posteriors: int = 0
    impossible: int = 0
    without: int = 0
    overflow: int = 0

    def take(self, other: "_Results") -> None:
        """Add the results of other frames."""
        for name in ("of_machine", "of_codes", "of_sampling"):
            getattr(self, name).take(getattr(other, name))
        self.lengths |= other.lengths
        self.places |= other.places
        for name in ("unlikely", "posteriors", "impossible", "without", "overflow"):
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def add(
        self,
        boards: EmulatedBoards,
        readings: Readings,
        place: int,
        frame: int,
        exact: _Posterior,
        prior: NDArray[np.uint16] | None,
        *,
        compare: bool,
    ) -> _Posterior:
        """Run the reading at an index with every bank, and compare it with `exact`, the posterior of the model, if any.

        `prior` is a written one. Return the posterior of the last bank.
        """
        inputs, prior_row = readings.of_machine(place, boards.machines[0])
        likelihood = _line_probabilities(boards, inputs, prior_row, prior)
        numbers = [(frame * self.banks + run) % boards.parameters.rng_banks for run in range(self.banks)]
        ran = [boards.run(inputs, prior_row, bank, prior) for bank in numbers]
        posteriors = [each.posterior for each in ran]
        self.posteriors += 1
        self.without += sum(each is None for each in posteriors)
        self.overflow += sum(any(reason.name == "OVERFLOW" for reason in each.reasons) for each in ran)
        self.lengths.setdefault(frame, []).append([each.length for each in ran])
        of_codes = fuse(likelihood, ()) if likelihood.any() else None
        if of_codes is None:
            self.impossible += 1
        else:
            self.places[place] = prior
        self.of_sampling.add(frame, posteriors, of_codes)
        if compare:
            self.of_codes.add(frame, [of_codes], exact)
            self.of_machine.add(frame, posteriors, exact)
        return posteriors[-1]

    def summary(self, boards: EmulatedBoards, readings: Readings, run: Run) -> Accuracy:
        """Return the statistics over all frames."""
        frames = sorted(self.lengths)
        lengths = np.array([np.max(self.lengths[frame], axis=0) for frame in frames])
        # the z-score of a count uses the cycles of single replicas
        by_themselves = np.array([length for frame in frames for length in self.lengths[frame]])
        runs = self.posteriors * self.banks
        z = None
        if (by_themselves > 0).any():
            usual = int(np.median(by_themselves[by_themselves > 0]))
            z = _z_scores(_Counts(boards, readings, self.places, usual), run)
        return Accuracy(
            frames=len(self.lengths),
            posteriors=self.posteriors,
            banks=self.banks,
            impossible=self.impossible / self.posteriors,
            without=self.without / runs,
            overflow=self.overflow / runs,
            machine=self.of_machine.summary(),
            quantising=self.of_codes.summary(),
            sampling=self.of_sampling.summary(),
            z=z,
            cycles=Cycles.of(lengths),
        )


def addressed_chances(
    machine: BM1Machine, addresses: Inputs, prior_address: int, prior: NDArray[np.uint16] | None = None
) -> NDArray[np.float64]:
    """Return the probability that each cell gives a 1 in a cycle: float64[columns, lines], the prior first."""
    frame = Start(
        addresses=addresses, prior_address=prior_address, prior_codes=prior, target_count=1, max_cycles=1
    )
    return decode_code(addressed_codes(machine, frame), machine.parameters.prob_bits)


def _line_probabilities(
    boards: EmulatedBoards, inputs: Inputs, prior_address: int, prior: NDArray[np.uint16] | None
) -> NDArray[np.float64]:
    """Return the probability that each line of all boards counts in a cycle: float64[lines]."""
    machines = boards.machines
    parts = zip(machines, inputs_of_boards(inputs, machines), priors_of_boards(prior, machines), strict=True)
    chances = [addressed_chances(machine, own, prior_address, codes) for machine, own, codes in parts]
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
    """The job of comparing counts with equation 2.1: piece n is the reading at index n, run for a number of cycles."""

    boards: EmulatedBoards
    readings: Readings
    places: dict[int, NDArray[np.uint16] | None]
    cycles: int

    def prepare(self) -> Work:
        """Return the function for a reading: sums of z^2, of z and of 1, and the number beyond 3; None without counts."""

        def compared(place: int) -> tuple[NDArray[np.float64], int] | None:
            boards, prior, cycles = self.boards, self.places[place], self.cycles
            addresses, row = self.readings.of_machine(place, boards.machines[0])
            chance = _line_probabilities(boards, addresses, row, prior)
            ran = boards.run_for(addresses, row, place % boards.parameters.rng_banks, cycles, prior)
            looked_at = (chance * cycles >= EXPECTED_COUNT) & (chance < 1)
            if not looked_at.any():
                return None
            p = chance[looked_at]
            z = (np.concatenate(ran.counts)[looked_at] - cycles * p) / np.sqrt(cycles * p * (1 - p))
            return np.array([(z**2).sum(), z.sum(), len(z)]), int((np.abs(z) > 3).sum())

        return compared


def _z_scores(job: _Counts, run: Run) -> ZScores | None:
    found: dict[int, tuple[NDArray[np.float64], int] | None] = {}
    run(job, sorted(job.places), found.__setitem__)
    # Frames with the same bank share all random numbers, so a bank is one draw for all of them.
    free = job.boards.parameters.rng_reset is RngReset.FREE
    drawn: dict[int, NDArray[np.float64]] = {}
    beyond = 0
    for place in sorted(found):  # the sum of floats depends on their order
        if (each := found[place]) is not None:
            key = place if free else place % job.boards.parameters.rng_banks
            drawn[key] = drawn[key] + each[0] if key in drawn else each[0]
            beyond += each[1]
    if not drawn:
        return None
    table = np.array(list(drawn.values()))
    counts = int(table[:, 2].sum())

    return ZScores(
        cycles=job.cycles,
        counts=counts,
        draws=len(table),
        rms=bootstrap_rows(table, lambda rows: math.sqrt(rows[:, 0].sum() / rows[:, 2].sum())),
        mean=bootstrap_rows(table, lambda rows: float(rows[:, 1].sum() / rows[:, 2].sum())),
        beyond_three=beyond / counts,
    )
