"""The posteriors of a running stack, one by one, each as a labelled array with its frame's data.

With asyncio:

    async with connect("ws://robot:9090") as ros:
        async for posterior in posteriors(ros):
            print(posterior.number, posterior.best(), posterior.values.shape)

and without, where a function gets each:

    listen("ws://robot:9090", lambda posterior: print(posterior.best()))

NumPy is imported when the first array is wanted (``docs/listening.md``).
"""

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import Future
from typing import Any, Final, Protocol, Self, TypeVar

from bridge.client import Message, Ros, State, Subscription, connect
from bridge.client.protocol import Compression
from bridge.errors import (
    BadResultError,
    ConcurrentReadError,
    DisconnectedError,
    LabelError,
    NoResultError,
    OptionError,
)
from posteriors.results import (
    FRAME_TOPIC,
    FRAME_TYPE,
    MAX_RESULT,
    RESULTS_TOPIC,
    RESULTS_TYPE,
    WAITING,
    FrameReport,
    Heard,
    Pairing,
    Posterior,
    StageTimes,
    read_frame_report,
    read_posterior,
)

__all__ = [
    "BadResultError",
    "FrameReport",
    "LabelError",
    "NoResultError",
    "Posterior",
    "Posteriors",
    "StageTimes",
    "listen",
    "posteriors",
]

#: Posteriors that wait for their reader, unless it says otherwise.
QUEUE_SIZE: Final = 64
#: Seconds that the first posterior may take, unless the caller says otherwise.
FIRST_TIMEOUT: Final = 30.0
#: So much later than its posterior a server may deliver the report that was published before it.
_DISORDER_NS: Final = 50_000_000
#: Seconds that a posterior waits for a report that does not come.
_PATIENCE: Final = 1.0

Outcome = TypeVar("Outcome")


class _Do(Protocol):
    """Awaits a coroutine on a loop in another thread."""

    def __call__(self, work: Coroutine[Any, Any, Outcome]) -> Outcome:
        """What came of it."""


class Posteriors:
    """The posteriors of one stack, to be read by one task: ``async for posterior in ...``; `posteriors` makes it.

    A lost connection does not end the iteration, posteriors go on after the reconnection; closing this or the client
    does. If the reader is too slow the oldest are dropped, and nothing else slows down.

    Attributes:
        without_posterior: frames passed over because they had none: impossible readings, mostly.
    """

    def __init__(
        self,
        ros: Ros,
        *,
        topic: str,
        frame_topic: str,
        deployment: str | None,
        queue_size: int,
        compression: Compression,
    ) -> None:
        """Subscribe (see `posteriors`)."""
        if queue_size < 1:
            raise OptionError(f"queue_size of {topic} must be at least 1, not {queue_size}")
        self.without_posterior = 0
        self._ros = ros
        self._topic = topic
        self._frame_topic = frame_topic
        self._deployment = deployment
        self._size = queue_size
        self._lost = 0
        self._open = 2  # topics
        self._pairing = Pairing(disorder_ns=_DISORDER_NS)
        self._ready: deque[Heard | BadResultError] = deque()
        self._waiter: asyncio.Future[None] | None = None
        self._patience: asyncio.TimerHandle | None = None
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
            heard = await self._take()
            if isinstance(heard, Posterior):
                return heard
            self.without_posterior += 1

    async def next(self, timeout: float | None) -> Posterior:  # noqa: ASYNC109  # the limit is part of the error
        """Wait for one posterior.

        Args:
            timeout: seconds; None for as long as it takes.

        Raises:
            NoResultError: none came in time.
            BadResultError: something else than a posterior came on its topic. The next call goes on behind it.
            DisconnectedError: this or the client are closed.
            ConcurrentReadError: another task waits here.
        """
        return await self._within(timeout, self.__anext__)

    async def next_frame(self, timeout: float | None) -> Heard:  # noqa: ASYNC109  # as above
        """Wait for one frame: its posterior, or the `FrameReport` of a frame that has none, which says why.

        Raises:
            NoResultError, BadResultError, DisconnectedError, ConcurrentReadError: as `next`.
        """
        return await self._within(timeout, self._take)

    async def _within(
        self,
        timeout: float | None,  # noqa: ASYNC109  # as above
        wait: Callable[[], Coroutine[Any, Any, Outcome]],
    ) -> Outcome:
        try:
            async with asyncio.timeout(timeout):
                return await wait()
        except StopAsyncIteration:
            raise DisconnectedError(f"the subscription of {self._topic} is closed") from None
        except TimeoutError:
            pass
        raise self.silence(timeout)

    def silence(self, waited: float | None) -> NoResultError:
        """The error that says that nothing came within so many seconds, and what can be known about it."""
        ros = self._ros
        why = (
            "is the master running, and do readings reach it?"
            if ros.state is State.CONNECTED
            else f"the connection is {ros.state}: {ros.last_error}"
        )
        limit = "" if waited is None else f" within {waited:g} s"
        return NoResultError(
            f"nothing came on {self._frame_topic} and {self._topic} from {ros.uri}{limit}: {why}"
        )

    async def _take(self) -> Heard:
        while not self._ready:
            if not self._open:
                raise StopAsyncIteration
            if self._waiter is not None:
                raise ConcurrentReadError(
                    f"another task waits for posteriors of {self._topic} already: a second reader needs its own"
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

    # How it stands

    @property
    def lost(self) -> int:
        """How many were dropped because the reader was too slow."""
        return self._lost + sum(subscription.lost for subscription in self._subscriptions)

    @property
    def announced_only(self) -> int:
        """How many frames were announced on `/bm/frame` whose posterior never came."""
        return self._pairing.announced_only

    @property
    def blind_seconds(self) -> float:
        """How long, all in all, nothing could be heard because the connection was lost."""
        return self._subscriptions[1].blind_seconds

    # Closing

    async def close(self) -> None:
        """Tell the server that this is not wanted any more. May be called again."""
        for subscription in self._subscriptions:
            await subscription.close()
        await asyncio.gather(*self._pumps, return_exceptions=True)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_exception: object) -> None:
        await self.close()

    # What arrives

    async def _pump(self, subscription: Subscription, take: Callable[[Message], list[Heard]]) -> None:
        """Hand the messages of one topic to the pairing, until it is closed."""
        async for message in subscription:
            try:
                self._put(take(message))
            except BadResultError as error:
                self._put([error])
        self._open -= 1
        self._flush()

    def _report(self, message: Message) -> list[Heard]:
        report = read_frame_report(message.msg, message.received_ns)
        if self._deployment is not None and report.deployment != self._deployment:
            return []
        return self._pairing.add_report(report)

    def _result(self, message: Message) -> list[Heard]:
        return self._pairing.add_posterior(read_posterior(message.msg, message.received_ns, self._topic))

    def _put(self, heard: list[Heard] | list[BadResultError]) -> None:
        self._ready.extend(heard)
        while len(self._ready) > self._size:
            self._ready.popleft()
            self._lost += 1
        if self._pairing.waits != (self._patience is not None):
            if self._patience is not None:
                self._patience.cancel()
                self._patience = None
            else:
                self._patience = asyncio.get_running_loop().call_later(_PATIENCE, self._flush)
        if (self._ready or not self._open) and self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)

    def _flush(self) -> None:
        """Hand out what waits for a report that does not come."""
        self._put(self._pairing.flush())


def posteriors(
    ros: Ros,
    *,
    topic: str = RESULTS_TOPIC,
    frame_topic: str = FRAME_TOPIC,
    deployment: str | None = None,
    queue_size: int = QUEUE_SIZE,
    compression: Compression = "none",
) -> Posteriors:
    """Subscribe to the posteriors of a stack that publishes on this server.

    Args:
        ros: the open client.
        topic: where the posteriors are (`toolchain build --output`).
        frame_topic: where their frames' data are.
        deployment: the model's name, where several stacks publish on one server: frames of others are passed over.
        queue_size: how many wait here for their reader; then the oldest is dropped and counted.
        compression: ``cbor`` brings large posteriors in less time, from servers that know it.

    Returns:
        The posteriors from now on; ``async with`` closes them before the client is closed.

    Raises:
        NameFormError: of a topic.
        TypeConflictError: this client subscribes to one of them already, in another form.
        OptionError: the queue has no room.
        DisconnectedError: the client was closed.
    """
    return Posteriors(
        ros,
        topic=topic,
        frame_topic=frame_topic,
        deployment=deployment,
        queue_size=queue_size,
        compression=compression,
    )


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
    """Call a function with each posterior, in this thread, until there is an end; no asyncio needed.

    The connection lives in a thread of its own, so a slow function loses the oldest posteriors of its queue and
    nothing else; a connection that is lost is waited for. Ctrl-C ends it like any other end.

    Args:
        server: a rosbridge server's URI, or ``connect(...)`` with more to say (a token, a proxy), not opened yet.
        function: is called with each `Posterior`; what it raises ends this and is raised here. Returning False ends
            it too.
        count: after so many it ends; None for no number.
        first_timeout: seconds that the first may take; None for as long as it takes.
        timeout: seconds between two; None for as long as it takes.
        topic: as in `posteriors`, like all that follows.
        frame_topic: as there.
        deployment: as there.
        queue_size: as there.

    Returns:
        How many posteriors the function got.

    Raises:
        NoResultError: none came in time.
        BadResultError: something else than a posterior came on its topic.
        BridgeError: the server is not there, or is none.
    """
    ros = connect(server, max_size=MAX_RESULT) if isinstance(server, str) else server
    taken = 0

    async def begin() -> Posteriors:
        return posteriors(
            ros, topic=topic, frame_topic=frame_topic, deployment=deployment, queue_size=queue_size
        )

    with contextlib.suppress(KeyboardInterrupt), _loop_in_a_thread() as do:
        try:
            do(ros.__aenter__())
            heard = do(begin())
            while count is None or taken < count:
                posterior = do(heard.next(timeout if taken else first_timeout))
                taken += 1
                if function(posterior) is False:
                    break
        finally:
            do(ros.close())
    return taken


@contextlib.contextmanager
def _loop_in_a_thread() -> Iterator[_Do]:
    """An event loop in a thread of its own, until the block is left."""
    started: Future[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def live() -> None:
        stop = asyncio.Event()
        started.set_result((asyncio.get_running_loop(), stop))
        await stop.wait()

    def run() -> None:
        try:
            asyncio.run(live())
        except BaseException as error:
            if started.done():
                raise
            started.set_exception(error)  # no loop was to be had: who waits for it must not wait on

    thread = threading.Thread(target=run, name="posteriors", daemon=True)
    thread.start()
    loop, stop = started.result()

    def do(work: Coroutine[Any, Any, Outcome]) -> Outcome:
        future = asyncio.run_coroutine_threadsafe(work, loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    try:
        yield do
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join()
