"""Shared code of case studies: publishing without waiting for a slow server, health checks, and true positions."""

import asyncio
import contextlib
import json
import os
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, FiniteFloat, TypeAdapter

from bridge.client import Publication, Ros, Subscription, connect
from bridge.errors import DisconnectedError, MessageTooLargeError, SlowPeerError
from bridge.names import same_type
from bridge.stamps import stamp_ns
from posteriors.errors import NoResultError
from posteriors.frame_report import FrameReport
from posteriors.listening import Posteriors, posteriors
from posteriors.messages import Part, validated
from posteriors.pairing import FrameOutcome
from posteriors.posterior import Posterior
from terminal.connection import report_connection
from terminal.errors import ExitCode, StoppedError
from terminal.health import resources, serve_health
from terminal.one_line import shown
from terminal.output import say, warn
from terminal.run_directory import status_directory
from terminal.signals import run_async

RECENT_S: Final = 10.0
"""A process is ready if its last work was at most this many seconds ago."""


class Readiness:
    """Readiness of a process. The process is ready if it has worked within the last `RECENT_S` seconds."""

    def __init__(self, work: str) -> None:
        """Start with no work done.

        `work` describes a step of the work in the past tense, for example "a reading was published".
        """
        self._work = work
        self._last: float | None = None
        self._done = 0

    def record(self) -> None:
        """Record that the process has just done its work."""
        self._last = time.monotonic()
        self._done += 1

    def state(self) -> tuple[bool, str]:
        """Return whether the process is ready, and the reason as text."""
        if self._last is None:
            return False, f"not yet: {self._work}"
        age = time.monotonic() - self._last
        return age <= RECENT_S, f"{self._work} {age:.1f} s ago, {self._done} in all"


@contextlib.asynccontextmanager
async def connected(name: str, work: str, uri: str) -> AsyncIterator[tuple[Ros, Readiness]]:
    """Connect to a server, and yield the connection and the `Readiness` of this process.

    Until the end of the context, the process `name` answers health checks through a socket in the run directory. The
    answer contains `work`, such as "a reading was published", and the time since `Readiness.record` was last called.
    Call `Readiness.record` whenever the work has been done.
    """
    started, readiness = time.monotonic(), Readiness(work)

    def answer() -> bytes:
        ready, why = readiness.state()
        uptime = round(time.monotonic() - started, 3)
        status = {"ready": ready, "why": why, "name": name, "pid": os.getpid(), "uptime_s": uptime}
        status |= resources()
        return json.dumps(status).encode()

    given = os.environ.get("BM_RUN_DIRECTORY")
    directory = status_directory(Path(given) if given else None, name)
    async with (
        serve_health(directory, name, answer),
        connect(uri, retry=True, on_state=report_connection(uri)) as ros,
    ):
        yield ros, readiness


def run_viewer(watching: Coroutine[Any, Any, None], finish: Callable[[], None]) -> None:
    """Run a viewer. Call `finish` at its end, also after Ctrl-C or a lack of results, but not after other errors."""
    try:
        run_async(watching)
    except (NoResultError, StoppedError) as ended:
        if isinstance(ended, NoResultError) or ended.exit_code == ExitCode.INTERRUPTED:
            finish()
        raise
    finish()


SETTLED_S: Final = 3.0
"""Seconds from an advertisement until the server must list the topic or service. Otherwise, the server refused it."""


async def report_refused(
    ros: Ros, topic: str, type_: str, otherwise: str = "publish arrays with --array"
) -> None:
    """Warn if rosapi does not list an advertised topic, or lists the topic with another type.

    The warning advises the user to install the message package on the robot, or to follow the advice `otherwise`.
    """
    await asyncio.sleep(SETTLED_S)
    known = await ros.topic_type(topic)
    if known is None or (known and same_type(known, type_)):
        return
    package = type_.partition("/")[0]
    reason = f"it is {shown(known)} there" if known else f"does the server have {package}?"
    warn(
        f"the server rejects everything on {topic}, of type {type_}: {reason}; "
        f"install the package on the robot, or {otherwise}"
    )


class LossyPublication:
    """A publication that drops messages while the server is disconnected or slow.

    A message that is too large for the server is also dropped. The user gets one warning about a slow server, and one
    about a message that is too large. After a message has been published, each warning may come again.
    """

    def __init__(self, publication: Publication) -> None:
        """Wrap a publication."""
        self._publication = publication
        # Whether the last message was dropped because the server was slow, or because the message was too large.
        self._slow = self._large = False

    async def publish(self, message: Mapping[str, Any]) -> bool:
        """Publish or drop the message. Return True if the message was published."""
        try:
            await self._publication.publish(message)
        except DisconnectedError:
            return False
        except SlowPeerError as error:
            if not self._slow:
                warn(f"{error}; messages on {self._publication.topic} are dropped until it keeps up")
            self._slow = True
            return False
        except MessageTooLargeError as error:
            if not self._large:
                warn(f"{error}; it is dropped")
            self._large = True
            return False
        if self._slow or self._large:
            say(f"{self._publication.topic} is published again")
        self._slow = self._large = False
        return True


TRUTH_TYPE: Final = "geometry_msgs/PoseStamped"


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """A true position, in the map's units."""

    stamp_ns: int
    x: float
    y: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Instance:
    """The outcome of a frame, received from the topics of results, and the true position at the frame's time.

    `truth` is None if no true pose matches the stamp of the frame. `truth_age_ns` is the stamp of the frame minus the
    stamp of the true pose, in ns.
    """

    heard: FrameOutcome
    truth: Truth | None = None
    truth_age_ns: int = 0

    @property
    def posterior(self) -> Posterior | None:
        """The posterior, or None if the frame has none."""
        return self.heard if isinstance(self.heard, Posterior) else None

    @property
    def report(self) -> FrameReport | None:
        """The report of the frame on `/bm/frame`, or None if a posterior arrived without a report."""
        return self.heard.report if isinstance(self.heard, Posterior) else self.heard


class _Header(Part):
    stamp: Annotated[int, BeforeValidator(stamp_ns)]


class _Point(Part):
    x: FiniteFloat
    y: FiniteFloat


class _Pose(Part):
    position: _Point


class _PoseStamped(Part):
    header: _Header
    pose: _Pose


_POSE: Final = TypeAdapter(_PoseStamped)


def read_truth(message: dict[str, Any], topic: str) -> Truth:
    """Return the true position in a geometry_msgs/PoseStamped from `topic`, or raise a BadResultError."""
    pose = validated(_POSE, message, topic, TRUTH_TYPE)
    return Truth(stamp_ns=pose.header.stamp, x=pose.pose.position.x, y=pose.pose.position.y)


_QUEUE_SIZE: Final = 256
_PATIENCE_S: Final = 1.0
"""Maximum seconds that a frame waits for the true position at its time."""


class Listener:
    """The frames that a running stack publishes, each with its true position. `listen` creates a Listener.

    A frame gets the newest true position that is not later than the frame. If this position is more than
    `tolerance_ns` older than the frame, the frame has no true position. With a tolerance of 0, the stamps must be
    equal. Readings without a header need a tolerance above 0, because they get their stamp when they reach the host.

    Attributes:
        route: The true positions received, with the newest last.
    """

    def __init__(self, heard: Posteriors, tolerance_ns: int) -> None:
        """Start without true positions."""
        self.route: deque[Truth] = deque(maxlen=100_000)
        self._heard = heard
        self._tolerance_ns = tolerance_ns
        # Set by every true position; cleared by a frame for which none came in time, so that later frames do not wait.
        self._truths_come = False
        self._news = asyncio.Event()
        # The task that reads truths, from `follow` on; a message that is not a truth ends it with an error.
        self._following: asyncio.Task[None] | None = None

    @property
    def announced_only(self) -> int:
        """The number of frames that `/bm/frame` announced, but for which no result arrived."""
        return self._heard.announced_only

    async def next(self, limit_s: float) -> Instance:
        """Wait for the next frame, and return the frame with its true position if there is one.

        The true position is the latest one before or at the time of the frame, within the tolerance.

        Raises:
            NoResultError: No frame arrived within `limit_s` seconds.
            BadResultError: A message was not a result, or not a true pose.
        """
        hearing = asyncio.ensure_future(self._heard.next_frame(limit_s))
        try:
            followed = {hearing} if self._following is None else {hearing, self._following}
            await asyncio.wait(followed, return_when=asyncio.FIRST_COMPLETED)
            if self._following is not None and self._following.done():
                self._following.result()
            instance = Instance(heard=await hearing)
        finally:
            hearing.cancel()
        if instance.report is not None:
            await self._wait_for_truth(instance.report.stamp_ns)
            for truth in reversed(self.route):
                age_ns = instance.report.stamp_ns - truth.stamp_ns
                if 0 <= age_ns <= self._tolerance_ns:
                    return replace(instance, truth=truth, truth_age_ns=age_ns)
                if age_ns > 0:
                    break
        return instance

    async def _wait_for_truth(self, stamp_ns: int) -> None:
        """Wait at most `_PATIENCE_S` for a true position of this time or a later one."""
        try:
            async with asyncio.timeout(_PATIENCE_S):
                while self._truths_come and self.route[-1].stamp_ns < stamp_ns:
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            self._truths_come = False

    def add_truth(self, truth: Truth) -> None:
        """Add a true position."""
        self.route.append(truth)
        self._truths_come = True
        self._news.set()

    @contextlib.asynccontextmanager
    async def follow(self, subscription: Subscription) -> AsyncIterator[None]:
        """Collect true positions within the context."""

        async def collect() -> None:
            async for message in subscription:
                self.add_truth(read_truth(message.msg, message.topic))

        self._following = asyncio.create_task(collect())
        try:
            yield
        finally:
            self._following.cancel()
            await asyncio.gather(self._following, return_exceptions=True)


@contextlib.asynccontextmanager
async def listen(
    ros: Ros, *, truth_topic: str | None = None, truth_tolerance_s: float = 0.0
) -> AsyncIterator[Listener]:
    """Listen to `/bm/frame` and `/BMresults`. If `truth_topic` is given, also listen to its geometry_msgs/PoseStamped.

    A true pose belongs to a frame if the stamps are equal, or if the pose is older by at most `truth_tolerance_s`.
    """
    async with contextlib.AsyncExitStack() as stack:
        heard = await stack.enter_async_context(posteriors(ros, queue_size=_QUEUE_SIZE))
        listener = Listener(heard, round(truth_tolerance_s * 1e9))
        if truth_topic is not None:
            truths = ros.subscribe(truth_topic, TRUTH_TYPE, queue_size=_QUEUE_SIZE)
            await stack.enter_async_context(truths)
            await stack.enter_async_context(listener.follow(truths))
        yield listener
