"""Processes that a script starts, follows and ends, for the demo and the benches."""

from __future__ import annotations

import asyncio
import contextlib
import re
import signal
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

from bridge.errors import BridgeError
from services.child import ask_for_end_with_parent, own_command
from services.errors import StackError
from terminal.errors import ExitCode, StoppedError
from terminal.signals import run_async
from toolchain.errors import ToolchainError

ROOT = Path(__file__).resolve().parents[2]
SILENCE = 1.5
"""Seconds without a line after which a `Screen` shows that the work continues."""
BOAT_TOPIC, BOAT_TYPE = "/boat/sensors", "boat_msgs/Sensors"


class Process:
    """One process of a script; its lines go to a log, and also to `show` if they are meant for the screen."""

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
        self._reader = asyncio.create_task(self._read())

    @property
    def pid(self) -> int:
        """The process number; 0 before the start."""
        return 0 if self._process is None else self._process.pid

    async def _read(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        with self._log.open("w") as log:
            async for line in self._process.stdout:
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
            StackError: The process ended before it printed such a line.
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

    def failure(self, code: int) -> StackError:
        """Return the end of the process as an error, with its last line."""
        said = self._lines[-1].removeprefix("error: ") if self._lines else "it said nothing"
        error = StackError(f"{self.name}: {said} (all that it said is in {self._log})")
        error.exit_code = code if code > 0 else ExitCode.CHILD
        return error

    async def wait(self) -> int:
        """Wait until the process has ended and all its lines are read, and return its exit code."""
        assert self._process is not None
        if self._reader is not None:
            await self._reader
        return await self._process.wait()

    async def succeed(self) -> None:
        """Wait for the successful end of the process.

        Raises:
            StackError: Its exit code is not 0.
        """
        if code := await self.wait():
            raise self.failure(code)

    async def end(self) -> None:
        """End the process by SIGTERM, and by SIGKILL after 6 s."""
        if self._process is None:
            return
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


async def build(
    case_study: str, deployment: Path, uri: str, topic: str, type_: str, *options: str, boards: int = 4
) -> None:
    """Build a case study's deployment; the report goes to DEPLOYMENT.log.

    Raises:
        StackError: The toolchain failed.
    """
    toolchain = Process("toolchain", deployment.with_name(deployment.name + ".log"))
    await toolchain.start(
        *("toolchain", "build", str(ROOT / "casestudies" / case_study), "-o", str(deployment)),
        *("--partitions", str(boards), "--uri", uri, "--topic", topic, "--type", type_, *options),
    )
    await toolchain.succeed()


def run_script(work: Callable[[], Awaitable[int]], limit: float) -> int:
    """Run a script's coroutine with a time limit, and report an error in one sentence.

    Returns:
        The exit code.
    """

    async def limited() -> int:
        try:
            return await asyncio.wait_for(work(), limit)
        except TimeoutError:
            raise StackError(f"this did not end within {limit:.0f} s") from None

    try:
        return run_async(limited())
    except StoppedError as stopped:
        print(stopped, file=sys.stderr)
        return stopped.exit_code
    except (StackError, BridgeError, ToolchainError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        print(f"error: {error.filename or ''}: {error.strerror or error}", file=sys.stderr)
        return ExitCode.USAGE
