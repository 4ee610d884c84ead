"""Actions of ROS 2: the client can send goals, and can execute the goals of an action that it offers.

A row has the method of the client, the rosbridge operation, and the object that the program gets:

    Ros.send_goal        ->  send_action_goal     ->  Goal, which receives feedback and the result
    Ros.advertise_action ->  advertise_action     ->  ActionServer, which runs a handler with each GoalRequest

Actions of ROS 1 (actionlib) consist of topics. They are not supported (see `Ros.send_goal`).
"""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

from bridge.client.handles import Handle
from bridge.client.protocol.events import CancelRequested, GoalEnded, GoalFeedback, GoalRequested, GoalStatus
from bridge.client.session import Session
from bridge.codecs.message_check import MessageCheck
from bridge.errors import BridgeError, ConcurrentReadError, DisconnectedError, GoalError, NoAnswerError
from bridge.names import absolute

_log = logging.getLogger("bridge")

FEEDBACK_QUEUE_SIZE: Final = 64
"""Maximum number of feedback messages queued for one goal. A further message replaces the oldest."""


@dataclass(frozen=True, slots=True)
class GoalResult:
    """Result of a goal.

    Attributes:
        status: Succeeded, canceled or aborted.
        values: Fields of the result.
    """

    status: GoalStatus
    values: dict[str, Any]


class Goal:
    """A goal that this client has sent. Use `async for feedback in goal`, then `await goal.result(timeout)`.

    The iteration ends when the goal ends. If the connection is lost, the iteration and `result` fail, because the
    server never reports the end. A block `async with goal` is optional. If the goal has not ended at the end of the
    block, the client cancels it. The iteration and `result` then fail, too.

    Attributes:
        action: Name of the action.
        lost: Number of feedback messages dropped because the reader was too slow.
    """

    def __init__(
        self, session: Session, action: str, type_name: str, goal: Mapping[str, Any], *, feedback: bool
    ) -> None:
        """Send a goal (see `bridge.client.Ros.send_goal`)."""
        identity = session.core.goals.send(action, type_name, goal, feedback=feedback)
        self.action = action
        self._place = f"{action} at {session.uri}"  # for error messages
        self._session = session
        self._identity = identity
        self._sent_at = time.monotonic()  # for error messages: what the server has said since
        # Feedback between `receive` and the iteration. A program need not iterate, so the queue may fill up.
        self._feedback: deque[dict[str, Any]] = deque(maxlen=FEEDBACK_QUEUE_SIZE)
        self.lost = 0
        # The iterating task, while it waits for feedback or for the end.
        self._reader: asyncio.Future[None] | None = None
        # Done with the end of the goal, or with the loss of the connection. Several tasks may wait for it, so each
        # shields it from its own cancellation.
        self._ended: asyncio.Future[GoalEnded] = asyncio.get_running_loop().create_future()
        session.goals[identity] = self
        session.flush()

    def receive(self, event: GoalFeedback | GoalEnded) -> None:
        """Handle an event of this goal."""
        if isinstance(event, GoalFeedback):
            if len(self._feedback) == FEEDBACK_QUEUE_SIZE:
                self.lost += 1
            self._feedback.append(event.values)
        elif not self._ended.done():
            self._ended.set_result(event)
        self._wake()

    def fail(self, reason: str) -> None:
        """End the goal without a result, because the connection was lost for `reason`."""
        self._fail(DisconnectedError(f"{reason} during a goal of {self.action}"))

    def _fail(self, error: BridgeError) -> None:
        if not self._ended.done():
            self._ended.set_exception(error)
            self._ended.exception()  # mark the exception as retrieved, because it need not be awaited
        self._wake()

    def _wake(self) -> None:
        if self._reader is not None and not self._reader.done():
            self._reader.set_result(None)

    @property
    def done(self) -> bool:
        """True if the goal has ended."""
        return self._ended.done()

    async def cancel(self) -> None:
        """If the goal is active, ask the server to cancel it. The result's status shows whether it was cancelled."""
        self._session.check_thread()
        self._session.core.goals.cancel(self._identity)
        self._session.flush()

    async def result(self, timeout: float) -> GoalResult:
        """Wait until the goal has ended, and return the result. The method may be called again.

        A canceled or aborted goal also has a result.

        Raises:
            GoalError: The action refused the goal, or does not exist.
            NoAnswerError: The goal did not end within `timeout` seconds, and is still active.
            DisconnectedError: The connection was lost before the goal ended.
        """
        try:
            async with asyncio.timeout(timeout):
                ended = await asyncio.shield(self._ended)
        except TimeoutError:
            raise NoAnswerError(
                f"the goal of action {self.action} at {self._session.uri} did not end within {timeout:g} s"
                f"{self._session.context_since(self._sent_at)}"
            ) from None
        if not ended.ok:
            raise GoalError(ended.values, self._place)
        return GoalResult(ended.status, ended.values)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> dict[str, Any]:
        # Feedback from before the end is returned first, however slow the reader is.
        while not self._feedback:
            if self._ended.done():
                if (error := self._ended.exception()) is not None:
                    raise error
                raise StopAsyncIteration
            if self._reader is not None:
                raise ConcurrentReadError(
                    f"another task is already waiting for feedback of this goal of {self.action}"
                )
            self._reader = asyncio.get_running_loop().create_future()
            try:
                await self._reader
            finally:
                self._reader = None
        return self._feedback.popleft()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_exception: object) -> None:
        # A program that leaves the block early no longer wants the robot to go on.
        try:
            if not self.done:
                await self.cancel()
        finally:
            self._forget()

    def _forget(self) -> None:
        """Ignore further events of this goal, and end all waits for them."""
        self._session.goals.pop(self._identity, None)
        self._session.core.goals.forget(self._identity)
        self._fail(GoalError("it was cancelled at the end of its block", self._place))


FeedBack = Callable[[Mapping[str, Any]], None]
End = Callable[[GoalStatus, Mapping[str, Any] | str], None]


class GoalRequest:
    """A goal that this client executes. The handler of the action receives it.

    The first call of `succeed`, `abort` or `cancel` ends the goal. The handler may then continue, to clean up.

    Attributes:
        values: Fields of the goal.
    """

    def __init__(self, values: dict[str, Any], feed_back: FeedBack, end: End) -> None:
        self.values = values
        # They send to the goal's sender, and raise if the values do not fit the action's type.
        self._feed_back = feed_back
        self._end = end
        # Set by the server of the action when the sender asks for it, and never cleared.
        self._canceling = asyncio.Event()
        # True once an end was sent; an end that does not fit the type raises an error instead, and does not count.
        self.ended = False

    @property
    def canceling(self) -> bool:
        """True if the sender has asked to cancel the goal."""
        return self._canceling.is_set()

    async def wait_canceling(self) -> None:
        """Wait until the sender asks to cancel the goal."""
        await self._canceling.wait()

    def ask_to_cancel(self) -> None:
        """Tell the handler that the sender asks to cancel the goal."""
        self._canceling.set()

    def feed_back(self, values: Mapping[str, Any]) -> None:
        """Send feedback. Do nothing if the goal has ended."""
        if not self.ended:
            self._feed_back(values)

    def succeed(self, values: Mapping[str, Any] | None = None) -> None:
        """End the goal with its result."""
        self._finish(GoalStatus.SUCCEEDED, values or {})

    def abort(self, values: Mapping[str, Any] | str | None = None) -> None:
        """End the goal as aborted. `values` is the result, or a text with the reason."""
        self._finish(GoalStatus.ABORTED, values or {})

    def cancel(self, values: Mapping[str, Any] | None = None) -> None:
        """End the goal as cancelled. `values` is the result so far."""
        self._finish(GoalStatus.CANCELED, values or {})

    def _finish(self, status: GoalStatus, values: Mapping[str, Any] | str) -> None:
        if not self.ended:
            self._end(status, values)
            self.ended = True


GoalHandler = Callable[[GoalRequest], Awaitable[Mapping[str, Any] | None]]


async def execute(goal: GoalRequest, handler: GoalHandler, action: str) -> None:
    """Run a goal's handler, and end the goal with the values that the handler returns.

    If the client has asked to cancel the goal, the goal ends as cancelled. If the handler fails, the goal is aborted.
    """
    # The handler may have ended the goal already; then the end here has no effect.
    try:
        values = await handler(goal)
        if goal.canceling:
            goal.cancel(values)
        else:
            goal.succeed(values)
    except BridgeError as error:
        _log.error("a goal of action %s failed: %s", action, error)
        goal.abort(str(error))
    except Exception as error:
        _log.exception("the handler of action %s failed", action)
        goal.abort(f"{action} failed: {type(error).__name__}")


class ActionServer(Handle):
    """One action that this client serves.

    Attributes:
        name: Name of the action.
        result_check: Check of each result before it is sent, or None if the result's type is unknown.
        feedback_check: Check of each feedback before it is sent, or None if the feedback's type is unknown.
    """

    def __init__(self, session: Session, name: str, type_name: str, handler: GoalHandler) -> None:
        super().__init__(session)
        self.name = name
        # Both are set by `Ros.advertise_action`, which has to ask for the type.
        self.result_check: MessageCheck | None = None
        self.feedback_check: MessageCheck | None = None
        self._handler = handler
        # By id. A goal is here until its handler returns, even if it has ended before.
        self._goals: dict[str, tuple[GoalRequest, asyncio.Task[None]]] = {}
        session.core.actions.advertise(name, type_name)
        session.action_servers[absolute(name)] = self
        self._register()

    def receive(self, event: GoalRequested | CancelRequested) -> None:
        """Start a requested goal, or tell the handler of a goal to cancel the goal."""
        if isinstance(event, CancelRequested):
            if event.goal in self._goals:
                self._goals[event.goal][0].ask_to_cancel()
            return
        actions, flush, identity = self._session.core.actions, self._session.flush, event.goal

        def feed_back(values: Mapping[str, Any]) -> None:
            if self.feedback_check is not None:
                self.feedback_check(values)
            actions.feed_back(identity, values)
            flush()

        def end(status: GoalStatus, values: Mapping[str, Any] | str) -> None:
            if self.result_check is not None and not isinstance(values, str):
                self.result_check(values)
            actions.end(identity, status, values)
            flush()

        goal = GoalRequest(event.values, feed_back, end)
        task = asyncio.get_running_loop().create_task(execute(goal, self._handler, self.name))
        self._goals[identity] = goal, task
        task.add_done_callback(lambda _task: self._goals.pop(identity, None))

    def lost(self) -> None:
        """After a loss of the connection, cancel the handlers, because no sender can receive their results."""
        # Each task removes its own entry when it has ended, so the dictionary does not change here.
        for _goal, task in self._goals.values():
            task.cancel()

    def end(self) -> None:
        """Cancel the handlers."""
        super().end()
        self.lost()

    def _withdraw(self) -> None:
        # `end` has cancelled the handlers, so the goals are ended here, while the action is still advertised.
        for goal, _task in self._goals.values():
            goal.abort(f"action {self.name} is no longer served")
        del self._session.action_servers[absolute(self.name)]
        self._session.core.actions.unadvertise(self.name)
