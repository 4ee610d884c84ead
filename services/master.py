"""The master: moves readings, frames and results between the processes (thesis 3.3, figure 3.4)."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Concatenate, ParamSpec

import orjson
import typer

from pcie_shim.endpoint import Endpoint
from services import options
from services.command_line import ends_well, make_app, run_async
from services.control_socket import ReloadOrder, control_served, control_socket, give_order
from services.errors import (
    BoardFailedError,
    ChildDiedError,
    ExitCode,
    NoDataError,
    NotReloadedError,
    OtherPeerError,
    ReportedError,
    RosbridgeLostError,
    ServiceError,
    SettingsError,
    VariableError,
)
from services.frames import WaitingFrames
from services.local_socket import RecordProtocol, check_hello, open_connection, own_hello
from services.logs import get_logger, say
from services.new_deployment import forget, keep, read_new
from services.records import (
    AnyRecord,
    Begin,
    Frame,
    FrameFailed,
    FrameResult,
    Hello,
    Notice,
    NotReloaded,
    Prepare,
    Prepared,
    Publish,
    Published,
    Reading,
    Ready,
    Switch,
    Switched,
    Trouble,
    Unusable,
)
from services.serving import board_endpoints, deployment_for, endpoint_from
from services.settings import Settings, endpoint_in, load_settings
from services.status_socket import (
    FrameCounts,
    PeerStatus,
    ProcessStatus,
    reasons,
    seconds_since,
    status_served,
)
from services.supervision import (
    RESTARTS,
    RESTARTS_WITHIN,
    Child,
    PrivateDirectory,
    end_all,
    end_with_parent,
    own_command,
)
from toolchain.deployment import Deployment

if TYPE_CHECKING:
    from services.fused import FusedEnd  # with all that the three services import

ROLE = "master"
RESULTS_UNDER_WAY = 8
"""Results that the publisher may have unanswered; then frames wait, and `queue` says which."""

LOST_IN_RELOAD = "lost in a reload"

_CONNECT_EVERY = 0.01
_RECONNECT_PATIENCE = 60.0
_PROGRESS_EVERY = 1.0
_ANSWER_TIME = 60.0
"""Seconds that pcie-app or the publisher may take beyond their own limits, before they count as stuck."""
_GRACE = 2.0
_DRAIN_TIME = 30.0
"""Seconds that the frames under way may take, once a reload waits for them."""

_PROGRAM_TIME = 30.0
"""Seconds that programming one board may take in a reload, at most."""

RELOAD_TIME = 600.0
"""Seconds that `master reload` waits for its answer."""


class Peer:
    """One service that the master talks to: its process if it is the master's own, its connection.

    A service inside the master's process has no endpoint.
    """

    def __init__(self, role: str, endpoint: Endpoint | None, child: Child | None) -> None:
        self.role = role
        self.endpoint = endpoint
        self.where = "this process" if endpoint is None else str(endpoint)
        self.child = child
        self.protocol: RecordProtocol | FusedEnd | None = None
        self.greeted = False
        self.ready = False
        self.closed = asyncio.Event()
        self.reason: Exception | None = None
        self.since = 0.0
        self.missed = False
        self.generation = 0
        self.answer: asyncio.Future[Prepared | Switched | NotReloaded] | None = None
        self.outdated = False


class Master:
    """One run: once or in a loop, over a deployment."""

    def __init__(
        self, settings: Settings, deployment: Deployment, *, once: bool, count: int | None, json: bool
    ) -> None:
        self._settings = settings
        self._deployment = deployment
        self._once = once
        self._count = 1 if once else count
        self._json = json
        self._log = get_logger(ROLE, settings.log_level)
        self._follows = settings.log_level == "debug"
        self._waiting: WaitingFrames[tuple[Reading, int]] = WaitingFrames(settings.queue or deployment.queue)
        self._generation = 0
        self._former_hash = ""
        self._folder = Path(settings.deployment or deployment.directory).absolute()
        self._kept = self._folder
        self._reloads = asyncio.Lock()
        self._coming: WaitingFrames[tuple[Reading, int]] | None = None
        self._held = False
        self._keeping: asyncio.Task[None] | None = None
        self._computing: tuple[Frame, Reading, int, int] | None = None
        self._under_way = 0
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
        self._expecting: asyncio.Task[None] | None = None
        self._published_at = 0.0
        self._private: PrivateDirectory | None = None
        self._boards: Child | None = None
        self._board_endpoints: tuple[str, ...] = ()
        self._peers: dict[str, Peer] = {}
        self._started = time.monotonic()
        self._shown = (0.0, 0)

    async def run(self) -> int:
        """Start what is not running, move frames until the run is over, and end what was started.

        Raises:
            ServiceError: what ended the run, with its exit code.
        """
        tasks: list[asyncio.Task[None]] = []
        inside: list[asyncio.Task[None]] = []
        status = contextlib.AsyncExitStack()
        try:
            self._prepare()
            run_directory = self._settings.run_directory or self._directory
            await status.enter_async_context(status_served(run_directory, ROLE, self.status))
            if not self._once:
                await status.enter_async_context(control_served(run_directory, self._ordered))
            if self._boards is not None:
                self._boards.start()
                tasks.append(asyncio.ensure_future(self._keep_boards(self._boards)))
            for peer in self._peers.values():
                if peer.child is not None:
                    peer.child.start()
            if self._settings.fused:
                inside = self._start_inside()
            else:
                tasks.extend(asyncio.ensure_future(self._keep(peer)) for peer in self._peers.values())
            if sys.stderr.isatty() and not self._once:
                tasks.append(asyncio.ensure_future(self._show_progress()))
            await self._end
        finally:
            others = [task for task in (self._expecting, self._keeping) if task is not None]
            for task in (*tasks, *inside, *others):
                task.cancel()
            if inside:
                await asyncio.wait(inside, timeout=self._settings.stop_timeout)
            await status.aclose()
            await self._finish()
        return ExitCode.DONE

    @property
    def _directory(self) -> Path | None:
        return None if self._private is None else self._private.path

    # --- starting and ending -------------------------------------------------------------------

    def _prepare(self) -> None:
        settings, deployment = self._settings, self._deployment
        given = {
            "subscriber": settings.subscriber,
            "publisher": settings.publisher,
            "pcie-app": settings.pcie_app,
        }
        if not all(given.values()):
            self._private = PrivateDirectory()
        directory = self._directory
        if settings.boards or any(board.endpoint for board in deployment.boards):
            board_endpoints(settings, deployment)  # a wrong list is told before anything starts
        if settings.fused and any(given.values()):
            role = next(role for role, text in given.items() if text)
            msg = f"--fused runs subscriber, publisher and pcie-app in the master's own process; take --connect or --{role} away"
            raise SettingsError(msg)
        common = ["--deployment", str(settings.deployment), "--log-level", settings.log_level]
        rosbridge = [*(["--uri", settings.uri] if settings.uri else [])]
        rosbridge += [
            "--ros-version",
            settings.ros_version,
            "--connect-timeout",
            str(settings.connect_timeout),
        ]
        boards = list(settings.boards)
        if not given["pcie-app"] and directory is not None:
            endpoints = [board.endpoint for board in deployment.boards]
            if not boards and not all(endpoints):
                boards = [str(endpoint_in(directory, f"board{at}")) for at in range(len(endpoints))]
                command = [*own_command("board"), "--boards", str(len(boards)), "--directory", str(directory)]
                command += ["--restarts", "0" if self._once else str(RESTARTS)]
                self._boards = Child("the boards' process", command, directory=directory)
        arguments = {
            "subscriber": [
                *common,
                *rosbridge,
                "--first-data-timeout",
                str(settings.first_data_timeout),
                *(["--queue", settings.queue] if settings.queue else []),
            ],
            "publisher": [*common, *rosbridge, "--seen-timeout", str(settings.seen_timeout)],
            "pcie-app": [
                *common,
                *(["--boards", ",".join(boards)] if boards else []),
                *(["--stop", settings.stop] if settings.stop else []),
                "--peer-timeout",
                str(settings.peer_timeout),
                "--board-timeout",
                str(settings.board_timeout),
                # nobody else can have programmed boards of this run
                *(["--reprogram"] if self._boards is not None else []),
            ],
        }
        self._board_endpoints = tuple(boards)
        if settings.fused:
            self._peers = {role: Peer(role, None, None) for role in given}
            return
        for role, text in given.items():
            child = None
            if text:
                endpoint = endpoint_from(text, f"--{role}")
            else:
                assert directory is not None  # noqa: S101 - made above for whoever has no endpoint
                endpoint = endpoint_in(directory, role)
                command = [*own_command(role), "--listen", str(endpoint), *arguments[role]]
                child = Child(role, command, directory=directory)
            self._peers[role] = Peer(role, endpoint, child)

    async def _finish(self) -> None:
        children = [peer.child for peer in self._peers.values() if peer.child is not None]
        if self._boards is not None:
            children.append(self._boards)
        for peer in self._peers.values():
            if peer.protocol is not None:
                peer.protocol.close()
        killed = await end_all(children, self._settings.stop_timeout)
        if killed:
            say(
                f"{' and '.join(killed)} did not end within {self._settings.stop_timeout:g} s and had to be killed"
            )
        if self._private is not None:
            self._private.remove()
        if not self._once:
            say(self._summary())

    def status(self) -> ProcessStatus:
        """What this process knows: the run as a whole."""
        number, tick = self._last
        age = seconds_since(tick)
        waiting = [peer.role for peer in self._peers.values() if not peer.ready]
        if waiting:
            why = f"waiting for {' and '.join(waiting)}"
        elif age is None:
            why = "no result yet: waiting for a complete reading"
        elif age > self._settings.ready_timeout:
            why = f"no result for {age:.0f} s"
        else:
            why = ""
        peers = [
            PeerStatus(
                name=peer.role,
                endpoint=peer.where,
                pid=peer.child.pid if peer.child else 0,
                restarts=peer.child.restarts if peer.child else 0,
                ready=peer.ready,
            )
            for peer in self._peers.values()
        ]
        lost = Counter(self._losses)
        lost["passed over"] += self._waiting.passed_over
        return ProcessStatus(
            ready=not why,
            why=why or "results flow",
            deployment=self._deployment.hash,
            generation=self._generation,
            folder=str(self._folder),
            peers=peers,
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
        self._losses["passed over"] += self._waiting.passed_over
        self._waiting.passed_over = 0
        losses = ", ".join(f"{count} {reason}" for reason, count in self._losses.items() if count)
        return f"{text}; not published: {losses}" if losses else text

    def _fail(self, error: Exception) -> None:
        if not self._end.done():
            self._end.set_exception(error)

    def _done(self) -> None:
        if not self._end.done():
            self._end.set_result(None)

    # --- processes -----------------------------------------------------------------------------

    async def _keep_boards(self, boards: Child) -> None:
        try:
            await self._restart_boards(boards)
        except Exception as error:
            self._fail(error)

    def _start_inside(self) -> list[asyncio.Task[None]]:
        """`--fused`: run the services here, each as a task."""
        from services.fused import fused_services

        settings = self._settings.model_copy(
            update={
                "boards": self._board_endpoints,
                "run_directory": self._settings.run_directory or self._directory,
            }
        )

        def to_master(role: str) -> Callable[[AnyRecord], None]:
            peer = self._peers[role]
            return lambda record: self._take(peer, peer.protocol, record)

        tasks = []
        for role, (end, service) in fused_services(settings, self._deployment, to_master).items():
            peer = self._peers[role]
            peer.protocol, peer.greeted = end, True
            tasks.append(asyncio.ensure_future(self._run_inside(service)))
        return tasks

    async def _run_inside(self, service: Coroutine[Any, Any, int]) -> None:
        try:
            await service
        except Exception as error:  # what a user can mend was reported before, and ended the run
            self._fail(error)

    async def _restart_boards(self, boards: Child) -> None:
        while True:
            await boards.ended()
            failure = boards.failure()
            if boards.exit_code() == ExitCode.BOARD:
                self._fail(failure)
                return
            if self._once or not boards.may_restart():
                self._fail(BoardFailedError(str(failure)))
                return
            self._log.warning(f"{failure}; restarting it")
            boards.start()

    async def _keep(self, peer: Peer) -> None:
        try:
            first = True
            while True:
                await self._connect(peer, self._settings.peer_timeout if first else _RECONNECT_PATIENCE)
                first = False
                closing = asyncio.ensure_future(peer.closed.wait())
                while not closing.done():
                    if peer.child is not None:
                        peer.child.relay()
                    self._check_stuck(peer)
                    await asyncio.wait([closing], timeout=0.05)
                peer.protocol, peer.ready = None, False
                self._lost(peer)
                await self._again(peer)
        except Exception as error:
            self._fail(error)

    def _check_stuck(self, peer: Peer) -> None:
        """A peer that is there but does not answer is treated as dead."""
        settings = self._settings
        now = time.monotonic()
        what = ""
        if not peer.greeted:
            limit, since, what = settings.peer_timeout, peer.since, "greet"
        elif not peer.ready:
            limit = settings.connect_timeout + len(self._deployment.boards) * settings.peer_timeout
            since, what = peer.since, "get ready"
        elif peer.role == "pcie-app" and self._computing is not None:
            limit, since = settings.board_timeout + _ANSWER_TIME, self._computing[3] / 1e9
            what = f"answer frame {self._computing[0].number}"
        elif peer.role == "publisher" and self._under_way:
            limit, since, what = settings.seen_timeout + _ANSWER_TIME, self._published_at, "publish"
        if not what or now - since <= limit:
            return
        sentence = f"{peer.role} at {peer.where} did not {what} within {limit:g} s"
        if self._once or peer.child is None:
            self._fail(ChildDiedError(sentence))
        else:
            self._log.warning(f"{sentence}; ending it")
        if peer.child is not None:
            peer.child.kill()
        elif peer.protocol is not None:
            peer.protocol.close()
        peer.since = now

    async def _expect_data(self) -> None:
        """The first reading, or a message that holds none, comes in time; the subscriber usually says so first."""
        limit = self._settings.first_data_timeout
        await asyncio.sleep(limit + _GRACE)
        if not self._heard:
            topics = ", ".join(source.topic for source in self._deployment.sources)
            self._fail(NoDataError(f"no reading came from {topics} within {limit:g} s"))

    async def _connect(self, peer: Peer, patience: float) -> None:
        deadline = time.monotonic() + patience

        def make() -> RecordProtocol:
            return RecordProtocol(
                f"{peer.role} at {peer.where}",
                lambda protocol, record: self._take(peer, protocol, record),
                lambda protocol: self._opened(peer, protocol),
                lambda protocol, why: self._closed(peer, protocol, why),
            )

        peer.greeted = False
        peer.since = time.monotonic()
        peer.reason = None
        peer.closed.clear()
        while True:
            child = peer.child
            if child is not None:
                child.relay()
                if child.exit_code() is not None:
                    raise child.failure()
            if peer.endpoint is None:
                return
            try:
                await open_connection(peer.endpoint, make)
            except OSError as error:
                if time.monotonic() > deadline:
                    msg = f"no {peer.role} answers at {peer.where} within {patience:g} s ({error.strerror or error}); is it running?"
                    raise ChildDiedError(msg) from error
                await asyncio.sleep(_CONNECT_EVERY)
            else:
                peer.since = time.monotonic()
                return

    def _lost(self, peer: Peer) -> None:
        peer.outdated = False
        if peer.answer is not None and not peer.answer.done():
            peer.answer.set_exception(NotReloadedError(f"{peer.role} ended meanwhile"))
        if peer.role == "pcie-app" and self._computing is not None:
            self._losses["lost with pcie-app"] += 1
            if self._follows:
                self._log.debug("lost with pcie-app", frame=self._computing[0].number)
            self._computing = None
        if peer.role == "publisher" and self._under_way:
            self._losses["lost with the publisher"] += self._under_way
            self._under_way = 0

    async def _again(self, peer: Peer) -> None:
        """After a lost connection: bring the process back, or say why the run is over."""
        if isinstance(peer.reason, ServiceError):
            raise peer.reason
        child = peer.child
        if child is None:
            if self._once:
                msg = f"{peer.role} at {peer.where} closed the connection"
                raise ChildDiedError(msg)
            if not peer.missed:  # a killed process may take one connection more before its socket is gone
                self._log.warning(f"{peer.role} at {peer.where} is gone; waiting for it")
            peer.missed = True
            return
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(child.ended(), self._settings.stop_timeout)
        if child.exit_code() is None:
            child.kill()
        failure = child.failure()
        if self._once or getattr(failure, "exit_code", ExitCode.CHILD) != ExitCode.CHILD:
            raise failure
        if not child.may_restart():
            msg = f"{failure}; it was restarted {RESTARTS} times within {RESTARTS_WITHIN:.0f} s before"
            raise ChildDiedError(msg)
        self._log.warning(f"{failure}; restarting it")
        child.start()

    # --- records -------------------------------------------------------------------------------

    def _opened(self, peer: Peer, protocol: RecordProtocol) -> None:
        peer.protocol = protocol
        protocol.send(own_hello(ROLE, self._deployment.hash, self._generation))

    def _closed(self, peer: Peer, protocol: RecordProtocol, why: Exception | None) -> None:
        if peer.protocol in (protocol, None):
            peer.reason = why
            peer.closed.set()

    def _take(self, peer: Peer, protocol: RecordProtocol | FusedEnd | None, record: AnyRecord) -> None:
        try:
            self._handle(peer, protocol, record)
        except OtherPeerError:
            raise
        except Exception as error:  # a closed standard output, or a bug: neither may pass for a lost peer
            self._fail(error)

    def _handle(self, peer: Peer, protocol: RecordProtocol | FusedEnd | None, record: AnyRecord) -> None:
        if peer.outdated:
            return
        if isinstance(record, Trouble):
            self._fail(ReportedError(record.exit_code, f"{peer.role}: {record.sentence}"))
            return
        if not peer.greeted:
            if self._is_outdated(peer, record):
                return
            check_hello(record, peer.role, self._deployment.hash, f"{peer.role} at {peer.where}")
            peer.greeted = True
            peer.generation = self._generation
            peer.missed = False
            return
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
                if peer.answer is not None and not peer.answer.done():
                    peer.answer.set_result(record)
            case _:
                self._log.warning(
                    f"{protocol.where if protocol else peer.role} sent a {type(record).__name__}, which is not its to send"
                )

    def _ready(self, peer: Peer, record: Ready) -> None:
        peer.ready = True
        self._log.info(f"{peer.role}: {record.sentence}")
        subscriber = self._peers["subscriber"]
        # the publisher advertises before the subscriber subscribes: no result without a topic
        if not self._began and all(each.ready for each in self._peers.values()):
            self._began = True
            self._expecting = asyncio.ensure_future(self._expect_data())
            if not self._once:
                self._keeping = asyncio.ensure_future(self._keep_first())
            for each in self._peers.values():
                if each.role != "pcie-app" and each.protocol is not None:
                    each.protocol.send(Begin(self._once))
        elif self._began and peer.protocol is not None and peer.role != "pcie-app":
            peer.protocol.send(Begin(self._once))
        if peer is not subscriber:
            self._next()

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
        if reading.generation != self._generation:
            self._wait_for_reload(waits)
            return
        try:
            self._waiting.put(waits)
        except ServiceError as error:
            self._fail(error)
            return
        self._next()

    def _wait_for_reload(self, waits: tuple[Reading, int]) -> None:
        """A reading of the deployment that comes next waits until the boards have its tables."""
        if self._coming is None or waits[0].generation != self._generation + 1:
            self._losses[LOST_IN_RELOAD] += 1
            return
        try:
            self._coming.put(waits)
        except ServiceError:  # the boards are no slow part while they are programmed
            self._losses[LOST_IN_RELOAD] += 1

    def _unusable(self, record: Unusable) -> None:
        self._heard = True
        if self._once:
            self._fail(VariableError(record.sentence))
            return
        self._losses["with an unusable variable"] += 1
        if record.cause not in self._told:
            self._told.add(record.cause)
            self._log.warning(f"{record.sentence}; such messages are skipped and counted")

    def _next(self) -> None:
        app = self._peers["pcie-app"]
        if self._computing is not None or self._held or not app.ready or app.protocol is None:
            return
        if self._under_way >= RESULTS_UNDER_WAY or not self._peers["publisher"].ready:
            return
        waiting = self._waiting.get()
        if waiting is None:
            return
        reading, arrived = waiting
        self._number += 1
        frame = Frame(
            self._number,
            reading.addresses,
            self._number % self._deployment.machine.rng_banks,
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
        subscriber = self._peers["subscriber"].protocol
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
        publisher = self._peers["publisher"].protocol
        record = Publish(
            result=result,
            stamp_ns=reading.stamp_ns,
            received_ns=reading.received_ns,
            received_tick=reading.received_tick,
            reading_sent_tick=reading.sent_tick,
            waited_ns=sent - arrived,
        )
        if not self._under_way:
            self._published_at = time.monotonic()
        self._under_way += 1  # before it goes: a publisher in this process answers at once
        if publisher is None or not publisher.send(record):
            self._under_way -= 1
            self._losses["lost with the publisher"] += 1
        self._next()

    def _frame_failed(self, record: FrameFailed) -> None:
        if self._computing is not None and self._computing[0].number == record.number:
            self._computing = None
        if self._once:
            self._fail(ReportedError(record.exit_code, record.sentence))
            return
        self._losses["failed on a board"] += 1
        if "is not back yet" not in record.sentence:
            now = time.monotonic()
            self._failures.append(now)
            recent = [each for each in self._failures if now - each <= RESTARTS_WITHIN]
            if len(recent) > RESTARTS:
                msg = (
                    f"{record.sentence}; {len(recent)} frames failed on boards within {RESTARTS_WITHIN:.0f} s"
                )
                self._fail(BoardFailedError(msg))
                return
            self._log.warning(record.sentence, frame=record.number)
        elif self._follows:
            self._log.debug(record.sentence, frame=record.number)
        self._next()

    def _was_published(self, record: Published) -> None:
        self._under_way = max(0, self._under_way - 1)
        self._published_at = time.monotonic()
        if record.outcome == "published":
            self._published += 1
            self._last = (record.number, time.monotonic_ns())
            self._print(record)
            if record.seen is False:
                say(
                    f"the result was published, but not seen on the wire within {self._settings.seen_timeout:g} s"
                )
        elif self._once:
            if record.outcome == "no posterior":
                msg = f"frame {record.number} has no posterior: no line of the model counted for its readings; nothing was published"
                self._fail(VariableError(msg))
            else:
                self._fail(RosbridgeLostError("rosbridge went away before the result could be published"))
            return
        else:
            self._losses[record.outcome] += 1
        if self._count is not None and self._published >= self._count:
            self._done()
        else:
            self._next()

    # --- another deployment --------------------------------------------------------------------

    async def _ordered(self, order: ReloadOrder) -> str:
        """Reload; gives a sentence about it.

        Raises:
            ServiceError, ToolchainError: why the run goes on with the deployment that it had.
        """
        if self._reloads.locked():
            msg = "another reload is under way; try again when it is done"
            raise NotReloadedError(msg)
        folder = Path(order.folder or self._folder)
        async with self._reloads:
            try:
                sentence = await self._reload(folder)
            except Exception as error:
                hash_ = self._deployment.hash[:12]
                self._log.warning(f"not reloaded: {error}; deployment {hash_} goes on")
                raise
            self._log.info(sentence)
            return sentence

    async def _reload(self, folder: Path) -> str:
        """Have everybody read the new deployment, wait for the frames of the old one, and switch.

        The subscriber switches first: what it sends from then on waits here. Then the boards, when no frame is under
        way; from there on there is no way back, and the publisher follows.
        """
        waiting = [peer.role for peer in self._peers.values() if not peer.ready]
        if waiting or not self._began:
            msg = f"the run is not ready: it waits for {' and '.join(waiting) or 'its processes'}; try again when it has begun"
            raise NotReloadedError(msg)
        if not folder.is_absolute():
            msg = f"the folder {folder} is not absolute, and the master may stand somewhere else; give the whole path"
            raise SettingsError(msg)
        started = time.monotonic()
        number = self._generation + 1
        new = await asyncio.to_thread(read_new, folder, self._deployment, self._as_used)
        kept = await self._keep_copy(new, number)
        subscriber, publisher, app = (self._peers[role] for role in ("subscriber", "publisher", "pcie-app"))
        limit = self._settings.peer_timeout + _ANSWER_TIME
        for peer in (subscriber, publisher, app):
            where = kept if peer.child is not None else folder
            await self._ask(peer, Prepare(number, str(where), new.hash), limit, kept, folder)
        in_flight = 0
        try:
            self._coming = WaitingFrames(self._settings.queue or self._deployment.queue)
            await self._ask(subscriber, Switch(number), limit)
            in_flight = len(self._waiting) + (self._computing is not None) + self._under_way
            await self._drain()
            self._held = True
            if app.child is not None:
                app.child.give("--reprogram")  # if it is restarted in between, boards hold either image
            boards = len(new.boards) * max(_PROGRAM_TIME, self._settings.peer_timeout)
            await self._ask(app, Switch(number), limit + boards)
        except BaseException:
            await self._go_back()
            raise
        self._adopt(new, number, folder, kept)
        for peer in (publisher, subscriber):
            if peer.generation != number and peer.protocol is not None:
                try:
                    await self._ask(peer, Switch(number), limit)
                except ServiceError as error:
                    self._renew(peer, f"{error}; ending it")
        elapsed = (time.monotonic() - started) * 1000
        frames = "1 frame was" if in_flight == 1 else f"{in_flight} frames were"
        return (
            f"generation {number} is in force, deployment {new.hash[:12]} of {folder}; "
            f"{frames} in flight and finished before, {elapsed:.0f} ms"
        )

    async def _ask(
        self,
        peer: Peer,
        record: Prepare | Switch,
        limit: float,
        kept: Path | None = None,
        folder: Path | None = None,
    ) -> None:
        """Have a service prepare or switch.

        Raises:
            NotReloadedError: It is not there, ended, or did not answer in time (then it is ended).
            ReportedError: It could not, in its own words.
        """
        if peer.protocol is None or not peer.ready:
            msg = f"{peer.role} is not there now; try again when it is back"
            raise NotReloadedError(msg)
        what = "read the new deployment" if isinstance(record, Prepare) else "switch to it"
        peer.answer = asyncio.get_running_loop().create_future()
        try:
            if not peer.protocol.send(record):
                msg = f"{peer.role} ended meanwhile"
                raise NotReloadedError(msg)
            answer = await asyncio.wait_for(peer.answer, limit)
        except TimeoutError as error:
            msg = f"{peer.role} at {peer.where} did not {what} within {limit:g} s"
            self._renew(peer, f"{msg}; ending it")
            raise NotReloadedError(msg) from error
        finally:
            peer.answer = None
        if isinstance(answer, NotReloaded):
            # a copy's path says nothing to who made the folder
            said = answer.sentence.replace(str(kept), str(folder)) if kept else answer.sentence
            raise ReportedError(answer.exit_code, f"{peer.role}: {said}")
        if isinstance(answer, Switched):
            peer.generation = answer.generation

    async def _drain(self) -> None:
        """Wait for the frames of the deployment that is in force; those that still wait after that are lost.

        Raises:
            NotReloadedError: A frame or a result is under way for too long.
        """
        deadline = time.monotonic() + _DRAIN_TIME
        while self._waiting or self._computing is not None or self._under_way:
            if time.monotonic() > deadline:
                if self._computing is not None or self._under_way:
                    what = "a frame on the boards" if self._computing else "results at the publisher"
                    msg = f"{what} took longer than {_DRAIN_TIME:g} s; try again"
                    raise NotReloadedError(msg)
                return
            await asyncio.sleep(_CONNECT_EVERY)

    async def _go_back(self) -> None:
        """Have whoever switched already work by the deployment in force again."""
        coming, self._coming = self._coming, None
        if coming is not None:
            self._losses[LOST_IN_RELOAD] += len(coming)
            self._losses["passed over"] += coming.passed_over
        for peer in self._peers.values():
            if peer.generation != self._generation and peer.protocol is not None and peer.ready:
                try:
                    limit = _ANSWER_TIME + len(self._deployment.boards) * _PROGRAM_TIME
                    await self._ask(peer, Switch(self._generation), limit)
                except ServiceError as error:
                    self._renew(peer, f"{error}; ending it")
        self._held = False
        self._next()

    def _adopt(self, new: Deployment, number: int, folder: Path, kept: Path) -> None:
        """The boards have the new tables: hand on the readings that were made for them."""
        self._former_hash = self._deployment.hash
        self._deployment, self._generation, self._folder, self._kept = new, number, folder, kept
        for peer in self._peers.values():
            if peer.child is not None:
                peer.child.give("--deployment", str(kept))
        self._losses[LOST_IN_RELOAD] += len(self._waiting)
        self._losses["passed over"] += self._waiting.passed_over
        if self._coming is not None:
            self._waiting, self._coming = self._coming, None
        self._peers["pcie-app"].generation = number
        self._held = False
        if self._directory is not None:
            forget(self._directory, number - 2)  # a child may be reading the last one's just now
        self._next()

    def _renew(self, peer: Peer, sentence: str) -> None:
        """Have a service begin anew: by the deployment in force, if it is the master's own."""
        self._log.warning(sentence)
        if peer.child is not None:
            peer.child.kill()
        elif peer.protocol is not None:
            peer.protocol.close()

    def _is_outdated(self, peer: Peer, record: AnyRecord) -> bool:
        """Whether this is a child that was started before a reload and greets after it: it is started once more."""
        peer.outdated = (
            peer.child is not None
            and isinstance(record, Hello)
            and record.deployment_hash == self._former_hash != self._deployment.hash
        )
        if peer.outdated:
            self._renew(peer, f"{peer.role} was started before the reload; starting it anew")
        return peer.outdated

    def _as_used(self, deployment: Deployment) -> Deployment:
        """A deployment without what this run's flags override: it need not be the same in the next one."""
        update: dict[str, Any] = {}
        if self._settings.uri:
            uri = self._settings.uri
            update["sources"] = tuple(each.model_copy(update={"uri": uri}) for each in deployment.sources)
            update["outputs"] = tuple(each.model_copy(update={"uri": uri}) for each in deployment.outputs)
        if self._settings.queue:
            update["queue"] = self._settings.queue
        if self._board_endpoints:
            update["boards"] = tuple(each.model_copy(update={"endpoint": ""}) for each in deployment.boards)
        return deployment.model_copy(update=update)

    async def _keep_copy(self, deployment: Deployment, number: int) -> Path:
        """Copy a deployment for children; gives the folder that they are to read."""
        if self._directory is None or not any(peer.child for peer in self._peers.values()):
            return deployment.directory
        return await asyncio.to_thread(keep, deployment, self._directory, number)

    async def _keep_first(self) -> None:
        """Children that are restarted find the deployment of the run's beginning, whatever is built into its folder since."""
        try:
            kept = await self._keep_copy(self._deployment, 0)
        except Exception as error:  # without a copy, they read the folder itself
            self._log.warning(f"restarted services will read {self._folder} as it is then: {error}")
            return
        if self._generation == 0:
            for peer in self._peers.values():
                if peer.child is not None:
                    peer.child.give("--deployment", str(kept))

    # --- what the user sees --------------------------------------------------------------------

    def _print(self, record: Published) -> None:
        cell = self._cell(record.best_line)
        milliseconds = record.total_ns / 1e6
        if self._json:
            line = orjson.dumps(
                {
                    "frame": record.number,
                    "best": cell,
                    "probability": record.best_probability,
                    "cycles": record.cycles,
                    "ms": round(milliseconds, 3),
                    "seen": record.seen,
                    "generation": self._generation,
                }
            )
            try:
                sys.stdout.buffer.write(line + b"\n")
                sys.stdout.buffer.flush()
            except BrokenPipeError:
                raise
            except OSError as error:
                msg = f"standard output can't be written: {error.strerror or error}"
                raise ServiceError(msg) from error
        elif self._once:
            where = ", ".join(f"{label} = {value:g}" for label, value in cell.items())
            print(
                f"frame {record.number}: most probable {where} (p = {record.best_probability:.3g}), "
                f"{record.cycles} cycles, {milliseconds:.2f} ms",
                flush=True,
            )

    def _cell(self, line: int) -> dict[str, float]:
        cell: dict[str, float] = {}
        for dimension in reversed(self._deployment.result_dimensions):
            line, index = divmod(line, dimension.size)
            cell[dimension.label] = dimension.value(index)
        return dict(reversed(cell.items()))

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


app = make_app(
    "Move readings to the boards and posteriors back to the robot.\n\n"
    "`master --once -d build/boat --uri ws://robot:9090` computes one frame; `master --loop` goes on until Ctrl-C.\n\n"
    "`master reload -d build/boat2` has a running one take another deployment of the same shape.\n\n"
    "It starts what is not running (subscriber, publisher, pcie-app, emulated boards) and ends it again. "
    "Exit codes: 0 done, 2 usage or deployment, 3 rosbridge, 4 a variable, 5 a board, 6 a process, 130, 143."
)


Parameters = ParamSpec("Parameters")


def _unless_another(
    command: Callable[Concatenate[typer.Context, Parameters], int],
) -> Callable[..., None]:
    """Run a command that has commands of its own, where none of those was given."""
    run = ends_well(command)

    @functools.wraps(command)
    def unless(context: typer.Context, *args: Parameters.args, **kwargs: Parameters.kwargs) -> None:
        if context.invoked_subcommand is None:
            run(context, *args, **kwargs)

    return unless


@app.callback(help=app.info.help, invoke_without_command=True)
@_unless_another
def master(
    context: typer.Context,
    once: Annotated[bool, typer.Option("--once", help="Compute the first complete frame, then end.")] = False,
    loop: Annotated[bool, typer.Option("--loop", help="Go on until Ctrl-C, or --count.")] = False,
    count: options.Count = None,
    deployment: options.Deployment = None,
    uri: options.Uri = None,
    connect: Annotated[
        Path | None,
        typer.Option(
            help="Folder with subscriber.sock, publisher.sock and pcie-app.sock of services that already run."
        ),
    ] = None,
    boards: options.Boards = None,
    queue: options.Queue = None,
    stop: options.Stop = None,
    ros_version: options.RosVersion = None,
    connect_timeout: options.ConnectTimeout = None,
    first_data_timeout: options.FirstDataTimeout = None,
    peer_timeout: options.PeerTimeout = None,
    board_timeout: options.BoardTimeout = None,
    stop_timeout: options.StopTimeout = None,
    fused: Annotated[
        bool | None,
        typer.Option(
            "--fused",
            help="Run subscriber, publisher and pcie-app inside this process: fewer hops, nothing else differs.",
        ),
    ] = None,
    log_level: options.LogLevel = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per result.")] = False,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="Print all settings as they are in force, and end.")
    ] = False,
) -> int:
    """Move readings to the boards and posteriors back to the robot."""
    del context  # it says whether there is something to do here at all
    end_with_parent()
    connected = {}
    if connect is not None:
        if not connect.is_dir():
            msg = f"--connect {connect} is no folder; name the one with the sockets of the services that run already"
            raise SettingsError(msg)
        for name in ("subscriber", "publisher", "pcie-app"):
            connected[name.replace("-", "_")] = str(endpoint_in(connect, name))
    settings = load_settings(
        deployment=deployment,
        uri=uri,
        boards=boards,
        queue=queue,
        stop=stop,
        ros_version=ros_version,
        connect_timeout=connect_timeout,
        first_data_timeout=first_data_timeout,
        peer_timeout=peer_timeout,
        board_timeout=board_timeout,
        stop_timeout=stop_timeout,
        fused=fused,
        log_level=log_level,
        **connected,
    )
    if print_config:
        print(orjson.dumps(settings.model_dump(mode="json"), option=orjson.OPT_INDENT_2).decode())
        return ExitCode.DONE
    if once == loop:
        msg = "choose one of --once and --loop"
        raise SettingsError(msg)
    if once and count is not None:
        msg = "--count belongs to --loop; --once computes one frame"
        raise SettingsError(msg)
    loaded = deployment_for(settings)
    return run_async(run_master(settings, loaded, once=once, count=count, json=json))


@app.command("reload")
@ends_well
def reload_(
    deployment: options.Deployment = None,
    directory: Annotated[
        Path | None,
        typer.Option(
            "--directory", help="Run folder of the master (BM_RUN_DIRECTORY), as for `status`.", metavar="DIR"
        ),
    ] = None,
) -> int:
    """Have a running `master --loop` take another deployment of the same shape, or the same folder as it is now.

    `toolchain regenerate memories build/boat --model casestudies/boat`, then `master reload -d build/boat`: readings and results go on. If
    it can't be taken, the run goes on with what it has, and the sentence says why. Exit codes: 0 done, 2 another shape
    or damaged, 5 a board, 6 not now.
    """
    end_with_parent()
    settings = load_settings(deployment=deployment, run_directory=directory)
    folder = "" if settings.deployment is None else str(settings.deployment.absolute())

    async def order() -> int:
        from services.status import find_run

        run = settings.run_directory or await find_run()
        print(await give_order(control_socket(run), ReloadOrder(folder), timeout=RELOAD_TIME))
        return ExitCode.DONE

    return run_async(order())


def main() -> None:
    """Entry point of the command `master`."""
    app()
