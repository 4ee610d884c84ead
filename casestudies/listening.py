"""Hears the result topics of one rosbridge server and hands out frames with all that belongs to them."""

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Final

from bridge.client import Message, Ros, Subscription
from casestudies.errors import BadResultError, NoResultError
from casestudies.results import (
    FRAME_TOPIC,
    FRAME_TYPE,
    RESULTS_TOPIC,
    RESULTS_TYPE,
    TRUTH_TYPE,
    Instance,
    Pairing,
    Truth,
    read_frame_report,
    read_posterior,
    read_truth,
)

_QUEUE_SIZE: Final = 256
_DISORDER_NS: Final = 50_000_000
"""So much later than its result a server may deliver the report that was published before it."""
_PATIENCE_S: Final = 1.0
"""So long a result waits for a report or a truth that does not come."""


class Listener:
    """The frames heard so far that nobody has taken yet; `listen` makes it.

    Attributes:
        route: the true positions heard, the newest last.
    """

    def __init__(self, uri: str, pairing: Pairing) -> None:
        """Hand out what this pairing makes of the messages from that server."""
        self.route: deque[Truth] = deque(maxlen=100_000)
        self._uri = uri
        self._pairing = pairing
        self._ready: deque[Instance] = deque()
        self._failure: BadResultError | None = None
        self._news = asyncio.Event()

    @property
    def announced_only(self) -> int:
        """How many frames were announced on `/bm/frame` whose result never came."""
        return self._pairing.announced_only

    async def next(self, limit_s: float) -> Instance:
        """Wait for the next frame.

        Raises:
            NoResultError: none came within the limit, in seconds.
            BadResultError: something else than a result came.
        """
        now = asyncio.get_running_loop().time
        end, flushing = now() + limit_s, now() + _PATIENCE_S
        while not self._ready:
            if self._failure is not None:
                raise self._failure
            if self._pairing.waits and now() >= min(flushing, end):
                self._ready.extend(self._pairing.flush())
            elif now() >= end:
                raise NoResultError(
                    f"nothing came on {FRAME_TOPIC} and {RESULTS_TOPIC} from {self._uri} within "
                    f"{limit_s:g} s: is the master running, and do readings reach it?"
                )
            else:
                self._news.clear()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout_at(min(flushing, end) if self._pairing.waits else end):
                        await self._news.wait()
        return self._ready.popleft()

    async def pump(self, subscription: Subscription, take: Callable[[Message], list[Instance]]) -> None:
        """Hand the messages of one topic to the pairing, until cancelled."""
        async for message in subscription:
            try:
                self._ready.extend(take(message))
            except BadResultError as error:
                self._failure = error
            self._news.set()

    def take_report(self, message: Message) -> list[Instance]:
        """A message of `/bm/frame`."""
        return self._pairing.add_report(read_frame_report(message.msg, message.received_ns))

    def take_posterior(self, message: Message) -> list[Instance]:
        """A message of `/BMresults`."""
        return self._pairing.add_posterior(read_posterior(message.msg, message.received_ns))

    def take_truth(self, message: Message) -> list[Instance]:
        """A message of the truth's topic."""
        truth = read_truth(message.msg, message.topic)
        self.route.append(truth)
        return self._pairing.add_truth(truth)


@contextlib.asynccontextmanager
async def listen(
    ros: Ros, *, truth_topic: str | None = None, truth_tolerance_s: float = 0.0
) -> AsyncIterator[Listener]:
    """Subscribe to `/bm/frame`, `/BMresults` and, if it is named, the truth's topic.

    Args:
        ros: the open client.
        truth_topic: of geometry_msgs/PoseStamped with the stamps of the readings; None for no truth.
        truth_tolerance_s: how much older than a frame's stamp a true pose may be, in seconds.
    """
    listener = Listener(
        ros.uri, Pairing(truth_tolerance_ns=round(truth_tolerance_s * 1e9), disorder_ns=_DISORDER_NS)
    )
    taking: list[tuple[str, str, Callable[[Message], list[Instance]]]] = [
        (FRAME_TOPIC, FRAME_TYPE, listener.take_report),
        (RESULTS_TOPIC, RESULTS_TYPE, listener.take_posterior),
    ]
    if truth_topic is not None:
        taking.append((truth_topic, TRUTH_TYPE, listener.take_truth))
    subscriptions = [
        ros.subscribe(topic, type_name, queue_size=_QUEUE_SIZE) for topic, type_name, _ in taking
    ]
    pumps = [
        asyncio.create_task(listener.pump(subscription, take))
        for subscription, (_, _, take) in zip(subscriptions, taking, strict=True)
    ]
    try:
        yield listener
    finally:
        for pump in pumps:
            pump.cancel()
        await asyncio.gather(*pumps, return_exceptions=True)
        for subscription in subscriptions:
            await subscription.close()
