"""Goals of ROS 2 actions as their sender holds them: feedback to be read, a result to be waited for, a way to cancel."""

import asyncio
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

from bridge.client.protocol.events import GoalEnded, GoalFeedback, GoalStatus
from bridge.client.session import Session
from bridge.errors import ConcurrentReadError, DisconnectedError, GoalError, NoAnswerError

#: Feedback that waits for its reader; then the oldest is dropped.
FEEDBACK_QUEUE_SIZE: Final = 64


@dataclass(frozen=True, slots=True)
class GoalResult:
    """How a goal ended.

    Attributes:
        status: succeeded, canceled or aborted.
        values: the result's fields.
    """

    status: GoalStatus
    values: dict[str, Any]


class Goal:
    """One goal on its way: ``async for feedback in goal``, then ``await goal.result(timeout)``.

    The iteration ends with the goal. If the connection is lost meanwhile, iteration and result fail: a server
    forgets whose goal it was, so that its end will not be told.

    Attributes:
        action: the action's name.
        lost: how much feedback was dropped because its reader was too slow.
    """

    def __init__(
        self, session: Session, action: str, type_name: str, goal: Mapping[str, Any], *, feedback: bool
    ) -> None:
        """Send the goal (see `bridge.client.Ros.send_goal`)."""
        self.action = action
        self.lost = 0
        self._session = session
        self._sent = time.monotonic()
        self._feedback: deque[dict[str, Any]] = deque(maxlen=FEEDBACK_QUEUE_SIZE)
        self._reader: asyncio.Future[None] | None = None
        self._ended: asyncio.Future[GoalEnded] = asyncio.get_running_loop().create_future()
        self._identity = session.core.goals.send(action, type_name, goal, feedback=feedback)
        session.goals[self._identity] = self
        session.flush()

    def receive(self, event: GoalFeedback | GoalEnded) -> None:
        """Take what the server says of this goal."""
        if isinstance(event, GoalFeedback):
            if len(self._feedback) == FEEDBACK_QUEUE_SIZE:
                self.lost += 1
            self._feedback.append(event.values)
        elif not self._ended.done():
            self._ended.set_result(event)
        self._wake()

    def fail(self, reason: str) -> None:
        """Take note that nothing more will be heard of it."""
        if not self._ended.done():
            self._ended.set_exception(DisconnectedError(f"{reason} while {self.action} had a goal"))
            self._ended.exception()  # nobody needs to ask for it
        self._wake()

    def _wake(self) -> None:
        if self._reader is not None and not self._reader.done():
            self._reader.set_result(None)

    @property
    def done(self) -> bool:
        """Whether it is over."""
        return self._ended.done()

    async def cancel(self) -> None:
        """Ask for it to be given up; `result` tells whether it was. Nothing happens if it is over."""
        self._session.core.goals.cancel(self._identity)
        self._session.flush()

    async def result(self, timeout: float) -> GoalResult:  # noqa: ASYNC109  # part of the error
        """Wait for its end. May be called again.

        Args:
            timeout: seconds.

        Returns:
            Its status and result, also of one that was canceled or aborted.

        Raises:
            GoalError: the action refused the goal, or is not there.
            NoAnswerError: it did not end in time; it goes on all the same.
            DisconnectedError: the connection was lost before it ended.
        """
        try:
            async with asyncio.timeout(timeout):
                ended = await asyncio.shield(self._ended)
        except TimeoutError:
            raise NoAnswerError(
                f"the goal of action {self.action} at {self._session.uri} did not end within {timeout:g} s"
                f"{self._session.said_since(self._sent)}"
            ) from None
        if not ended.ok:
            raise GoalError(ended.values, f"{self.action} at {self._session.uri}")
        return GoalResult(ended.status, ended.values)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> dict[str, Any]:
        while not self._feedback:
            if self._ended.done():
                if (error := self._ended.exception()) is not None:
                    raise error
                raise StopAsyncIteration
            if self._reader is not None:
                raise ConcurrentReadError(f"another task waits for feedback of this goal of {self.action}")
            self._reader = asyncio.get_running_loop().create_future()
            try:
                await self._reader
            finally:
                self._reader = None
        return self._feedback.popleft()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_exception: object) -> None:
        """Cancel it if it is not over; nobody is left who would read of it."""
        if not self.done:
            await self.cancel()
        self._session.goals.pop(self._identity, None)
        self._session.core.goals.forget(self._identity)
