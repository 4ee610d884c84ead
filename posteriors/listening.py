"""Subscription to the posteriors of a running stack, each as a labelled array with the report of its frame.

With asyncio:

    async with connect("ws://robot:9090") as ros:
        async for posterior in posteriors(ros):
            print(posterior.number, posterior.best(), posterior.values.shape)

Without asyncio:

    listen("ws://robot:9090", lambda posterior: print(posterior.best()))

NumPy is imported when the first array is used (docs/how-to/listening.md).
"""

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from typing import Any, Final, Self, TypeVar

from bridge.client import Message, Ros, State, Subscription, connect
from bridge.client.protocol import Compression
from bridge.errors import ConcurrentReadError, DisconnectedError, OptionError
from bridge.names import same_type
from posteriors.errors import BadResultError, NoResultError
from posteriors.frame_report import FRAME_TOPIC, FRAME_TYPE, read_frame_report
from posteriors.pairing import WAITING, FrameOutcome, Pairing
from posteriors.posterior import MAX_RESULT, RESULTS_TOPIC, RESULTS_TYPE, Posterior, read_posterior
from terminal.health import in_thread

QUEUE_SIZE: Final = 64
"""Default maximum number of received posteriors that wait for the reader."""
FIRST_TIMEOUT: Final = 30.0
"""Default timeout for the first posterior, in seconds."""
_DISORDER_NS: Final = 50_000_000
"""Maximum delay of a report after its posterior, in ns: reports are published first, but may arrive second."""
_REPORT_TIMEOUT: Final = 1.0
"""Seconds that a posterior waits for its report."""

Result = TypeVar("Result")


class Posteriors:
    """A subscription to the posteriors of a stack on the client's server, read by one task with `async for`.

    After a lost connection, the iteration continues as soon as the client has reconnected. The iteration ends if this
    object or the client is closed. Use `async with`, so that this object is closed before the client. If the reader is
    too slow, the oldest posteriors are dropped. The connection is not affected.

    Args:
        ros: The open client.
        topic: Topic of the posteriors, as given to `toolchain build --output`.
        frame_topic: Topic of the frame reports.
        deployment: The model's name. If it is given, frames of other models are ignored.
        queue_size: Maximum number of posteriors that wait for the reader. If more arrive, the oldest is dropped and
            counted.
        compression: `cbor` transfers large posteriors faster if the server supports it.

    Raises:
        NameFormError: A topic's name is malformed.
        TypeConflictError: This client already subscribes to the topic with another type.
        OptionError: `queue_size` is less than 1.
        DisconnectedError: The client is closed.

    Attributes:
        without_posterior: Number of frames skipped because they had no posterior, usually due to impossible
            readings.
    """

    def __init__(
        self,
        ros: Ros,
        *,
        topic: str = RESULTS_TOPIC,
        frame_topic: str = FRAME_TOPIC,
        deployment: str | None = None,
        queue_size: int = QUEUE_SIZE,
        compression: Compression = "none",
    ) -> None:
        if queue_size < 1:
            raise OptionError(f"queue_size of {topic} must be at least 1, not {queue_size}")
        self.without_posterior = 0
        self._ros = ros
        self._topic = topic
        self._frame_topic = frame_topic
        self._deployment = deployment
        self._size = queue_size
        self._lost = 0
        self._open_topics = 2
        self._pairing = Pairing(disorder_ns=_DISORDER_NS)
        self._ready: deque[FrameOutcome | BadResultError] = deque()
        self._waiter: asyncio.Future[None] | None = None
        self._report_timer: asyncio.TimerHandle | None = None
        reports = ros.subscribe(frame_topic, FRAME_TYPE, queue_size=max(queue_size, WAITING))
        results = ros.subscribe(
            topic, RESULTS_TYPE, queue_size=max(queue_size, WAITING), compression=compression
        )
        self._subscriptions = (reports, results)
        self._pumps = [
            asyncio.create_task(self._pump(reports, self._report)),
            asyncio.create_task(self._pump(results, self._result)),
        ]

    # Reading

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Posterior:
        while True:
            frame = await self._take()
            if isinstance(frame, Posterior):
                return frame
            self.without_posterior += 1

    async def next(self, timeout: float | None) -> Posterior:
        """Wait for one posterior, for at most `timeout` seconds, or without a limit if `timeout` is None.

        Raises:
            NoResultError: No posterior arrived in time.
            BadResultError: A message on the topic is not a posterior. The next call continues after this message.
            DisconnectedError: This object or the client is closed.
            ConcurrentReadError: Another task is already waiting.
        """
        return await self._within(timeout, self.__anext__)

    async def next_frame(self, timeout: float | None) -> FrameOutcome:
        """Wait for one frame, for at most `timeout` seconds, or without a limit if `timeout` is None.

        Returns the frame's posterior. If the frame has no posterior, returns its `FrameReport` with the reason.

        Raises:
            NoResultError, BadResultError, DisconnectedError, ConcurrentReadError: The conditions are those of `next`.
        """
        return await self._within(timeout, self._take)

    async def _within(self, timeout: float | None, wait: Callable[[], Coroutine[Any, Any, Result]]) -> Result:
        try:
            async with asyncio.timeout(timeout):
                return await wait()
        except StopAsyncIteration:
            raise DisconnectedError(f"the subscription of {self._topic} is closed") from None
        except TimeoutError:
            pass
        raise await self.no_result_error(timeout)

    async def no_result_error(self, waited: float | None) -> NoResultError:
        """Return the error for `waited` seconds without a frame. Its text names the likely cause."""
        ros = self._ros
        why = "is the master running, and do readings reach it?"
        if ros.state is not State.CONNECTED:
            why = f"the connection is {ros.state}: {ros.last_error}"
        elif (known := await ros.topic_type(self._topic)) and not same_type(known, RESULTS_TYPE):
            why = f"{self._topic} is {known[:80]} there, not {RESULTS_TYPE}: no master can publish on it"
        limit = "" if waited is None else f" within {waited:g} s"
        return NoResultError(
            f"nothing came on {self._frame_topic} and {self._topic} of {ros.uri}{limit}: {why}"
        )

    async def _take(self) -> FrameOutcome:
        while not self._ready:
            if not self._open_topics:
                raise StopAsyncIteration
            if self._waiter is not None:
                raise ConcurrentReadError(
                    f"another task is already waiting for posteriors of {self._topic}: give each reader its own subscription"
                )
            self._waiter = asyncio.get_running_loop().create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        first = self._ready.popleft()
        if isinstance(first, BadResultError):
            raise first
        return first

    # Counters

    @property
    def lost(self) -> int:
        """Number of posteriors dropped because the reader was too slow."""
        return self._lost + sum(subscription.lost for subscription in self._subscriptions)

    @property
    def announced_only(self) -> int:
        """Number of frames announced on `/bm/frame` whose posterior never arrived."""
        return self._pairing.announced_only

    @property
    def blind_seconds(self) -> float:
        """Total time without a connection, in seconds."""
        return self._subscriptions[1].blind_seconds

    # Closing

    async def close(self) -> None:
        """Unsubscribe. Further calls have no effect."""
        for subscription in self._subscriptions:
            await subscription.close()
        await asyncio.gather(*self._pumps, return_exceptions=True)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_exception: object) -> None:
        await self.close()

    # Arrival

    async def _pump(self, subscription: Subscription, take: Callable[[Message], list[FrameOutcome]]) -> None:
        """Pass the messages of one topic to the pairing, until the subscription is closed."""
        async for message in subscription:
            try:
                self._put(take(message))
            except BadResultError as error:
                self._put([error])
        self._open_topics -= 1
        self._flush()

    def _report(self, message: Message) -> list[FrameOutcome]:
        report = read_frame_report(message.msg, message.received_ns)
        if self._deployment is not None and report.deployment != self._deployment:
            return []
        return self._pairing.add_report(report)

    def _result(self, message: Message) -> list[FrameOutcome]:
        return self._pairing.add_posterior(read_posterior(message.msg, message.received_ns, self._topic))

    def _put(self, frames: list[FrameOutcome] | list[BadResultError]) -> None:
        self._ready.extend(frames)
        while len(self._ready) > self._size:
            self._ready.popleft()
            self._lost += 1
        if self._pairing.waits != (self._report_timer is not None):
            if self._report_timer is not None:
                self._report_timer.cancel()
                self._report_timer = None
            else:
                self._report_timer = asyncio.get_running_loop().call_later(_REPORT_TIMEOUT, self._flush)
        if (self._ready or not self._open_topics) and self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)

    def _flush(self) -> None:
        """Deliver the posteriors whose reports did not arrive in time."""
        self._put(self._pairing.flush())


posteriors: Final = Posteriors
"""Alias of `Posteriors` for loops: `async for posterior in posteriors(ros)`."""


def listen(
    server: str | Ros,
    function: Callable[[Posterior], object],
    *,
    count: int | None = None,
    first_timeout: float | None = FIRST_TIMEOUT,
    timeout: float | None = None,
    topic: str = RESULTS_TOPIC,
    frame_topic: str = FRAME_TOPIC,
    deployment: str | None = None,
    queue_size: int = QUEUE_SIZE,
) -> int:
    """Call a function with each posterior, in this thread, without asyncio.

    The connection runs in its own thread. If the function is too slow, it loses the oldest posteriors, but not the
    connection. A lost connection is restored. Ctrl-C ends the loop normally.

    Args:
        server: The URI of a rosbridge server, or `robot:NAME`. For further options, such as a token or a proxy, pass
            an unopened `connect(...)`.
        function: Called with each `Posterior`. If the function returns False, the loop ends. If it raises an
            exception, the loop ends, and the exception propagates.
        count: Number of posteriors after which to return, or None for no limit.
        first_timeout: Seconds until the first posterior, or None for no limit.
        timeout: Seconds between two posteriors, or None for no limit.
        topic: Topic of the posteriors.
        frame_topic: Topic of the frame reports.
        deployment: The model's name, to ignore frames of other stacks on the server, or None.
        queue_size: Maximum number of posteriors that wait for the function.

    Returns:
        The number of posteriors passed to the function.

    Raises:
        NoResultError: No posterior arrived in time.
        BadResultError: A message on the topic is not a posterior.
        BridgeError: The server is not reachable, or is not a rosbridge server.
    """
    ros = connect(server, max_size=MAX_RESULT) if isinstance(server, str) else server
    taken = 0

    async def begin() -> Posteriors:
        return posteriors(
            ros, topic=topic, frame_topic=frame_topic, deployment=deployment, queue_size=queue_size
        )

    with contextlib.suppress(KeyboardInterrupt), _loop_in_a_thread() as run:
        try:
            run(ros.__aenter__())
            subscription = run(begin())
            while count is None or taken < count:
                posterior: Posterior = run(subscription.next(timeout if taken else first_timeout))
                taken += 1
                if function(posterior) is False:
                    break
        finally:
            run(ros.close())
    return taken


@contextlib.contextmanager
def _loop_in_a_thread() -> Iterator[Callable[[Coroutine[Any, Any, Any]], Any]]:
    """Within the context, run an event loop in a thread of its own.

    Yields a function that runs a coroutine in this event loop and returns the coroutine's result.
    """
    loops: list[asyncio.AbstractEventLoop] = []

    @contextlib.asynccontextmanager
    async def running() -> AsyncIterator[None]:
        loops.append(asyncio.get_running_loop())
        yield

    def run(work: Coroutine[Any, Any, Any]) -> Any:
        future = asyncio.run_coroutine_threadsafe(work, loops[0])
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    with in_thread(running):
        yield run
