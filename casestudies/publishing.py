"""Publishing in case studies: readiness on a status socket, and publications that drop messages."""

import asyncio
import contextlib
import json
import os
import time
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any, Final

from bridge.client import Publication, Ros
from bridge.errors import DisconnectedError, SlowPeerError
from bridge.names import same_type
from terminal.health import resources, serve_health
from terminal.one_line import shown
from terminal.output import say, warn
from terminal.run_directory import status_directory

RECENT_S: Final = 10.0
"""Seconds without work after which a process is not ready."""


class Readiness:
    """Readiness of a process, which is ready if it has worked within the last `RECENT_S` seconds."""

    def __init__(self, work: str) -> None:
        """Start with no work done; `work` describes the work in the past tense, such as "a reading was published"."""
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
    """Report the readiness within the context, on a socket in the run directory."""
    started = time.monotonic()

    def answer() -> bytes:
        ready, why = readiness.state()
        uptime = round(time.monotonic() - started, 3)
        status = {"ready": ready, "why": why, "name": name, "pid": os.getpid(), "uptime_s": uptime}
        status |= resources()
        return json.dumps(status).encode()

    given = os.environ.get("BM_RUN_DIRECTORY")
    directory = status_directory(Path(given) if given else None, name)
    async with serve_health(directory, name, answer):
        yield


SETTLED_S: Final = 3.0
"""If a server does not list an advertised topic after this many seconds, it has refused it."""


async def report_refused(ros: Ros, topic: str, type_: str) -> None:
    """Warn if, according to rosapi, the server does not forward an advertised topic."""
    await asyncio.sleep(SETTLED_S)
    known = await ros.topic_type(topic)
    if known is None or (known and same_type(known, type_)):
        return
    package = type_.partition("/")[0]
    reason = f"it is {shown(known)} there" if known else f"does the server have {package}?"
    warn(
        f"the server rejects everything on {topic}, of type {type_}: {reason}; "
        "install the package on the robot, or publish arrays with --array"
    )


class LossyPublication:
    """A publication that drops messages while the server is disconnected or slow, with one warning each time."""

    def __init__(self, publication: Publication) -> None:
        """Wrap a publication."""
        self._publication = publication
        self._slow = False

    async def publish(self, message: Mapping[str, Any]) -> bool:
        """Publish the message or drop it, and return whether it was published."""
        try:
            await self._publication.publish(message)
        except DisconnectedError:
            return False
        except SlowPeerError as error:
            if not self._slow:
                warn(f"{error}; messages on {self._publication.topic} are dropped until it keeps up")
            self._slow = True
            return False
        if self._slow:
            say(f"{self._publication.topic} is published again")
        self._slow = False
        return True
