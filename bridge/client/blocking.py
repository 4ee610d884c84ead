"""The blocking rosbridge client: the asyncio client on a thread of its own, for programs without an event loop.

    with connect("ws://127.0.0.1:9090") as ros:
        for message in ros.subscribe("/pose", "geometry_msgs/PointStamped", timeout=5):
            print(message.msg)

Methods have the names, arguments and errors of their asyncio counterparts, and may be called from any thread.
Callbacks run on threads of their own, so they may call them too.
"""

import asyncio
import atexit
import logging
import threading
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from functools import wraps
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Concatenate, Final, Generic, ParamSpec, Self, TypeVar

import uvloop

from bridge.client.actions.goals import Goal
from bridge.client.actions.server import GoalRequest
from bridge.client.graph import Params
from bridge.client.handles import Publication, Service, Subscription
from bridge.client.protocol.actions import MAX_SERVED_GOALS
from bridge.client.protocol.services import MAX_REQUESTS
from bridge.client.ros import Ros
from bridge.client.ros import connect as connect_async
from bridge.client.session import Message, State, StateCallback
from bridge.errors import (
    BridgeError,
    DisconnectedError,
    GoalError,
    NoAnswerError,
    ServiceError,
    WrongThreadError,
)

if TYPE_CHECKING:
    from bridge.transforms import Transform

WAIT_TIMEOUT: Final = 60.0
"""Default timeout in seconds of each step of an iteration."""
CLOSE_TIMEOUT: Final = 5.0
"""Maximum time in seconds that closing takes."""
_LOOK: Final = 1.0
"""Interval in seconds at which a waiting thread checks that the client's thread is alive."""

_log = logging.getLogger("bridge")

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

A = TypeVar("A")

BlockingHandler = Callable[[dict[str, Any]], Mapping[str, Any] | None]
BlockingGoalHandler = Callable[["BlockingGoalRequest"], Mapping[str, Any] | None]


class _LoopThread:
    """A daemon thread with an event loop."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop
        self._stopping: asyncio.Event
        started = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(started,), name="rosbridge", daemon=True)
        self._thread.start()
        started.wait()

    def _run(self, started: threading.Event) -> None:
        async def main() -> None:
            self._loop = asyncio.get_running_loop()
            self._stopping = asyncio.Event()
            started.set()
            await self._stopping.wait()

        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(main())

    def is_current(self) -> bool:
        """Return whether the caller runs on this thread."""
        return threading.current_thread() is self._thread

    def wait(self, coroutine: Coroutine[Any, Any, R]) -> R:
        """Run a coroutine, whose waits are all limited, and return its result; Ctrl-C cancels it."""
        if self.is_current():
            coroutine.close()
            raise WrongThreadError("a blocking call from the thread of its own client would never return")
        try:
            future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        except RuntimeError:  # the loop is closed
            coroutine.close()
            raise DisconnectedError("this client was closed") from None
        try:
            while True:
                try:
                    return future.result(_LOOK)
                except TimeoutError:
                    if future.done():
                        return future.result()
                    if not self._thread.is_alive():
                        raise DisconnectedError("this client was closed") from None
        except CancelledError:
            raise DisconnectedError("this client was closed meanwhile") from None
        finally:
            future.cancel()

    def start_soon(self, coroutine: Coroutine[Any, Any, object]) -> None:
        """Start a coroutine from this thread."""
        self._loop.create_task(coroutine)  # the loop ends with it

    def stop(self) -> None:
        """End the loop and the thread."""
        with suppress(RuntimeError):  # it has ended
            self._loop.call_soon_threadsafe(self._stopping.set)
        if not self.is_current():
            self._thread.join(CLOSE_TIMEOUT)


class _Blocking(Generic[T]):
    """Base of objects that stand for one of the asyncio client."""

    def __init__(self, thread: _LoopThread, asynchronous: T) -> None:
        self._thread = thread
        self._async = asynchronous

    def _wait(self, coroutine: Coroutine[Any, Any, R]) -> R:
        return self._thread.wait(coroutine)

    def _do(self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Call a function on the client's thread."""

        async def do() -> R:
            return function(*args, **kwargs)

        return self._thread.wait(do())


def _blocking(
    function: Callable[Concatenate[T, P], Awaitable[R]],
) -> Callable[Concatenate[_Blocking[T], P], R]:
    """Return the blocking form of a coroutine method."""

    @wraps(function)
    def wait(self: _Blocking[T], /, *args: P.args, **kwargs: P.kwargs) -> R:
        async def do() -> R:
            return await function(self._async, *args, **kwargs)

        return self._thread.wait(do())

    return wait


class _BlockingHandle(_Blocking[T]):
    """Base of handles, which are closed once: by `close`, by leaving their `with`, or with the client."""

    def close(self) -> None:
        """Withdraw this from the server. Further calls have no effect, nor after the client is closed."""
        handle: Any = self._async
        with suppress(DisconnectedError):
            self._wait(handle.close())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()


class BlockingSubscription(_BlockingHandle[Subscription]):
    """The messages of one topic, for its callback or for one reader: `for message in subscription`."""

    def __init__(self, thread: _LoopThread, subscription: Subscription, timeout: float) -> None:
        super().__init__(thread, subscription)
        self._timeout = timeout

    next = _blocking(Subscription.next)

    @property
    def topic(self) -> str:
        """Name of the topic."""
        return self._async.topic

    @property
    def lost(self) -> int:
        """Number of messages dropped because the queue was full."""
        return self._async.lost

    @property
    def discarded(self) -> int:
        """Number of messages above the topic's limit (`max_bytes`)."""
        return self._async.discarded

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Message:
        """Wait for a message as `next` does; the iteration ends with the subscription."""
        try:
            return self.next(self._timeout)
        except DisconnectedError:
            raise StopIteration from None

    def pass_on(self, callback: Callable[[Message], object]) -> None:
        """Call a function with each message, on a thread of its own, until the subscription ends."""
        threading.Thread(
            target=self._pass_on, args=(callback,), name=f"callback of {self.topic}", daemon=True
        ).start()

    def _pass_on(self, callback: Callable[[Message], object]) -> None:
        async def take() -> Message | None:
            return await anext(self._async, None)

        while True:
            try:
                message = self._wait(take())
            except DisconnectedError:
                return
            except BridgeError:
                _log.exception("the callback of %s gets no more messages", self.topic)
                return
            if message is None:
                return
            try:
                callback(message)
            except Exception:
                _log.exception("the callback of %s failed", self.topic)


class BlockingPublication(_BlockingHandle[Publication]):
    """One advertised topic."""

    publish = _blocking(Publication.publish)

    def publish_nowait(self, msg: Mapping[str, Any]) -> None:
        """Send one message, or raise `SlowPeerError` instead of waiting for a slow server."""
        self._do(self._async.publish_nowait, msg)

    @property
    def topic(self) -> str:
        """Name of the topic."""
        return self._async.topic


class BlockingService(_BlockingHandle[Service]):
    """One service that this client serves."""


class BlockingAction(_BlockingHandle[Any]):
    """One action that this client serves."""

    @property
    def name(self) -> str:
        """Name of the action."""
        return str(self._async.name)


class BlockingGoalRequest(_Blocking[GoalRequest]):
    """A goal that this client executes, for its handler (see `bridge.client.GoalRequest`)."""

    @property
    def values(self) -> dict[str, Any]:
        """Fields of the goal."""
        return self._async.values

    @property
    def canceling(self) -> bool:
        """True if the sender has cancelled the goal, or nobody waits for its result any more."""
        return self._async.canceling

    def wait_canceling(self, timeout: float) -> bool:
        """Wait at most `timeout` seconds for the cancellation of the goal; return whether it was cancelled."""

        async def wait() -> None:
            with suppress(TimeoutError):
                async with asyncio.timeout(timeout):
                    await self._async.wait_canceling()

        self._wait(wait())
        return self.canceling

    def feed_back(self, values: Mapping[str, Any]) -> None:
        """Send feedback; no effect after the end."""
        self._do(self._async.feed_back, values)

    def succeed(self, values: Mapping[str, Any] | None = None) -> None:
        """End the goal with its result."""
        self._do(self._async.succeed, values)

    def abort(self, values: Mapping[str, Any] | str | None = None) -> None:
        """End the goal without success, with a result or the text of a reason."""
        self._do(self._async.abort, values)

    def cancel(self, values: Mapping[str, Any] | None = None) -> None:
        """End the goal as cancelled, with the values reached so far."""
        self._do(self._async.cancel, values)


class BlockingGoal(_Blocking[Goal]):
    """One active goal: `for feedback in goal`, then `goal.result(timeout)`."""

    result = _blocking(Goal.result)

    def __init__(self, thread: _LoopThread, goal: Goal, timeout: float) -> None:
        super().__init__(thread, goal)
        self._timeout = timeout

    def cancel(self) -> None:
        """Ask the server to cancel the goal, if it is active; `result` returns whether it did."""
        self._wait(self._async.cancel())

    @property
    def done(self) -> bool:
        """True if the goal has ended."""
        return self._async.done

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> dict[str, Any]:
        async def take() -> dict[str, Any] | None:
            try:
                async with asyncio.timeout(self._timeout):
                    return await anext(self._async, None)
            except TimeoutError:
                raise NoAnswerError(
                    f"the goal of action {self._async.action} gave no feedback within {self._timeout:g} s"
                ) from None

        feedback = self._wait(take())
        if feedback is None:
            raise StopIteration
        return feedback

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        with suppress(DisconnectedError):
            self._wait(self._async.__aexit__())


class BlockingTransforms(_BlockingHandle[Any]):
    """The transforms of a robot (see `bridge.client.tf.Transforms`), subscribed from its creation on."""

    def lookup(
        self, target: str, source: str, stamp_ns: int | None = None, timeout: float = 1.0
    ) -> "Transform":
        """Return the transform from frame `source` to frame `target`, as soon as it is known."""
        found: Transform = self._wait(self._async.lookup(target, source, stamp_ns, timeout))
        return found


class BlockingParams(_Blocking[Params]):
    """The parameters of a ROS system (see `bridge.client.graph.Params`)."""

    get = _blocking(Params.get)
    set = _blocking(Params.set)
    has = _blocking(Params.has)
    delete = _blocking(Params.delete)
    names = _blocking(Params.names)


class BlockingRos(_Blocking[Ros]):
    """A client of one rosbridge server, created and connected by `connect`; see `bridge.client.Ros`."""

    def __init__(self, ros: Ros) -> None:
        super().__init__(_LoopThread(), ros)
        self._closing = threading.Lock()
        try:
            self._wait(ros.__aenter__())
        except BaseException:
            self._thread.stop()
            raise
        atexit.register(self.close)
        self.params = BlockingParams(self._thread, ros.params)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection after all published messages, and end everything that waits.

        Further calls have no effect. The exit of the interpreter closes the client too.
        """
        if not self._closing.acquire(blocking=False):
            return
        atexit.unregister(self.close)
        if self._thread.is_current():
            self._thread.start_soon(self._close())
            return
        try:
            self._wait(self._close())
        except DisconnectedError:
            pass  # the thread has ended meanwhile
        finally:
            self._thread.stop()

    async def _close(self) -> None:
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(CLOSE_TIMEOUT):
                    await self._async.close()
        finally:
            self._thread.stop()

    @property
    def uri(self) -> str:
        """URI of the server."""
        return self._async.uri

    @property
    def state(self) -> State:
        """State of the connection."""
        return self._async.state

    @property
    def reconnections(self) -> int:
        """Number of completed reconnections."""
        return self._async.reconnections

    @property
    def last_error(self) -> str:
        """Reason of the lost connection, or of the last failed attempt to reconnect."""
        return self._async.last_error

    wait_for_state = _blocking(Ros.wait_for_state)
    call = _blocking(Ros.call)
    detect_ros_version = _blocking(Ros.detect_ros_version)
    topics = _blocking(Ros.topics)
    topic_type = _blocking(Ros.topic_type)
    publishers = _blocking(Ros.publishers)
    nodes = _blocking(Ros.nodes)
    services = _blocking(Ros.services)
    subscribers = _blocking(Ros.subscribers)
    topics_for_type = _blocking(Ros.topics_for_type)
    message_details = _blocking(Ros.message_details)
    node_details = _blocking(Ros.node_details)
    service_type = _blocking(Ros.service_type)
    service_node = _blocking(Ros.service_node)
    service_providers = _blocking(Ros.service_providers)

    def advertise(self, topic: str, type: str, *args: Any, **options: Any) -> BlockingPublication:
        """Advertise a topic (see `Ros.advertise`)."""
        return BlockingPublication(
            self._thread, self._wait(self._async.advertise(topic, type, *args, **options))
        )

    def subscribe(
        self,
        topic: str,
        type: str | None = None,
        callback: Callable[[Message], object] | None = None,
        *,
        timeout: float = WAIT_TIMEOUT,
        **options: Any,
    ) -> BlockingSubscription:
        """Subscribe to a topic (see `Ros.subscribe`).

        Args:
            topic: Name of the topic.
            type: Type of the messages; None for any.
            callback: Function that is called with each message, on a thread of its own. An error in it is
                logged, with its traceback, and it gets the next message.
            timeout: Timeout in seconds of each step of the iteration, which then raises `NoMessageError`.
            options: Those of `Ros.subscribe`.
        """
        subscription = BlockingSubscription(
            self._thread, self._do(self._async.subscribe, topic, type, **options), timeout
        )
        if callback is not None:
            subscription.pass_on(callback)
        return subscription

    def transforms(self) -> BlockingTransforms:
        """Subscribe to `/tf` and `/tf_static`, and return their transforms."""
        transforms = self._async.transforms()
        self._wait(transforms.__aenter__())
        return BlockingTransforms(self._thread, transforms)

    def advertise_service(
        self,
        service: str,
        type: str,
        handler: BlockingHandler,
        *,
        handler_timeout: float = 30.0,
    ) -> BlockingService:
        """Serve a service (see `Ros.advertise_service`) with a function, called on a thread per request."""
        busy = ServiceError(f"{MAX_REQUESTS} requests are still being handled here")
        serving = self._async.advertise_service(
            service, type, _in_threads(handler, MAX_REQUESTS, busy), handler_timeout=handler_timeout
        )
        return BlockingService(self._thread, self._wait(serving))

    def advertise_action(
        self,
        action: str,
        type: str,
        handler: BlockingGoalHandler,
    ) -> BlockingAction:
        """Serve an action (see `Ros.advertise_action`) with a function, called on a thread per goal.

        A thread cannot be stopped: when nobody waits for the goal any more, because the connection was lost or
        the action is no longer served, `canceling` of the goal becomes true.
        """
        busy = GoalError(f"{MAX_SERVED_GOALS} goals are still being executed here", action)
        run = _in_threads(handler, MAX_SERVED_GOALS, busy)

        async def execute(goal: GoalRequest) -> Mapping[str, Any] | None:
            try:
                return await run(BlockingGoalRequest(self._thread, goal))
            except asyncio.CancelledError:
                goal.ask_to_cancel()
                raise

        return BlockingAction(self._thread, self._wait(self._async.advertise_action(action, type, execute)))

    def send_goal(
        self,
        action: str,
        type: str,
        goal: Mapping[str, Any] | None = None,
        *,
        timeout: float = WAIT_TIMEOUT,
        **options: Any,
    ) -> BlockingGoal:
        """Send a goal (see `Ros.send_goal`); `timeout` applies to each step of the iteration over its feedback."""
        return BlockingGoal(
            self._thread, self._wait(self._async.send_goal(action, type, goal, **options)), timeout
        )


def _in_threads(handler: Callable[[A], R], most: int, busy: BridgeError) -> Callable[[A], Awaitable[R]]:
    """Return a coroutine function that calls a function on a daemon thread, which cannot delay the exit.

    It raises `busy` if `most` threads are still calling the function.
    """
    free = threading.BoundedSemaphore(most)

    async def serve(args: A) -> R:
        if not free.acquire(blocking=False):
            raise busy
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[R] = loop.create_future()

        def settle(called: Future[R]) -> None:
            if answer.done():
                return  # too late
            if (error := called.exception()) is not None:
                answer.set_exception(error)
            else:
                answer.set_result(called.result())

        def work() -> None:
            called: Future[R] = Future()
            try:
                called.set_result(handler(args))
            except Exception as error:
                called.set_exception(error)
            except BaseException as error:  # sys.exit() ends this thread, not the client's
                called.set_exception(RuntimeError(f"a handler ended with {error!r}"))
            finally:
                free.release()
            with suppress(RuntimeError):  # the client was closed
                loop.call_soon_threadsafe(settle, called)

        threading.Thread(target=work, name="handler", daemon=True).start()
        return await answer

    return serve


def _on_own_thread(callback: StateCallback) -> StateCallback:
    """Return a function that queues the calls of another one, which a daemon thread makes in order until `CLOSED`."""
    waiting: SimpleQueue[tuple[State, str]] = SimpleQueue()
    started = False

    def work() -> None:
        state = None
        while state is not State.CLOSED:
            state, reason = waiting.get()
            try:
                callback(state, reason)
            except Exception:
                _log.exception("on_state failed")

    def put(state: State, reason: str) -> None:
        nonlocal started
        waiting.put((state, reason))
        if not started:
            started = True
            threading.Thread(target=work, name="on_state", daemon=True).start()

    return put


def _connecting(create: Callable[P, Ros]) -> Callable[P, BlockingRos]:
    @wraps(create)
    def connect(*args: P.args, **kwargs: P.kwargs) -> BlockingRos:
        options: dict[str, Any] = kwargs
        on_state = options.get("on_state")
        if on_state is not None:
            options["on_state"] = _on_own_thread(on_state)
        return BlockingRos(create(*args, **kwargs))

    return connect


connect = _connecting(connect_async)
"""Connect to a rosbridge server at once; options and errors are those of `bridge.client.connect`."""
