"""Topics of case studies: publications that drop messages, readiness, and a listener that yields frames with their truth."""

import asyncio
import contextlib
import json
import os
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BaseModel, BeforeValidator, ConfigDict, FiniteFloat, ValidationError

from bridge.client import Publication, Ros, Subscription
from bridge.errors import DisconnectedError, SlowPeerError
from bridge.names import same_type
from bridge.stamps import stamp_ns
from posteriors.errors import BadResultError, NoResultError
from posteriors.frame_report import FrameReport
from posteriors.listening import Posteriors, posteriors
from posteriors.pairing import FrameOutcome
from posteriors.posterior import Posterior
from terminal.errors import ExitCode, StoppedError
from terminal.health import resources, serve_health
from terminal.one_line import shown
from terminal.output import say, warn
from terminal.run_directory import status_directory
from terminal.signals import run_async

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


def run_viewer(watching: Coroutine[Any, Any, None], finish: Callable[[], None]) -> None:
    """Run a viewer, and finish it when it ends, also by Ctrl-C or because no more results come."""
    try:
        run_async(watching)
    except (NoResultError, StoppedError) as ended:
        if isinstance(ended, NoResultError) or ended.exit_code == ExitCode.INTERRUPTED:
            finish()
        raise
    finish()


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


TRUTH_TYPE: Final = "geometry_msgs/PoseStamped"

_TRUTHS_KEPT = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """A true position, in the map's units."""

    stamp_ns: int
    x: float
    y: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Instance:
    """A frame's outcome and its true position.

    `truth` is None if no true pose matches the stamp. `truth_age_ns` is the age of the true pose relative to the
    frame's stamp, 0 if the stamps are equal.
    """

    heard: FrameOutcome
    truth: Truth | None = None
    truth_age_ns: int = 0

    @property
    def posterior(self) -> Posterior | None:
        """The posterior, or None for a frame without one."""
        return self.heard if isinstance(self.heard, Posterior) else None

    @property
    def report(self) -> FrameReport | None:
        """The report, or None for a posterior that no `/bm/frame` announced."""
        return self.heard.report if isinstance(self.heard, Posterior) else self.heard


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class _Header(_Part):
    stamp: Annotated[int, BeforeValidator(stamp_ns)]


class _Point(_Part):
    x: FiniteFloat
    y: FiniteFloat


class _Pose(_Part):
    position: _Point


class _PoseStamped(_Part):
    header: _Header
    pose: _Pose


def read_truth(message: dict[str, Any], topic: str) -> Truth:
    """Return a geometry_msgs/PoseStamped as a true position, or raise a BadResultError."""
    try:
        pose = _PoseStamped.model_validate(message)
    except ValidationError as error:
        place = ".".join(str(step) for step in error.errors()[0]["loc"])
        raise BadResultError(
            f"a message on {topic} is not the {TRUTH_TYPE} of a simulator ({place or 'the message'} is wrong)"
        ) from None
    return Truth(stamp_ns=pose.header.stamp, x=pose.pose.position.x, y=pose.pose.position.y)


class Truths:
    """Frames and true positions, matched in any order of arrival.

    A frame waits for its truth until a newer truth or the next frame arrives. If no truth has exactly the
    frame's stamp, the newest older one is used, if it is at most `tolerance_ns` older: a message without a
    header is stamped only when it reaches the host.
    """

    def __init__(self, *, tolerance_ns: int = 0) -> None:
        self._tolerance_ns = tolerance_ns
        self._truths: deque[Truth] = deque(maxlen=_TRUTHS_KEPT)
        self._untrue: deque[Instance] = deque()  # frames that still wait for their true pose

    @property
    def waits(self) -> bool:
        """True while a frame waits for its truth."""
        return bool(self._untrue)

    def add_frame(self, heard: FrameOutcome) -> list[Instance]:
        """Add a frame's outcome and return the instances that are now complete."""
        self._untrue.append(Instance(heard=heard))
        return self._resolve()

    def add_truth(self, truth: Truth) -> list[Instance]:
        """Add a true position and return the instances that are now complete."""
        self._truths.append(truth)
        return self._resolve()

    def flush(self) -> list[Instance]:
        """Return the frames that still wait for a truth, because it will not arrive."""
        ended = [self._with_truth(instance) for instance in self._untrue]
        self._untrue.clear()
        return ended

    def _resolve(self) -> list[Instance]:
        ready: list[Instance] = []
        while self._untrue:
            report = self._untrue[0].report
            waits = (
                report is not None
                and len(self._untrue) == 1
                and bool(self._truths)
                and self._truths[-1].stamp_ns < report.stamp_ns
            )
            if waits:
                break
            ready.append(self._with_truth(self._untrue.popleft()))
        return ready

    def _with_truth(self, instance: Instance) -> Instance:
        if instance.report is None:
            return instance
        for truth in reversed(self._truths):
            age_ns = instance.report.stamp_ns - truth.stamp_ns
            if age_ns >= 0:
                if age_ns > self._tolerance_ns:
                    break
                return Instance(heard=instance.heard, truth=truth, truth_age_ns=age_ns)
        return instance


_QUEUE_SIZE: Final = 256
_PATIENCE_S: Final = 1.0
"""Seconds that a frame waits for its truth."""


class Listener:
    """The frames received and not yet returned by `next`; created by `listen`.

    Attributes:
        route: The true positions received, the newest last.
    """

    def __init__(self, heard: Posteriors, truths: Truths) -> None:
        """Start without frames."""
        self.route: deque[Truth] = deque(maxlen=100_000)
        self._heard = heard
        self._truths = truths
        self._ready: deque[Instance] = deque()
        self._failure: BadResultError | None = None
        self._news = asyncio.Event()

    @property
    def announced_only(self) -> int:
        """The number of frames that `/bm/frame` announced and whose result never arrived."""
        return self._heard.announced_only

    async def next(self, limit_s: float) -> Instance:
        """Wait for the next frame.

        Raises:
            NoResultError: No frame arrived within the limit, in seconds.
            BadResultError: A message was not a result.
        """
        now = asyncio.get_running_loop().time
        end, flushing = now() + limit_s, now() + _PATIENCE_S
        while not self._ready:
            if self._failure is not None:
                raise self._failure
            if self._truths.waits and now() >= min(flushing, end):
                self._ready.extend(self._truths.flush())
            elif now() >= end:
                raise await self._heard.no_result_error(limit_s)
            else:
                self._news.clear()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout_at(min(flushing, end) if self._truths.waits else end):
                        await self._news.wait()
        return self._ready.popleft()

    async def follow_frames(self) -> None:
        """Collect frames until the client is closed."""
        while True:
            try:
                self._ready.extend(self._truths.add_frame(await self._heard.next_frame(None)))
            except DisconnectedError:
                return
            except BadResultError as error:
                self._failure = error
            self._news.set()

    async def follow_truths(self, subscription: Subscription) -> None:
        """Collect true positions until the subscription is closed."""
        async for message in subscription:
            try:
                truth = read_truth(message.msg, message.topic)
            except BadResultError as error:
                self._failure = error
            else:
                self.route.append(truth)
                self._ready.extend(self._truths.add_truth(truth))
            self._news.set()


@contextlib.asynccontextmanager
async def listen(
    ros: Ros, *, truth_topic: str | None = None, truth_tolerance_s: float = 0.0
) -> AsyncIterator[Listener]:
    """Subscribe to `/bm/frame`, `/BMresults` and, if given, a geometry_msgs/PoseStamped topic of true poses.

    A true pose belongs to a frame if it has the same stamp, or one older by at most the tolerance.
    """
    async with contextlib.AsyncExitStack() as stack:
        heard = await stack.enter_async_context(posteriors(ros, queue_size=_QUEUE_SIZE))
        listener = Listener(heard, Truths(tolerance_ns=round(truth_tolerance_s * 1e9)))
        followers = [asyncio.create_task(listener.follow_frames())]
        if truth_topic is not None:
            truths = ros.subscribe(truth_topic, TRUTH_TYPE, queue_size=_QUEUE_SIZE)
            await stack.enter_async_context(truths)
            followers.append(asyncio.create_task(listener.follow_truths(truths)))
        try:
            yield listener
        finally:
            for follower in followers:
                follower.cancel()
            await asyncio.gather(*followers, return_exceptions=True)
