"""Child processes: starting, monitoring, restarting and stopping. When the parent ends, its children end too.

parent ◀─ standard error ──────── child   lines that the parent passes on to the user
       ◀─ ROSBAYES_ERROR_DESCRIPTOR       {"error": "the sentence that explains the child's end"}
"""

import asyncio
import contextlib
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Final, NoReturn

import msgspec

from services.errors import ReportedError, StackError
from terminal.errors import ExitCode, StoppedError, exit_code_of
from terminal.logs import PARENT_VARIABLE
from terminal.output import ERROR_DESCRIPTOR, relay, say_error
from terminal.processes import Forked, ask_for_end_with_parent, fork, fork_command, own_command
from terminal.run_directory import LockedRunDirectory
from terminal.signals import ENDING_SIGNALS, raise_on_signals, stopped_error

RUN_DIRECTORY_VARIABLE = "BM_RUN_DIRECTORY"
"""Environment variable for the setting `run_directory`, the folder of the status sockets."""

_IGNORED_BY_PYTHON: Final = (signal.SIGPIPE, signal.SIGXFSZ)
LONGEST_LINE: Final = 1 << 20
"""Maximum number of bytes of a line from a child. The parent passes a longer line on in pieces."""

RESTARTS = 3
"""Maximum number of restarts of a process within the setting `restart_window`.

If the process exits once more in this time, its parent ends with an error.
"""


def describe_exit(code: int | None) -> str:
    """Return a text that describes an exit code, such as `was killed by SIGTERM`."""
    if code is not None and code < 0:
        try:
            return f"was killed by {signal.Signals(-code).name}"
        except ValueError:  # real-time signals have no names
            return f"was killed by signal {-code}"
    return f"ended by itself with exit code {code}"


class _ErrorReport(msgspec.Struct, frozen=True):
    error: str


_decoder: Final = msgspec.json.Decoder(_ErrorReport)


class _Pipe:
    """The reading end of a pipe from a child; each line is passed to a function.

    It is not a pipe of asyncio, because processes forked by the child may keep it open after the child's exit.
    """

    def __init__(self, take: Callable[[str], None]) -> None:
        self._take = take
        # The writing end is the child's; its parent closes it after the start; otherwise the pipe would never end.
        self._reader, self.writer = os.pipe()
        self._is_open = True
        # The beginning of an incomplete line; bounded.
        self._pending = b""
        os.set_blocking(self._reader, False)
        asyncio.get_running_loop().add_reader(self._reader, self.read)

    def read(self, *, last: bool = False) -> None:
        """Read the child's output, at most 64 KiB, and pass on the lines.

        With `last`, read all of the output, and also pass on a final line without a line end.
        """
        while self._is_open:
            try:
                data = os.read(self._reader, 1 << 16)
            except BlockingIOError:
                break
            if not data:
                last = True
                self.close()
            *lines, self._pending = (self._pending + data).split(b"\n")
            # a child may print without ever ending a line
            if len(self._pending) >= LONGEST_LINE:
                lines, self._pending = [*lines, self._pending], b""
            self._pass_on(lines)
            if not last:
                return  # a child that prints without a pause must not keep the loop from its other work
        if last:
            self._pass_on([self._pending])
            self._pending = b""

    def _pass_on(self, lines: list[bytes]) -> None:
        # a child may print anything, also bytes that are not text
        for line in lines:
            if text := line.decode("utf-8", "replace").rstrip():
                self._take(text)

    def close(self) -> None:
        """Stop reading."""
        if self._is_open:
            self._is_open = False
            asyncio.get_running_loop().remove_reader(self._reader)
            os.close(self._reader)


class Child:
    """A child process. This object stores the error that the child reports, and passes the child's lines on."""

    def __init__(
        self,
        name: str,
        command: list[str],
        *,
        directory: LockedRunDirectory | None = None,
        ends: deque[float] | None = None,
    ) -> None:
        """Store the command. `ends` holds the times of the last exits, and several children may share one `ends`.

        If `ends` is None, the child keeps the times of its last `RESTARTS` + 1 exits.
        """
        self.name = name
        self._command = command
        # The run directory, whose lock the child holds too, so that the next run waits for its end.
        self._directory = directory
        # Of the last start: the process, its pipes (standard error and error reports), and its last report.
        self._process: Forked | None = None
        self._pipes: list[_Pipe] = []
        self._error = ""
        # Times of the last exits (monotonic, s), whose number within a window is limited, and the number of restarts.
        self._ends: deque[float] = deque(maxlen=RESTARTS + 1) if ends is None else ends
        self.restarts = 0

    async def start(self) -> None:
        """Start the child in its own session, so that a Ctrl-C does not reach the child.

        Raises a StackError if the child's command cannot be started.
        """
        self.close()
        self._error = ""
        lines, reports = self._pipes = [_Pipe(lambda line: relay(line, self.name)), _Pipe(self._take_report)]
        environment = dict(os.environ) | {
            PARENT_VARIABLE: str(os.getpid()),
            ERROR_DESCRIPTOR: str(reports.writer),
            "PYTHONUNBUFFERED": "1",
        }
        # a folder of status sockets that the user has chosen is that of all processes
        if self._directory is not None:
            environment[RUN_DIRECTORY_VARIABLE] = str(self._directory.path)
        try:
            self._process = await self._spawn(environment, lines.writer)
        except OSError as error:
            raise StackError(
                f"cannot start {self.name} ({self._command[0]}): {error.strerror or error}"
                + ("; install rosbayes into this environment" if isinstance(error, FileNotFoundError) else "")
            ) from error
        finally:
            for pipe in self._pipes:
                os.close(pipe.writer)

    def _take_report(self, line: str) -> None:
        # a child that was killed may have written half a line
        with contextlib.suppress(msgspec.MsgspecError):
            self._error = _decoder.decode(line).error

    async def _spawn(self, environment: dict[str, str], lines: int) -> Forked:
        """Start the process, whose standard error is the descriptor `lines`."""
        return Forked(self._execute(environment, lines))

    def _execute(self, environment: dict[str, str], lines: int) -> int:
        inherited = [int(environment[ERROR_DESCRIPTOR])]
        if self._directory is not None:
            inherited.append(self._directory.lock)
        for descriptor in inherited:
            os.set_inheritable(descriptor, True)
        try:
            # not by the event loop: uvloop aborts a process that was forked without the descriptors of its parent
            return os.posix_spawnp(
                self._command[0],
                self._command,
                environment,
                file_actions=[
                    (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
                    (os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),
                    (os.POSIX_SPAWN_DUP2, lines, 2),
                ],
                setsid=True,
                setsigdef=_IGNORED_BY_PYTHON,
            )
        finally:
            for descriptor in inherited:
                os.set_inheritable(descriptor, False)

    @property
    def pid(self) -> int:
        """The process id, or 0 before the first start."""
        return self._process.pid if self._process else 0

    @property
    def exit_code(self) -> int | None:
        """The exit code, negative after a signal. It is None before the first start and while the process runs."""
        return self._process.returncode if self._process else None

    @property
    def is_running(self) -> bool:
        """True while the process runs."""
        return self._process is not None and self._process.returncode is None

    async def wait(self) -> None:
        """Wait until the process has exited and all its lines have been passed on."""
        if self._process is not None:
            await self._process.wait()
            # the pipes may stay open: a grandchild can hold them
            for pipe in self._pipes:
                pipe.read(last=True)

    def failure(self) -> StackError:
        """Return the process's exit as an error. The error has the reported text, or else describes the exit code."""
        code = self.exit_code
        # the exit code of an error decides whether a restart would help, so it must not be lost
        if self._error:
            return ReportedError(code if code and code > 0 else ExitCode.CHILD, self._error)
        return ReportedError(ExitCode.CHILD, f"{self.name} {describe_exit(code)}")

    def may_restart(self, window: float) -> bool:
        """Count an exit. Return whether the number of exits in the last `window` seconds permits another start."""
        now = time.monotonic()
        self.restarts += 1
        self._ends.append(now)
        return sum(1 for at in self._ends if now - at <= window) < (self._ends.maxlen or 0)

    def terminate(self) -> None:
        """Send SIGTERM to the process."""
        self._send(signal.SIGTERM)

    def kill(self) -> None:
        """Kill the process."""
        self._send(signal.SIGKILL)

    def _send(self, number: signal.Signals) -> None:
        if self._process is not None and self.is_running:
            self._process.send_signal(number)

    def close(self) -> None:
        """Stop reading from an exited process."""
        for pipe in self._pipes:
            pipe.close()


class ForkedChild(Child):
    """A child that is forked from this process and runs a function. The child shares the modules loaded so far."""

    def __init__(self, name: str, run: Callable[[], int], *, ends: deque[float]) -> None:
        """Store the function. Its result is the child's exit code. `ends` has the same meaning as in `Child`."""
        super().__init__(name, [name], ends=ends)
        self._run = run

    async def _spawn(self, environment: dict[str, str], lines: int) -> Forked:
        return fork(partial(self._run_forked, environment, lines))

    def _run_forked(self, environment: dict[str, str], lines: int) -> NoReturn:
        """Run the function in the child and exit, so that the child never continues in the parent's code."""
        code: int = ExitCode.BUG
        try:
            os.setsid()
            os.dup2(lines, 2)
            os.environ.update(environment)
            signal.set_wakeup_fd(-1)
            raise_on_signals()
            signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING_SIGNALS)
            end_with_parent()
            code = self._run()
        except StoppedError as stopped:
            code = stopped.exit_code
        except BaseException as error:
            code = exit_code_of(error)
            say_error(f"{self.name}: {error}")
        finally:
            os._exit(code)


class ForkedCommand(Child):
    """A `rosbayes` command as a child. The first start forks this process. Each restart executes a new interpreter.

    A fork takes a few milliseconds, and a new interpreter takes 0.3 s for its imports. But a fork during the run would
    copy the state of the run.
    """

    def __init__(
        self, name: str, role: str, arguments: list[str], *, directory: LockedRunDirectory | None
    ) -> None:
        """Store the child's name for messages, the `rosbayes` command `role`, and the command's arguments."""
        super().__init__(name, [*own_command(role), *arguments], directory=directory)
        self._role = role
        self._arguments = arguments

    async def _spawn(self, environment: dict[str, str], lines: int) -> Forked:
        if self._process is not None:
            return await super()._spawn(environment, lines)
        kept = [int(environment[ERROR_DESCRIPTOR])]
        if self._directory is not None:
            kept.append(self._directory.lock)
        return fork_command(
            self._role, self._arguments, output=None, errors=lines, kept=kept, variables=environment
        )


async def end_all(children: Iterable[Child], stop_timeout: float) -> list[str]:
    """Terminate children. After `stop_timeout` seconds, kill the children that still run, and return their names."""
    children = list(children)
    running = [child for child in children if child.is_running]
    for child in running:
        child.terminate()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(stop_timeout):
            for child in running:
                await child.wait()
    # a stopped process (SIGSTOP), or one in a system call that does not return
    stubborn = [child for child in running if child.is_running]
    for child in stubborn:
        child.kill()
    for child in children:
        await child.wait()
        child.close()
    return [child.name for child in stubborn]


# --- in the child -----------------------------------------------------------------------------------


def end_with_parent() -> None:
    """Make this child process exit when its parent ends, even if the parent ends by SIGKILL.

    Raises a StoppedError if the parent has already ended. If rosbayes did not start this process, do nothing.
    """
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None or not parent.isdigit():
        return
    ask_for_end_with_parent()
    # the parent may have exited before the request to the kernel
    if os.getppid() != int(parent):
        raise stopped_error(signal.SIGTERM)
