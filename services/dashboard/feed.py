"""The state that the dashboard shows: the last frames, the times of their stages, rate and losses.

    frame outcomes ──▶ Feed ──▶ frames (the last 1000), stage times (means per second), rate, losses by reason

The feed has no clock and no connection. The caller gives the time of each frame.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Final

import numpy as np

from machines.bm2_estimate import AGREE, standard_error
from posteriors.frame_report import FrameReport, StageTimes
from posteriors.pairing import FrameOutcome
from posteriors.posterior import REPLICA, Posterior

if TYPE_CHECKING:
    from numpy.typing import NDArray

KEPT_FRAMES: Final = 1000
KEPT_BYTES: Final = 128 << 20
"""Maximum size of all kept posteriors together, in bytes. Of large posteriors, fewer than `KEPT_FRAMES` are kept."""
STAGE_SECONDS: Final = 300
RATE_SECONDS: Final = 5
STAGES: Final = tuple(each.name for each in fields(StageTimes) if each.name != "boards_compute")
"""The consecutive stages of a frame. `boards_compute` is omitted: it is a part of `compute`."""
OTHER: Final = "other reasons"
_MAX_REASONS: Final = 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeptFrame:
    """A frame in the feed. If the frame has no posterior, `values` is None. Frames are compared by identity."""

    at: int
    """Number of the frame in the order of arrival, counted from 1."""
    heard_ns: int
    values: "NDArray[np.float32] | None" = None
    labels: tuple[str, ...] = ()
    report: FrameReport | None = None
    statistics: Mapping[str, str] = field(default_factory=dict)
    """Statistics of a BM2's samples, by their keys in `/bm/frame`."""
    truth: tuple[float, float] | None = None
    """The true position (x, y) of the simulated robot when the frame arrived."""

    @property
    def searched(self) -> tuple[str, ...]:
        """The labels of the searched variables, without the label `replica`."""
        return tuple(label for label in self.labels if label != REPLICA)

    @property
    def form(self) -> object:
        """The labels and shape of the posterior, or False without a posterior."""
        return self.values is not None and (self.labels, self.values.shape)

    def sampling_error(self, probabilities: "NDArray[np.float64]") -> "NDArray[np.float64] | None":
        """Return the standard error of each probability, or None if the frame has no statistics of samples (a BM1)."""
        effective = self._statistic("effective_samples")
        error = standard_error(probabilities, effective if 1 <= effective < math.inf else math.nan)
        # boards that disagree do not know each value's error, so the error of the worst value is used
        if self._statistic("r_hat") > AGREE or np.isnan(error).any():
            worst = self._statistic("standard_error")
            error = np.fmax(error, worst if 0 <= worst <= 1 else math.nan)
        return None if np.isnan(error).any() else error

    def _statistic(self, key: str) -> float:
        try:
            return float(self.statistics.get(key, math.nan))
        except ValueError:
            return math.nan

    def marginal(self, labels: tuple[str, ...]) -> "NDArray[np.float64]":
        """Return the marginal over one or two variables, with the axes in the order of `labels`.

        One of `labels` may be `replica`. The whole array still sums to 1, so the part of a single replica sums to less
        than 1.
        """
        if self.values is None:
            raise ValueError("a frame without a posterior has no marginal")
        places = [self.labels.index(label) for label in labels]
        others = tuple(at for at in range(len(self.labels)) if at not in places)
        summed = self.values.sum(axis=others, dtype=np.float64)
        if places != sorted(places):
            summed = summed.T
        return np.asarray(summed / summed.sum())


@dataclass(slots=True)
class _Second:
    """The frames of one second: their number, and for each stage the sum and the number of its times."""

    start: int
    frames: int = 0
    sums: list[float] = field(default_factory=lambda: [0.0] * len(STAGES))
    counts: list[int] = field(default_factory=lambda: [0] * len(STAGES))


class Feed:
    """The frames of the page, the newest last.

    Attributes:
        frames: The last frames, at most `KEPT_FRAMES`.
        truth: Newest true position (x, y) of the simulated robot, or None if there is none.
        watchers: Functions called during each change. The feed is incomplete then, so a watcher must not read it.
        lost: Number of frames without a posterior, by reason. Beyond `_MAX_REASONS` reasons, new reasons share `OTHER`.
    """

    def __init__(self) -> None:
        self.frames: deque[KeptFrame] = deque(maxlen=KEPT_FRAMES)
        self.truth: tuple[float, float] | None = None
        self.watchers: set[Callable[[], None]] = set()
        self.lost: Counter[str] = Counter()
        # Frames so far: the number of the newest one.
        self._count = 0
        # Bytes of the posteriors in `frames`.
        self._bytes = 0
        # One for each second with frames, the newest last; those older than `STAGE_SECONDS` are removed.
        self._seconds: deque[_Second] = deque()

    @property
    def newest(self) -> KeptFrame | None:
        """The newest frame, or None before the first frame."""
        return self.frames[-1] if self.frames else None

    def frame(self, at: int) -> KeptFrame | None:
        """Return the kept frame whose number is nearest to `at`, or None before the first frame."""
        if not self.frames:
            return None
        return self.frames[min(max(at - self.frames[0].at, 0), len(self.frames) - 1)]

    def add(self, outcome: FrameOutcome, now_s: float) -> KeptFrame:
        """Add a frame and call the watchers. `now_s` is the frame's time on a monotonic clock, in seconds."""
        report = outcome.report if isinstance(outcome, Posterior) else outcome
        details = report.details if report else outcome.details
        values = None
        if isinstance(outcome, Posterior):
            # scaled before the conversion to float32, whose range is smaller; by the maximum first: a sum may be tiny
            relative = outcome.values / outcome.values.max()
            values = (relative * (outcome.replicas / relative.sum())).astype(np.float32)
        else:
            self.add_loss(outcome.outcome or "no reason given")
        self._count += 1
        frame = KeptFrame(
            at=self._count,
            heard_ns=outcome.heard_ns,
            values=values,
            labels=outcome.labels if isinstance(outcome, Posterior) else (),
            report=report,
            statistics=details,
            truth=self.truth,
        )
        self._keep(frame)
        self._time(report, now_s)
        self.changed()
        return frame

    def add_loss(self, reason: str) -> None:
        """Count a frame without a posterior by its reason. After `_MAX_REASONS` reasons, new ones count as `OTHER`."""
        known = reason in self.lost or len(self.lost) < _MAX_REASONS
        self.lost[reason if known else OTHER] += 1

    def changed(self) -> None:
        """Tell the watchers that something is new."""
        for watcher in tuple(self.watchers):
            watcher()

    def rate(self, now_s: float) -> float:
        """Return the mean frames per second in the last `RATE_SECONDS` whole seconds."""
        last = int(now_s)
        recent = [each for each in self._seconds if last - RATE_SECONDS <= each.start < last]
        # from the first frame on, as in the other processes' rates
        first = self._seconds[0].start if self._seconds else last
        return sum(each.frames for each in recent) / max(min(RATE_SECONDS, last - first), 1)

    def stage_times(self, now_s: float) -> list[tuple[int, list[float]]]:
        """Return the mean times of the stages in each recent second, the oldest second first.

        Each row contains the age of a second in seconds, and the mean time of each stage in microseconds.
        """
        rows = []
        for second in self._seconds:
            means = [total / max(count, 1) for total, count in zip(second.sums, second.counts, strict=True)]
            if (age := int(now_s) - second.start) <= STAGE_SECONDS and any(second.counts):
                rows.append((age, [round(mean, 1) for mean in means]))
        return rows

    def _keep(self, frame: KeptFrame) -> None:
        if len(self.frames) == KEPT_FRAMES:
            self._forget()
        self.frames.append(frame)
        self._bytes += frame.values.nbytes if frame.values is not None else 0
        while self._bytes > KEPT_BYTES and len(self.frames) > 1:
            self._forget()

    def _forget(self) -> None:
        values = self.frames.popleft().values
        self._bytes -= values.nbytes if values is not None else 0

    def _time(self, report: FrameReport | None, now_s: float) -> None:
        if not self._seconds or self._seconds[-1].start != int(now_s):
            self._seconds.append(_Second(int(now_s)))
            while self._seconds[0].start < int(now_s) - STAGE_SECONDS:
                self._seconds.popleft()
        second = self._seconds[-1]
        second.frames += 1
        if report is None:
            return
        for at, stage in enumerate(STAGES):
            if (time := getattr(report.stages, stage)) is not None:
                second.sums[at] += time
                second.counts[at] += 1
