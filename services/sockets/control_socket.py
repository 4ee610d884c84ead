"""Control socket of a running master: a JSON line with an order in, a JSON object with the answer out.

`master.control.sock` is accessible only to its user (0600), in BM_CONTROL_DIRECTORY or in the run directory.
Orders are bounded in size, time and number; others are answered with one sentence, and the connection is
closed.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import msgspec

from pcie_shim.endpoint import Endpoint, listen, remove_listener
from pcie_shim.errors import PcieShimError
from services.errors import ControlError, NotReloadedError, ReportedError
from terminal.errors import ExitCode, exit_code_of
from terminal.output import say
from terminal.private_directory import CONTROL_SUFFIX

ORDER_LIMIT = 1 << 14
"""Maximum size of an order in bytes, with room for a path of 4096 escaped characters."""

ORDER_TIME = 5.0
"""Seconds in which a client must send its order."""

CLIENTS = 8
"""Maximum number of concurrent connections; more are refused."""

ANSWER_LIMIT = 1 << 20


class ReloadOrder(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="order", tag="reload"):
    """An order to use the deployment in this folder; empty for the folder in force."""

    folder: str = ""


class Answer(msgspec.Struct, frozen=True):
    """The result of an order: an exit code for the command, and a sentence."""

    exit_code: int
    sentence: str


Execute = Callable[[ReloadOrder], Awaitable[str]]
"""Function that executes an order and returns a sentence about it."""


def control_socket(directory: Path, name: str = "master") -> Path:
    """Return the path of the control socket of a process."""
    return directory.absolute() / f"{name}{CONTROL_SUFFIX}"


def order_of(line: bytes) -> ReloadOrder:
    """Return the order in a line, or raise a ControlError."""
    try:
        return msgspec.json.decode(line, type=ReloadOrder)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ControlError(
            f'this is not an order ({error}); expected {{"order": "reload", "folder": "/path"}} and a line\'s end'
        ) from error


async def _order(reader: asyncio.StreamReader) -> ReloadOrder:
    try:
        async with asyncio.timeout(ORDER_TIME):
            line = await reader.readline()
    except TimeoutError as error:
        raise ControlError(f"no order came within {ORDER_TIME:g} s") from error
    except ValueError as error:
        raise ControlError(f"an order has at most {ORDER_LIMIT} bytes") from error
    return order_of(line)


class _Clients:
    """Connected clients, each with a task that ends with the run."""

    def __init__(self, execute: Execute) -> None:
        self._execute = execute
        self._tasks: set[asyncio.Task[None]] = set()

    def connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.ensure_future(self._serve(reader, writer, full=len(self._tasks) >= CLIENTS))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, full: bool) -> None:
        try:
            if full:
                answer = Answer(ExitCode.CHILD, f"{CLIENTS} other clients are connected now; try again later")
            else:
                answer = await self._answer(reader)
            with contextlib.suppress(OSError, TimeoutError):
                async with asyncio.timeout(ORDER_TIME):
                    writer.write(msgspec.json.encode(answer))
                    writer.write_eof()
                    # a socket that is closed with unread bytes discards the answer
                    while await reader.read(1 << 16):
                        pass
        finally:
            writer.close()

    async def _answer(self, reader: asyncio.StreamReader) -> Answer:
        try:
            order = await _order(reader)
        except (ControlError, OSError) as error:
            return Answer(ExitCode.USAGE, str(error))
        try:
            return Answer(ExitCode.DONE, await self._execute(order))
        except Exception as error:  # the client gets the error, and the run continues
            return Answer(exit_code_of(error), str(error) or type(error).__name__)

    async def end(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)


@contextlib.asynccontextmanager
async def serve_control(directory: Path | None, execute: Execute) -> AsyncIterator[None]:
    """Accept orders in the running loop within the context; do nothing without a directory.

    A socket that cannot be opened only causes a warning, because it must not end a robot's run.
    """
    endpoint = Endpoint(path="" if directory is None else str(control_socket(directory)))
    try:
        listener = listen(endpoint) if endpoint.path else None
    except PcieShimError as error:
        say(f"master: warning: it cannot be reloaded: {error}")
        listener = None
    if listener is None:
        yield
        return
    clients = _Clients(execute)
    server = await asyncio.start_unix_server(clients.connected, sock=listener, limit=ORDER_LIMIT)
    try:
        yield
    finally:
        server.close()
        await clients.end()
        remove_listener(endpoint, listener)


async def give_order(path: Path, order: ReloadOrder, *, timeout: float) -> str:
    """Send an order to a running master; return its sentence.

    Raises:
        ControlError: No master listens there, or the answer is malformed.
        NotReloadedError: No answer in time.
        ReportedError: The master refused, with its own sentence and exit code.
    """
    try:
        async with asyncio.timeout(timeout):
            reader, writer = await asyncio.open_unix_connection(path)
            try:
                writer.write(msgspec.json.encode(order) + b"\n")
                await writer.drain()
                data = await _all(reader, path)
            finally:
                writer.close()
    except TimeoutError as error:
        raise NotReloadedError(
            f"the master at {path} did not answer within {timeout:g} s; `status` shows the deployment in force"
        ) from error
    except OSError as error:
        raise ControlError(
            f"no master listens at {path} ({error.strerror or error}); is a master --loop running, with this BM_CONTROL_DIRECTORY or BM_RUN_DIRECTORY?"
        ) from error
    if not data:
        raise NotReloadedError(f"the master at {path} exited before it had finished")
    try:
        answer = msgspec.json.decode(data, type=Answer)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ControlError(
            f"the answer at {path} does not come from a master of this version ({error})"
        ) from error
    if answer.exit_code:
        raise ReportedError(answer.exit_code, answer.sentence)
    return answer.sentence


async def _all(reader: asyncio.StreamReader, path: Path) -> bytes:
    data = bytearray()
    while part := await reader.read(65536):
        data += part
        if len(data) > ANSWER_LIMIT:
            raise ControlError(
                f"the answer at {path} has more than {ANSWER_LIMIT} bytes: it is not one of a master"
            )
    return bytes(data)
