"""Status socket of a process, which reports whether the process is ready, and the reason.

A process listens on `NAME.status.sock` in the run directory. Only the user of the process can access the socket
(mode 0600). Each client receives one JSON object with at least `ready` and `why`. The process reads nothing, and
closes the connection. Health checks run every few seconds, so the import of this module must be fast. It imports only
the standard library. Only the process that answers at a status socket also imports asyncio.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    import asyncio

SUFFIX = ".status.sock"
ANSWER_LIMIT = 1 << 20
"""Maximum size of an answer in bytes."""

_END_TIMEOUT = 2.0


class NoHealthError(Exception):
    """A process did not report its status. The message continues a sentence that begins with the process's name."""


def status_socket(directory: str | os.PathLike[str], name: str) -> str:
    """Return the path of the status socket of the process `name`."""
    return os.path.join(directory, name + SUFFIX)


# --- asking ----------------------------------------------------------------------------------------


def read_status(path: str, timeout: float) -> bytes:
    """Return the answer of a process at its status socket.

    Raises a NoHealthError if no answer of at most `ANSWER_LIMIT` bytes arrives within `timeout` seconds.
    """
    deadline = time.monotonic() + timeout
    data = bytearray()
    with silence_explained(path, timeout), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.settimeout(timeout)
        asking.connect(path)
        while len(data) <= ANSWER_LIMIT:
            asking.settimeout(max(0.001, deadline - time.monotonic()))
            part = asking.recv(1 << 16)
            if not part:
                return bytes(data)
            data += part
    raise foreign_socket_error(path)


@contextlib.contextmanager
def silence_explained(path: str, timeout: float) -> Iterator[None]:
    """Within the context, turn an OSError or a TimeoutError into a NoHealthError that says why no answer came."""
    try:
        yield
    except TimeoutError:
        raise NoHealthError(f"does not answer at {path} within {timeout:g} s") from None
    except ConnectionRefusedError:
        raise NoHealthError(f"was killed and has not been restarted yet: nothing listens at {path}") from None
    except OSError as error:
        sentence = f"is not running, or does not report its status at {path} ({error.strerror or error})"
        raise NoHealthError(sentence) from None


def foreign_socket_error(path: str) -> NoHealthError:
    """Return the error for an answer that is not the status of a rosbayes process."""
    return NoHealthError(f"is not a rosbayes process of this version, according to its answer at {path}")


def is_ready(path: str, timeout: float) -> tuple[bool, str]:
    """Return whether a process is ready, and why. Raises a NoHealthError if the process gives no valid answer."""
    data = read_status(path, timeout)
    try:
        status = json.loads(data)
        return status["ready"] is True, str(status["why"])
    except (ValueError, TypeError, KeyError, RecursionError):
        raise foreign_socket_error(path) from None


def resources() -> dict[str, float]:
    """Return the CPU time of this process in seconds, and its resident memory in bytes."""
    with open("/proc/self/statm", encoding="ascii") as statm:
        pages = int(statm.read().split()[1])
    return {"cpu_s": round(time.process_time(), 3), "memory_bytes": pages * os.sysconf("SC_PAGESIZE")}


# --- answering -------------------------------------------------------------------------------------


def _listen(path: str) -> socket.socket:
    """Listen at a path, replacing a socket that a killed process left; raise an OSError if another process listens."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)  # a full backlog means that a process is listening
        if probe.connect_ex(path) == errno.ECONNREFUSED:
            os.unlink(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        # Linux creates the file with the mode of the socket, so another user can never connect
        os.fchmod(listener.fileno(), 0o600)
        listener.bind(path)
        listener.listen()
    except OSError:
        listener.close()
        raise
    return listener


@contextlib.contextmanager
def _listening(directory: str | os.PathLike[str] | None, name: str) -> Iterator[socket.socket | None]:
    """Listen within the context; yield None without a directory, or after a warning if the socket cannot be created."""
    listener = None
    path = "" if directory is None else status_socket(os.path.abspath(directory), name)
    if path:
        try:
            listener = _listen(path)
        except OSError as error:
            from terminal.output import warn

            reason = error.strerror
            if error.errno == errno.EADDRINUSE:
                reason = "another process listens there; give this one its own directory (BM_RUN_DIRECTORY)"
            warn(f"its status cannot be shown at {path}: {reason or error}", name=name)
    try:
        yield listener
    finally:
        if listener is not None:
            listener.close()
            with contextlib.suppress(OSError):
                os.unlink(path)


@contextlib.asynccontextmanager
async def serve_health(
    directory: str | os.PathLike[str] | None, name: str, answer: Callable[[], bytes]
) -> AsyncIterator[None]:
    """Answer health checks within the context. The running event loop answers, which proves that it is not blocked.

    `answer` returns the JSON object. If `directory` is None, there is no status socket.
    """
    import asyncio

    class Answering(asyncio.Protocol):
        """A client's connection, without asyncio's streams, which would keep the error of a client that has gone."""

        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            writing = cast("asyncio.Transport", transport)
            try:
                writing.write(answer())
            finally:
                writing.close()

    with _listening(directory, name) as listener:
        if listener is None:
            yield
            return
        server = await asyncio.get_running_loop().create_unix_server(Answering, sock=listener)
        try:
            yield
        finally:
            server.close()


@contextlib.contextmanager
def in_thread(serving: Callable[[], AbstractAsyncContextManager[None]]) -> Iterator[None]:
    """Keep a context open in the event loop of another thread, so that the main thread of the process may block."""
    import asyncio

    entered: Future[None] = Future()
    loop = asyncio.new_event_loop()
    over = asyncio.Event()

    async def serve() -> None:
        try:
            async with serving():
                entered.set_result(None)
                await over.wait()
        except BaseException as error:
            if entered.done():
                raise
            entered.set_exception(error)

    def run() -> None:
        try:
            loop.run_until_complete(serve())
        finally:
            loop.close()

    thread = threading.Thread(target=run, name="event loop", daemon=True)
    # signals must go to the main thread: a blocking call there would not return otherwise
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    try:
        thread.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    entered.result()
    try:
        yield
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join(_END_TIMEOUT)
