"""The transforms of a robot, from its topics `/tf` and `/tf_static`."""

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final, Self

from bridge.errors import TransformError
from bridge.qos import Qos
from bridge.transforms import Transform, TransformTree

if TYPE_CHECKING:
    from bridge.client.handles import Subscription

_TYPE: Final = "tf2_msgs/TFMessage"
_STATIC: Final = Qos(durability="transient_local", reliability="reliable")
"""Static transforms are published once, so late subscribers want the last message."""
_QUEUE: Final = 1000


class Transforms:
    """The transforms of a robot: `async with ros.transforms() as transforms`.

    Attributes:
        tree: The frames received so far.
    """

    def __init__(self, subscribe: "Callable[..., Subscription]") -> None:
        """Store the client's method `subscribe` instead of the client, whose module imports this one."""
        self.tree = TransformTree()
        self._subscribe = subscribe
        # Set by each message; `lookup` clears it before it waits for the next.
        self._news = asyncio.Event()
        # One per topic, while the context is open; each owns its subscription.
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        self._tasks = [
            loop.create_task(self._follow("/tf", None, static=False)),
            loop.create_task(self._follow("/tf_static", _STATIC, static=True)),
        ]
        return self

    async def __aexit__(self, *_exception: object) -> None:
        await self.close()

    async def close(self) -> None:
        """End the subscriptions."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _follow(self, topic: str, qos: Qos | None, *, static: bool) -> None:
        async with self._subscribe(topic, _TYPE, queue_size=_QUEUE, qos=qos) as messages:
            async for message in messages:
                self.tree.take(message.msg, static=static)
                self._news.set()

    async def lookup(
        self, target: str, source: str, stamp_ns: int | None = None, timeout: float = 1.0
    ) -> Transform:
        """Return the transform from frame `source` to frame `target`, as soon as it is known.

        Args:
            target: Name of the frame in which coordinates are wanted.
            source: Name of the frame in which they are given.
            stamp_ns: Nanoseconds since 1970, for which stored transforms are interpolated; None for the latest.
            timeout: Maximum seconds to wait until it is known.

        Raises:
            FrameUnknownError: One of the frames is not known.
            FramesUnconnectedError: They have no common ancestor.
            ExtrapolationError: A part is not known at that time.
        """
        deadline = time.monotonic() + timeout
        while True:
            try:
                return self.tree.lookup(target, source, stamp_ns)
            except TransformError:
                if time.monotonic() >= deadline:
                    raise
            self._news.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout(deadline - time.monotonic()):
                    await self._news.wait()
