"""Readiness of a case study's process, which its status socket reports."""

import contextlib
import json
import os
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Final

from terminal.health import resources, serve_health
from terminal.private_directory import own_directory

RECENT_S: Final = 10.0
"""Seconds without work after which a process is not ready."""


class Readiness:
    """Readiness of a process: true if it has worked within the last `RECENT_S` seconds."""

    def __init__(self, work: str) -> None:
        """Start with no work done; `work` names it in the past tense, such as "a reading was published"."""
        self._work = work
        self._last: float | None = None
        self._done = 0

    def record(self) -> None:
        """Record that the process worked."""
        self._last = time.monotonic()
        self._done += 1

    def state(self) -> tuple[bool, str]:
        """Return whether the process is ready, and why."""
        if self._last is None:
            return False, f"not yet: {self._work}"
        age = time.monotonic() - self._last
        return age <= RECENT_S, f"{self._work} {age:.1f} s ago, {self._done} in all"


@contextlib.asynccontextmanager
async def serve_readiness(name: str, readiness: Readiness) -> AsyncIterator[None]:
    """Report the readiness within the context, on a socket in BM_RUN_DIRECTORY or in a private directory."""
    started = time.monotonic()

    def answer() -> bytes:
        ready, why = readiness.state()
        uptime = round(time.monotonic() - started, 3)
        status = {"ready": ready, "why": why, "name": name, "pid": os.getpid(), "uptime_s": uptime}
        status |= resources()
        return json.dumps(status).encode()

    given = os.environ.get("BM_RUN_DIRECTORY")
    with own_directory(Path(given) if given else None, name) as directory:
        async with serve_health(directory, name, answer):
            yield
