"""Orders to a running master, over a socket of its own: one JSON line in, one JSON object out.

`master.control.sock` belongs to its user alone (0600), in the folder that BM_CONTROL_DIRECTORY names, else in the run's.
What comes over it is bounded in size, time and number; what is no order gets one sentence, and is done with.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import msgspec

from pcie_shim.endpoint import Endpoint, listen, remove_listener
from pcie_shim.errors import PcieShimError
from services.errors import ControlError, NotReloadedError, ReportedError
from services.supervision.private_directory import CONTROL_SUFFIX
from terminal.errors import ExitCode, exit_code_of
from terminal.output import say

ORDER_LIMIT = 1 << 14
"""Bytes of the longest order: a folder's path of 4096 characters, each escaped, fits."""

ORDER_TIME = 5.0
"""Seconds that who connects has to say it."""

CALLERS = 8
"""Connections at a time; more are turned away."""

ANSWER_LIMIT = 1 << 20


class ReloadOrder(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="order", tag="reload"):
    """Take the deployment in this folder; empty: in the one that is in force."""

    folder: str = ""


class Answer(msgspec.Struct, frozen=True):
    """What became of an order: an exit code for the command that gave it, and a sentence."""

    exit_code: int
    sentence: str


Obey = Callable[[ReloadOrder], Awaitable[str]]
"""Does what was ordered, and gives a sentence about it."""


def control_socket(directory: Path, name: str = "master") -> Path:
    """Where a process takes orders."""
    return directory.absolute() / f"{name}{CONTROL_SUFFIX}"


def order_of(line: bytes) -> ReloadOrder:
    """What a line orders.

    Raises:
        ControlError: Nothing; says what was expected.
    """
    try:
        return msgspec.json.decode(line, type=ReloadOrder)
    except (msgspec.MsgspecError, RecursionError) as error:
        msg = (
            f'that is no order ({error}); expected {{"order": "reload", "folder": "/path"}} and a line\'s end'
        )
        raise ControlError(msg) from error


async def _order(reader: asyncio.StreamReader) -> ReloadOrder:
    try:
        async with asyncio.timeout(ORDER_TIME):
            line = await reader.readline()
    except TimeoutError as error:
        msg = f"no order came within {ORDER_TIME:g} s"
        raise ControlError(msg) from error
    except ValueError as error:
        msg = f"an order has {ORDER_LIMIT} bytes at most"
        raise ControlError(msg) from error
    return order_of(line)


class _Callers:
    """Those who are connected: each has its task, which ends with the run."""

    def __init__(self, obey: Obey) -> None:
        self._obey = obey
        self._tasks: set[asyncio.Task[None]] = set()

    def called(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.ensure_future(self._serve(reader, writer, full=len(self._tasks) >= CALLERS))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, full: bool) -> None:
        try:
            if full:
                answer = Answer(ExitCode.CHILD, f"{CALLERS} others give orders already; try again")
            else:
                answer = await self._answer(reader)
            with contextlib.suppress(OSError, TimeoutError):
                async with asyncio.timeout(ORDER_TIME):
                    writer.write(msgspec.json.encode(answer))
                    writer.write_eof()
                    # a socket that is closed with something unread takes the answer along
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
            return Answer(ExitCode.DONE, await self._obey(order))
        except Exception as error:  # whoever ordered it is told, and the run goes on
            return Answer(exit_code_of(error), str(error) or type(error).__name__)

    async def end(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)


@contextlib.asynccontextmanager
async def control_served(directory: Path | None, obey: Obey) -> AsyncIterator[None]:
    """Take orders in the running loop while the context lasts; nothing happens without a directory.

    A socket that can't be had is a warning: a robot's run does not end by that.
    """
    endpoint = Endpoint(path="" if directory is None else str(control_socket(directory)))
    try:
        listener = listen(endpoint) if endpoint.path else None
    except PcieShimError as error:
        say(f"master: warning: it takes no orders: {error}")
        listener = None
    if listener is None:
        yield
        return
    callers = _Callers(obey)
    server = await asyncio.start_unix_server(callers.called, sock=listener, limit=ORDER_LIMIT)
    try:
        yield
    finally:
        server.close()
        await callers.end()
        remove_listener(endpoint, listener)


async def give_order(path: Path, order: ReloadOrder, *, timeout: float) -> str:
    """Have a running master do something; gives its sentence.

    Raises:
        ControlError: Nobody takes orders there, or the answer is none.
        NotReloadedError: No answer in time.
        ReportedError: The master could not; with its sentence and exit code.
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
        msg = f"the master at {path} did not answer within {timeout:g} s; `status` says which deployment is in force"
        raise NotReloadedError(msg) from error
    except OSError as error:
        msg = f"no master takes orders at {path} ({error.strerror or error}); is a master --loop running, with this BM_CONTROL_DIRECTORY or BM_RUN_DIRECTORY?"
        raise ControlError(msg) from error
    if not data:
        msg = f"the master at {path} ended before it was done"
        raise NotReloadedError(msg)
    try:
        answer = msgspec.json.decode(data, type=Answer)
    except (msgspec.MsgspecError, RecursionError) as error:
        msg = f"what answers at {path} is no master of rosbayes, or one of another version ({error})"
        raise ControlError(msg) from error
    if answer.exit_code:
        raise ReportedError(answer.exit_code, answer.sentence)
    return answer.sentence


async def _all(reader: asyncio.StreamReader, path: Path) -> bytes:
    data = bytearray()
    while part := await reader.read(65536):
        data += part
        if len(data) > ANSWER_LIMIT:
            msg = f"what answers at {path} says more than {ANSWER_LIMIT} bytes: it is no master of rosbayes"
            raise ControlError(msg)
    return bytes(data)
