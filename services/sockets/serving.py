"""The services of a run, and their end of the local socket to the master.

A service accepts one master at a time:

master ──connects──▶ service   a second master is refused with `Trouble`
       ◀───Hello────           role, version, deployment
       ────Hello───▶           a difference is refused with `Trouble`
       ◀─Notice, Ready         notices not yet sent, and the current state
       ◀──records──▶
"""

import asyncio
import socket
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Protocol, Self

from pcie_shim.credentials import read_key
from pcie_shim.endpoint import Endpoint, listen, parse_endpoint, remove_listener
from pcie_shim.errors import PcieShimError
from services.errors import OtherPeerError, OutdatedError, SettingsError
from services.settings import Settings
from services.sockets.local_socket import RecordProtocol, check_hello, own_hello
from services.sockets.records import AnyRecord, Hello, Notice, Record, Trouble
from services.sockets.reporting import check_metrics, serve_status
from services.sockets.status import ProcessStatus
from terminal.errors import ExitCode, exit_code_of
from terminal.logs import get_logger
from toolchain.deployment import Deployment, load_deployment
from toolchain.errors import ToolchainError

GREETING_TIME = 5.0
"""If a client sends no hello for this many seconds, the service disconnects the client."""
MAX_UNSAID = 4
"""Maximum number of notices that are stored for the next master. Further notices replace the oldest."""
_REPORT_ATTEMPTS = 100
_REPORT_INTERVAL = 0.02


class Link(Protocol):
    """The connection of a service to its master: over a local socket, or inside the same process."""

    masters: int = 1
    """Number of masters that have sent their hello so far."""

    @property
    def has_master(self) -> bool:
        """True while a master is connected and has sent its hello."""

    @property
    def backlog(self) -> int:
        """Number of sent bytes that the master has not read yet."""
        return 0

    def send(self, record: Record) -> bool:
        """Send a record to the master. Return False if no master is connected."""

    def keep(self, record: Record) -> None:
        """Send a lasting state, such as readiness, now. Send it again to every master that connects later."""
        self.send(record)

    def notice(self, level: str, sentence: str) -> None:
        """Send the master a message for the user. The run continues."""
        self.send(Notice(level, sentence))

    async def __aenter__(self) -> Self:
        """Open the link, so that a master can connect."""
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the link."""


MakeLink = Callable[[Callable[[AnyRecord], None]], Link]
"""Function that creates a service's link.

The argument is a callback of the service. The link passes every record from the master to this callback, except hellos.
"""


class MasterLink(Link):
    """A link that listens on a local socket for a master, and passes the master's records on.

    A second master is refused until the first has disconnected. If the deployment folder has changed since the
    service started, and a master requires the new deployment, the service ends with an error.
    """

    def __init__(
        self, endpoint: Endpoint, role: str, deployment: Deployment, on_record: Callable[[AnyRecord], None]
    ) -> None:
        self._endpoint = endpoint
        self._role = role
        self._deployment = deployment
        self._on_record = on_record
        # From `__aenter__` on.
        self._server: asyncio.Server | None = None
        self._listener: socket.socket | None = None
        # The task of the service, which is cancelled when a master requires the new deployment in its folder, and the
        # error that then replaces the cancellation.
        self._service: asyncio.Task[Any] | None = None
        self._outdated: OutdatedError | None = None
        # The connection that is served, and whether its hello has arrived; records go only to a greeted master.
        self._master: RecordProtocol | None = None
        self._greeted = False
        self.masters = 0
        # For the next master: the last record of each lasting state, and messages that nobody has received.
        self._last: dict[type[Record], Record] = {}
        self._unsaid: deque[Notice] = deque(maxlen=MAX_UNSAID)

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

    async def __aexit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Stop listening, remove the socket, and raise an OutdatedError if a master requires a new deployment."""
        if self._server is not None:
            self._server.close()
        if self._master is not None:
            self._master.close()
            # the transport closes its socket in the next turn of the loop
            await asyncio.sleep(0)
        if self._listener is not None:
            remove_listener(self._endpoint, self._listener)
        if self._outdated is not None and kind is asyncio.CancelledError:
            raise self._outdated from None

    def _open(self, protocol: RecordProtocol) -> None:
        if self._master is not None:
            # it is refused after its hello, because a record sent before might never be read
            return
        self._master = protocol
        self._greeted = False
        protocol.send(own_hello(self._role, self._deployment.hash))
        asyncio.get_running_loop().call_later(GREETING_TIME, self._check_greeted, protocol)

    def _check_greeted(self, protocol: RecordProtocol) -> None:
        if protocol is self._master and not self._greeted:
            protocol.close()

    def _take(self, protocol: RecordProtocol, record: AnyRecord) -> None:
        if protocol is not self._master:
            protocol.send(
                Trouble(ExitCode.USAGE, f"the {self._role} at {self._endpoint} serves another master already")
            )
            protocol.close()
            return
        # nothing else from a peer counts before it is known to be a master of this version and deployment
        if not self._greeted:
            try:
                check_hello(record, "master", self._deployment.hash, f"{self._role} at {self._endpoint}")
            except OtherPeerError as error:
                protocol.send(Trouble(error.exit_code, str(error)))
                # after a restart, by whoever started this service, it has the deployment of the master
                self._outdated = outdated(self._deployment, record)
                if self._outdated is not None and self._service is not None:
                    self._service.cancel()
                raise
            self._greeted = True
            self.masters += 1
            # first the notices, which led to the lasting states
            for each in (*self._unsaid, *self._last.values()):
                protocol.send(each)
            self._unsaid.clear()
            return
        if not isinstance(record, Hello):
            self._on_record(record)

    def _closed(self, protocol: RecordProtocol, _: Exception | None) -> None:
        if protocol is self._master:
            self._master = None

    @property
    def has_master(self) -> bool:
        """True while a master is connected and has sent its hello."""
        return self._master is not None and self._greeted

    @property
    def backlog(self) -> int:
        """Number of sent bytes that the master has not read yet."""
        return 0 if self._master is None else self._master.backlog

    def send(self, record: Record) -> bool:
        """Send a record to the master. Return False if no master is connected."""
        return self._master is not None and self._greeted and self._master.send(record)

    def keep(self, record: Record) -> None:
        """Send a lasting state, such as readiness, now. Send it again to every master that connects later."""
        self._last[type(record)] = record
        self.send(record)

    def notice(self, level: str, sentence: str) -> None:
        """Send the master a message for the user. If no master is connected, store the message for the next master."""
        if not self.send(record := Notice(level, sentence)):
            self._unsaid.append(record)


def listening(
    listen: str, role: str, settings: Settings, deployment: Deployment, *, insecure: bool
) -> MakeLink:
    """Return a function that creates the link of a service. The link listens for the master at the endpoint `listen`.

    Raises:
        SettingsError: `listen` is not an endpoint. If `insecure` is False, the error is also raised if other machines
            could reach the endpoint or the metrics.
    """
    check_metrics(settings.metrics, insecure=insecure)
    endpoint = endpoint_from(listen, "--listen")
    if endpoint.host and not insecure and not endpoint.is_loopback:
        raise SettingsError(
            f"--listen {listen} lets everybody on that network compute frames and read results; "
            "use unix:PATH or a loopback address, or give --insecure if that is intended"
        )
    return lambda on_record: MasterLink(endpoint, role, deployment, on_record)


class RunService(ABC):
    """A service of a run. The service works for one master at a time through a link, and reports its status."""

    role: ClassVar[str]

    def __init__(self, settings: Settings, link: MakeLink) -> None:
        self._settings = settings
        self._link = link(self._take)
        self._log = get_logger(self.role, settings.log_level)
        # Whether each frame is logged, because its texts take time.
        self._logs_frames = settings.log_level == "debug"

    async def run(self) -> int:
        """Serve until cancelled, or until an error. Unless the error is a bug, the service reports it to the master.

        Raises:
            OutdatedError: The deployment was rebuilt after this service loaded it, and a master requires the new one.
        """
        settings = self._settings
        status = serve_status(settings.run_directory, self.role, self.status, metrics=settings.metrics)
        async with self._link, status:
            try:
                await self._serve()
            except Exception as error:
                await report_failure(self._link, error)
                raise
        return 0

    @abstractmethod
    def status(self) -> ProcessStatus:
        """Return the status of this process."""

    @abstractmethod
    def _take(self, record: AnyRecord) -> None:
        """Handle a record of the master."""

    @abstractmethod
    async def _serve(self) -> None:
        """Do the work of the service, while the link is open."""


async def report_failure(link: Link, error: BaseException) -> None:
    """Send the master the error that ends this service.

    An error that indicates a bug is not sent, because the service prints it.
    """
    code = exit_code_of(error)
    if code == ExitCode.BUG or not isinstance(error, Exception):
        return
    for _ in range(_REPORT_ATTEMPTS):  # a master that was started with us may still be connecting
        if link.send(Trouble(code, str(error))):
            return
        await asyncio.sleep(_REPORT_INTERVAL)


def outdated(deployment: Deployment, refused: AnyRecord) -> OutdatedError | None:
    """Return an error that advises a restart of this service, or None if a restart would not help.

    This service has loaded `deployment`, and has refused a master because of the record `refused`. A restart helps if
    `refused` is a `Hello` for another deployment, and the folder of `deployment` now contains that other deployment.
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
        "and a master requires the new one; restart this service"
    )


def endpoint_from(text: str, flag: str) -> Endpoint:
    """Parse the endpoint that a user gave to a flag, or raise a SettingsError that names the flag."""
    try:
        return parse_endpoint(text)
    except PcieShimError as error:
        raise SettingsError(f"{flag}: {error}") from error


def deployment_for(settings: Settings, *, images: bool = False) -> Deployment:
    """Load the deployment that the settings name. With `images`, check its images.

    Raises:
        SettingsError: The settings do not name a deployment.
        ToolchainError: The deployment is damaged, of another version, or missing.
    """
    if settings.deployment is None:
        raise SettingsError(
            "no deployment was given: use --deployment DIR (or BM_DEPLOYMENT), with a folder written by `toolchain build`"
        )
    return load_deployment(settings.deployment, images=images)


def board_endpoints(settings: Settings, deployment: Deployment) -> list[Endpoint]:
    """Return the boards' endpoints from the settings or, if the settings have none, from the deployment.

    The endpoint `unix:/folder/` stands for all boards that `board --directory` runs in this folder.

    Raises:
        SettingsError: A board has no valid endpoint, or the number of endpoints is wrong.
        CredentialsError: The file with the boards' key is unusable.
    """
    # a flag or variable replaces all endpoints of the deployment, never some of them
    texts = settings.boards or tuple(board.endpoint for board in deployment.boards)
    if len(texts) == 1 and texts[0].startswith("unix:") and texts[0].endswith("/"):
        texts = tuple(f"{texts[0]}board{at}.sock" for at in range(len(deployment.boards)))
    if len(texts) != len(deployment.boards):
        raise SettingsError(
            f"--boards (or BM_BOARDS) names {len(texts)} board(s), and {deployment.directory} has {len(deployment.boards)}; "
            "name each once, in the order of the partitions, or a folder as unix:/folder/ with a slash at its end"
        )
    if not all(texts) and any(texts):
        raise SettingsError(
            f"{deployment.path} names endpoints of some boards only; name all of them, or none (then the master starts emulated ones)"
        )
    if not all(texts):
        raise SettingsError(
            "the deployment names no endpoints of boards; give --boards ENDPOINT,... (start some with: board --boards 4 --directory DIR)"
        )
    where = "--boards" if settings.boards else f"{deployment.path}, [[board]] endpoint"
    return [board_endpoint(text, where, settings) for text in texts]


def board_endpoint(text: str, where: str, settings: Settings) -> Endpoint:
    """Parse the endpoint of a board. A TCP endpoint also gets the key from `settings.key_file`, if that is set.

    Raises:
        SettingsError: `text` is not an endpoint. The error says that `text` comes from `where`.
        CredentialsError: The key file cannot be used.
    """
    endpoint = endpoint_from(text, where)
    if not endpoint.host or settings.key_file is None:
        return endpoint
    return replace(endpoint, key=read_key(settings.key_file))
