"""The master's peers: subscriber, publisher, pcie-app and boards, started where they do not run, connected, brought back, ended."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from structlog.typing import FilteringBoundLogger

from pcie_shim.endpoint import Endpoint
from services.errors import (
    BoardFailedError,
    ChildDiedError,
    NotReloadedError,
    OtherPeerError,
    ReportedError,
    SettingsError,
    StackError,
)
from services.pipeline.generations import InForce
from services.settings import Settings, endpoint_in
from services.sockets.local_socket import RecordProtocol, check_hello, open_connection, own_hello
from services.sockets.records import AnyRecord, Hello, NotReloaded, Prepared, Switched, Trouble
from services.sockets.serving import board_endpoints, endpoint_from
from services.sockets.status import PeerStatus
from services.supervision.child import RESTARTS, RESTARTS_WITHIN, Child, end_all, own_command
from services.supervision.private_directory import PrivateDirectory
from terminal.errors import ExitCode
from terminal.output import say

if TYPE_CHECKING:
    from services.master.fused import FusedEnd  # with all that the three services import


ROLE = "master"
ANSWER_TIME = 60.0
"""Seconds that a service may take beyond its own limits, before it counts as stuck."""

COMPILING_TIME = 60.0
"""Seconds that the run's own boards may take longer to listen: where no kernels are kept yet, they compile them first."""

_CONNECT_EVERY = 0.01
_RECONNECT_PATIENCE = 60.0


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

    def cut(self) -> None:
        """End it if it is the master's own process, else close the connection: either begins anew."""
        if self.child is not None:
            self.child.kill()
        elif self.protocol is not None:
            self.protocol.close()

    def answered(self, record: Prepared | Switched | NotReloaded) -> None:
        """Hand its answer on to the reload that asked for it."""
        if self.answer is not None and not self.answer.done():
            self.answer.set_result(record)


@dataclass(frozen=True, slots=True)
class Awaited:
    """What a peer has to do: in words, since when (monotonic, s), and within how many seconds."""

    what: str
    since: float
    limit: float


class Moving(Protocol):
    """What moves between the peers, as their processes and connections see it: the run."""

    def take(self, peer: Peer, record: AnyRecord) -> None:
        """A peer that has greeted sent a record."""

    def lost(self, peer: Peer) -> None:
        """A peer is gone, with whatever it had."""

    def awaited(self, peer: Peer) -> Awaited | None:
        """What a peer that is ready was asked for and has not answered yet."""

    def fail(self, error: Exception) -> None:
        """End the run."""


class Peers:
    """The three services, and the boards' process if the master starts it."""

    def __init__(
        self,
        settings: Settings,
        in_force: InForce,
        moving: Moving,
        log: FilteringBoundLogger,
        *,
        once: bool,
    ) -> None:
        self._settings = settings
        self._in_force = in_force
        self._moving = moving
        self._log = log
        self._once = once
        self._private: PrivateDirectory | None = None
        self._boards: Child | None = None
        self._by_role: dict[str, Peer] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self._inside: list[asyncio.Task[None]] = []
        self.board_endpoints: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[Peer]:
        """Each of them."""
        return iter(self._by_role.values())

    @property
    def subscriber(self) -> Peer:
        """Who makes readings."""
        return self._by_role["subscriber"]

    @property
    def publisher(self) -> Peer:
        """Who takes results."""
        return self._by_role["publisher"]

    @property
    def app(self) -> Peer:
        """Who computes frames."""
        return self._by_role["pcie-app"]

    @property
    def directory(self) -> Path | None:
        """The run's private folder, if it needs one."""
        return None if self._private is None else self._private.path

    @property
    def not_ready(self) -> list[str]:
        """The roles of those that are waited for."""
        return [peer.role for peer in self if not peer.ready]

    def status(self) -> list[PeerStatus]:
        """What is known of each."""
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

    def give(self, flag: str, value: str) -> None:
        """Start those that are the master's own with another value of a flag from now on."""
        for peer in self:
            if peer.child is not None:
                peer.child.give(flag, value)

    def renew(self, peer: Peer, sentence: str) -> None:
        """Have a service begin anew: by the deployment in force, if it is the master's own."""
        self._log.warning(sentence)
        peer.cut()

    # --- starting and ending -------------------------------------------------------------------

    def prepare(self) -> None:
        """Find out which of them run already, and how the others are to be started.

        Raises:
            SettingsError: the settings contradict each other.
        """
        settings, deployment = self._settings, self._in_force.deployment
        given = {
            "subscriber": settings.subscriber,
            "publisher": settings.publisher,
            "pcie-app": settings.pcie_app,
        }
        if not all(given.values()):
            self._private = PrivateDirectory()
        directory = self.directory
        if settings.boards or any(board.endpoint for board in deployment.boards):
            board_endpoints(settings, deployment)  # a wrong list is told before anything starts
        if settings.fused and any(given.values()):
            role = next(role for role, text in given.items() if text)
            msg = f"--fused runs subscriber, publisher and pcie-app in the master's own process; take --connect or --{role} away"
            raise SettingsError(msg)
        boards = list(settings.boards)
        if not given["pcie-app"] and directory is not None:
            endpoints = [board.endpoint for board in deployment.boards]
            if not boards and not all(endpoints):
                boards = [str(endpoint_in(directory, f"board{at}")) for at in range(len(endpoints))]
                command = [*own_command("board"), "--boards", str(len(boards)), "--directory", str(directory)]
                command += ["--restarts", "0" if self._once else str(RESTARTS)]
                self._boards = Child("the boards' process", command, directory=directory)
        self.board_endpoints = tuple(boards)
        if settings.fused:
            self._by_role = {role: Peer(role, None, None) for role in given}
            return
        for role, text in given.items():
            child = None
            if text:
                endpoint = endpoint_from(text, f"--{role}")
            else:
                assert directory is not None  # noqa: S101 - made above for whoever has no endpoint
                endpoint = endpoint_in(directory, role)
                command = [*own_command(role), "--listen", str(endpoint), *self._arguments(role)]
                child = Child(role, command, directory=directory)
            self._by_role[role] = Peer(role, endpoint, child)

    def _arguments(self, role: str) -> list[str]:
        """The flags that a child is started with, so that it works by the settings of the run."""
        settings = self._settings
        flags = ["--deployment", str(settings.deployment), "--log-level", settings.log_level]
        if role == "pcie-app":
            flags += ["--boards", ",".join(self.board_endpoints)] if self.board_endpoints else []
            flags += ["--stop", settings.stop] if settings.stop else []
            flags += ["--peer-timeout", str(settings.peer_timeout + self._compiling_time)]
            flags += ["--board-timeout", str(settings.board_timeout)]
            # nobody else can have programmed boards of this run
            flags += ["--reprogram"] if self._boards is not None else []
            return flags
        flags += ["--uri", settings.uri] if settings.uri else []
        flags += ["--ros-version", settings.ros_version, "--connect-timeout", str(settings.connect_timeout)]
        if role == "publisher":
            return [*flags, "--seen-timeout", str(settings.seen_timeout)]
        flags += ["--first-data-timeout", str(settings.first_data_timeout)]
        return [*flags, "--queue", settings.queue] if settings.queue else flags

    @property
    def _compiling_time(self) -> float:
        """Seconds more that boards may take to listen. Whether one of the run's own has died is seen without it."""
        return 0.0 if self._boards is None else COMPILING_TIME

    async def start(self) -> None:
        """Start what does not run, connect to all, and bring back what is lost from then on."""
        if self._boards is not None:
            await self._boards.start()
            self._tasks.append(asyncio.ensure_future(self._keep_boards(self._boards)))
        for peer in self:
            if peer.child is not None:
                await peer.child.start()
        if self._settings.fused:
            self._inside = self._start_inside()
        else:
            self._tasks.extend(asyncio.ensure_future(self._keep(peer)) for peer in self)

    async def leave(self) -> None:
        """Bring nothing back any more; services in this process have a moment to end."""
        for task in (*self._tasks, *self._inside):
            task.cancel()
        if self._inside:
            await asyncio.wait(self._inside, timeout=self._settings.stop_timeout)

    async def end(self) -> None:
        """End what was started, and take the private folder away."""
        children = [peer.child for peer in self if peer.child is not None]
        if self._boards is not None:
            children.append(self._boards)
        for peer in self:
            if peer.protocol is not None:
                peer.protocol.close()
        killed = await end_all(children, self._settings.stop_timeout)
        if killed:
            say(
                f"{' and '.join(killed)} did not end within {self._settings.stop_timeout:g} s and had to be killed"
            )
        if self._private is not None:
            self._private.remove()

    # --- processes -----------------------------------------------------------------------------

    async def _keep_boards(self, boards: Child) -> None:
        try:
            await self._restart_boards(boards)
        except Exception as error:
            self._moving.fail(error)

    def _start_inside(self) -> list[asyncio.Task[None]]:
        """`--fused`: run the services here, each as a task."""
        from services.master.fused import fused_services

        settings = self._settings.model_copy(
            update={
                "boards": self.board_endpoints,
                "peer_timeout": self._settings.peer_timeout + self._compiling_time,
                "run_directory": self._settings.run_directory or self.directory,
            }
        )

        def to_master(role: str) -> Callable[[AnyRecord], None]:
            peer = self._by_role[role]
            return lambda record: self._take(peer, record)

        tasks = []
        for role, (end, service) in fused_services(settings, self._in_force.deployment, to_master).items():
            peer = self._by_role[role]
            peer.protocol, peer.greeted = end, True
            tasks.append(asyncio.ensure_future(self._run_inside(service)))
        return tasks

    async def _run_inside(self, service: Coroutine[Any, Any, int]) -> None:
        try:
            await service
        except Exception as error:  # what a user can mend was reported before, and ended the run
            self._moving.fail(error)

    async def _restart_boards(self, boards: Child) -> None:
        while True:
            await boards.ended()
            failure = boards.failure()
            if boards.exit_code == ExitCode.BOARD:
                self._moving.fail(failure)
                return
            if self._once or not boards.may_restart():
                self._moving.fail(BoardFailedError(str(failure)))
                return
            self._log.warning(f"{failure}; restarting it")
            await boards.start()

    async def _keep(self, peer: Peer) -> None:
        try:
            first = True
            while True:
                # a process of the master's own is seen to end: while it lives it is merely slow, on a busy computer
                patience = _RECONNECT_PATIENCE if peer.child is not None or not first else 0.0
                await self._connect(peer, max(patience, self._settings.peer_timeout))
                first = False
                closing = asyncio.ensure_future(peer.closed.wait())
                while not closing.done():
                    self._check_stuck(peer)
                    await asyncio.wait([closing], timeout=0.05)
                peer.protocol, peer.ready = None, False
                self._lost(peer)
                await self._again(peer)
        except Exception as error:
            self._moving.fail(error)

    def _check_stuck(self, peer: Peer) -> None:
        """A peer that is there but does not answer is treated as dead."""
        now = time.monotonic()
        awaited = self._awaited(peer)
        if awaited is None or now - awaited.since <= awaited.limit:
            return
        sentence = f"{peer.role} at {peer.where} did not {awaited.what} within {awaited.limit:g} s"
        if self._once or peer.child is None:
            self._moving.fail(ChildDiedError(sentence))
        else:
            self._log.warning(f"{sentence}; ending it")
        peer.cut()
        peer.since = now

    def _awaited(self, peer: Peer) -> Awaited | None:
        settings = self._settings
        if not peer.greeted:
            # pcie-app greets when the boards are open
            opening = self._compiling_time if peer.role == "pcie-app" else 0.0
            return Awaited("greet", peer.since, settings.peer_timeout + opening)
        if not peer.ready:
            boards = len(self._in_force.deployment.boards)
            limit = settings.connect_timeout + boards * settings.peer_timeout + self._compiling_time
            return Awaited("get ready", peer.since, limit)
        return self._moving.awaited(peer)

    async def _connect(self, peer: Peer, patience: float) -> None:
        deadline = time.monotonic() + patience

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
            child = peer.child
            if child is not None and not child.is_running:
                await child.ended()
                raise child.failure()
            if peer.endpoint is None:
                return
            try:
                await open_connection(peer.endpoint, make)
            except OSError as error:
                if time.monotonic() > deadline:
                    mend = (
                        "is it running?"
                        if child is None
                        else "it was started, and is not there yet: is the computer too busy?"
                    )
                    msg = f"no {peer.role} answers at {peer.where} within {patience:g} s ({error.strerror or error}); {mend}"
                    raise ChildDiedError(msg) from error
                await asyncio.sleep(_CONNECT_EVERY)
            else:
                peer.since = time.monotonic()
                return

    def _lost(self, peer: Peer) -> None:
        peer.outdated = False
        if peer.answer is not None and not peer.answer.done():
            peer.answer.set_exception(NotReloadedError(f"{peer.role} ended meanwhile"))
        self._moving.lost(peer)

    async def _again(self, peer: Peer) -> None:
        """After a lost connection: bring the process back, or say why the run is over."""
        if isinstance(peer.reason, StackError):
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
        if child.is_running:
            child.kill()
            await child.ended()
        failure = child.failure()
        if self._once or getattr(failure, "exit_code", ExitCode.CHILD) != ExitCode.CHILD:
            raise failure
        if not child.may_restart():
            msg = f"{failure}; it was restarted {RESTARTS} times within {RESTARTS_WITHIN:.0f} s before"
            raise ChildDiedError(msg)
        self._log.warning(f"{failure}; restarting it")
        await child.start()

    # --- greetings -----------------------------------------------------------------------------

    def _opened(self, peer: Peer, protocol: RecordProtocol) -> None:
        peer.protocol = protocol
        protocol.send(own_hello(ROLE, self._in_force.deployment.hash, self._in_force.generation))

    def _closed(self, peer: Peer, protocol: RecordProtocol, why: Exception | None) -> None:
        if peer.protocol in (protocol, None):
            peer.reason = why
            peer.closed.set()

    def _take(self, peer: Peer, record: AnyRecord) -> None:
        try:
            self._hear(peer, record)
        except OtherPeerError:
            raise
        except Exception as error:  # a closed standard output, or a bug: neither may pass for a lost peer
            self._moving.fail(error)

    def _hear(self, peer: Peer, record: AnyRecord) -> None:
        if peer.outdated:
            return
        if isinstance(record, Trouble):
            self._moving.fail(ReportedError(record.exit_code, f"{peer.role}: {record.sentence}"))
        elif peer.greeted:
            self._moving.take(peer, record)
        elif not self._is_outdated(peer, record):
            check_hello(record, peer.role, self._in_force.deployment.hash, f"{peer.role} at {peer.where}")
            peer.greeted = True
            peer.generation = self._in_force.generation
            peer.missed = False

    def _is_outdated(self, peer: Peer, record: AnyRecord) -> bool:
        """Whether this is a child that was started before a reload and greets after it: it is started once more."""
        in_force = self._in_force
        peer.outdated = (
            peer.child is not None
            and isinstance(record, Hello)
            and record.deployment_hash == in_force.former_hash != in_force.deployment.hash
        )
        if peer.outdated:
            self.renew(peer, f"{peer.role} was started before the reload; starting it anew")
        return peer.outdated
