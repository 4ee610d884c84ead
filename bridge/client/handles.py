"""Handles: the subscriptions, publications and services that a program has opened.

When a handle is created, it registers an operation such as `subscribe` with the session. When the handle is closed, it
withdraws the operation. Handles stay open when the connection is lost.
"""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from math import inf
from typing import Any, Final, Self

from bridge.client.protocol.events import Message, ServiceRequested
from bridge.client.protocol.subscriptions import Delivery
from bridge.client.session import Session, State
from bridge.codecs.message_check import MessageCheck
from bridge.errors import (
    BridgeError,
    ConcurrentReadError,
    DisconnectedError,
    NoMessageError,
    OptionError,
    ServiceError,
    SlowPeerError,
    TopicLeftOutError,
)
from bridge.names import absolute, same_type
from bridge.qos import Qos

QUEUE_SIZE: Final = 64
"""Default maximum number of messages queued for the reader of a subscription."""
PUBLISH_QUEUE_SIZE: Final = 100
"""Default maximum number of messages of one topic that wait for a slow server."""
EXPLAIN_TIMEOUT: Final = 0.5
"""Timeout in seconds for finding out why a topic is silent."""
# Maximum seconds for which `next` busy-waits. The processes of client and server sleep in turn while one message is
# under way, and waking each takes longer than an answer through the hub; a reader that polls needs no waking.
_BUSY_WAIT: Final = 200e-6

Handler = Callable[[dict[str, Any]], Awaitable[Mapping[str, Any] | None]]

_log = logging.getLogger("bridge")


class Handle:
    """Base class of handles. A handle is closed by `close`, at the end of an `async with` block, or with its client."""

    def __init__(self, session: Session) -> None:
        session.check_thread()
        if session.state is State.CLOSED:
            raise DisconnectedError(f"the client of {session.uri} was closed: connect() makes a new one")
        self._session = session
        # Set once by `end`, which is called by `close`, or by the session when the client is closed.
        self._closed = False

    def _register(self) -> None:
        """Send the handle's operation; from now on, closing the client also ends the handle."""
        self._session.on_closed.add(self.end)
        self._session.flush()

    def end(self) -> None:
        """End the handle without sending anything. Both `close` and the closing of the client call this method."""
        self._closed = True

    def _withdraw(self) -> None:
        """Withdraw the operation from the server."""
        raise NotImplementedError

    async def close(self) -> None:
        """Close the handle, and withdraw its operation from the server. Further calls have no effect."""
        self._session.check_thread()
        if not self._closed:
            self.end()
            self._session.on_closed.discard(self.end)
            self._withdraw()
            self._session.flush()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_exception: object) -> None:
        await self.close()


def _check_queue_size(size: int, topic: str) -> int:
    if size < 1:
        raise OptionError(f"queue_size of topic {topic} must be at least 1, not {size}")
    return size


class Subscription(Handle):
    """The messages of one topic, to be read by one task: `async for message in subscription`.

    If the reader is too slow, the oldest messages are dropped. A slow reader does not affect the connection.
    The iteration continues after a lost connection. It ends when the subscription or the client is closed.
    A message larger than the client's `max_size` ends the connection. The client then connects again, but does not
    subscribe to the topic again. When all queued messages have been read, reading raises a `TopicLeftOutError`.

    Attributes:
        topic: Name of the topic.
        lost: Number of messages dropped because the queue was full.
        discarded: Number of messages discarded because they were larger than the subscription's `max_bytes`.
        blind_seconds: Total time in which messages may have been missed. After each lost connection, this time
            lasts from the last data until the client subscribes to the topic again.
    """

    def __init__(
        self, session: Session, topic: str, type_name: str | None, *, queue_size: int, delivery: Delivery
    ) -> None:
        super().__init__(session)
        self.topic = topic
        self._type = type_name
        # The messages between `receive` and the reader. The deque drops the oldest itself; `_size` is needed to count
        # these.
        self._size = _check_queue_size(queue_size, topic)
        self._queue: deque[Message] = deque(maxlen=queue_size)
        self.lost = 0
        self.discarded = 0

        # Counted from `_begun` on: a new subscription has not missed what was lost before it existed.
        self.blind_seconds = 0.0
        self._begun = time.monotonic()

        # The waiting reader, if any, and its deadline. The alarm rings at `_rings`, no later than the deadline; an
        # alarm of an earlier wait is kept, and sets the next one.
        self._waiter: asyncio.Future[None] | None = None
        self._deadline = inf
        self._alarm: asyncio.TimerHandle | None = None
        self._rings = inf
        # True if the last wait of `next` ended within `_BUSY_WAIT`: then the next one begins with busy-waiting, so that
        # only a reader of prompt answers takes CPU time for it.
        self._is_prompt = False

        # Registered only after the core has accepted the subscription, because it may raise.
        self._number = session.core.subscriptions.subscribe(topic, type_name, delivery)
        session.readers[self._number] = self
        # If the topic is left out, perhaps since before this subscription: the reason, as the end of a sentence.
        self._left_out = session.why_left_out() if session.core.subscriptions.has_left_out(topic) else ""
        self._register()
        session.watch_silence()

    def receive(self, messages: list[Message]) -> None:
        """Queue messages."""
        queue = self._queue
        over = len(queue) + len(messages) - self._size
        if over > 0:
            self.lost += over
        queue.extend(messages)
        if self._waiter is not None:
            self._wake()

    def discard(self) -> None:
        """Count a message that was discarded because it is larger than `max_bytes`."""
        self.discarded += 1

    def leave_out(self, reason: str) -> None:
        """Record why the client no longer subscribes to the topic.

        The reader still gets the queued messages. Then it gets a `TopicLeftOutError` with the reason.
        """
        _log.warning("%s %s", self.topic, reason)
        self._left_out = reason
        self._wake()

    def add_blind_seconds(self, seconds: float) -> None:
        """After a reconnection, add the seconds without a connection to `blind_seconds`."""
        self.blind_seconds += min(seconds, time.monotonic() - self._begun)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Message:
        queue = self._queue
        # A loop, because another task may take the message before this one runs.
        while not queue:
            if self._closed:
                raise StopAsyncIteration
            await self._wait()
        return queue.popleft()

    async def _wait(self, busy_until: float = 0.0) -> None:
        self._check_alone()
        if self._left_out:
            raise TopicLeftOutError(f"{self.topic} {self._left_out}")
        self._waiter = waiter = asyncio.get_running_loop().create_future()
        try:
            # Other tasks have their turn at each pass, and the event loop polls its sockets without sleeping.
            while time.monotonic() < busy_until and not waiter.done():  # noqa: ASYNC110 - an event would sleep
                await asyncio.sleep(0)
            await waiter
        finally:
            self._waiter = None

    def _check_alone(self) -> None:
        self._session.check_thread()
        if self._waiter is not None:
            raise ConcurrentReadError(
                f"another task is already waiting for messages of {self.topic}: give each reader its "
                "own subscription"
            )

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)

    def _set_alarm(self, now: float) -> None:
        """Schedule a call that wakes the reader at its deadline.

        An earlier call is kept, and schedules the next one, because scheduling a call for each message would
        take longer than everything else.
        """
        if self._alarm is not None:
            if self._rings <= self._deadline:
                return
            self._alarm.cancel()
        self._rings = self._deadline
        self._alarm = asyncio.get_running_loop().call_later(max(self._deadline - now, 0), self._ring)

    def _ring(self) -> None:
        # An alarm of an earlier wait rings too early for the present one, and sets the next alarm; without a wait, it
        # sets none.
        self._alarm = None
        now = time.monotonic()
        if self._deadline <= now:
            self._wake()
        elif self._deadline != inf:
            self._set_alarm(now)

    async def next(self, timeout: float) -> Message:
        """Wait for one message, at most `timeout` seconds.

        Raises:
            NoMessageError: No message arrived in time. The error names the topic, the server, the timeout and the
                probable reason. The client may ask rosapi for the reason, which takes up to half a second more.
            TopicLeftOutError: The topic's messages are too large for the connection.
            DisconnectedError: The subscription or the client is closed.
            ConcurrentReadError: Another task is already waiting.
        """
        queue = self._queue
        if queue:
            return queue.popleft()
        self._check_alone()
        begun = now = time.monotonic()
        # Not `asyncio.timeout`, which schedules and cancels a call for each message.
        self._deadline = begun + timeout
        self._set_alarm(begun)
        try:
            while not queue:
                if self._closed:
                    raise DisconnectedError(f"the subscription of {self.topic} is closed")
                if now >= self._deadline:
                    break
                prompt = now + _BUSY_WAIT
                await self._wait(prompt if self._is_prompt else 0.0)
                now = time.monotonic()
                self._is_prompt = now < prompt
            else:
                return queue.popleft()
        finally:
            self._deadline = inf
        why = await self._why_silent(begun)
        raise NoMessageError(
            f"no message of {self.topic} came from {self._session.uri} within {timeout:g} s{why}"
        )

    async def _why_silent(self, begun: float) -> str:
        """Return why the topic has been silent, as the last clause of an error's sentence."""
        session = self._session
        # First what is known here, because asking the server takes time, and the server may be the reason.
        if self.discarded:
            return f"; {self.discarded} messages of the topic were larger than its limit, and were discarded"
        if session.state is not State.CONNECTED:
            return f"; the connection is {session.state}: {session.last_error}"
        try:
            async with asyncio.timeout(EXPLAIN_TIMEOUT):
                known = await session.ask_rosapi("topic_type", {"topic": self.topic}, EXPLAIN_TIMEOUT)
                known_type = known.get("type")
                if known_type == "":
                    return "; the server does not know the topic"
                if isinstance(known_type, str) and self._type and not same_type(known_type, self._type):
                    return f"; the server knows it as {known_type[:80]}, not as {self._type}"
                found = await session.ask_rosapi("publishers", {"topic": self.topic}, EXPLAIN_TIMEOUT)
                if found.get("publishers") == []:
                    return "; it has no publisher"
        except TimeoutError:  # a server without rosapi answers at once
            return session.context_since(begun) or (
                f"; a call to rosapi was not answered either within {EXPLAIN_TIMEOUT:g} s: is it a rosbridge server?"
            )
        return session.context_since(begun)

    def end(self) -> None:
        """End the iteration after the queued messages."""
        super().end()
        if self._alarm is not None:
            self._alarm.cancel()
            self._alarm = None
        self._wake()

    def _withdraw(self) -> None:
        del self._session.readers[self._number]
        self._session.core.subscriptions.unsubscribe(self._number)


class Publication(Handle):
    """One advertised topic.

    Attributes:
        topic: Name of the topic.
    """

    def __init__(
        self, session: Session, topic: str, type_name: str, *, latch: bool, queue_size: int, qos: Qos | None
    ) -> None:
        super().__init__(session)
        self.topic = topic
        # Number of tasks that wait for their turn in `publish`; with more than `_size` it raises an error.
        self._size = _check_queue_size(queue_size, topic)
        self._waiting = 0
        self._publications = session.core.publications
        self._number = self._publications.advertise(
            topic, type_name, latch=latch, queue_size=queue_size, qos=qos
        )
        self._register()

    async def publish(self, msg: Mapping[str, Any], *, timeout: float = 5.0) -> None:
        """Send one message, and return when the socket has accepted the message.

        Values of the message may be NumPy arrays. If the server does not keep up, the message waits for its turn, at
        most `timeout` seconds. Messages are not stored while the connection is lost, because old readings are useless.

        Raises:
            DisconnectedError: There is no connection now, or the publication or the client is closed.
            SlowPeerError: The server did not accept the message in time, or `queue_size` messages are already waiting.
            MessageTooLargeError: The message is larger than `max_size`, or than the known limit of the server.
                `bridge.hub` announces its limit. Other servers close the connection when a message is too large. The
                client then refuses every message that is at least as large as the largest message sent on the closed
                connection.
            MessageTypeError: The message has a field that its type does not have, or an array of another shape.
            EncodeError: The message cannot be sent as JSON. If a value is NaN or infinite, the error names the field.
        """
        session = self._session
        # The usual case has no `await` at all: a task switch would take longer than sending.
        if session.must_wait():
            if self._waiting >= self._size:
                raise SlowPeerError(
                    f"{session.uri} does not keep up: {self._waiting} messages of {self.topic} are already waiting"
                )
            self._waiting += 1
            try:
                await session.wait_turn(f"a message of {self.topic}", timeout)
            finally:
                self._waiting -= 1
        # Encoded only now, because during the wait the publication may have been closed, or the server's limit become
        # known.
        session.send_now(self._encode(msg))
        if session.should_yield():
            await asyncio.sleep(0)

    @property
    def must_wait(self) -> bool:
        """True while a message would have to wait for a slow server or for a connection."""
        return not self._session.is_open or self._session.must_wait()

    async def ready(self, timeout: float = 5.0) -> None:
        """Wait until the server has accepted all previous messages.

        Raises a DisconnectedError if there is no connection, or a SlowPeerError after `timeout` seconds.
        """
        if self._session.must_wait():
            await self._session.wait_turn(f"a message of {self.topic}", timeout)

    def publish_nowait(self, msg: Mapping[str, Any]) -> None:
        """Send one message like `publish`, but raise a SlowPeerError if the message would have to wait."""
        session = self._session
        if session.must_wait():
            raise SlowPeerError(
                f"{session.uri} does not keep up: a message of {self.topic} would have to wait for its turn"
            )
        session.send_now(self._encode(msg))

    def _encode(self, msg: Mapping[str, Any]) -> bytes:
        if self._closed:
            raise DisconnectedError(f"{self.topic} is no longer advertised: its publication was closed")
        return self._publications.publish(self._number, msg)

    def _withdraw(self) -> None:
        self._publications.unadvertise(self._number)


class Service(Handle):
    """One service that this client serves.

    Attributes:
        name: Name of the service.
        check: Function that checks an answer before it is sent, or None if the service's type is unknown.
    """

    def __init__(
        self, session: Session, name: str, type_name: str, handler: Handler, handler_timeout: float
    ) -> None:
        super().__init__(session)
        self.name = name
        self.check: MessageCheck | None = (
            None  # set by `Ros.advertise_service`, which has to ask for the type
        )
        self._handler = handler
        self._limit = handler_timeout
        session.core.services.advertise(name, type_name)
        session.servers[absolute(name)] = self._serve
        self._register()

    async def _serve(self, request: ServiceRequested) -> None:
        """Answer one request, even if its handler fails."""
        # Other errors of the handler are reported by their type only, because their text may contain secrets.
        values: Mapping[str, Any] | str
        ok = False
        try:
            async with asyncio.timeout(self._limit):
                values = await self._handler(request.args) or {}
            ok = True
        except ServiceError as error:
            values = error.reason
        except TimeoutError:
            values = f"{self.name} did not finish within {self._limit:g} s"
        except Exception as error:
            _log.exception("the handler of service %s failed", self.name)
            values = f"{self.name} failed: {type(error).__name__}"
        # Whatever the handler did, the caller must get an answer; it may wait without a timeout.
        answer = self._session.core.services.answer
        try:
            if self.check is not None and not isinstance(values, str):
                self.check(values)
            answer(request.ticket, values, ok=ok)
        except BridgeError as error:
            _log.error("the answer of service %s cannot be sent: %s", self.name, error)
            answer(request.ticket, f"the answer cannot be sent: {error}", ok=False)
        self._session.flush()

    def _withdraw(self) -> None:
        del self._session.servers[absolute(self.name)]
        self._session.core.services.unadvertise(self.name)
