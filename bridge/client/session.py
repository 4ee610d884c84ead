"""A rosbridge connection with automatic reconnection: states, sending in order, dispatch of messages."""

import asyncio
import logging
import random
import time
from collections import deque
from collections.abc import Callable, Coroutine, Mapping
from contextlib import AbstractContextManager, nullcontext
from enum import StrEnum
from threading import get_ident
from typing import Any, Final, Protocol

from websockets.uri import WebSocketURI

from bridge.client.protocol import ClientCore
from bridge.client.protocol.events import (
    CallAnswered,
    CancelRequested,
    Event,
    GoalEnded,
    GoalFeedback,
    GoalRequested,
    Message,
    MessageDiscarded,
    MessageReceived,
    ServiceRequested,
    StatusReceived,
    UnusableReceived,
)
from bridge.client.route import Route
from bridge.client.websocket import CLOSE_TIMEOUT, Limits, Loss, WebSocket, open_websocket
from bridge.codecs.json_codec import topic_in
from bridge.errors import (
    BridgeError,
    DisconnectedError,
    NoAnswerError,
    ServiceError,
    SlowPeerError,
    StateTimeoutError,
    UnreachableError,
    WrongThreadError,
)

FIRST_DELAY: Final = 0.1
"""Delay in seconds before the first attempt to reconnect. Each further delay is twice as long, up to `MAX_DELAY`."""
MAX_DELAY: Final = 2.0
ATTEMPT_TIMEOUT: Final = 5.0
"""Timeout in seconds of one attempt to reconnect."""
STEADY: Final = 5.0
"""A connection that lasts this many seconds resets the delay of the next reconnection to `FIRST_DELAY`."""
SILENCE: Final = 2.0
"""If a subscription gets no message within this many seconds, the client checks whether it must subscribe again."""
LONGEST_SILENCE: Final = 30.0
"""Maximum delay in seconds between two checks of silent subscriptions. The delay begins at `SILENCE` and doubles."""
_ROSAPI_TIMEOUT: Final = 1.0
KEPT_STATUSES: Final = 16
"""Maximum number of stored status messages of the server."""
# Number of messages sent in a row before other tasks get their turn.
_LONGEST_BURST: Final = 32

_log = logging.getLogger("bridge")


class State(StrEnum):
    """State of a connection."""

    CONNECTING = "connecting"
    CONNECTED = "connected"
    RECONNECTING = "reconnecting"
    CLOSED = "closed"


StateCallback = Callable[[State, str], None]
Server = Callable[[ServiceRequested], Coroutine[Any, Any, None]]


# Receivers of a session's events. They are protocols, because the handles import this module.


class Reader(Protocol):
    """Receiver of the messages of one subscription."""

    def receive(self, messages: list[Message]) -> None:
        """Queue messages."""

    def discard(self) -> None:
        """Count a message that was discarded because it is larger than `max_bytes`."""

    def leave_out(self, reason: str) -> None:
        """Record that the client no longer subscribes to the topic, because a message was too large for a connection.

        After the messages in the queue, reading raises an error with `reason`.
        """

    def add_blind_seconds(self, seconds: float) -> None:
        """After a reconnection, add the seconds without a connection to `blind_seconds`."""


class GoalReceiver(Protocol):
    """Receiver of the events of one goal that this client has sent."""

    def receive(self, event: GoalFeedback | GoalEnded) -> None:
        """Handle an event of the goal."""

    def fail(self, reason: str) -> None:
        """End the goal without a result."""


class GoalExecutor(Protocol):
    """Receiver of the goals of one action that this client serves."""

    def receive(self, event: GoalRequested | CancelRequested) -> None:
        """Start a requested goal, or cancel a running goal."""

    def lost(self) -> None:
        """Give up all goals, because the connection is lost."""


class Session:
    """The connection of a client, over its successive WebSockets.

    The session owns the timers and the socket. It moves bytes between the socket and `core`, and `core` interprets
    the bytes:

        handle  ->  core  ->  flush  ->  WebSocket  ->  server
        handle  <-  _take  <-  core  <-  WebSocket  <-  server

    Published messages do not wait in the core's outbox: the core encodes them, and the session writes them to the
    socket at once. All code runs in the thread of the event loop, so state changes only at an `await`.
    """

    def __init__(
        self,
        shown_uri: str,
        locate: Callable[[], Coroutine[Any, Any, tuple[WebSocketURI, str, Route]]],
        core: ClientCore,
        limits: Limits,
        on_state: StateCallback | None,
        *,
        retry: bool = False,
    ) -> None:
        # URI of the server, without secrets; that of a named robot from the first attempt to connect on.
        self.uri = shown_uri
        # What each attempt to connect needs: the URI and the route, which the first one gets from `_locate`.
        self._locate = locate
        self._located: tuple[WebSocketURI, Route] | None = None
        self._limits = limits
        self._retry = retry
        # The protocol state: what the program wants, and what waits for an answer.
        self.core = core

        # Only `_set_state` changes `state`; it also sets the event, which wakes the waiters, and replaces it.
        self.state = State.CONNECTING
        self._state_changed = asyncio.Event()
        self._on_state = on_state
        # Set by `open`: the thread of the event loop, the only one that may call. None until then.
        self._entered = False
        self._thread: int | None = None

        # The connection. `_websocket` is set just before the state becomes CONNECTED, and cleared just before it
        # changes again, so handles check it instead of the state.
        self._websocket: WebSocket | None = None
        self._connected_at = 0.0
        self._lost_at = 0.0
        # Time of the last data on the lost connection; messages after it may be missing.
        self._blind_since = 0.0
        # Number of completed reconnections.
        self.reconnections = 0
        # Reason of the lost connection or of the last failed attempt; it is kept after a reconnection.
        self.last_error = ""

        # Reconnecting: one task, which runs from a loss until the next connection. `_pause` is its current sleep, which
        # `reconnect_now` cancels; `_delay` is the next wait's length. It doubles; a steady connection resets it.
        self._reconnecting: asyncio.Task[None] | None = None
        self._pause: asyncio.Future[None] | None = None
        self._delay = FIRST_DELAY

        # Silent subscriptions: the timer runs while the connection is open and a topic has had no message. The task
        # asks rosapi about those subscribed to with a type; there is at most one such task.
        self._retry_timer: asyncio.TimerHandle | None = None
        self._renewal_delay = SILENCE
        self._looking: asyncio.Task[None] | None = None

        # Sending. Senders wait in order while the socket is full: the lock is fair. `_waiting` counts them, so that a
        # later message waits too instead of overtaking them.
        self._turn = asyncio.Lock()
        self._waiting = 0
        # Number of messages since a publisher last yielded; without yielding, a tight loop would starve other tasks.
        self._burst = 0
        # Size of the largest message sent on this connection: if the server closes it with 1009 (message too big), the
        # limit of the server is less.
        self._largest_sent = 0

        # The objects behind the numbers, absolute names and ids in the core's events. An entry is made when its
        # operation is sent, and removed by its handle or by its last event; a lost connection empties goals and calls.
        self.readers: dict[int, Reader] = {}  # by number of the subscription
        self.servers: dict[str, Server] = {}  # by name of the service
        self.action_servers: dict[str, GoalExecutor] = {}  # by name of the action
        self.goals: dict[str, GoalReceiver] = {}  # by id
        self._calls: dict[str, asyncio.Future[CallAnswered]] = {}  # by id
        # Tasks that serve requests; stored here, because the event loop has only weak references to tasks.
        self._serving: set[asyncio.Task[None]] = set()
        # Callbacks of all open handles, for `close`.
        self.on_closed: set[Callable[[], object]] = set()

        # Number of unusable messages received. They are ignored, and do not affect others.
        self.unusable = 0
        # Latest status messages of the server, newest last. Errors quote the last one: it often says why an answer is
        # missing. The count limits the lines in the log.
        self.statuses: deque[StatusReceived] = deque(maxlen=KEPT_STATUSES)
        self._status_at = 0.0
        self._status_count = 0

    # Opening, losing, closing

    async def open(self) -> None:
        """Connect for the first time (see `bridge.client.connect`)."""
        if self._entered:
            raise DisconnectedError(
                f"this client of {self.uri} was already opened: connect() creates a new one"
            )
        self._entered = True
        self._thread = get_ident()
        try:
            await self._open(self._limits.connect_timeout)
        except BaseException as error:
            await self.close(str(error))
            raise

    async def _open(self, limit: float) -> None:
        deadline, delay = time.monotonic() + limit, FIRST_DELAY
        while True:
            try:
                await self._connect(min(limit, ATTEMPT_TIMEOUT) if self._retry else limit)
            except UnreachableError as error:
                if not self._retry or time.monotonic() + delay >= deadline:
                    raise
                if not self.last_error:
                    self._set_state(State.CONNECTING, str(error))
                self.last_error = str(error)
                await asyncio.sleep(delay)
                delay = min(2 * delay, MAX_DELAY)
                limit = deadline - time.monotonic()
            else:
                return

    async def close(self, reason: str = "closed by this client") -> None:
        """End every wait for a message or an answer. Close the connection once all sent messages are written."""
        self.check_thread()
        if self.state is State.CLOSED:
            return
        # First, so that nothing more is sent, and the end of the connection does not count as a loss.
        websocket, self._websocket = self._websocket, None
        self.core.lost()
        if self._retry_timer is not None:
            self._retry_timer.cancel()
        ending = {*self._serving, *(each for each in (self._reconnecting, self._looking) if each is not None)}
        ending -= {asyncio.current_task()}  # a service's handler may close the client
        for task in ending:
            task.cancel()
        self._fail_calls(f"the client of {self.uri} was closed")
        self._set_state(State.CLOSED, reason)
        for callback in self.on_closed:
            callback()
        self.on_closed.clear()
        if websocket is not None:
            try:
                await websocket.close()
            finally:
                websocket.abort()
        if ending:
            await asyncio.wait(ending, timeout=CLOSE_TIMEOUT)

    async def _connect(self, seconds: float) -> None:
        if self._located is None:
            uri, self.uri, route = await self._locate()
            self._located = uri, route
        uri, route = self._located
        websocket = await open_websocket(
            uri,
            self.uri,
            route=route,
            timeout=seconds,
            limits=self._limits,
            on_messages=self._take,
            on_lost=self._lost,
        )
        self._websocket = websocket
        self._connected_at = time.monotonic()
        if self.state is State.RECONNECTING:
            self.reconnections += 1
            for reader in self.readers.values():
                reader.add_blind_seconds(self._connected_at - self._blind_since)
        # Before the state changes, because a task that waits for CONNECTED may publish at once.
        self._largest_sent = 0
        if websocket.largest_accepted is not None:
            self.core.wire.limit(websocket.largest_accepted)
        self.core.restore()
        for message in self.core.data_to_send():
            if self.is_open:
                self.send_now(message)
        self.watch_silence()
        self._set_state(State.CONNECTED, "")

    def _lost(self, websocket: WebSocket, reason: str) -> None:
        if websocket is not self._websocket:
            return  # this client has closed it
        self._websocket = None
        self._blind_since = websocket.last_heard
        if websocket.loss is Loss.SENT_TOO_LARGE:
            self.core.wire.limit(self._largest_sent - 1)
        elif websocket.loss is Loss.RECEIVED_TOO_LARGE:
            reason += self._leave_out(topic_in(websocket.refused))
        self.core.lost()
        for server in self.action_servers.values():
            server.lost()
        self.last_error = reason
        self._lost_at = now = time.monotonic()
        _log.warning("the connection to %s is lost: %s", self.uri, reason)
        self._fail_calls(f"the connection to {self.uri} was lost ({reason})")
        if now - self._connected_at >= STEADY:
            self._delay = FIRST_DELAY
        self._reconnecting = asyncio.get_running_loop().create_task(self._reconnect())
        self._set_state(State.RECONNECTING, reason)

    def _leave_out(self, topic: str | None) -> str:
        """Leave out the topic of a message that was too large for the connection; return a clause for the error.

        If the beginning of the message did not name the topic, the next such message ends the connection again.
        """
        subscriptions = self.core.subscriptions
        numbers = subscriptions.leave_out(topic)
        for number in numbers:
            self.readers[number].leave_out(self.why_left_out())
        if numbers:
            return f"; it was one of {topic}, which is left out"
        largest, size = subscriptions.largest
        return f"; the largest so far was one of {largest}, with {size} bytes" if size else ""

    def why_left_out(self) -> str:
        """Return why the client no longer subscribes to a topic: a message was larger than `max_size`.

        The result is the rest of a sentence. The caller puts the name of the topic in front.
        """
        return (
            f"is left out: a message of it has more than the {self.core.wire.max_size} bytes (max_size) that this "
            f"client of {self.uri} accepts"
        )

    def reconnect_now(self) -> None:
        """If the connection is lost, make the next attempt to reconnect at once."""
        self.check_thread()
        self._delay = FIRST_DELAY
        if self._pause is not None:
            self._pause.cancel()

    async def _reconnect(self) -> None:
        while True:
            # Up to a fifth earlier, so that the clients of a server do not all reconnect at once. The sleep is a future
            # of its own, so that `reconnect_now` can cancel it without cancelling this task.
            self._pause = asyncio.ensure_future(asyncio.sleep(self._delay * random.uniform(0.8, 1.0)))
            try:
                await asyncio.wait([self._pause])
            finally:
                self._pause.cancel()
            self._delay = min(2 * self._delay, MAX_DELAY)
            try:
                await self._connect(min(self._limits.connect_timeout, ATTEMPT_TIMEOUT))
            except BridgeError as error:  # the server is still away
                self.last_error = str(error)
                _log.debug("reconnecting: %s", error)
            except Exception as error:
                self.last_error = f"{type(error).__name__}: {error}"
                _log.exception("reconnecting to %s failed", self.uri)
            else:
                _log.info("the connection to %s is back", self.uri)
                return

    def _fail_calls(self, reason: str) -> None:
        goals, self.goals = self.goals, {}
        for goal in goals.values():
            goal.fail(reason)
        calls, self._calls = self._calls, {}
        for call, future in calls.items():
            if not future.done():
                future.set_exception(DisconnectedError(f"{reason} during a call of {call.split(':')[1]}"))

    # States

    def _set_state(self, state: State, reason: str) -> None:
        self.state = state
        # A new event for each change: clearing the old one could hide a change from a task that has not woken yet.
        self._state_changed.set()
        self._state_changed = asyncio.Event()
        if self._on_state is not None:
            try:
                self._on_state(state, reason)
            except Exception:
                _log.exception("on_state failed")

    async def wait_for_state(self, state: State, limit: float) -> None:
        """Wait until the connection is in a state (see `bridge.client.Ros.wait_for_state`)."""
        self.check_thread()
        try:
            async with asyncio.timeout(limit):
                while self.state is not state:
                    if self.state is State.CLOSED:
                        raise DisconnectedError(f"the client of {self.uri} was closed")
                    await self._state_changed.wait()
        except TimeoutError:
            because = f" ({self.last_error})" if self.last_error else ""
            raise StateTimeoutError(
                f"the connection to {self.uri} was not {state} within {limit:g} s, it is {self.state}{because}"
            ) from None

    # Sending

    @property
    def is_open(self) -> bool:
        """True while there is a connection that accepts messages."""
        websocket = self._websocket
        # one that is about to end discards messages silently
        return websocket is not None and websocket.is_open and not websocket.is_closing

    def check_thread(self) -> None:
        """Raise a WrongThreadError outside the event loop's thread, because no lock protects the client's data."""
        if get_ident() != self._thread and self._thread is not None:
            raise WrongThreadError(
                f"the client of {self.uri} belongs to the thread of its event loop: call it there with "
                "asyncio.run_coroutine_threadsafe"
            )

    def must_wait(self) -> bool:
        """Return whether a message must wait, because the socket is full or earlier messages wait.

        Raises:
            DisconnectedError: There is no connection.
            WrongThreadError: The caller runs in another thread than the client's event loop.
        """
        if get_ident() != self._thread:  # `check_thread` without its call, for each message that is published
            self.check_thread()
        return self._connected().paused or self._waiting > 0

    def _connected(self) -> WebSocket:
        websocket = self._websocket
        if websocket is None or not websocket.is_open or websocket.is_closing:
            why = {State.CLOSED: "this client was closed", State.CONNECTING: "`async with` opens it"}
            lost = self.last_error or "the server is closing it"
            raise DisconnectedError(f"{self.uri} is not connected: {why.get(self.state, lost)}")
        return websocket

    def send_now(self, data: bytes) -> None:
        """Write a message to the socket.

        Call `must_wait` or `wait_turn` first. Do not `await` anything between that call and `send_now`.
        """
        (self._websocket or self._connected()).send((data,))
        if len(data) > self._largest_sent:  # noqa: PLR1730 - `max` takes ten times as long
            self._largest_sent = len(data)

    def should_yield(self) -> bool:
        """Count a sent message. Return whether the caller should now yield to other tasks."""
        self._burst += 1
        if self._burst < _LONGEST_BURST:
            return False
        self._burst = 0
        return True

    def together(self) -> AbstractContextManager[None]:
        """Return a context that sends all messages of its block together (see `bridge.client.Ros.together`)."""
        self.check_thread()
        websocket = self._websocket
        return nullcontext() if websocket is None else websocket.together()

    async def wait_turn(self, what: str, limit: float) -> None:
        """Wait until the server has accepted all previous messages. `what` is the name of the new message in errors."""
        self._waiting += 1
        try:
            async with asyncio.timeout(limit), self._turn:
                while (websocket := self._connected()).paused:
                    await websocket.drain()
        except TimeoutError:
            raise SlowPeerError(f"{self.uri} did not accept {what} within {limit:g} s") from None
        finally:
            self._waiting -= 1

    def flush(self) -> None:
        """Send the messages in the core's outbox without waiting.

        If the server leaves too many bytes of messages from the outbox unread, the connection is aborted.
        """
        for message in self.core.data_to_send():
            websocket = self._websocket
            if websocket is not None and self.is_open:
                self.send_now(message)
                websocket.count_unread(len(message))

    def watch_silence(self) -> None:
        """Check for silent subscriptions, until each subscription has had a message on this connection."""
        self._renewal_delay = SILENCE
        if self._websocket is not None:
            self._schedule_renewal()

    def _schedule_renewal(self) -> None:
        if self._retry_timer is not None:
            self._retry_timer.cancel()
        self._retry_timer = asyncio.get_running_loop().call_later(
            self._renewal_delay, self._renew_subscriptions
        )

    def _renew_subscriptions(self) -> None:
        """Repeat subscriptions without a type, and renew those to published topics from which no message has come."""
        self._retry_timer = None
        if not self.is_open:
            return  # a new connection begins to check again
        untyped = self.core.subscriptions.retry_untyped()
        self.flush()
        silent = self.core.subscriptions.silent()
        if silent and (self._looking is None or self._looking.done()):
            self._looking = asyncio.get_running_loop().create_task(self._renew(silent))
        if untyped or silent:
            self._renewal_delay = SILENCE if untyped else min(2 * self._renewal_delay, LONGEST_SILENCE)
            self._schedule_renewal()

    async def _renew(self, topics: list[str]) -> None:
        """Renew the subscriptions of those topics that somebody publishes."""
        # Without a publisher, silence is normal, and renewing would only interrupt a working subscription.
        for topic in topics:
            answer = await self.ask_rosapi("publishers", {"topic": topic}, _ROSAPI_TIMEOUT)
            if not answer.get("publishers") or not self.is_open:
                continue
            if self.core.subscriptions.renew(topic):
                _log.warning(
                    "%s sends nothing of %s as CBOR, although somebody publishes it; asking for JSON",
                    self.uri,
                    topic,
                )
            self.flush()

    async def ask_rosapi(self, name: str, args: Mapping[str, Any], limit: float) -> dict[str, Any]:
        """Return the answer of a rosapi service, or an empty answer if the call fails.

        A failed call is no error, because many servers lack rosapi.
        """
        try:
            answer = await self.call(f"/rosapi/{name}", args, limit)
        except BridgeError:
            return {}
        return answer if isinstance(answer, dict) else {}

    async def call(self, service: str, args: Mapping[str, Any], limit: float) -> Any:
        """Call a service and wait for its answer (see `bridge.client.Ros.call`)."""
        if self.must_wait():
            await self.wait_turn(f"a call of {service}", limit)
        begun = time.monotonic()
        # The future exists before the call is sent, because the answer may arrive with the next bytes.
        call = self.core.calls.send(service, args)
        future = self._calls[call] = asyncio.get_running_loop().create_future()
        self.flush()
        try:
            async with asyncio.timeout(limit):
                answer = await future
        except TimeoutError:
            raise NoAnswerError(
                f"service {service} at {self.uri} did not answer within {limit:g} s{self.context_since(begun)}"
            ) from None
        finally:
            self._calls.pop(call, None)
            self.core.calls.forget(call)
        if not answer.ok:
            raise ServiceError(answer.values, f"{service} at {self.uri}")
        return answer.values

    def context_since(self, since: float) -> str:
        """Return a clause about a lost connection or a status message after `since`, or "" if there was neither."""
        if self._lost_at > since:
            return f"; meanwhile the connection was lost: {self.last_error}"
        return f"; the server reported: {self.statuses[-1].text[:200]}" if self._status_at > since else ""

    # Receiving

    def _take(self, messages: list[bytes]) -> None:
        # One time for all messages that arrived together: their order in the socket says nothing about their age.
        received_ns, monotonic_ns = time.time_ns(), time.monotonic_ns()
        receive_known, readers, at = self.core.receive_known, self.readers, 0
        while at < len(messages):
            received, subscriptions = receive_known(messages, at, received_ns, monotonic_ns)
            if not received:
                event = self.core.receive(messages[at], monotonic_ns * 1e-9)
                if type(event) is not MessageReceived:
                    self._take_other(event)
                    at += 1
                    continue
                received = [Message(event.topic, event.msg, received_ns, monotonic_ns)]
                subscriptions = event.subscriptions
            at += len(received)
            for number in subscriptions:
                readers[number].receive(received)

    def _take_other(self, event: Event | None) -> None:
        match event:
            case MessageDiscarded():
                for number in event.subscriptions:
                    self.readers[number].discard()
                if event.count & (event.count - 1) == 0:
                    _log.warning(
                        "a message of %s has %d bytes, more than its limit of %d, and was discarded; %d so far",
                        *(event.topic, event.size, event.limit, event.count),
                    )
            case CallAnswered():
                future = self._calls.pop(event.call, None)
                if future is not None and not future.done():
                    future.set_result(event)
            case ServiceRequested():
                task = asyncio.get_running_loop().create_task(self.servers[event.service](event))
                self._serving.add(task)
                task.add_done_callback(self._serving.discard)
            case GoalFeedback() | GoalEnded():
                ended = isinstance(event, GoalEnded)
                goal = self.goals.pop(event.goal, None) if ended else self.goals.get(event.goal)
                if goal is not None:
                    goal.receive(event)
            case GoalRequested() | CancelRequested():
                self.action_servers[event.action].receive(event)
            case StatusReceived():
                self.statuses.append(event)
                self._status_at = time.monotonic()
                self._status_count += 1
                if self._status_count <= KEPT_STATUSES or self._status_count & (self._status_count - 1) == 0:
                    level = logging.WARNING if event.level in {"error", "warning"} else logging.INFO
                    _log.log(level, "%s reports (%.20s): %.500s", self.uri, event.level, event.text)
            case UnusableReceived():
                self.unusable += 1
                # Only the 1st, 2nd, 4th, 8th ..., so that a faulty server does not fill the log (as for
                # statuses).
                if self.unusable & (self.unusable - 1) == 0:
                    _log.warning("%s, %d so far: %s", self.uri, self.unusable, event.reason)
            case _:
                self.flush()  # a request may have been refused at once
