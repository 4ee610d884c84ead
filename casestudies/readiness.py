"""Whether a process of a case study does its work, told to whoever asks: a container's health check, or `status`.

Where BM_RUN_DIRECTORY names a folder, `NAME.status.sock` there answers each connection with one JSON object and closes
it, as the services' own do: `python -m services.ready boat-viewer` understands it.
"""

import asyncio
import contextlib
import json
import os
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Final

from casestudies.running import say

RECENT_S: Final = 10.0
"""Seconds after which the last piece of work is too long ago."""


class Readiness:
    """When a process last did what it is there for."""

    def __init__(self, work: str) -> None:
        """Nothing is done yet; `work` names it in the past tense: "a reading was published"."""
        self._work = work
        self._last: float | None = None
        self._done = 0

    def did(self) -> None:
        """Note a piece of work."""
        self._last = time.monotonic()
        self._done += 1

    def tell(self) -> tuple[bool, str]:
        """Whether it is ready, and a sentence that says why."""
        if self._last is None:
            return False, f"not once yet: {self._work}"
        age = time.monotonic() - self._last
        return age <= RECENT_S, f"{self._work} {age:.1f} s ago, {self._done} in all"


@contextlib.asynccontextmanager
async def readiness_told(name: str, readiness: Readiness) -> AsyncIterator[None]:
    """Answer while the context lasts; nothing happens without a run directory.

    A folder that refuses the socket is a warning: a process's work does not end by that.
    """
    directory = os.environ.get("BM_RUN_DIRECTORY", "")
    if not directory:
        yield
        return
    path = Path(directory) / f"{name}.status.sock"
    started = time.monotonic()

    def answer(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        ready, why = readiness.tell()
        told = {
            "ready": ready,
            "why": why,
            "name": name,
            "pid": os.getpid(),
            "uptime_s": round(time.monotonic() - started, 3),
        }
        writer.write(json.dumps(told).encode())
        writer.close()

    server = None
    before = os.umask(0o177)  # the socket is its owner's alone
    try:
        with contextlib.suppress(FileNotFoundError):
            path.unlink()  # of a process that was killed
        server = await asyncio.start_unix_server(answer, path)
    except OSError as error:
        say(f"{name}: warning: its status can't be shown at {path}: {error.strerror or error}")
    finally:
        os.umask(before)
    try:
        yield
    finally:
        if server is not None:
            server.close()
            with contextlib.suppress(OSError):
                path.unlink()
