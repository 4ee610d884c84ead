"""Processes of a run: started together, watched, and ended together, however the run ends."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import fcntl
import os
import re
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterable
from pathlib import Path

from services.errors import ReportedError, ServiceError
from terminal.errors import ExitCode
from terminal.logs import say

PARENT_VARIABLE = "ROSBAYES_PARENT"
"""Names the process whose end ends this one; set by `Child`."""

DIRECTORY_VARIABLE = "ROSBAYES_DIRECTORY"
"""The run's private directory, which whoever ends last takes away."""

RUN_DIRECTORY_VARIABLE = "BM_RUN_DIRECTORY"
"""Where status sockets go (the setting `run_directory`); a run of the user's own choice, else the private one."""

STATUS_SUFFIX = ".status.sock"
CONTROL_SUFFIX = ".control.sock"
KEPT = "deployment-"
"""How the folders begin in which a run keeps the deployments of its children (`services.master.new_deployment`)."""

PRIVATE = "rosbayes-"
"""How a run's private directory begins; what follows is tempfile's."""
_PRIVATE_NAME = re.compile(PRIVATE + "[a-z0-9_]{8}")
_KEPT_NAME = re.compile(KEPT + "[0-9]+")
_MOST_ABANDONED = 100

RESTARTS = 3
RESTARTS_WITHIN = 60.0
"""A process may be restarted three times in 60 s; then its master gives up."""

_PR_SET_PDEATHSIG = 1
_DYING_TIME = 5.0
"""Seconds that a killed parent's last threads are waited for."""
_TAIL_LINES = 20


def _place() -> Path:
    """Where this user's runs have their private directories."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    # A relative one counts for nothing, by its specification; behind a long one there is no room for the sockets' names.
    usable = Path(runtime).is_absolute() and len(os.fsencode(runtime)) < 40
    return Path(runtime if usable and os.access(f"{runtime}/.", os.W_OK | os.X_OK) else tempfile.gettempdir())


def make_private_directory() -> Path:
    """A directory for this run's sockets that only this user can enter (0700).

    Raises:
        ServiceError: There is no place that it can be made in.
    """
    try:
        return Path(tempfile.mkdtemp(prefix=PRIVATE, dir=_place()))
    except OSError as error:
        msg = f"can't make a private directory for the local sockets: {error.strerror or error}; set TMPDIR to a writable folder"
        raise ServiceError(msg) from error


def remove_abandoned_directories() -> None:
    """Take the private directories away that masters left which were killed before anybody else was there to do it.

    One is taken for such only if it is named as one, belongs to this user alone, no master has it locked, and nothing is
    in it that a run does not put there. Links are not followed.
    """
    with contextlib.suppress(OSError):
        found = [each for each in _place().iterdir() if _PRIVATE_NAME.fullmatch(each.name)]
        for directory in found[:_MOST_ABANDONED]:
            with contextlib.suppress(OSError):
                _remove_if_abandoned(directory)


def _remove_if_abandoned(directory: Path) -> None:
    """Remove one, unless its master lives.

    Raises:
        OSError: it is no directory, is somebody else's, or is locked.
    """
    handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        found = os.fstat(handle)
        if found.st_uid != os.geteuid() or stat.S_IMODE(found.st_mode) != 0o700:
            return
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # a master that is just making it notices (below)
        with os.scandir(handle) as entries:
            kinds = {each.name: each.stat(follow_symlinks=False).st_mode for each in entries}
        kept = {name for name, mode in kinds.items() if stat.S_ISDIR(mode) and _KEPT_NAME.fullmatch(name)}
        sockets = {name for name, mode in kinds.items() if stat.S_ISSOCK(mode)}
        if kept | sockets != set(kinds):
            return
        for name in sockets:
            os.unlink(name, dir_fd=handle)
        for name in kept:
            shutil.rmtree(name, dir_fd=handle)
        directory.rmdir()
    finally:
        os.close(handle)


def ask_for_end_with_parent() -> None:
    """Have the kernel send this process SIGTERM when its parent ends; an exec does not undo it."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


def _end_early(_number: int, _frame: object) -> None:
    leave_private_directory()
    os._exit(ExitCode.TERMINATED)


def end_with_parent() -> None:
    """In a child: have the kernel send SIGTERM when the parent ends, even by SIGKILL.

    Does nothing in a process that nobody supervises.
    """
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None or not parent.isdigit():
        return
    # until the command has its own handlers, an early end still takes the run's directory away
    signal.signal(signal.SIGTERM, _end_early)
    ask_for_end_with_parent()
    # the parent may have ended before the kernel was told
    if os.getppid() != int(parent):
        _end_early(signal.SIGTERM, None)


class PrivateDirectory:
    """A run's directory while its master lives: locked, so that its children can see when that is over."""

    def __init__(self) -> None:
        """Make it; what runs left that were killed is taken away on the occasion.

        Raises:
            ServiceError: it can't be made.
        """
        remove_abandoned_directories()
        for _ in range(_MOST_ABANDONED):
            self.path = make_private_directory()
            with contextlib.suppress(FileNotFoundError):
                # the kernel lets go of it when the process ends, however that happens
                self._lock = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
                fcntl.flock(self._lock, fcntl.LOCK_EX)
                if os.fstat(self._lock).st_nlink:
                    return
                os.close(self._lock)  # before it was locked, another master took it for an abandoned one
        msg = f"can't keep a private directory in {self.path.parent}: something removes what is made there"
        raise ServiceError(msg)

    def remove(self) -> None:
        """Take it away with all that is in it."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)


def _is_abandoned(directory: Path) -> bool:
    """Whether the master whose directory it was is gone."""
    try:
        handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return False
    else:
        return True
    finally:
        os.close(handle)


def _is_dying(process: str) -> bool:
    """Whether the process has been killed, but not yet every thread of it: till then it keeps its locks and sockets."""
    try:
        ended = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
        return ended and len(list(Path(f"/proc/{process}/task").iterdir())) > 1
    except OSError:
        return False


def leave_private_directory() -> None:
    """In a child that ends: take the run's directory away, if its master is gone or nothing is in it.

    Every child does so; the last one finds no other's sockets in it. Does nothing in a process that nobody supervises.
    """
    directory = os.environ.get(DIRECTORY_VARIABLE)
    if directory:
        deadline = time.monotonic() + _DYING_TIME
        while _is_dying(os.environ.get(PARENT_VARIABLE, "")) and time.monotonic() < deadline:
            time.sleep(0.001)
        remove_dead_sockets(Path(directory))
        if _is_abandoned(Path(directory)):
            for kept in Path(directory).glob(f"{KEPT}*"):
                shutil.rmtree(kept, ignore_errors=True)
        with contextlib.suppress(OSError):
            Path(directory).rmdir()


def remove_dead_sockets(directory: Path) -> None:
    """Take the status and control sockets away that processes left which were killed."""
    for path in (*directory.glob(f"*{STATUS_SUFFIX}"), *directory.glob(f"*{CONTROL_SUFFIX}")):
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(0.2)
            try:
                probe.connect(str(path))
            except ConnectionRefusedError:
                path.unlink()


def own_command(name: str) -> list[str]:
    """How to start one of our commands in this same environment; a path stands for itself."""
    if "/" in name:
        return [name]
    beside = Path(sys.executable).with_name(name)
    return [str(beside)] if beside.exists() else [shutil.which(name) or name]


def how_it_ended(code: int | None) -> str:
    """A process's exit code in words: the signal that killed it, or the code itself."""
    if code is not None and code < 0:
        try:
            return f"was killed by {signal.Signals(-code).name}"
        except ValueError:  # real-time signals have no names
            return f"was killed by signal {-code}"
    return f"ended by itself with exit code {code}"


class Child:
    """A process that belongs to this one. Its errors (lines `error: ...`) are kept, other lines are passed on."""

    def __init__(self, name: str, command: list[str], *, directory: Path | None = None) -> None:
        self.name = name
        self._command = command
        self._directory = directory
        self._errors: deque[str] = deque(maxlen=_TAIL_LINES)
        self._process: subprocess.Popen[bytes] | None = None
        self._restarts: deque[float] = deque(maxlen=RESTARTS + 1)
        self._pending = b""
        self.restarts = 0

    def start(self) -> None:
        """Start it, in a session of its own so that a terminal's Ctrl-C reaches the parent alone.

        Raises:
            ServiceError: the command is not installed.
        """
        environment = dict(os.environ) | {PARENT_VARIABLE: str(os.getpid()), "PYTHONUNBUFFERED": "1"}
        if self._directory is not None:
            environment[DIRECTORY_VARIABLE] = str(self._directory)
            if not environment.get(RUN_DIRECTORY_VARIABLE):
                environment[RUN_DIRECTORY_VARIABLE] = str(self._directory)
        self._errors.clear()
        self._pending = b""
        try:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                env=environment,
                start_new_session=True,
            )
        except OSError as error:
            msg = f"can't start {self.name} ({self._command[0]}): {error.strerror or error}; install rosbayes into this environment"
            raise ServiceError(msg) from error
        assert self._process.stderr is not None  # noqa: S101 - a pipe was asked for
        os.set_blocking(self._process.stderr.fileno(), False)

    @property
    def pid(self) -> int:
        """Its process number; 0 before it was started."""
        return self._process.pid if self._process else 0

    def relay(self) -> None:
        """Pass on what it wrote; keep the sentences of its errors for `failure`."""
        if self._process is None or self._process.stderr is None:
            return
        while True:
            try:
                data = os.read(self._process.stderr.fileno(), 65536)
            except (BlockingIOError, ValueError, OSError):
                break
            if not data:
                break
            self._pending += data
        *lines, self._pending = self._pending.split(b"\n")
        if self._process.poll() is not None and self._pending:
            lines, self._pending = [*lines, self._pending], b""
        for line in lines:
            text = line.decode("utf-8", "replace").rstrip()
            if text.startswith("error: "):
                self._errors.append(text.removeprefix("error: "))
            elif text:
                say(text)

    def give(self, flag: str, value: str | None = None) -> None:
        """Start it with another value of a flag from now on, or with a flag that takes none."""
        if flag not in self._command:
            self._command = [*self._command, flag, *([] if value is None else [value])]
        elif value is not None:
            at = self._command.index(flag) + 1
            self._command = [*self._command[:at], value, *self._command[at + 1 :]]

    def exit_code(self) -> int | None:
        """Its exit code, negative for a signal; None while it runs."""
        return None if self._process is None else self._process.poll()

    async def ended(self) -> None:
        """Pass its lines on as they come, until it has ended."""
        while self.exit_code() is None:
            self.relay()
            await asyncio.sleep(0.05)
        self.relay()

    def failure(self) -> ServiceError:
        """Its end, as an error: its own sentence and exit code where it left them."""
        self.relay()
        code = self.exit_code()
        if self._errors:
            return ReportedError(code if code and code > 0 else ExitCode.CHILD, self._errors[-1])
        return ReportedError(ExitCode.CHILD, f"{self.name} {how_it_ended(code)}")

    def may_restart(self) -> bool:
        """Count a restart; False when there were too many within the last minute."""
        now = time.monotonic()
        self.restarts += 1
        self._restarts.append(now)
        return sum(1 for at in self._restarts if now - at <= RESTARTS_WITHIN) <= RESTARTS

    def terminate(self) -> None:
        """Ask it to end."""
        if self._process is not None and self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.terminate()

    def kill(self) -> None:
        """End it at once."""
        if self._process is not None and self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()
            self._process.wait(5)

    def close(self) -> None:
        """Let go of its standard error after its end."""
        self.relay()
        if self._process is not None and self._process.stderr is not None:
            self._process.stderr.close()


async def end_all(children: Iterable[Child], stop_timeout: float) -> list[str]:
    """End children within `stop_timeout` seconds, the stubborn ones by SIGKILL.

    Returns:
        The names of those that had to be killed.
    """
    children = list(children)
    for child in children:
        child.terminate()
    deadline = time.monotonic() + stop_timeout
    while any(child.pid and child.exit_code() is None for child in children) and time.monotonic() < deadline:
        await asyncio.sleep(0.01)
    killed = [child.name for child in children if child.pid and child.exit_code() is None]
    for child in children:
        child.kill()
        child.close()
    return killed
