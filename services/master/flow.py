"""Flow of frames through a run: waiting, computing, publishing (thesis 3.3, figure 3.4).

subscriber ─reading─▶ [waiting] ─frame─▶ pcie-app ─result─▶ publisher ─outcome─▶ counted
"""

import asyncio
import time
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from services.child import RESTARTS
from services.errors import (
    BoardFailedError,
    OverflowedQueueError,
    ReportedError,
    RosbridgeLostError,
    VariableError,
)
from services.master.peers import ANSWER_TIME, Awaited, Peer, Peers
from services.settings import Settings
from services.sockets.records import (
    AnyRecord,
    FailureReason,
    FrameFailed,
    FrameRequest,
    FrameResult,
    LossReason,
    Notice,
    Outcome,
    Publish,
    Published,
    Reading,
    Seen,
    Unusable,
)
from services.sockets.status import BUCKETS_S, FrameCounts, StageLatency
from terminal.logs import Logger
from toolchain.deployment import Deployment

# the boards, whose start takes longest, must not wait for NumPy
if TYPE_CHECKING:
    from toolchain.deployment.filter import Filter

QUEUE_ALL_DEPTH = 256
"""With `queue = all`, at most this many frames wait. One more frame ends the run with an error."""
MOST_AT_PUBLISHER = 8
"""Maximum number of results that the publisher has not acknowledged. At this number, no further frame starts."""

REMEMBERED = 1000
"""Quantiles of latencies are computed over the last published frames, at most this many."""

_STAGES = (
    *("rosbridge_in", "waited", "register_writes", "compute", "reads", "rosbridge_out"),
    *("local_hops", "frame"),
)
"""The stages in the order in which a frame passes them, then the time between processes, and the whole frame."""

_LOSSES = {
    Outcome.NO_POSTERIOR: LossReason.NO_POSTERIOR,
    Outcome.ROSBRIDGE_AWAY: LossReason.ROSBRIDGE_AWAY,
    Outcome.REFUSED: LossReason.REFUSED,
}


@dataclass(frozen=True, slots=True)
class _WaitingReading:
    """A reading that waits for the boards, and the time of its arrival (monotonic, ns).

    `steps` is 1 plus the number of readings dropped since the previous frame: a filter predicts that many frames.
    """

    reading: Reading
    arrived: int
    steps: int


@dataclass(frozen=True, slots=True)
class _Computing:
    """The frame on the boards, and the time when it was sent there (monotonic, ns)."""

    number: int
    waiting: _WaitingReading
    sent: int


class Latencies:
    """Latencies of published frames: quantiles over the last `REMEMBERED` frames, and histograms over all frames."""

    def __init__(self) -> None:
        # A row for each of the last frames, with a column for each stage, in ns.
        self._times: deque[list[int]] = deque(maxlen=REMEMBERED)
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
        times = [max(0, spent) for spent in (*stages, total - sum(stages), total)]
        self._times.append(times)
        self._frames += 1
        for at, spent in enumerate(times):
            self._sums_ns[at] += spent
            self._counts[at][bisect_left(BUCKETS_S, spent / 1e9)] += 1

    def summary(self) -> list[StageLatency]:
        """Return the latencies of each stage, or an empty list if no frame has been published yet."""
        if not self._frames:
            return []
        import numpy as np  # not before the boards have started, which takes longest

        p50, p99 = np.percentile(np.array(self._times), (50, 99), axis=0, method="nearest") / 1e6
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


class FrameFlow:
    """The frames of a run, from reading to outcome. At most one frame is on the boards."""

    def __init__(
        self,
        settings: Settings,
        deployment: Deployment,
        peers: Peers,
        log: Logger,
        *,
        once: bool,
        count: int | None,
        show: Callable[[Published], None],
    ) -> None:
        """Start without frames. If `once` is set, one frame ends the run. If `count` is set, `count` results end it."""
        self._settings = settings
        self._deployment = deployment
        self._peers = peers
        self._log = log
        self._follows = settings.log_level == "debug"
        self._once = once
        self._count = count
        self._show = show
        # A frame is in one of three places, in this order. `_send_next` moves the next one to the boards whenever
        # something changes that may have held it back: a reading, a result, an outcome, or a peer that is ready again.
        # Of the readings that wait, only the newest is kept, or all in order (`queue`).
        self._readings: deque[_WaitingReading] = deque()
        self._keeps_all = (settings.queue or deployment.queue) == "all"
        self._computing: _Computing | None = None
        self._at_publisher: dict[int, Publish] = {}
        # Start of the publisher's time limit (monotonic, s): when the first of these results was sent to it, or its
        # last outcome arrived.
        self._published_at = 0.0
        # Number of the last frame sent to the boards; it also chooses the bank of the generators.
        self._number = 0
        # For the status: complete readings so far, and the number of the last published frame with its time (ns).
        self._received = 0
        self._last = (0, 0)
        # The belief of a deployment with [filter]: the prediction for the last frame sent to the boards, and after its
        # result the posterior. It outlives boards and pcie-app; a lost frame leaves the prediction.
        self._filter = deployment.new_filter()
        # Readings that were lost since the last one in `_readings`: steps of the filter without an update. The
        # subscriber counts messages, and a reading takes one of each topic; `_messages` is the remainder, less than a
        # reading.
        self._skipped = self._messages = 0
        self.losses: Counter[LossReason] = Counter()
        """Readings and results lost so far, by reason."""
        # Causes of unusable messages, and of frames without a posterior or with a biased one: the user is warned once
        # of each.
        self._reported_causes: set[str] = set()
        self.latencies = Latencies()
        """Latencies of the published frames."""
        # Times of the last frames that failed on a board, as many as may fail within `restart_window` and one more.
        self._failures: deque[float] = deque(maxlen=RESTARTS + 1)
        self.published = 0
        """Number of results that reached at least one topic."""
        self.seen: bool | None = None
        """With `--loop`, whether the publisher received one of its results back; None until it knows."""
        self.looked = asyncio.Event()
        """Set when `seen` is known."""
        self.newest: Publish | None = None
        """The newest result that went to the publisher."""
        self.first_reading_at: float | None = None
        """Monotonic time of the first complete reading."""
        self.has_data = False
        """True if a message has arrived, usable or not."""
        self.end: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Completed at the end of the run, with its error if any."""

    def fail(self, error: Exception) -> None:
        """End the run with an error."""
        if not self.end.done():
            self.end.set_exception(error)

    def counts(self) -> FrameCounts:
        """Return the counts for the status."""
        return FrameCounts.of(self._received, self.published, self.losses, self._last)

    @property
    def is_idle(self) -> bool:
        """True while no frame waits, is computed or is being published."""
        return not self._readings and self._computing is None and not self._at_publisher

    # --- events at the peers -------------------------------------------------------------------

    def ready(self, peer: Peer) -> None:
        """Handle a peer that has become ready. If a frame was waiting for this peer, send the frame."""
        if peer is not self._peers.subscriber:
            self._send_next()

    def received(self, peer: Peer, record: AnyRecord) -> None:
        """Handle a record about a reading, a frame or a result."""
        match record:
            case Reading():
                self._take_reading(record)
            case Unusable():
                self._take_unusable(record)
            case FrameResult():
                self._take_result(record)
            case FrameFailed():
                self._take_failure(record)
            case Published():
                self._take_outcome(record)
            case Seen():
                self.seen = record.seen
                self.looked.set()
            case _:
                where, what = peer.protocol.where if peer.protocol else peer.role, type(record).__name__
                self._log.warning(f"{where} sent a {what}, which only another service may send")

    def lost(self, peer: Peer) -> None:
        """Handle the loss of a peer. Count the frame or the results at the peer as lost."""
        if peer is self._peers.app and self._computing is not None:
            self.losses[LossReason.WITH_APP] += 1
            if self._follows:
                number, reason = self._computing.number, LossReason.WITH_APP
                self._log.debug(reason, frame=number, _reason=reason)
            self._computing = None
        if peer is self._peers.publisher and self._at_publisher:
            self.losses[LossReason.WITH_PUBLISHER] += len(self._at_publisher)
            self._at_publisher.clear()

    def awaited(self, peer: Peer) -> Awaited | None:
        """Return what a peer still has to do (answer a frame, or publish results) and by when, or None if nothing."""
        if peer is self._peers.app and self._computing is not None:
            what, since = f"answer frame {self._computing.number}", self._computing.sent / 1e9
            return Awaited(what, since, self._settings.board_timeout + ANSWER_TIME)
        if peer is self._peers.publisher and self._at_publisher:
            return Awaited("publish", self._published_at, self._settings.seen_timeout + ANSWER_TIME)
        return None

    # --- from reading to outcome ---------------------------------------------------------------

    def _take_reading(self, reading: Reading) -> None:
        self.has_data = True
        if self._once and self._number:
            # the run ends with the first frame, which is on its way
            return
        self._received += 1
        if self.first_reading_at is None:
            self.first_reading_at = time.monotonic()
        self.losses[LossReason.PASSED_OVER] += reading.passed_over
        self.losses[LossReason.UNPAIRED] += reading.unpaired
        steps, self._messages = divmod(self._messages + reading.passed_over, len(self._deployment.sources))
        self._skipped += steps
        if self._peers.publisher.away and not self._once:
            # computing it would only delay a later one, whose result can be received
            self.losses[LossReason.ROSBRIDGE_AWAY] += 1
            self._skipped += 1
            return
        if not self._keeps_all:
            self.losses[LossReason.PASSED_OVER] += len(self._readings)
            self._skipped += sum(each.steps for each in self._readings)
            self._readings.clear()
        # an error instead of a loss, because a user who chose `queue = all` wants every result
        elif len(self._readings) >= QUEUE_ALL_DEPTH:
            self.fail(
                OverflowedQueueError(
                    f"{QUEUE_ALL_DEPTH} frames wait for the boards and more come in: the boards (pcie-app) are the slow part; "
                    "publish more slowly, lower the target count, or use queue = latest"
                )
            )
            return
        self._readings.append(_WaitingReading(reading, time.monotonic_ns(), 1 + self._skipped))
        self._skipped = 0
        self._send_next()

    def _take_unusable(self, record: Unusable) -> None:
        self.has_data = True
        if self._once:
            self.fail(VariableError(record.sentence))
            return
        self.losses[LossReason.UNUSABLE] += 1
        self._skipped += 1
        self._warn_once(record.cause, f"{record.sentence}; such messages are skipped and counted")

    def _warn_once(self, cause: str, sentence: str) -> None:
        if cause not in self._reported_causes:
            self._reported_causes.add(cause)
            self._log.warning(sentence)

    def _send_next(self) -> None:
        app = self._peers.app
        if self._computing is not None or not app.ready or app.protocol is None:
            return
        if len(self._at_publisher) >= MOST_AT_PUBLISHER or not self._peers.publisher.ready:
            return
        if self._count is not None and self.published + len(self._at_publisher) >= self._count:
            # wait until it is known whether the results at the publisher are enough
            return
        if not self._readings:
            return
        waiting = self._readings.popleft()
        self._number += 1
        reading, number = waiting.reading, self._number
        bank = number % self._deployment.machine.rng_banks
        self._computing = _Computing(number, waiting, time.monotonic_ns())
        codes = reading.prior_codes if self._filter is None else self._predict(self._filter, waiting.steps)
        app.protocol.send(FrameRequest(number, reading.addresses, bank, codes))
        if self._follows:
            self._follow(number, bank, waiting)

    def _predict(self, own: "Filter", steps: int) -> bytes:
        """Predict the filter's belief for the next frame, `steps` ahead, and return it as prior codes."""
        if self._number == 1:
            self._log.info("the filter begins with its start distribution")
            steps = 1  # nothing happened before the first frame
        if steps > own.most_steps:
            sentence = f"{steps - 1} readings were lost before frame {self._number}, and the filter predicts {own.most_steps} at most"
            self._warn_once("steps", f"{sentence}; later ones are not reported")
        return own.predict(steps).astype("<u2").tobytes()

    def _follow(self, number: int, bank: int, waiting: _WaitingReading) -> None:
        """Log a sent frame, and send its number to the subscriber, which logs it too."""
        waited = (time.monotonic_ns() - waiting.arrived) // 1000
        self._log.debug("handed on to pcie-app", frame=number, bank=bank, waited_us=waited)
        subscriber, reading = self._peers.subscriber.protocol, waiting.reading
        if subscriber is not None:
            taken = (reading.sent_tick - reading.received_tick) // 1000
            times = f"stamp_ns={reading.stamp_ns} received_ns={reading.received_ns} taken_us={taken}"
            subscriber.send(Notice("debug", f"complete frame={number} {times}"))

    def _take_result(self, result: FrameResult) -> None:
        computing = self._computing
        # a frame that was counted as lost with a former pcie-app
        if computing is None or computing.number != result.number:
            return
        self._computing = None
        if self._filter is not None:
            from services.pipeline.inference import infer

            self._filter.update(infer(result, self._deployment).posterior)
        reading = computing.waiting.reading
        publisher = self._peers.publisher.protocol
        record = Publish(
            result=result,
            stamp_ns=reading.stamp_ns,
            received_ns=reading.received_ns,
            received_tick=reading.received_tick,
            reading_sent_tick=reading.sent_tick,
            waited_ns=computing.sent - computing.waiting.arrived,
            # arrays may be large, and a report has none
            addresses=[-1 if isinstance(each, list) else each for each in reading.addresses],
            values=reading.values,
            ticks=reading.ticks,
        )
        if not self._at_publisher:
            self._published_at = time.monotonic()
        self.newest = record
        # before sending: a publisher in this process answers at once
        self._at_publisher[result.number] = record
        if publisher is None or not publisher.send(record):
            del self._at_publisher[result.number]
            self.losses[LossReason.WITH_PUBLISHER] += 1
        self._send_next()

    def _take_failure(self, record: FrameFailed) -> None:
        if self._computing is not None and self._computing.number == record.number:
            self._computing = None
        if self._once:
            self.fail(ReportedError(record.exit_code, record.sentence))
            return
        self.losses[LossReason.FAILED] += 1
        if record.reason is FailureReason.FAILED:
            now, window = time.monotonic(), self._settings.restart_window
            self._failures.append(now)
            recent = sum(1 for each in self._failures if now - each <= window)
            if recent > RESTARTS:
                often = f"{recent} frames failed on boards within {window:g} s"
                self.fail(BoardFailedError(f"{record.sentence}; {often}"))
                return
            self._log.warning(record.sentence, frame=record.number, _reason=LossReason.FAILED)
        elif self._follows:
            self._log.debug(record.sentence, frame=record.number, _reason=LossReason.FAILED)
        self._send_next()

    def _take_outcome(self, record: Published) -> None:
        publish = self._at_publisher.pop(record.number, None)
        self._published_at = time.monotonic()
        if record.why and (record.outcome is Outcome.PUBLISHED or not self._once):
            sentence = f"frame {record.number}: {record.why}; later ones like it are not reported"
            self._warn_once(f"{record.outcome}: {record.cause}", sentence)
        if record.outcome is Outcome.PUBLISHED:
            if publish is not None:
                self.latencies.add(publish, record)
            self.published += 1
            self._last = (record.number, time.monotonic_ns())
            self.losses[LossReason.SOME_TOPICS] += bool(record.missed)
            self._show(record)
        elif self._once and record.outcome is Outcome.NO_POSTERIOR:
            self.fail(VariableError(f"frame {record.number}: {record.why}; nothing was published"))
            return
        elif self._once:
            why = "the rosbridge connection was lost before the result could be published"
            self.fail(RosbridgeLostError(why))
            return
        else:
            self.losses[_LOSSES[record.outcome]] += 1
        if self._count is not None and self.published >= self._count:
            if not self.end.done():
                self.end.set_result(None)
        else:
            self._send_next()
