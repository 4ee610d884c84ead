"""Readiness of a case study's process: whether it did its work lately, shown on its status socket."""

import contextlib
import json
import os
import time
from collections.abc import AsyncIterator
from typing import Final

from terminal.health import health_served

RECENT_S: Final = 10.0
"""Seconds after which the last piece of work is too long ago."""


class Readiness:
    """When a process last did its work."""

    def __init__(self, work: str) -> None:
        """Begin with nothing done; `work` names the work in the past tense: "a reading was published"."""
        self._work = work
        self._last: float | None = None
        self._done = 0

    def did(self) -> None:
        """Note a piece of work."""
        self._last = time.monotonic()
        self._done += 1

    def state(self) -> tuple[bool, str]:
        """Return whether the process is ready, and why."""
        if self._last is None:
            return False, f"not once yet: {self._work}"
        age = time.monotonic() - self._last
        return age <= RECENT_S, f"{self._work} {age:.1f} s ago, {self._done} in all"


@contextlib.asynccontextmanager
async def readiness_served(name: str, readiness: Readiness) -> AsyncIterator[None]:
    """Show the readiness in the folder that BM_RUN_DIRECTORY names, if any, while the context lasts."""
    started = time.monotonic()

    def answer() -> bytes:
        ready, why = readiness.state()
        uptime = round(time.monotonic() - started, 3)
        status = {"ready": ready, "why": why, "name": name, "pid": os.getpid(), "uptime_s": uptime}
        return json.dumps(status).encode()

    async with health_served(os.environ.get("BM_RUN_DIRECTORY") or None, name, answer):
        yield
