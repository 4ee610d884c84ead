"""Processes that a command or a script starts, follows and ends: those of the demo, for example."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import re
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from terminal.errors import ExitCode, ProcessError

SILENCE: Final = 1.5
"""Seconds without a line after which a `Screen` shows that the work continues."""
_PR_SET_PDEATHSIG: Final = 1


def own_command(name: str) -> list[str]:
    """Return the command line of one of our commands in this environment; a path is used unchanged.

    PATH is not searched, because other software has commands of the same names.
    """
    if "/" in name:
        return [name]
    beside = Path(sys.executable).with_name(name)
    return [str(beside)] if beside.exists() else [sys.executable, "-P", "-m", "rosbayes", name]


def ask_for_end_with_parent() -> None:
    """Make the kernel send SIGTERM to this process when its parent exits; this survives an exec."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


class Process:
    """A process with its lines: they go to a log, and also to `show` if they are meant for the screen."""

    def __init__(self, name: str, log: Path, *, show: Callable[[str], None] | None = None) -> None:
        self.name = name
        self._log = log
        self._show = show
        self._process: asyncio.subprocess.Process | None = None
        self._reader: asyncio.Task[None] | None = None
        self._lines: list[str] = []
        self._news = asyncio.Event()

    async def start(self, *command: str) -> None:
        """Start the process in its own session, so that Ctrl-C reaches only the script."""
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
        """Wait for a line that matches.

        Raises:
            ProcessError: The process ended before it printed such a line.
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
        """Return the end of the process as an error, with its last line."""
        said = self._lines[-1].removeprefix("error: ") if self._lines else "it said nothing"
        error = ProcessError(f"{self.name}: {said} (all that it said is in {self._log})")
        error.exit_code = code if code > 0 else ExitCode.CHILD
        return error

    async def wait(self) -> int:
        """Wait until the process has ended and all its lines are read, and return its exit code."""
        if self._reader is not None:
            await self._reader
        return await self._process.wait() if self._process else 0

    async def succeed(self) -> None:
        """Wait for the successful end of the process.

        Raises:
            ProcessError: Its exit code is not 0.
        """
        if code := await self.wait():
            raise self.failure(code)

    async def end(self) -> None:
        """End the process by SIGTERM, and by SIGKILL after 6 s."""
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
    """The lines of a script, and while there are none, the work that it waits for.

    On a terminal, the work is one line with the time so far, which the next line replaces. Elsewhere it is a line
    followed by dots.
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
        """Show the work after each `SILENCE` seconds without a line, until cancelled."""
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
