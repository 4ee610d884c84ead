"""Peers of the master (subscriber, publisher, pcie-app): starting, connecting, restarting and stopping them.

    _keep:  _connect ──▶ _watch ──connection lost──▶ _bring_back ──▶ _connect ...
    records of a connection:  Hello ──▶ Ready ──▶ (all ready: Begin) ──▶ readings, frames, results ──▶ FrameFlow

Each peer has a task `_keep`. An error of this task ends the run. With `--fused`, the services run as tasks of the
master, and there are no connections to keep.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from pcie_shim.endpoint import Endpoint
from pcie_shim.wires import LinkRate
from services.child import RESTARTS, Child, ForkedCommand, end_all
from services.errors import (
    BoardFailedError,
    ChildDiedError,
    OtherPeerError,
    ReportedError,
    SettingsError,
    StackError,
)
from services.master.command_lines import boards_arguments, service_arguments
from services.settings import Settings, endpoint_in
from services.sockets.local_socket import RecordProtocol, check_hello, open_connection, own_hello
from services.sockets.records import AnyRecord, Begin, Notice, Ready, Rosbridge, Trouble
from services.sockets.serving import board_endpoints, endpoint_from
from services.sockets.status import PeerStatus
from terminal.errors import ExitCode
from terminal.logs import Logger
from terminal.output import say
from terminal.run_directory import LockedRunDirectory
from toolchain.deployment import Deployment

if TYPE_CHECKING:
    from services.master.fused import FusedEnd  # it imports all three services


ROLE = "master"
ANSWER_TIME = 60.0
"""Seconds that a service may take beyond its own timeouts before the master treats it as stuck."""

COMPILING_TIME = 60.0
"""Additional seconds for boards that the master starts, because they may first compile their kernels."""

_CONNECT_EVERY = 0.01
_WATCH_EVERY = 1.0
_RECONNECT_TIME = 60.0


class Peer:
    """A service that the master uses, with its connection. If the master starts the service, `child` is its process.

    A service inside the master's process has no endpoint.
    """

    def __init__(self, role: str, endpoint: Endpoint | None, child: Child | None) -> None:
        self.role = role
        self.endpoint = endpoint
        self.where = "this process" if endpoint is None else str(endpoint)
        self.child = child
        # State of the present connection, which `_keep` resets: None and False between two connections. Records count
        # only from a peer that has greeted; frames and results go only to a peer that is ready.
        self.protocol: RecordProtocol | FusedEnd | None = None
        self.greeted = False
        self.ready = False
        self.away = False
        """True while it has no connection to its rosbridge servers."""
        # Set at the end of the connection, with its error if it had one. The error of a service of another version
        # or deployment ends the run; after any other error, the connection is restored.
        self.closed = asyncio.Event()
        self.reason: Exception | None = None
        # When its time to greet or to get ready began (monotonic, s).
        self.since = 0.0
        # True after a warning that it is gone, until it greets again: one warning for each absence.
        self.missed = False

    def cut(self) -> None:
        """If the master started the peer's process, kill the process. Otherwise close the connection.

        The master's task for this peer then restarts the process, or connects again.
        """
        if self.child is not None:
            self.child.kill()
        elif self.protocol is not None:
            self.protocol.close()


@dataclass(frozen=True, slots=True)
class Awaited:
    """A step that a peer has to take within `limit` seconds from the time `since` (monotonic, s)."""

    what: str
    since: float
    limit: float


class PeerEvents(Protocol):
    """Receiver of the events of peers."""

    @property
    def is_idle(self) -> bool:
        """True while no frame is in progress."""

    def ready(self, peer: Peer) -> None:
        """Handle a peer that has become ready."""

    def received(self, peer: Peer, record: AnyRecord) -> None:
        """Handle a record about a reading, a frame or a result."""

    def lost(self, peer: Peer) -> None:
        """Handle the loss of a connection to a peer, and count the frame or the results that are lost."""

    def awaited(self, peer: Peer) -> Awaited | None:
        """Return the step that a ready peer has to take next, or None."""

    def fail(self, error: Exception) -> None:
        """End the run."""


class Peers:
    """The three services, and the boards' process if the master starts the boards."""

    def __init__(self, settings: Settings, deployment: Deployment, log: Logger, *, once: bool) -> None:
        self._settings = settings
        self._deployment = deployment
        self._log = log
        self._once = once
        # The receiver of events, given to `start`; no record arrives before.
        self._events: PeerEvents
        # Determined by `prepare`, in the order in which a frame meets them: the services by role, the run
        # directory if any of them is started here, the boards' process if the master starts it, and where boards listen.
        self._by_role: dict[str, Peer] = {}
        self._run: LockedRunDirectory | None = None
        self._boards: Child | None = None
        self.board_endpoints: tuple[str, ...] = ()
        # Tasks that keep peers and boards, which end at once; and services in this process, which get time to end.
        self._tasks: list[asyncio.Task[None]] = []
        self._inside: list[asyncio.Task[None]] = []
        self.begun = asyncio.Event()
        """Set when all peers have been ready."""

    def __iter__(self) -> Iterator[Peer]:
        """Iterate over the three services."""
        return iter(self._by_role.values())

    @property
    def subscriber(self) -> Peer:
        """The source of readings."""
        return self._by_role["subscriber"]

    @property
    def publisher(self) -> Peer:
        """The destination of results."""
        return self._by_role["publisher"]

    @property
    def app(self) -> Peer:
        """The service that computes frames."""
        return self._by_role["pcie-app"]

    @property
    def directory(self) -> Path | None:
        """The run directory, or None if all services run outside the master."""
        return None if self._run is None else self._run.path

    @property
    def not_ready(self) -> list[str]:
        """The roles of peers that are not ready."""
        return [peer.role for peer in self if not peer.ready]

    def status(self) -> list[PeerStatus]:
        """Return the status of each peer."""
        return [
            PeerStatus(
                name=peer.role,
                endpoint=peer.where,
                pid=peer.child.pid if peer.child else 0,
                restarts=peer.child.restarts if peer.child else 0,
                ready=peer.ready,
            )
            for peer in self
        ]

    # --- starting and ending -------------------------------------------------------------------

    def prepare(self) -> None:
        """Determine which peers are running, and how to start the other peers.

        Raises:
            SettingsError: The settings contain a wrong endpoint, or an endpoint together with `fused`.
            OccupiedError: Another run uses the run directory.
        """
        settings, deployment = self._settings, self._deployment
        given = {
            "subscriber": settings.subscriber,
            "publisher": settings.publisher,
            "pcie-app": settings.pcie_app,
        }
        if not all(given.values()):
            self._run = LockedRunDirectory(settings.run_directory)
        directory = self.directory
        if settings.boards or any(board.endpoint for board in deployment.boards):
            board_endpoints(settings, deployment)  # check the list before anything starts
        role = next((role for role, text in given.items() if text), None)
        if settings.fused and role is not None:
            raise SettingsError(
                f"--fused runs subscriber, publisher and pcie-app in the process of the master; omit --connect or --{role}"
            )
        self.board_endpoints = settings.boards
        endpoints = [board.endpoint for board in deployment.boards]
        if not given["pcie-app"] and directory is not None and not settings.boards and not all(endpoints):
            self.board_endpoints = tuple(
                str(endpoint_in(directory, f"board{at}")) for at in range(len(endpoints))
            )
            arguments = boards_arguments(len(endpoints), directory, settings, once=self._once)
            self._boards = ForkedCommand("the boards' process", "board", arguments, directory=self._run)
        elif settings.link_rate is not LinkRate.NONE or settings.read_results:
            raise SettingsError(
                "--link-rate and --read-results are for boards that the master starts, and those of this run are started "
                "elsewhere: give the flags to their command `board`"
            )
        for role, text in given.items():
            self._by_role[role] = Peer(role, None, None) if settings.fused else self._peer(role, text)

    def _peer(self, role: str, text: str) -> Peer:
        """Return the peer of a role: the service at the endpoint `text`, or, if that is empty, a child to start."""
        if text or self.directory is None:
            return Peer(role, endpoint_from(text, f"--{role}"), None)
        endpoint = endpoint_in(self.directory, role)
        # boards that this master starts can hold only images of this run
        reprogram = role == "pcie-app" and self._boards is not None
        arguments = service_arguments(role, endpoint, self._service_settings, reprogram=reprogram)
        return Peer(role, endpoint, ForkedCommand(role, role, arguments, directory=self._run))

    @property
    def _service_settings(self) -> Settings:
        """Settings of the services that this master starts or contains."""
        peer_timeout = self._settings.peer_timeout + self._compiling_time
        return self._settings.model_copy(
            update={"boards": self.board_endpoints, "peer_timeout": peer_timeout}
        )

    @property
    def _compiling_time(self) -> float:
        """Additional seconds to wait for boards that the master starts, which may compile their kernels."""
        return 0.0 if self._boards is None else COMPILING_TIME

    async def start(self, events: PeerEvents) -> None:
        """Start peers that are not running, and connect to all peers. From then on, restore lost connections."""
        self._events = events
        if self._boards is not None:
            await self._boards.start()
            self._begin_task(self._keep_boards(self._boards))
        # once for all of them, while the boards load their kernels
        for peer in self:
            if peer.child is not None:
                import_module(f"services.commands.{peer.role.replace('-', '_')}")
        for peer in self:
            if peer.child is not None:
                await peer.child.start()
        if self._settings.fused:
            self._start_inside()
        else:
            for peer in self:
                self._begin_task(self._keep(peer))

    def _begin_task(self, work: Coroutine[Any, Any, Any], *, inside: bool = False) -> None:
        """Start a task. An error of the task ends the run. `inside` marks the task of a service in this process."""

        async def guarded() -> None:
            try:
                await work
            except Exception as error:
                self._events.fail(error)

        task = asyncio.ensure_future(guarded())
        task.add_done_callback(lambda _: work.close())  # a task cancelled before it begins never awaits it
        (self._inside if inside else self._tasks).append(task)

    def _start_inside(self) -> None:
        """With `--fused`, run each service as a task in this process."""
        from services.master.fused import fused_services

        settings = self._service_settings.model_copy(update={"run_directory": self.directory})

        def to_master(role: str) -> Callable[[AnyRecord], None]:
            peer = self._by_role[role]
            return lambda record: self._take(peer, record)

        for role, (end, service) in fused_services(settings, self._deployment, to_master).items():
            peer = self._by_role[role]
            peer.protocol, peer.greeted = end, True
            self._begin_task(service, inside=True)

    async def leave(self) -> None:
        """Stop restoring lost connections, and give services in this process a grace period to end."""
        for task in (*self._tasks, *self._inside):
            task.cancel()
        if self._inside:
            await asyncio.wait(self._inside, timeout=self._settings.stop_timeout)

    async def end(self) -> None:
        """Stop the processes that the master started, and release the run directory."""
        children = [peer.child for peer in self if peer.child is not None]
        if self._boards is not None:
            children.append(self._boards)
        for peer in self:
            if peer.protocol is not None:
                peer.protocol.close()
        stop_timeout = self._settings.stop_timeout
        if killed := await end_all(children, stop_timeout):
            say(f"{' and '.join(killed)} did not end within {stop_timeout:g} s and had to be killed")
        if self._run is not None:
            self._run.release()

    # --- processes and connections -------------------------------------------------------------

    async def _keep_boards(self, boards: Child) -> None:
        while True:
            await boards.wait()
            failure = boards.failure()
            if boards.exit_code == ExitCode.BOARD:
                # it has restarted its boards as often as it may
                raise failure
            if self._once or not boards.may_restart(self._settings.restart_window):
                raise BoardFailedError(str(failure))
            self._log.warning(f"{failure}; restarting it")
            await boards.start()

    async def _keep(self, peer: Peer) -> None:
        first = True
        while True:
            # the exit of the master's own process is detected, so while it is alive it is only slow
            limit = _RECONNECT_TIME if peer.child is not None or not first else 0.0
            await self._connect(peer, max(limit, self._settings.peer_timeout))
            first = False
            await self._watch(peer)
            peer.protocol, peer.ready, peer.away = None, False, False
            self._events.lost(peer)
            await self._bring_back(peer)

    async def _connect(self, peer: Peer, limit: float) -> None:
        if peer.endpoint is None:
            return
        deadline = time.monotonic() + limit

        def make() -> RecordProtocol:
            return RecordProtocol(
                f"{peer.role} at {peer.where}",
                lambda _, record: self._take(peer, record),
                lambda protocol: self._opened(peer, protocol),
                lambda protocol, why: self._closed(peer, protocol, why),
            )

        peer.greeted = False
        peer.since = time.monotonic()
        peer.reason = None
        peer.closed.clear()
        while True:
            if peer.child is not None and not peer.child.is_running:
                await self._restart(peer.child)
                deadline = time.monotonic() + limit
            try:
                await open_connection(peer.endpoint, make)
            except OSError as error:
                if time.monotonic() > deadline:
                    hint = (
                        "is it running?"
                        if peer.child is None
                        else "it was started but is not listening yet: is the computer overloaded?"
                    )
                    raise ChildDiedError(
                        f"no {peer.role} answers at {peer.where} within {limit:g} s ({error.strerror or error}); {hint}"
                    ) from error
                await asyncio.sleep(_CONNECT_EVERY)
            else:
                peer.since = time.monotonic()
                return

    async def _watch(self, peer: Peer) -> None:
        """Wait until the connection is closed; disconnect a peer that does not answer in time."""
        while not peer.closed.is_set():
            awaited = self._awaited(peer)
            left = _WATCH_EVERY
            if awaited is not None:
                left = awaited.since + awaited.limit - time.monotonic()
                if left <= 0:
                    self._cut_stuck(peer, awaited)
                    left = _WATCH_EVERY
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(min(left, _WATCH_EVERY)):
                    await peer.closed.wait()

    def _cut_stuck(self, peer: Peer, awaited: Awaited) -> None:
        sentence = f"{peer.role} at {peer.where} did not {awaited.what} within {awaited.limit:g} s"
        if self._once or peer.child is None:
            self._events.fail(ChildDiedError(sentence))
        else:
            self._log.warning(f"{sentence}; ending it")
        peer.cut()
        peer.since = time.monotonic()

    def _awaited(self, peer: Peer) -> Awaited | None:
        settings = self._settings
        if not peer.greeted:
            return Awaited("greet", peer.since, settings.peer_timeout)
        if not peer.ready:
            boards = len(self._deployment.boards)
            limit = settings.connect_timeout + boards * settings.peer_timeout + self._compiling_time
            return Awaited("get ready", peer.since, limit)
        return self._events.awaited(peer)

    async def _bring_back(self, peer: Peer) -> None:
        """Restart the process after a lost connection, or raise the error that ends the run."""
        if isinstance(peer.reason, StackError):
            raise peer.reason
        child = peer.child
        if child is None:
            if self._once:
                raise ChildDiedError(f"{peer.role} at {peer.where} closed the connection")
            # a killed process may accept one more connection before its socket disappears
            if not peer.missed:
                self._log.warning(f"{peer.role} at {peer.where} is gone; waiting for it")
            peer.missed = True
            return
        # it closes its socket before it exits, and its exit code says whether another start would help
        await self._ended(child)
        await self._restart(child)

    async def _restart(self, child: Child) -> None:
        """Start a process again when it has exited, or raise the error that ends the run."""
        await child.wait()
        failure = child.failure()
        if self._once or failure.exit_code != ExitCode.CHILD:
            raise failure
        window = self._settings.restart_window
        if not child.may_restart(window):
            raise ChildDiedError(f"{failure}; it was restarted {RESTARTS} times within {window:g} s before")
        self._log.warning(f"{failure}; restarting it")
        await child.start()

    async def _ended(self, child: Child) -> None:
        """Wait until a process that has closed its connection exits.

        If the process still runs after `stop_timeout`, kill it.
        """
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(child.wait(), self._settings.stop_timeout)
        if child.is_running:
            child.kill()
            await child.wait()

    # --- records -------------------------------------------------------------------------------

    def _opened(self, peer: Peer, protocol: RecordProtocol) -> None:
        peer.protocol = protocol
        protocol.send(own_hello(ROLE, self._deployment.hash))

    def _closed(self, peer: Peer, protocol: RecordProtocol, why: Exception | None) -> None:
        # a refused connection to a socket that is about to disappear may end after the next one has begun
        if peer.protocol in (protocol, None):
            peer.reason = why
            peer.closed.set()

    def _take(self, peer: Peer, record: AnyRecord) -> None:
        try:
            self._dispatch(peer, record)
        except OtherPeerError:
            # the connection closes with it, and `_bring_back` raises it
            raise
        except Exception as error:  # a closed standard output, or a bug: not an error of the connection
            self._events.fail(error)

    def _dispatch(self, peer: Peer, record: AnyRecord) -> None:
        if isinstance(record, Trouble):
            self._events.fail(ReportedError(record.exit_code, f"{peer.role}: {record.sentence}"))
        elif not peer.greeted:
            check_hello(record, peer.role, self._deployment.hash, f"{peer.role} at {peer.where}")
            peer.greeted, peer.missed = True, False
        elif isinstance(record, Ready):
            self._ready(peer, record)
        elif isinstance(record, Rosbridge):
            self._rosbridge(peer, record)
        elif isinstance(record, Notice):
            (self._log.warning if record.level == "warning" else self._log.info)(record.sentence)
        else:
            self._events.received(peer, record)

    def _ready(self, peer: Peer, record: Ready) -> None:
        peer.ready = True
        self._log_ready(peer, record)
        # the publisher must advertise before the subscriber subscribes, because results need a topic
        if self.begun.is_set():
            self._begin(peer)
        elif not self.not_ready:
            self.begun.set()
            for each in self:
                self._begin(each)
        self._events.ready(peer)

    def _log_ready(self, peer: Peer, record: Ready) -> None:
        self._log.info(f"{peer.role}: {record.sentence}")

    def _rosbridge(self, peer: Peer, record: Rosbridge) -> None:
        peer.away = not record.connected
        if record.connected:
            # the other one may be waiting for its next attempt, several seconds later
            for other in self:
                if other is not peer and other.away and other.protocol is not None:
                    other.protocol.send(record)
            self._events.ready(peer)

    def _begin(self, peer: Peer) -> None:
        if peer is not self.app and peer.protocol is not None:
            peer.protocol.send(Begin(self._once))
