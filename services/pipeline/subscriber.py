"""The subscriber, which converts messages of a deployment's topics to readings (thesis 3.1, Subscriber.jar).

    topic ──message──▶ _follow ──▶ FrameAssembler.take ──readings──▶ _forward ──Reading──▶ master
    timer ───────────▶ _wake ────▶ FrameAssembler.due ───readings──▶

The timer limits how long a set of messages waits for a message that may belong to the set. In a simulation, messages
of `/clock` replace the timer.
"""

import asyncio
import contextlib
import time
from functools import partial

import msgspec

from bridge.client import Message, Ros, State, Subscription
from bridge.errors import NoMessageError, TopicLeftOutError
from services.errors import RosbridgeLostError, VariableError
from services.pipeline.clock import CLOCK_TOPIC, Clock
from services.pipeline.connections import (
    check_types,
    connect_all,
    reconnect_now,
    report_unpublished,
    report_unused_clock,
)
from services.pipeline.frames import FrameAssembler
from services.settings import Settings
from services.sockets.local_socket import MAX_RECORD
from services.sockets.records import AnyRecord, Begin, LossReason, Notice, Reading, Ready, Rosbridge, Unusable
from services.sockets.serving import MakeLink, RunService
from services.sockets.status import FrameCounts, ProcessStatus, connections, why_not_connected
from toolchain.deployment import Deployment, Source

ROLE = "subscriber"
RECEIVED_QUEUE = 64
"""Maximum number of messages of a topic that wait to be read."""
_BURST_PAUSE = 0.02
"""Seconds of silence that end the backlog sent to a new subscriber."""
_BURST_LIMIT = 0.1
_BACKLOG_LIMIT = min(1 << 18, MAX_RECORD)
"""Number of bytes that may wait for the master. If more bytes wait, `queue = latest` drops readings."""


async def newest_message(subscription: Subscription, message: Message) -> tuple[Message, int]:
    """Skip old messages at the start of a subscription. Return the newest message, and how many were skipped.

    `message` is the first message. A ROS 2 server begins with a burst of messages from before the subscription.
    """
    older = 0
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_BURST_LIMIT):
            while True:
                async with asyncio.timeout(_BURST_PAUSE):
                    message = await anext(subscription)
                older += 1
    return message, older


class Subscriber(RunService):
    """Service that converts messages of a deployment's topics to addresses, and sends them to a master as readings."""

    role = ROLE

    def __init__(self, settings: Settings, deployment: Deployment, link: MakeLink) -> None:
        super().__init__(settings, link)
        self._deployment = deployment
        self._clock = Clock(simulated=settings.use_sim_time)
        self._assembler = FrameAssembler(deployment, self._clock)
        # At the assembler's deadline (a tick, ns), `_wake` forwards the readings that are due.
        self._timer: asyncio.TimerHandle | None = None
        self._timer_deadline: int | None = None
        self._queue_all = (settings.queue or deployment.queue) == "all"
        # Set by the master's `Begin`: all services are ready. With `once`, the run ends with its first reading, and a
        # lost server ends this service (through `_lost`) until that reading has been sent.
        self._begun = asyncio.Event()
        self._once = False
        self._lost: asyncio.Future[None] | None = None
        # Connections by URI, from their first attempt on, and the subscriptions of this run.
        self._rosbridges: dict[str, Ros] = {}
        self._subscriptions: list[Subscription] = []
        # Counts since the start. Those ending in `_sent` are what the master knows so far; each reading reports the
        # difference.
        self._received = self._completed = self._unusable = 0
        self._passed_over = self._passed_over_sent = 0
        self._unpaired_sent = 0
        # Receipt of the last complete reading (monotonic, ns; 0 before the first one), and the tick when it was sent.
        self._last_tick = 0
        self._last_sent: int | None = None
        # What was reported already: a gap between stamps (until the next reading), and topics without which frames
        # are formed.
        self._gap_reported = False
        self._absent_reported: set[str] = set()

    def _take(self, record: AnyRecord) -> None:
        if isinstance(record, Begin):
            self._once = record.once
            self._begun.set()
        elif isinstance(record, Notice) and self._logs_frames:
            # the master numbers a frame when it is neither passed over nor unusable
            self._log.debug(record.sentence)
        elif isinstance(record, Rosbridge):
            reconnect_now(self._rosbridges)

    def status(self) -> ProcessStatus:
        """Return the status of this process."""
        why = why_not_connected(self._rosbridges)
        age = None if self._last_sent is None else (self._clock.tick() - self._last_sent) / 1e9
        limit = self._settings.ready_timeout
        # without a run no readings are expected, and the master may be waiting for us to be ready
        if not why and self._begun.is_set() and self._link.has_master and (age is None or age > limit):
            topics = " and ".join(source.topic for source in self._deployment.sources)
            since = "yet" if age is None else f"for {age:.0f} s"
            why = f"no complete reading {since}: {self._assembler.stamp_gap() or f'waiting for messages on {topics}'}"
        silence = time.monotonic() - self._clock.heard
        if not why and self._clock.simulated and self._assembler.deadline is not None and silence > limit:
            why = f"a message waits for another topic, and {CLOCK_TOPIC} has brought nothing for {silence:.0f} s"
        return ProcessStatus(
            ready=not why,
            why=why or f"connected to {', '.join(self._rosbridges)}",
            deployment=self._deployment.hash,
            connections=connections(self._rosbridges),
            frames=FrameCounts.of(
                self._received,
                self._completed,
                {
                    LossReason.PASSED_OVER: self._passed_over,
                    LossReason.TOO_LARGE: sum(each.discarded for each in self._subscriptions),
                    LossReason.UNUSABLE: self._unusable,
                    LossReason.UNPAIRED: self._assembler.unpaired,
                },
                (0, self._last_tick),
                self._assembler.absent,
            ),
        )

    def _state_changed(self, uri: str, state: State, reason: str) -> None:
        if self._begun.is_set():
            self._link.keep(Rosbridge(state is State.CONNECTED))
        if state is State.RECONNECTING:
            self._link.notice("warning", f"rosbridge at {uri} is gone ({reason}); waiting for it")
            if self._once and self._link.has_master and self._lost is not None and not self._lost.done():
                self._lost.set_exception(
                    RosbridgeLostError(f"rosbridge at {uri} was lost before a reading arrived ({reason})")
                )
        elif state is State.CONNECTING:
            self._link.notice("info", f"waiting for rosbridge at {uri} ({reason})")
        elif state is State.CONNECTED and self._begun.is_set():
            self._link.notice("info", f"rosbridge at {uri} is connected again")

    async def _serve(self) -> None:
        """Send readings to the master, until an error ends the service.

        Raises:
            BridgeError: A server is unreachable, or no message of a topic arrives in time.
            RosbridgeLostError: The connection to a server was lost in a run with `--once`.
        """
        settings, sources = self._settings, self._deployment.sources
        self._lost = asyncio.get_running_loop().create_future()
        async with contextlib.AsyncExitStack() as stack:
            by_uri = await connect_all(
                stack,
                settings,
                [source.uri for source in sources],
                self._rosbridges,
                on_state=self._state_changed,
                max_size=settings.message_bytes,
            )
            rosbridges = [by_uri[settings.uri or source.uri] for source in sources]
            needed = [at for at in range(len(sources)) if self._assembler.needs(at)]
            await check_types((rosbridges[at], sources[at].topic, sources[at].type) for at in needed)
            self._link.keep(Ready(f"connected to {', '.join(by_uri)}"))
            # not only when the boards are programmed, which may take much longer
            warn = partial(self._link.notice, "warning")
            hints = [
                asyncio.ensure_future(report_unpublished(ros, source.topic, warn))
                for ros, source in zip(rosbridges, sources, strict=True)
            ]
            for hint in hints:
                stack.callback(hint.cancel)
            await self._begun.wait()
            tasks = [
                asyncio.ensure_future(self._follow(rosbridges[at], at, source, hints[at]))
                for at, source in enumerate(sources)
            ]
            clock_hint = report_unpublished if self._clock.simulated else report_unused_clock
            hints.append(asyncio.ensure_future(clock_hint(rosbridges[0], CLOCK_TOPIC, warn)))
            stack.callback(hints[-1].cancel)
            if self._clock.simulated:
                tasks.append(asyncio.ensure_future(self._clock.follow(rosbridges[0], self._wake_if_due)))
            for task in tasks:
                stack.callback(task.cancel)
            # the first error ends the service; a topic that is left out ends without one
            ended, _ = await asyncio.wait([*tasks, self._lost], return_when=asyncio.FIRST_EXCEPTION)
            for each in ended:
                each.result()

    async def _follow(self, ros: Ros, at: int, source: Source, hint: asyncio.Future[None]) -> None:
        subscription = ros.subscribe(
            source.topic,
            source.type,
            queue_length=0 if self._queue_all else 1,
            queue_size=RECEIVED_QUEUE,
            compression=source.compression,
            max_bytes=self._settings.topic_bytes or source.topic_bytes,
        )
        self._subscriptions.append(subscription)
        timeout = self._settings.first_data_timeout
        # Before the first message, silence is an error of the deployment or of the robot; later, the subscriber waits
        # until it ends.
        first, silent = True, False
        # Number of the connection whose backlog was skipped, and messages lost in the queue that were counted.
        connection: int | None = None
        lost_before = 0
        while True:
            try:
                message = await subscription.next(timeout=timeout)
            except NoMessageError as error:
                if first and ros.state is State.CONNECTED and self._assembler.needs(at):
                    raise
                self._link.notice("warning", str(error))
                silent = True
                continue
            except TopicLeftOutError as error:
                if self._assembler.needs(at):
                    raise
                self._link.notice("warning", f"{error}; frames go on without it")
                hint.cancel()
                return
            if silent:
                self._link.notice("info", f"messages of {source.topic} are back")
            first = silent = False
            hint.cancel()
            self._received += 1
            if connection != ros.reconnections and not self._queue_all:
                connection = ros.reconnections
                message, older = await newest_message(subscription, message)
                self._passed_over += older
            self._passed_over += subscription.lost - lost_before
            lost_before = subscription.lost
            self._read(at, message)

    def _read(self, at: int, message: Message) -> None:
        try:
            readings = self._assembler.take(
                at, message.msg, message.received_ns, message.received_monotonic_ns
            )
        except VariableError as error:
            self._unusable += 1
            # the master warns once for each cause; the sentence may contain the value, which differs each time
            cause = f"{type(error.__cause__).__name__} {at}"
            self._link.send(Unusable(cause, str(error)))
            return
        self._forward(readings)
        gap = self._assembler.stamp_gap()
        if gap is not None and not self._gap_reported:
            self._link.notice("warning", str(gap))
            self._gap_reported = True

    def _wake_if_due(self) -> None:
        if self._timer_deadline is not None and self._timer_deadline <= self._clock.tick():
            self._wake()

    def _wake(self) -> None:
        self._timer = self._timer_deadline = None
        self._forward(self._assembler.due(self._clock.tick()))

    def _forward(self, readings: list[Reading]) -> None:
        """Send readings to the master, and set the timer for incomplete ones."""
        for reading in readings:
            self._send(reading)
        deadline = self._assembler.deadline
        if deadline != self._timer_deadline:
            if self._timer is not None:
                self._timer.cancel()
            self._timer, self._timer_deadline = None, deadline
            if deadline is not None and not self._clock.simulated:
                delay = max(deadline - time.monotonic_ns(), 0) / 1e9
                self._timer = asyncio.get_running_loop().call_later(delay, self._wake)

    def _send(self, reading: Reading) -> None:
        self._gap_reported = False
        for topic in self._assembler.absent.keys() - self._absent_reported:
            self._absent_reported.add(topic)
            self._link.notice(
                "warning",
                f"frames go on without {topic}: it brought nothing within {self._deployment.tolerance_s:g} s of the others",
            )
        self._last_tick, self._last_sent = reading.received_tick, self._clock.tick()
        # a master that reads slowly gets the newest readings, not all of them late
        if self._link.backlog > _BACKLOG_LIMIT and not self._queue_all:
            self._passed_over += len(self._deployment.sources)
            return
        passed_over, unpaired = self._passed_over, self._assembler.unpaired
        record = msgspec.structs.replace(
            reading,
            sent_tick=time.monotonic_ns(),
            passed_over=passed_over - self._passed_over_sent,
            unpaired=unpaired - self._unpaired_sent,
        )
        if self._link.send(record):
            self._completed += 1
            self._passed_over_sent, self._unpaired_sent = passed_over, unpaired
            self._once = False  # the reading has been sent: a later failure must not end the service
        else:
            # without a master: the next one learns of it with its first reading
            self._passed_over += len(self._deployment.sources)
