"""Processes that a command or a script starts, watches and ends, such as the processes of the demo."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import ctypes
import gc
import os
import re
import signal
import sys
import time
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Final, NoReturn

from terminal.errors import ExitCode, ProcessError
from terminal.logs import name_process
from terminal.signals import ENDING_SIGNALS

SILENCE: Final = 1.5
"""If a `Screen` prints no line for this many seconds, it shows that the work continues."""
_PR_SET_PDEATHSIG: Final = 1
_PR_SET_NAME: Final = 15


def own_command(name: str) -> list[str]:
    """Return the command line that runs one of our commands in this environment.

    If `name` is a path, it is returned unchanged. PATH is not searched, because other software has commands with the
    names of ours.
    """
    if "/" in name:
        return [name]
    beside = Path(sys.executable).with_name(name)
    return [str(beside)] if beside.exists() else [sys.executable, "-P", "-m", "rosbayes", name]


def ask_for_end_with_parent() -> None:
    """Make the kernel send SIGTERM to this process when its parent exits. An exec does not change this."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


class Forked:
    """A forked or spawned child process, with some of the methods of asyncio's `Process`."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._ended = asyncio.Event()
        self._descriptor = os.pidfd_open(pid)
        asyncio.get_running_loop().add_reader(self._descriptor, self._take_exit)

    def _take_exit(self) -> None:
        asyncio.get_running_loop().remove_reader(self._descriptor)
        os.close(self._descriptor)
        _, status = os.waitpid(self.pid, 0)
        self.returncode = os.waitstatus_to_exitcode(status)
        self._ended.set()

    async def wait(self) -> int | None:
        """Wait until the process has ended, and return its exit code."""
        await self._ended.wait()
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal. No other process can have the pid, because the forked process's exit is not collected yet."""
        os.kill(self.pid, number)

    def kill(self) -> None:
        """Kill the process."""
        self.send_signal(signal.SIGKILL)


def fork(run: Callable[[], NoReturn]) -> Forked:
    """Call `run` in a forked process. At first, `ENDING_SIGNALS` are blocked. `run` must exit instead of returning."""
    # until the child has handlers of its own, a signal would reach the event loop of this process instead
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING_SIGNALS)
    pid = os.fork()
    if not pid:
        run()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING_SIGNALS)
    return Forked(pid)


def fork_command(
    name: str,
    arguments: Sequence[str],
    *,
    output: int | None,
    errors: int,
    kept: Collection[int] = (),
    variables: Mapping[str, str] | None = None,
) -> Forked:
    """Run one of our commands in a fork of this process, where most of the command's modules are already loaded.

    The command runs in its own session, with /dev/null as standard input. `output` becomes its standard output
    (/dev/null if None), and `errors` its standard error. Of all other descriptors, only those in `kept` stay open.
    """
    return fork(partial(_run_command, name, arguments, output, errors, kept, variables or {}))


def _run_command(
    name: str,
    arguments: Sequence[str],
    output: int | None,
    errors: int,
    kept: Collection[int],
    variables: Mapping[str, str],
) -> NoReturn:
    """Run a command in a forked child and exit, so that the child never continues in the parent's code."""
    try:
        # Nothing of the parent's may end here: neither its open files, nor what it does at its exit.
        gc.freeze()
        atexit._clear()  # noqa: SLF001 - it has no public name
        os.setsid()
        null = os.open(os.devnull, os.O_RDWR)
        for number, source in enumerate((null, null if output is None else output, errors)):
            os.dup2(source, number)
        for number in [int(each.name) for each in Path("/proc/self/fd").iterdir()]:
            if number > 2 and number not in kept:
                with contextlib.suppress(OSError):  # that of the listing itself
                    os.close(number)
        os.environ.update(variables)
        # the event loop's handlers write to descriptors that were just closed
        signal.set_wakeup_fd(-1)
        for each in (*ENDING_SIGNALS, signal.SIGCHLD):
            signal.signal(each, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING_SIGNALS)
        ask_for_end_with_parent()
        name_process("")
        sys.argv = [name, *arguments]
        command = own_command(name)
        _show_command(
            name, [sys.executable, *(word for word in command if word != sys.executable), *arguments]
        )
        # by its name, as its executable does: only the entry point knows all commands
        getattr(import_module("rosbayes.start"), name.replace("-", "_"))()
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(ExitCode.BUG)


def _show_command(name: str, words: Sequence[str]) -> None:
    """Show a forked process in `top` by its name, and in `ps` by its command line, cut to its parent's length."""
    ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode(), 0, 0, 0)
    start, end = map(int, Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[45:47])
    size = end - start  # 0 where the system does not say
    if size > 0:
        text = "\0".join(words).encode("utf-8", "surrogateescape")[: size - 1]
        ctypes.memmove(start, text.ljust(size, b"\0"), size)


class Process:
    """A process that this process starts, and the lines that it prints.

    The lines are written to a log and, if `show` is given, passed to `show`. With `forks`, this process forks the new
    process instead of starting a program; this is faster (see `fork_command`).
    """

    def __init__(
        self, name: str, log: Path, *, show: Callable[[str], None] | None = None, forks: bool = False
    ) -> None:
        self.name = name
        self._log = log
        self._show = show
        self._forks = forks
        self._process: asyncio.subprocess.Process | Forked | None = None
        self._reader: asyncio.Task[None] | None = None
        self._lines: list[str] = []
        self._news = asyncio.Event()

    async def start(self, *command: str) -> None:
        """Start the process in its own session. Ctrl-C then reaches only the calling process."""
        if self._forks:
            reading, writing = os.pipe()
            self._process = fork_command(command[0], command[1:], output=writing, errors=writing)
            os.close(writing)
            lines = asyncio.StreamReader()
            await asyncio.get_running_loop().connect_read_pipe(
                lambda: asyncio.StreamReaderProtocol(lines), os.fdopen(reading, "rb")
            )
            self._reader = asyncio.create_task(self._read(lines))
            return
        self._process = await asyncio.create_subprocess_exec(
            *own_command(command[0]),
            *command[1:],
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=ask_for_end_with_parent,
        )
        if self._process.stdout is not None:
            self._reader = asyncio.create_task(self._read(self._process.stdout))

    @property
    def pid(self) -> int:
        """The process number; 0 before the start."""
        return 0 if self._process is None else self._process.pid

    async def _read(self, output: asyncio.StreamReader) -> None:
        with self._log.open("w") as log:
            async for line in output:
                text = line.decode("utf-8", "replace").rstrip()
                log.write(text + "\n")
                log.flush()
                self._lines.append(text)
                self._news.set()
                # `failure` reports errors with the path of the log
                if self._show is not None and not text.startswith("error: "):
                    self._show(text)
        self._news.set()

    async def line(self, pattern: str) -> re.Match[str]:
        """Wait for a line that matches `pattern`.

        Raises:
            ProcessError: The process ended before it printed a matching line.
        """
        seen = 0
        while True:
            for text in self._lines[seen:]:
                if match := re.search(pattern, text):
                    return match
            seen = len(self._lines)
            if self._reader is not None and self._reader.done():
                raise self.failure(await self.wait())
            self._news.clear()
            await self._news.wait()

    def failure(self, code: int) -> ProcessError:
        """Return an error for the process's exit code, with the last line that the process printed."""
        said = self._lines[-1].removeprefix("error: ") if self._lines else "it said nothing"
        error = ProcessError(f"{self.name}: {said} (all that it said is in {self._log})")
        error.exit_code = code if code > 0 else ExitCode.CHILD
        return error

    async def wait(self) -> int:
        """Wait until the process has ended and all its lines have been read. Return the exit code."""
        if self._reader is not None:
            await self._reader
        code = await self._process.wait() if self._process else 0
        return code or 0

    async def succeed(self) -> None:
        """Wait until the process has ended.

        Raises:
            ProcessError: The exit code of the process is not 0.
        """
        if code := await self.wait():
            raise self.failure(code)

    async def end(self) -> None:
        """Send SIGTERM to the process. If it still runs after 6 s, send SIGKILL."""
        if self._process is None:
            return
        self._show = None  # that it was terminated is no news
        if self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGTERM)
            try:
                await asyncio.wait_for(self._process.wait(), 6)
            except TimeoutError:
                self._process.kill()
                await self._process.wait()
        if self._reader is not None:
            await self._reader


class Screen:
    """The output of a script: its lines and, when no line comes for a while, the work that the script waits for.

    On a terminal, a temporary line shows the work and the time so far. Elsewhere, a line names the work, and dots
    follow.
    """

    def __init__(self) -> None:
        self.waits_for = "starting"
        """The current work, such as "building"."""
        self._began = time.monotonic()
        self._newest = self._began
        self._named = ""
        self._is_open = False  # whether a line without its end is on the screen

    def show(self, text: str) -> None:
        """Print a line."""
        self._end_line()
        self._print(text + "\n")

    def _print(self, text: str) -> None:
        self._newest = time.monotonic()
        print(text, end="", flush=True)

    def _end_line(self) -> None:
        if self._is_open:
            self._is_open = False
            self._print("\r\033[K" if sys.stdout.isatty() else "\n")

    async def say_what_it_waits_for(self) -> None:
        """Until cancelled, show the work in progress after every `SILENCE` seconds without a line."""
        try:
            while True:
                await asyncio.sleep(max(self._newest + SILENCE - time.monotonic(), 0))
                if time.monotonic() - self._newest >= SILENCE:
                    self._say()
        finally:
            self._end_line()

    def _say(self) -> None:
        if sys.stdout.isatty():
            self._print(f"\r\033[K... {self.waits_for} ({time.monotonic() - self._began:.0f} s)")
        elif self._named == self.waits_for:
            self._print(".")
        else:
            self._end_line()
            self._named = self.waits_for
            self._print(f"... {self.waits_for} ...")
        self._is_open = True
