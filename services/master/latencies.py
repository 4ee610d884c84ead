"""Latencies of the stages of published frames, for `status` and the metrics."""

from bisect import bisect_left

import numpy as np

from services.sockets.records import Publish, Published
from services.sockets.status import BUCKETS_S, StageLatency

REMEMBERED = 1000
"""Number of frames over which quantiles are computed."""

_STAGES = (
    *("rosbridge_in", "waited", "register_writes", "compute", "reads", "rosbridge_out"),
    *("local_hops", "frame"),
)
"""The stages in the order of a frame's path, the time between the processes, and the whole frame."""


class Latencies:
    """Quantiles over the last published frames, and counts over all of them."""

    def __init__(self) -> None:
        # A ring with a row for each of the last frames and a column for each stage, in ns.
        self._times = np.zeros((REMEMBERED, len(_STAGES)), np.int64)
        # Over all frames: their number, and for each stage the sum and the counts of the buckets.
        self._frames = 0
        self._sums_ns = [0] * len(_STAGES)
        self._counts = [[0] * (len(BUCKETS_S) + 1) for _ in _STAGES]

    def add(self, publish: Publish, published: Published) -> None:
        """Add a published frame."""
        result, total = publish.result, published.total_ns
        stages = (
            publish.reading_sent_tick - publish.received_tick,
            publish.waited_ns,
            *(result.register_writes_ns, result.compute_ns, result.reads_ns),
            published.out_ns,
        )
        times = [max(0, time) for time in (*stages, total - sum(stages), total)]
        self._times[self._frames % REMEMBERED] = times
        self._frames += 1
        for at, time in enumerate(times):
            self._sums_ns[at] += time
            self._counts[at][bisect_left(BUCKETS_S, time / 1e9)] += 1

    def summary(self) -> list[StageLatency]:
        """Return the latencies of each stage; none before the first frame."""
        known = min(self._frames, REMEMBERED)
        if not known:
            return []
        p50, p99 = np.percentile(self._times[:known], (50, 99), axis=0, method="nearest") / 1e6
        return [
            StageLatency(
                stage=stage,
                p50_ms=round(float(p50[at]), 3),
                p99_ms=round(float(p99[at]), 3),
                frames=self._frames,
                sum_s=self._sums_ns[at] / 1e9,
                buckets=list(self._counts[at]),
            )
            for at, stage in enumerate(_STAGES)
        ]
