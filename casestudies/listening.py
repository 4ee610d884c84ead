"""A listener to results and true positions, which yields frames with their truth."""

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator
from typing import Final

from bridge.client import Ros, Subscription
from bridge.errors import DisconnectedError
from casestudies.truths import TRUTH_TYPE, Instance, Truth, Truths, read_truth
from posteriors.errors import BadResultError
from posteriors.listening import Posteriors, posteriors

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
