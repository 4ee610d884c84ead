"""Child processes: started, watched, restarted, and ended together."""

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
from terminal.ending import PARENT_VARIABLE
from terminal.errors import ExitCode
from terminal.output import say

RUN_DIRECTORY_VARIABLE = "BM_RUN_DIRECTORY"
"""Environment variable with the folder of status sockets (the setting `run_directory`)."""

RESTARTS = 3
RESTARTS_WITHIN = 60.0
"""A process may be restarted three times in 60 s; then its master gives up."""

_KEPT_ERRORS = 20


def own_command(name: str) -> list[str]:
    """Return how to start one of our commands in this same environment; a path stands for itself."""
    if "/" in name:
        return [name]
    beside = Path(sys.executable).with_name(name)
    return [str(beside)] if beside.exists() else [shutil.which(name) or name]


def how_it_ended(code: int | None) -> str:
    """Return a process's exit code in words: the signal that killed it, or the code itself."""
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
        self._errors: deque[str] = deque(maxlen=_KEPT_ERRORS)
        self._process: asyncio.subprocess.Process | None = None
        self._stderr: int | None = None
        self._pending = b""
        self._restarts: deque[float] = deque(maxlen=RESTARTS + 1)
        self.restarts = 0

    async def start(self) -> None:
        """Start the process, in a session of its own so that a terminal's Ctrl-C reaches the parent alone.

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
        # a pipe of our own, because processes forked by the child may hold it open beyond the child's end
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
                f"can't start {self.name} ({self._command[0]}): {error.strerror or error}; install rosbayes into this environment"
            ) from error
        finally:
            os.close(write_end)
        asyncio.get_running_loop().add_reader(self._stderr, self._relay)

    @property
    def pid(self) -> int:
        """The process number; 0 before the first start."""
        return self._process.pid if self._process else 0

    @property
    def exit_code(self) -> int | None:
        """The exit code, negative for a signal; None before the first start and while the process runs."""
        return self._process.returncode if self._process else None

    @property
    def is_running(self) -> bool:
        """Whether the process was started and has not ended."""
        return self._process is not None and self._process.returncode is None

    def give(self, flag: str, value: str | None = None) -> None:
        """Start the process with another value of a flag from now on, or with a flag that takes none."""
        if flag not in self._command:
            self._command = [*self._command, flag, *([] if value is None else [value])]
        elif value is not None:
            at = self._command.index(flag) + 1
            self._command = [*self._command[:at], value, *self._command[at + 1 :]]

    async def ended(self) -> None:
        """Wait until the process has ended; its lines are passed on by then."""
        if self._process is not None:
            await self._process.wait()
            self._relay()

    def failure(self) -> StackError:
        """Return the end of the process as an error, with its own sentence and exit code where it left them."""
        code = self.exit_code
        if self._errors:
            return ReportedError(code if code and code > 0 else ExitCode.CHILD, self._errors[-1])
        return ReportedError(ExitCode.CHILD, f"{self.name} {how_it_ended(code)}")

    def may_restart(self) -> bool:
        """Count a restart; return whether there were few enough within the last minute."""
        now = time.monotonic()
        self.restarts += 1
        self._restarts.append(now)
        return sum(1 for at in self._restarts if now - at <= RESTARTS_WITHIN) <= RESTARTS

    def terminate(self) -> None:
        """Ask the process to end."""
        self._send(signal.SIGTERM)

    def kill(self) -> None:
        """Have the kernel end the process."""
        self._send(signal.SIGKILL)

    def _send(self, number: signal.Signals) -> None:
        if self._process is not None and self.is_running:
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(number)

    def close(self) -> None:
        """Stop reading the standard error of a process that has ended."""
        if self._stderr is not None:
            asyncio.get_running_loop().remove_reader(self._stderr)
            os.close(self._stderr)
            self._stderr, self._pending = None, b""

    def _relay(self) -> None:
        """Pass on the lines that have come, but keep the sentences of errors."""
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
                say(text)


async def end_all(children: Iterable[Child], stop_timeout: float) -> list[str]:
    """End children within `stop_timeout` seconds, the stubborn ones by SIGKILL.

    Returns:
        The names of those that had to be killed.
    """
    children = list(children)
    running = [child for child in children if child.is_running]
    for child in running:
        child.terminate()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(stop_timeout):
            for child in running:
                await child.ended()
    stubborn = [child for child in running if child.is_running]
    for child in stubborn:
        child.kill()
    for child in children:
        await child.ended()
        child.close()
    return [child.name for child in stubborn]
