"""Child processes: starting, monitoring, restarting and stopping."""

import asyncio
import contextlib
import os
import shutil
import signal
import sys
import time
from collections import deque
from collections.abc import Iterable
from pathlib import Path

from services.errors import ReportedError, StackError
from services.supervision.parent import DIRECTORY_VARIABLE
from terminal.errors import ExitCode
from terminal.logs import PARENT_VARIABLE
from terminal.output import relay

RUN_DIRECTORY_VARIABLE = "BM_RUN_DIRECTORY"
"""Environment variable with the folder of status sockets (the setting `run_directory`)."""

RESTARTS = 3
"""A process may be restarted three times within the setting `restart_window`; then its master gives up."""

_KEPT_ERRORS = 20


def own_command(name: str) -> list[str]:
    """Return the command line of one of our commands in this environment; a path is used unchanged."""
    if "/" in name:
        return [name]
    beside = Path(sys.executable).with_name(name)
    return [str(beside)] if beside.exists() else [shutil.which(name) or name]


def describe_exit(code: int | None) -> str:
    """Return a text for an exit code: the signal that killed the process, or the code itself."""
    if code is not None and code < 0:
        try:
            return f"was killed by {signal.Signals(-code).name}"
        except ValueError:  # real-time signals have no names
            return f"was killed by signal {-code}"
    return f"ended by itself with exit code {code}"


class Child:
    """A child process. Its errors (lines `error: ...`) are stored, and other lines are forwarded."""

    def __init__(self, name: str, command: list[str], *, directory: Path | None = None) -> None:
        self.name = name
        self._command = command
        self._directory = directory
        self._errors: deque[str] = deque(maxlen=_KEPT_ERRORS)
        self._process: asyncio.subprocess.Process | None = None
        self._stderr: int | None = None
        self._pending = b""
        self._restarts: deque[float] = deque(maxlen=RESTARTS + 1)
        self.restarts = 0

    async def start(self) -> None:
        """Start the process in its own session, so that Ctrl-C in a terminal reaches only the parent.

        Raises:
            StackError: The command is not installed.
        """
        environment = dict(os.environ) | {PARENT_VARIABLE: str(os.getpid()), "PYTHONUNBUFFERED": "1"}
        if self._directory is not None:
            environment[DIRECTORY_VARIABLE] = str(self._directory)
            if not environment.get(RUN_DIRECTORY_VARIABLE):
                environment[RUN_DIRECTORY_VARIABLE] = str(self._directory)
        self.close()
        self._errors.clear()
        # our own pipe, because processes forked by the child may keep it open after its exit
        self._stderr, write_end = os.pipe()
        os.set_blocking(self._stderr, False)
        try:
            self._process = await asyncio.create_subprocess_exec(
                *self._command,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=write_end,
                env=environment,
                start_new_session=True,
            )
        except OSError as error:
            raise StackError(
                f"cannot start {self.name} ({self._command[0]}): {error.strerror or error}; install rosbayes into this environment"
            ) from error
        finally:
            os.close(write_end)
        asyncio.get_running_loop().add_reader(self._stderr, self._relay)

    @property
    def pid(self) -> int:
        """The process id; 0 before the first start."""
        return self._process.pid if self._process else 0

    @property
    def exit_code(self) -> int | None:
        """The exit code, negative for a signal; None before the first start and while the process runs."""
        return self._process.returncode if self._process else None

    @property
    def is_running(self) -> bool:
        """True while the process runs."""
        return self._process is not None and self._process.returncode is None

    def set_flag(self, flag: str, value: str | None = None) -> None:
        """From now on, start the process with another value of a flag, or with a flag without a value."""
        if flag not in self._command:
            self._command = [*self._command, flag, *([] if value is None else [value])]
        elif value is not None:
            at = self._command.index(flag) + 1
            self._command = [*self._command[:at], value, *self._command[at + 1 :]]

    async def wait(self) -> None:
        """Wait until the process has exited and its lines have been forwarded."""
        if self._process is not None:
            await self._process.wait()
            self._relay()

    def failure(self) -> StackError:
        """Return the exit of the process as an error, with its own sentence and exit code if it gave any."""
        code = self.exit_code
        if self._errors:
            return ReportedError(code if code and code > 0 else ExitCode.CHILD, self._errors[-1])
        return ReportedError(ExitCode.CHILD, f"{self.name} {describe_exit(code)}")

    def may_restart(self, window: float) -> bool:
        """Count a restart; return whether the limit within `window` seconds permits it."""
        now = time.monotonic()
        self.restarts += 1
        self._restarts.append(now)
        return sum(1 for at in self._restarts if now - at <= window) <= RESTARTS

    def terminate(self) -> None:
        """Send SIGTERM to the process."""
        self._send(signal.SIGTERM)

    def kill(self) -> None:
        """Kill the process."""
        self._send(signal.SIGKILL)

    def _send(self, number: signal.Signals) -> None:
        if self._process is not None and self.is_running:
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(number)

    def close(self) -> None:
        """Stop reading the standard error of an exited process."""
        if self._stderr is not None:
            asyncio.get_running_loop().remove_reader(self._stderr)
            os.close(self._stderr)
            self._stderr, self._pending = None, b""

    def _relay(self) -> None:
        """Forward the received lines, but store the sentences of errors."""
        while self._stderr is not None:
            try:
                data = os.read(self._stderr, 1 << 16)
            except BlockingIOError:
                break
            self._pending += data
            if not data:
                self._take_lines(last=True)
                self.close()
        self._take_lines(last=self.exit_code is not None)

    def _take_lines(self, *, last: bool) -> None:
        *lines, self._pending = self._pending.split(b"\n")
        if last:
            lines, self._pending = [*lines, self._pending], b""
        for line in lines:
            text = line.decode("utf-8", "replace").rstrip()
            if text.startswith("error: "):
                self._errors.append(text.removeprefix("error: "))
            elif text:
                relay(text, self.name)


async def end_all(children: Iterable[Child], stop_timeout: float) -> list[str]:
    """Stop children within `stop_timeout` seconds, and kill those that are left.

    Returns:
        The names of the killed ones.
    """
    children = list(children)
    running = [child for child in children if child.is_running]
    for child in running:
        child.terminate()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(stop_timeout):
            for child in running:
                await child.wait()
    stubborn = [child for child in running if child.is_running]
    for child in stubborn:
        child.kill()
    for child in children:
        await child.wait()
        child.close()
    return [child.name for child in stubborn]
