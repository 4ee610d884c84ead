"""The last frames of a run: the stages and the outcome of each, and latencies over all of them."""

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from machines.bm1 import StopReason
from services.pipeline.inference import REASON_WORDS
from services.sockets.frame_timeline import BoardOutcome, FrameTimeline, StageSpan
from services.sockets.records import FrameResult, Published, Reading
from services.sockets.status import BUCKETS_S, StageLatency

REMEMBERED = 1000
"""Number of frames of which a master remembers each stage; about 1 MB."""

ON_THE_BOARDS = "on the boards"
AT_THE_PUBLISHER = "at the publisher"

FRAME = "frame"
"""The whole frame as a stage: from the receipt of the reading until the result has been sent."""
_WHERE = {
    "rosbridge_in": "subscriber",
    "waited": "master",
    "register_writes": "pcie-app",
    "compute": "pcie-app and boards",
    "reads": "pcie-app",
    "rosbridge_out": "publisher",
}
_STAGES = (*_WHERE, "local_hops", FRAME)


@dataclass(slots=True)
class FrameTrace:
    """The times of a frame, as they become known; those ending in `_tick` are monotonic, in ns."""

    number: int
    bank: int
    stamp_ns: int
    received_ns: int
    received_tick: int
    reading_sent_tick: int
    arrived_tick: int
    sent_tick: int
    outcome: str = ON_THE_BOARDS
    why: str = ""
    result: tuple[int, int, int, int] | None = None
    """Begin of the register writes, and the durations of register writes, computing and reads."""
    published: Published | None = field(default=None, repr=False)

    def spans(self) -> dict[str, tuple[int, int]]:
        """Return the begin (monotonic) and the duration of each stage that the frame has reached, in ns."""
        spans = {
            "rosbridge_in": (self.received_tick, self.reading_sent_tick - self.received_tick),
            "waited": (self.arrived_tick, self.sent_tick - self.arrived_tick),
        }
        if self.result is not None:
            began, *durations = self.result
            for stage, duration in zip(("register_writes", "compute", "reads"), durations, strict=True):
                spans[stage] = (began, duration)
                began += duration
        if self.published is not None and self.published.total_ns:
            out_ns = self.published.out_ns
            spans["rosbridge_out"] = (self.received_tick + self.published.total_ns - out_ns, out_ns)
        return spans

    def timeline(self) -> FrameTimeline:
        """Return the frame as it is reported to the user."""
        spans, published = self.spans(), self.published
        total_ns = published.total_ns if published is not None else 0
        hops_ns = total_ns - sum(duration for _, duration in spans.values())
        return FrameTimeline(
            number=self.number,
            outcome=self.outcome,
            why=self.why,
            bank=self.bank,
            stamp_ns=self.stamp_ns,
            received_ns=self.received_ns,
            stages=[
                StageSpan(stage, _WHERE[stage], _ms(began - self.received_tick), _ms(duration))
                for stage, (began, duration) in spans.items()
            ],
            local_hops_ms=_ms(max(0, hops_ns)) if total_ns else None,
            total_ms=_ms(total_ns) if total_ns else None,
            cycles=published.cycles if published is not None and published.boards else None,
            boards=[
                BoardOutcome(index, cycles, REASON_WORDS[StopReason(reason)])
                for index, (cycles, reason) in enumerate(published.boards if published is not None else ())
            ],
        )


def _ms(nanoseconds: int) -> float:
    return round(nanoseconds / 1e6, 3)


class FrameHistory:
    """The last frames of a run, and the latencies of all published ones."""

    def __init__(self) -> None:
        self._traces: deque[FrameTrace] = deque(maxlen=REMEMBERED)
        self._times = np.zeros((REMEMBERED, len(_STAGES)), np.int64)
        self._counts = [[0] * (len(BUCKETS_S) + 1) for _ in _STAGES]
        self._sums_ns = [0] * len(_STAGES)
        self._timed = 0

    def sent(self, number: int, bank: int, reading: Reading, ticks: tuple[int, int]) -> None:
        """Remember a frame that goes to the boards; `ticks` are its arrival and now."""
        self._traces.append(
            FrameTrace(
                number,
                bank,
                reading.stamp_ns,
                reading.received_ns,
                reading.received_tick,
                reading.sent_tick,
                *ticks,
            )
        )

    def computed(self, result: FrameResult) -> None:
        """Remember the durations on the boards."""
        trace = self._trace(result.number)
        if trace is not None:
            trace.outcome = AT_THE_PUBLISHER
            trace.result = (
                result.began_tick,
                result.register_writes_ns,
                result.compute_ns,
                result.reads_ns,
            )

    def ended(self, published: Published, outcome: str) -> None:
        """Remember the outcome of a result, and the latencies of a published one."""
        trace = self._trace(published.number)
        if trace is None:
            return
        trace.outcome, trace.published = outcome, published
        if outcome == "published" and trace.result is not None:
            self._time(trace, published.total_ns)

    def lost(self, number: int, reason: str, why: str = "") -> None:
        """Remember that a frame was lost."""
        trace = self._trace(number)
        if trace is not None:
            trace.outcome, trace.why = reason, why

    def lost_at_publisher(self, reason: str) -> None:
        """Remember that the results at the publisher were lost; they are the newest ones."""
        for trace in self._traces:
            if trace.outcome == AT_THE_PUBLISHER:
                trace.outcome = reason

    def timeline(self, number: int) -> FrameTimeline | str:
        """Return a frame, or a sentence that says why it is not known."""
        trace = self._trace(number)
        if trace is not None:
            return trace.timeline()
        if not self._traces:
            return f"frame {number} is not known: this run has not sent a frame to the boards yet"
        first, last = self._traces[0].number, self._traces[-1].number
        if number > last:
            return f"frame {number} is not known: the last one of this run is {last}"
        if number < 1:
            return f"frame {number} is not known: the first one of a run is 1"
        return f"frame {number} is not remembered any more: the master has the frames {first} to {last}"

    def latencies(self) -> list[StageLatency]:
        """Return the latencies: quantiles over the remembered frames, and counts over all published ones."""
        known = min(self._timed, REMEMBERED)
        if not known:
            return []
        p50, p99 = np.percentile(self._times[:known], (50, 99), axis=0, method="nearest") / 1e6
        return [
            StageLatency(
                stage=stage,
                p50_ms=round(float(p50[at]), 3),
                p99_ms=round(float(p99[at]), 3),
                frames=self._timed,
                sum_s=self._sums_ns[at] / 1e9,
                buckets=list(self._counts[at]),
            )
            for at, stage in enumerate(_STAGES)
        ]

    def _time(self, trace: FrameTrace, total_ns: int) -> None:
        times = [max(0, duration) for _, duration in trace.spans().values()]
        times += (max(0, total_ns - sum(times)), total_ns)
        self._times[self._timed % REMEMBERED] = times
        self._timed += 1
        for at, duration in enumerate(times):
            self._sums_ns[at] += duration
            self._counts[at][bisect_left(BUCKETS_S, duration / 1e9)] += 1

    def _trace(self, number: int) -> FrameTrace | None:
        """Return a remembered frame; the numbers of a run are consecutive."""
        at = number - self._traces[0].number if self._traces else -1
        return self._traces[at] if 0 <= at < len(self._traces) else None
