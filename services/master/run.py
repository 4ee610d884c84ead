"""One run of the master: moves readings, frames and results between the processes (thesis 3.3, figure 3.4)."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections import Counter, deque
from pathlib import Path

from services.errors import (
    BoardFailedError,
    NoDataError,
    ReportedError,
    RosbridgeLostError,
    StackError,
    VariableError,
)
from services.master.peers import ANSWER_TIME, ROLE, Awaited, Peer, Peers
from services.master.reload import LOST_IN_RELOAD, Reloads, Waits
from services.output.master_output import print_json, print_sentence
from services.pipeline.frames import WaitingFrames
from services.pipeline.generations import InForce
from services.settings import Settings
from services.sockets.control_socket import control_served
from services.sockets.records import (
    AnyRecord,
    Begin,
    FailureReason,
    Frame,
    FrameFailed,
    FrameResult,
    Notice,
    NotReloaded,
    Outcome,
    Prepared,
    Publish,
    Published,
    Reading,
    Ready,
    Switched,
    Unusable,
)
from services.sockets.status import FrameCounts, ProcessStatus, reasons, seconds_since, status_served
from services.supervision.child import RESTARTS, RESTARTS_WITHIN
from terminal.errors import ExitCode
from terminal.logs import get_logger
from terminal.output import say
from toolchain.deployment import Deployment

RESULTS_UNDER_WAY = 8
"""Results that the publisher may have unanswered; then frames wait, and `queue` says which."""

MISSED = "on some topics only"
"""What is counted of results that went to one of several servers, while another was away."""

_PROGRESS_EVERY = 1.0
_GRACE = 2.0


class Master:
    """One run: once or in a loop, over a deployment."""

    def __init__(
        self, settings: Settings, deployment: Deployment, *, once: bool, count: int | None, json: bool
    ) -> None:
        self._settings = settings
        self._once = once
        self._count = 1 if once else count
        self._json = json
        self._log = get_logger(ROLE, settings.log_level)
        self._follows = settings.log_level == "debug"
        self._in_force = InForce(deployment, Path(settings.deployment or deployment.directory).absolute())
        self._peers = Peers(settings, self._in_force, self, self._log, once=once)
        self._reloads = Reloads(settings, self._in_force, self._peers, self, self._log)
        self._readings: WaitingFrames[Waits] = WaitingFrames(settings.queue or deployment.queue)
        self._held = False
        self._catching_up = 0
        self._computing: tuple[Frame, Reading, int, int] | None = None
        self._at_publisher = 0
        self._number = 0
        self._received = 0
        self._published = 0
        self._last = (0, 0)
        self._losses: Counter[str] = Counter()
        self._told: set[str] = set()
        self._failures: deque[float] = deque(maxlen=RESTARTS + 1)
        self._end: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._began = False
        self._heard = False
        self._tasks: list[asyncio.Task[None]] = []
        self._published_at = 0.0
        self._started = time.monotonic()
        self._shown = (0.0, 0)

    async def run(self) -> int:
        """Start what is not running, move frames until the run is over, and end what was started.

        Raises:
            StackError: what ended the run, with its exit code.
        """
        settings, peers = self._settings, self._peers
        sockets = contextlib.AsyncExitStack()
        try:
            peers.prepare()
            run_directory = settings.run_directory or peers.directory
            await sockets.enter_async_context(status_served(run_directory, ROLE, self.status))
            if not self._once:
                control = settings.control_directory or run_directory
                await sockets.enter_async_context(control_served(control, self._reloads.order))
            await peers.start()
            if sys.stderr.isatty() and not self._once:
                self._tasks.append(asyncio.ensure_future(self._show_progress()))
            await self._end
        finally:
            for task in self._tasks:
                task.cancel()
            await peers.leave()
            await sockets.aclose()
            await peers.end()
            if not self._once:
                say(self._summary())
        return ExitCode.DONE

    def status(self) -> ProcessStatus:
        """What this process knows: the run as a whole."""
        number, tick = self._last
        age = seconds_since(tick)
        waiting = self._peers.not_ready
        if waiting:
            why = f"waiting for {' and '.join(waiting)}"
        elif age is None:
            why = "no result yet: waiting for a complete reading"
        elif age > self._settings.ready_timeout:
            why = f"no result for {age:.0f} s"
        else:
            why = ""
        lost = Counter(self._losses)
        lost["passed over"] += self._readings.passed_over
        return ProcessStatus(
            ready=not why,
            why=why or "results flow",
            deployment=self._in_force.deployment.hash,
            generation=self._in_force.generation,
            folder=str(self._in_force.folder),
            peers=self._peers.status(),
            frames=FrameCounts(
                received=self._received,
                completed=self._published,
                lost=reasons(lost),
                last_number=number or None,
                last_age_s=age,
            ),
        )

    def _summary(self) -> str:
        elapsed = time.monotonic() - self._started
        text = f"{self._published} results published in {elapsed:.1f} s"
        self._losses["passed over"] += self._readings.passed_over
        self._readings.passed_over = 0
        missed = self._losses.pop(MISSED, 0)
        text += f", {missed} of them {MISSED}" if missed else ""
        losses = ", ".join(f"{count} {reason}" for reason, count in self._losses.items() if count)
        return f"{text}; not published: {losses}" if losses else text

    def fail(self, error: Exception) -> None:
        """End the run by this error."""
        if not self._end.done():
            self._end.set_exception(error)

    def _done(self) -> None:
        if not self._end.done():
            self._end.set_result(None)

    async def _expect_data(self) -> None:
        """The first reading, or a message that holds none, comes in time; the subscriber usually says so first."""
        limit = self._settings.first_data_timeout
        await asyncio.sleep(limit + _GRACE)
        if not self._heard:
            topics = ", ".join(source.topic for source in self._in_force.deployment.sources)
            self.fail(NoDataError(f"no reading came from {topics} within {limit:g} s"))

    # --- what the peers' connections tell and ask ----------------------------------------------

    def take(self, peer: Peer, record: AnyRecord) -> None:
        """A peer that has greeted sent a record."""
        match record:
            case Ready():
                self._ready(peer, record)
            case Notice():
                self._noticed(record)
            case Reading():
                self._read(record)
            case Unusable():
                self._unusable(record)
            case FrameResult():
                self._computed(record)
            case FrameFailed():
                self._frame_failed(record)
            case Published():
                self._was_published(record)
            case Prepared() | Switched() | NotReloaded():
                peer.answered(record)
            case _:
                where = peer.protocol.where if peer.protocol else peer.role
                self._log.warning(f"{where} sent a {type(record).__name__}, which is not its to send")

    def lost(self, peer: Peer) -> None:
        """A peer is gone, with the frame that it computed or the results that it had to publish."""
        if peer is self._peers.app and self._computing is not None:
            self._losses["lost with pcie-app"] += 1
            if self._follows:
                self._log.debug("lost with pcie-app", frame=self._computing[0].number)
            self._computing = None
        if peer is self._peers.publisher and self._at_publisher:
            self._losses["lost with the publisher"] += self._at_publisher
            self._at_publisher = 0

    def awaited(self, peer: Peer) -> Awaited | None:
        """What a peer that is ready was asked for and has not answered yet."""
        if peer is self._peers.app and self._computing is not None:
            what, since = f"answer frame {self._computing[0].number}", self._computing[3] / 1e9
            return Awaited(what, since, self._settings.board_timeout + ANSWER_TIME)
        if peer is self._peers.publisher and self._at_publisher:
            return Awaited("publish", self._published_at, self._settings.seen_timeout + ANSWER_TIME)
        return None

    # --- what a reload asks --------------------------------------------------------------------

    @property
    def has_begun(self) -> bool:
        """Whether all peers were ready once."""
        return self._began

    @property
    def waiting(self) -> int:
        """How many readings wait for the boards."""
        return len(self._readings)

    @property
    def under_way(self) -> str:
        """Where frames are: on the boards, at the publisher; nothing if there are none."""
        if self._computing is not None:
            return "a frame on the boards"
        return "results at the publisher" if self._at_publisher else ""

    @property
    def in_flight(self) -> int:
        """How many frames wait, are computed, or are being published."""
        return len(self._readings) + (self._computing is not None) + self._at_publisher

    def hold(self) -> None:
        """Hand no frame to pcie-app."""
        self._held = True

    def go_on(self, readings: WaitingFrames[Waits] | None = None) -> None:
        """Hand frames on again: these readings, where there are any, in place of those that wait."""
        if readings is not None:
            self.lose(LOST_IN_RELOAD, len(self._readings))
            self.lose("passed over", self._readings.passed_over)
            self._readings = readings
        self._held = False
        self._catching_up = len(self._readings)
        self._next()

    def lose(self, reason: str, count: int) -> None:
        """Count what was lost."""
        self._losses[reason] += count

    def lost_for(self, reason: str) -> int:
        """How many were lost for a reason so far."""
        return self._losses[reason]

    # --- records -------------------------------------------------------------------------------

    def _ready(self, peer: Peer, record: Ready) -> None:
        peer.ready = True
        self._log.info(f"{peer.role}: {record.sentence}")
        # the publisher advertises before the subscriber subscribes: no result without a topic
        if not self._began and not self._peers.not_ready:
            self._began = True
            self._tasks.append(asyncio.ensure_future(self._expect_data()))
            if not self._once:
                self._tasks.append(asyncio.ensure_future(self._reloads.keep_first()))
            for each in self._peers:
                self._begin(each)
        elif self._began:
            self._begin(peer)
        if peer is not self._peers.subscriber:
            self._next()

    def _begin(self, peer: Peer) -> None:
        if peer is not self._peers.app and peer.protocol is not None:
            peer.protocol.send(Begin(self._once))

    def _noticed(self, record: Notice) -> None:
        if record.level == "warning":
            self._log.warning(record.sentence)
        else:
            self._log.info(record.sentence)

    def _read(self, reading: Reading) -> None:
        self._heard = True
        if self._once and self._number:
            return
        self._received += 1
        self._losses["passed over"] += reading.passed_over
        self._losses["unpaired"] += reading.unpaired
        waits = reading, time.monotonic_ns()
        if reading.generation != self._in_force.generation:
            self._reloads.wait(waits)
            return
        try:
            self._readings.put(waits)
        except StackError as error:
            if self._held or self._catching_up:  # a reload was the slow part, not the boards
                self.lose(LOST_IN_RELOAD, 1)
            else:
                self.fail(error)
            return
        self._next()

    def _unusable(self, record: Unusable) -> None:
        self._heard = True
        if self._once:
            self.fail(VariableError(record.sentence))
            return
        self._losses["with an unusable variable"] += 1
        if record.cause not in self._told:
            self._told.add(record.cause)
            self._log.warning(f"{record.sentence}; such messages are skipped and counted")

    def _next(self) -> None:
        app = self._peers.app
        if self._computing is not None or self._held or not app.ready or app.protocol is None:
            return
        if self._at_publisher >= RESULTS_UNDER_WAY or not self._peers.publisher.ready:
            return
        if self._count is not None and self._published + self._at_publisher >= self._count:
            return  # until it is known whether those at the publisher are enough
        waiting = self._readings.get()
        if waiting is None:
            return
        reading, arrived = waiting
        self._catching_up = max(0, self._catching_up - 1)
        self._number += 1
        frame = Frame(
            self._number,
            reading.addresses,
            self._number % self._in_force.deployment.machine.rng_banks,
            reading.prior_codes,
        )
        self._computing = (frame, reading, arrived, time.monotonic_ns())
        app.protocol.send(frame)
        if self._follows:
            self._follow(frame, reading, arrived)

    def _follow(self, frame: Frame, reading: Reading, arrived: int) -> None:
        """Log a frame that was handed on, and tell its number to the subscriber, which could not know it before."""
        now = time.monotonic_ns()
        self._log.debug(
            "handed on to pcie-app", frame=frame.number, bank=frame.bank, waited_us=(now - arrived) // 1000
        )
        subscriber = self._peers.subscriber.protocol
        if subscriber is not None:
            taken = (reading.sent_tick - reading.received_tick) // 1000
            subscriber.send(
                Notice(
                    "debug",
                    f"frame={frame.number} complete stamp_ns={reading.stamp_ns} received_ns={reading.received_ns} "
                    f"taken_us={taken}",
                )
            )

    def _computed(self, result: FrameResult) -> None:
        computing = self._computing
        if computing is None or computing[0].number != result.number:
            return
        _, reading, arrived, sent = computing
        self._computing = None
        publisher = self._peers.publisher.protocol
        record = Publish(
            result=result,
            stamp_ns=reading.stamp_ns,
            received_ns=reading.received_ns,
            received_tick=reading.received_tick,
            reading_sent_tick=reading.sent_tick,
            waited_ns=sent - arrived,
        )
        if not self._at_publisher:
            self._published_at = time.monotonic()
        self._at_publisher += 1  # before it goes: a publisher in this process answers at once
        if publisher is None or not publisher.send(record):
            self._at_publisher -= 1
            self._losses["lost with the publisher"] += 1
        self._next()

    def _frame_failed(self, record: FrameFailed) -> None:
        if self._computing is not None and self._computing[0].number == record.number:
            self._computing = None
        if self._once:
            self.fail(ReportedError(record.exit_code, record.sentence))
            return
        self._losses["failed on a board"] += 1
        if record.reason is not FailureReason.AWAY:
            now = time.monotonic()
            self._failures.append(now)
            recent = [each for each in self._failures if now - each <= RESTARTS_WITHIN]
            if len(recent) > RESTARTS:
                msg = (
                    f"{record.sentence}; {len(recent)} frames failed on boards within {RESTARTS_WITHIN:.0f} s"
                )
                self.fail(BoardFailedError(msg))
                return
            self._log.warning(record.sentence, frame=record.number)
        elif self._follows:
            self._log.debug(record.sentence, frame=record.number)
        self._next()

    def _was_published(self, record: Published) -> None:
        self._at_publisher = max(0, self._at_publisher - 1)
        self._published_at = time.monotonic()
        if record.outcome is Outcome.PUBLISHED:
            self._published += 1
            self._last = (record.number, time.monotonic_ns())
            if record.missed:
                self._losses[MISSED] += 1
            if self._json:
                print_json(record, self._in_force)
            elif self._once:
                print_sentence(record, self._in_force)
            if record.seen is False:
                say(
                    f"the result was published, but not seen on the wire within {self._settings.seen_timeout:g} s"
                )
        elif self._once:
            if record.outcome is Outcome.NO_POSTERIOR:
                msg = f"frame {record.number} has no posterior: no line of the model counted for its readings; nothing was published"
                self.fail(VariableError(msg))
            else:
                self.fail(RosbridgeLostError("rosbridge went away before the result could be published"))
            return
        else:
            self._losses[record.outcome] += 1
        if self._count is not None and self._published >= self._count:
            self._done()
        else:
            self._next()

    async def _show_progress(self) -> None:
        while True:
            await asyncio.sleep(_PROGRESS_EVERY)
            at, count = self._shown
            now = time.monotonic()
            if at and self._published != count:
                rate = (self._published - count) / (now - at)
                of = f" of {self._count}" if self._count else ""
                self._log.info(f"{self._published}{of} results, {rate:.0f} a second")
            self._shown = (now, self._published)


async def run_master(
    settings: Settings, deployment: Deployment, *, once: bool, count: int | None, json: bool
) -> int:
    """Run a master until its end (see `Master.run`)."""
    return await Master(settings, deployment, once=once, count=count, json=json).run()
