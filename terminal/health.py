"""Health of a process: whether it is ready, and why, shown on its status socket.

A process listens on `NAME.status.sock` in the run directory, a socket of its user alone (0600). Each connection gets one
JSON object, which has at least `ready` and `why`, and is closed; nothing is read from it. This module imports the standard
library alone, and asyncio only to serve: a health check runs every few seconds.
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
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import asyncio

SUFFIX = ".status.sock"
ANSWER_LIMIT = 1 << 20
"""Bytes of the longest answer that is read."""

_SAMPLE_EVERY = 1.0
_SEND_TIMEOUT = 0.5


class Silence(StrEnum):
    """Reason why a status socket gave no answer."""

    NO_SOCKET = "no socket"
    NO_LISTENER = "no listener"
    TIMEOUT = "timeout"
    NOT_OURS = "not ours"


class NoHealthError(Exception):
    """A status socket gave no answer; the text says why."""

    def __init__(self, reason: Silence, sentence: str) -> None:
        """Take the reason, and a sentence whose subject is the process."""
        super().__init__(sentence)
        self.reason = reason


def status_socket(directory: str | os.PathLike[str], name: str) -> str:
    """Return the path of a process's status socket."""
    return os.path.join(directory, name + SUFFIX)  # noqa: PTH118 - pathlib takes as long to import as all the rest


# --- asking ----------------------------------------------------------------------------------------


def read_status(path: str, timeout: float) -> bytes:
    """Return what the process at a status socket answers, within `timeout` seconds.

    Raises:
        NoHealthError: It gave no answer, or one of more than `ANSWER_LIMIT` bytes.
    """
    deadline = time.monotonic() + timeout
    data = bytearray()
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
            asking.settimeout(timeout)
            asking.connect(path)
            while len(data) <= ANSWER_LIMIT:
                asking.settimeout(max(0.001, deadline - time.monotonic()))
                part = asking.recv(1 << 16)
                if not part:
                    return bytes(data)
                data += part
    except TimeoutError:
        raise NoHealthError(Silence.TIMEOUT, f"does not answer at {path} within {timeout:g} s") from None
    except ConnectionRefusedError:
        sentence = f"was killed and has not been restarted yet: nobody listens at {path}"
        raise NoHealthError(Silence.NO_LISTENER, sentence) from None
    except OSError as error:
        sentence = f"is not running, or shows no status at {path} ({error.strerror or error})"
        raise NoHealthError(Silence.NO_SOCKET, sentence) from None
    raise not_ours(path)


def not_ours(path: str) -> NoHealthError:
    """Return the error for an answer that is not a status."""
    sentence = f"is not a process of rosbayes of this version, by the answer at {path}"
    return NoHealthError(Silence.NOT_OURS, sentence)


def is_ready(path: str, timeout: float) -> tuple[bool, str]:
    """Return whether a process is ready, and why; a NoHealthError without an answer, or for one that is not a status."""
    data = read_status(path, timeout)
    try:
        status = json.loads(data)
        return status["ready"] is True, str(status["why"])
    except (ValueError, TypeError, KeyError, RecursionError):
        raise not_ours(path) from None


# --- answering -------------------------------------------------------------------------------------


def _listen(path: str) -> socket.socket:
    """Listen at a path, in place of a killed process; an OSError if another one listens there, or the system refuses."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)  # a full backlog is a process that listens
        if probe.connect_ex(path) == errno.ECONNREFUSED:
            os.unlink(path)  # noqa: PTH108 - see above
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        # Linux gives the socket's file the mode of the socket: at no time can another user connect
        os.fchmod(listener.fileno(), 0o600)
        listener.bind(path)
        listener.listen()
    except OSError:
        listener.close()
        raise
    return listener


@contextlib.contextmanager
def _listening(directory: str | os.PathLike[str] | None, name: str) -> Iterator[socket.socket | None]:
    """Listen while the context lasts; give None without a directory, and after a warning where the socket can't be had."""
    listener = None
    path = "" if directory is None else status_socket(os.path.abspath(directory), name)  # noqa: PTH100 - see above
    if path:
        try:
            listener = _listen(path)
        except OSError as error:
            from terminal.output import say

            reason = "another process listens there" if error.errno == errno.EADDRINUSE else error.strerror
            say(f"{name}: warning: its status can't be shown at {path}: {reason or error}")
    try:
        yield listener
    finally:
        if listener is not None:
            listener.close()
            with contextlib.suppress(OSError):
                os.unlink(path)  # noqa: PTH108 - see above


@contextlib.asynccontextmanager
async def health_served(
    directory: str | os.PathLike[str] | None,
    name: str,
    answer: Callable[[], bytes],
    sample: Callable[[], None] | None = None,
) -> AsyncIterator[None]:
    """Answer in the running loop while the context lasts, so that an answer shows that the loop turns.

    `answer` gives the JSON object, and `sample` is called once a second. Without a directory nothing is served.
    """
    import asyncio

    def connected(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(answer())
        writer.close()

    async def keep_sampling(sample: Callable[[], None]) -> None:
        while True:
            sample()
            await asyncio.sleep(_SAMPLE_EVERY)

    with _listening(directory, name) as listener:
        if listener is None:
            yield
            return
        server = await asyncio.start_unix_server(connected, sock=listener)
        sampling = None if sample is None else asyncio.ensure_future(keep_sampling(sample))
        try:
            yield
        finally:
            if sampling is not None:
                sampling.cancel()
            server.close()


@contextlib.contextmanager
def health_thread(
    directory: str | os.PathLike[str] | None,
    name: str,
    answer: Callable[[], bytes],
    sample: Callable[[], None],
) -> Iterator[None]:
    """Answer from a thread while the context lasts, for a process with one blocking thread.

    The arguments are those of `health_served`; `answer` and `sample` run in the thread.
    """
    with _listening(directory, name) as listener:
        if listener is None:
            yield
            return
        over = threading.Event()
        thread = threading.Thread(
            target=_answer_all, args=(listener, answer, sample, over), name="status", daemon=True
        )
        # a signal must find the main thread: a blocking call there would not return otherwise
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        try:
            thread.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        try:
            yield
        finally:
            over.set()


def _answer_all(
    listener: socket.socket, answer: Callable[[], bytes], sample: Callable[[], None], over: threading.Event
) -> None:
    sampled = 0.0
    while not over.is_set():
        if time.monotonic() >= sampled + _SAMPLE_EVERY:
            sample()
            sampled = time.monotonic()
        try:
            listener.settimeout(_SAMPLE_EVERY)
            connection, _ = listener.accept()
        except TimeoutError:
            continue
        except OSError:  # the context has ended
            return
        with connection, contextlib.suppress(OSError):
            connection.settimeout(_SEND_TIMEOUT)
            connection.sendall(answer())
