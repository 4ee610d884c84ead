"""A service's side of a local socket: it listens, and serves one master at a time."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from types import TracebackType
from typing import Any, Protocol, Self

from pcie_shim.endpoint import Endpoint, listen, parse_endpoint, remove_listener
from pcie_shim.errors import PcieShimError
from services.errors import OtherPeerError, OutdatedError, SettingsError
from services.settings import Settings
from services.sockets.local_socket import RecordProtocol, check_hello, own_hello
from services.sockets.records import AnyRecord, Hello, Notice, Record, Trouble
from toolchain.deployment import Deployment, load_deployment
from toolchain.errors import ToolchainError

GREETING_TIME = 5.0
"""Seconds that who connects has to greet, before the place is free for another."""


class Link(Protocol):
    """What a service holds of its master: over a local socket, or inside the same process."""

    @property
    def has_master(self) -> bool:
        """Whether a master is there and has greeted."""

    @property
    def backlog(self) -> int:
        """Bytes that the master has not taken yet."""

    def send(self, record: Record) -> bool:
        """Send to the master; False where there is none."""

    def keep(self, record: Record) -> None:
        """Send now, and again to every later master: what is true from now on (readiness)."""

    def notice(self, level: str, sentence: str) -> None:
        """Tell the master something that ends nothing."""

    def serve(self, deployment: Deployment) -> None:
        """Greet later masters with another deployment from now on."""

    async def __aenter__(self) -> Self:
        """Begin to serve."""

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End."""


MakeLink = Callable[[Callable[[AnyRecord], None]], Link]
"""Makes a service's link; the argument takes the master's records, its greeting first."""


class MasterLink:
    """Listens for a master, greets it, and passes its records on.

    A second master is told that there is one already and is turned away; when a master goes, the next may come. A
    service that was started before its folder was changed, and is asked for what is there now, ends by an error.
    """

    def __init__(
        self, endpoint: Endpoint, role: str, deployment: Deployment, on_record: Callable[[AnyRecord], None]
    ) -> None:
        self._endpoint = endpoint
        self._role = role
        self._deployment = deployment
        self._service: asyncio.Task[Any] | None = None
        self._outdated: OutdatedError | None = None
        self._on_record = on_record
        self._master: RecordProtocol | None = None
        self._greeted = False
        self._server: asyncio.Server | None = None
        self._listener: socket.socket | None = None
        self._last: dict[type[Record], Record] = {}

    async def __aenter__(self) -> Self:
        """Start listening."""
        loop = asyncio.get_running_loop()
        self._service = asyncio.current_task()
        listener = self._listener = listen(self._endpoint)

        def make() -> RecordProtocol:
            return RecordProtocol(f"{self._role} at {self._endpoint}", self._take, self._open, self._closed)

        if self._endpoint.path:
            self._server = await loop.create_unix_server(make, sock=listener)
        else:
            self._server = await loop.create_server(make, sock=listener)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop listening; take the socket's file away.

        Raises:
            OutdatedError: that is why it ends.
        """
        if self._server is not None:
            self._server.close()
        if self._master is not None:
            self._master.close()
            await asyncio.sleep(0)
        if self._listener is not None:
            remove_listener(self._endpoint, self._listener)
        if self._outdated is not None and kind is asyncio.CancelledError:
            raise self._outdated from None

    def _open(self, protocol: RecordProtocol) -> None:
        if self._master is not None:
            return  # it is told so when it greets: what is sent before might never be read
        self._master = protocol
        self._greeted = False
        protocol.send(own_hello(self._role, self._deployment.hash))
        asyncio.get_running_loop().call_later(GREETING_TIME, self._check_greeted, protocol)

    def _check_greeted(self, protocol: RecordProtocol) -> None:
        if protocol is self._master and not self._greeted:
            protocol.close()

    def _take(self, protocol: RecordProtocol, record: AnyRecord) -> None:
        if protocol is not self._master:
            protocol.send(Trouble(2, f"the {self._role} at {self._endpoint} serves another master already"))
            protocol.close()
            return
        if not self._greeted:
            try:
                check_hello(record, "master", self._deployment.hash, f"{self._role} at {self._endpoint}")
            except OtherPeerError as error:
                protocol.send(Trouble(error.exit_code, str(error)))
                self._outdated = outdated(self._deployment, record)
                if self._outdated is not None and self._service is not None:
                    self._service.cancel()
                raise
            self._greeted = True
            self._on_record(record)
            for each in self._last.values():
                protocol.send(each)
            return
        if not isinstance(record, Hello):
            self._on_record(record)

    def _closed(self, protocol: RecordProtocol, _: Exception | None) -> None:
        if protocol is self._master:
            self._master = None

    @property
    def has_master(self) -> bool:
        """Whether a master is connected and has greeted."""
        return self._master is not None and self._greeted

    @property
    def backlog(self) -> int:
        """Bytes that the master has not taken yet."""
        return 0 if self._master is None else self._master.backlog

    def send(self, record: Record) -> bool:
        """Send to the master; False where there is none."""
        return self._master is not None and self._greeted and self._master.send(record)

    def keep(self, record: Record) -> None:
        """Send now, and again to every later master: what is true from now on (readiness)."""
        self._last[type(record)] = record
        self.send(record)

    def notice(self, level: str, sentence: str) -> None:
        """Tell the master something that ends nothing."""
        self.send(Notice(level, sentence))

    def serve(self, deployment: Deployment) -> None:
        """Greet later masters with another deployment from now on."""
        self._deployment = deployment


def listening(endpoint: Endpoint, role: str, deployment: Deployment) -> MakeLink:
    """A link over a local socket that the service listens on."""
    return lambda on_record: MasterLink(endpoint, role, deployment, on_record)


def outdated(deployment: Deployment, refused: AnyRecord) -> OutdatedError | None:
    """Why a service that refused a master's greeting has to be started anew; None where that would not help.

    Args:
        deployment: what the service works by.
        refused: the greeting.
    """
    if not isinstance(refused, Hello) or refused.deployment_hash == deployment.hash:
        return None
    try:
        there = load_deployment(deployment.directory, images=False).hash
    except (ToolchainError, OSError):
        return None
    if there != refused.deployment_hash:
        return None
    return OutdatedError(
        f"{deployment.directory} was changed since this was started, from deployment {deployment.hash[:12]} to {there[:12]}, "
        "and a master asks for what is there now; start this anew"
    )


def endpoint_from(text: str, flag: str) -> Endpoint:
    """An endpoint that a user gave.

    Raises:
        SettingsError: it is none.
    """
    try:
        return parse_endpoint(text)
    except PcieShimError as error:
        msg = f"{flag}: {error}"
        raise SettingsError(msg) from error


def deployment_for(settings: Settings, *, images: bool = False) -> Deployment:
    """The deployment that the settings name.

    Raises:
        SettingsError: none is named.
        ToolchainError: it is damaged, of another version, or not there.
    """
    if settings.deployment is None:
        msg = "no deployment was given: use --deployment DIR (or BM_DEPLOYMENT), with a folder that `toolchain build` wrote"
        raise SettingsError(msg)
    return load_deployment(settings.deployment, images=images)


def board_endpoints(settings: Settings, deployment: Deployment) -> list[Endpoint]:
    """Where the boards are: the settings' list, else the deployment's own endpoints.

    Raises:
        SettingsError: a board has no endpoint, or there are too few or too many.
    """
    texts = settings.boards or tuple(board.endpoint for board in deployment.boards)
    if len(texts) != len(deployment.boards):
        msg = f"--boards names {len(texts)} of the deployment's {len(deployment.boards)} boards; name each once, in the order of the partitions"
        raise SettingsError(msg)
    if not all(texts) and any(texts):
        msg = f"{deployment.path} names endpoints of some boards only; name all of them, or none (then the master starts emulated ones)"
        raise SettingsError(msg)
    if not all(texts):
        msg = "the deployment names no endpoints of boards; give --boards ENDPOINT,... (start some with: board --boards 4 --directory DIR)"
        raise SettingsError(msg)
    where = "--boards" if settings.boards else f"{deployment.path}, [[board]] endpoint"
    return [endpoint_from(text, where) for text in texts]
