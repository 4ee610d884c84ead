"""Goals for their sender: feedback, result and cancellation, over the operations of ROS 2.

`bridge.client.actions.actionlib_goals` sends goals of ROS 1 behind the same class.
"""

import asyncio
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

from bridge.client.protocol.events import GoalEnded, GoalFeedback, GoalStatus
from bridge.client.session import Session
from bridge.errors import ConcurrentReadError, DisconnectedError, GoalError, NoAnswerError

FEEDBACK_QUEUE_SIZE: Final = 64
"""Maximum number of queued feedback messages; then the oldest is dropped."""


@dataclass(frozen=True, slots=True)
class GoalResult:
    """Result of a goal.

    Attributes:
        status: Succeeded, canceled or aborted.
        values: Fields of the result.
        text: Text of the server about the end, in ROS 1; empty in ROS 2.
    """

    status: GoalStatus
    values: dict[str, Any]
    text: str = ""


class Goal:
    """One active goal: `async for feedback in goal`, then `await goal.result(timeout)`.

    The iteration ends with the goal. If the connection is lost, iteration and result fail, because the server
    forgets the sender of a goal and never reports its end.

    Attributes:
        action: Name of the action.
        lost: Number of feedback messages dropped because the reader was too slow.
    """

    def __init__(self, session: Session, action: str, identity: str) -> None:
        self.action = action
        self.lost = 0
        self._session = session
        self._identity = identity
        self._sent_at = time.monotonic()
        self._feedback: deque[dict[str, Any]] = deque(maxlen=FEEDBACK_QUEUE_SIZE)
        self._reader: asyncio.Future[None] | None = None
        self._ended: asyncio.Future[GoalEnded] = asyncio.get_running_loop().create_future()
        session.goals[identity] = self

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
        """End the goal without a result."""
        if not self._ended.done():
            self._ended.set_exception(DisconnectedError(f"{reason} during a goal of {self.action}"))
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
        """Ask the server to cancel the goal, if it is active; `result` returns whether it did."""
        raise NotImplementedError

    async def result(self, timeout: float) -> GoalResult:
        """Wait for the end of the goal; return its status even if canceled or aborted. May be repeated.

        Raises:
            GoalError: The action refused the goal, or does not exist.
            NoAnswerError: The goal did not end in time, and is still active.
            DisconnectedError: The connection was lost before it ended.
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
            raise GoalError(ended.values, f"{self.action} at {self._session.uri}")
        return GoalResult(ended.status, ended.values, ended.text)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> dict[str, Any]:
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
        try:
            if not self.done:
                await self.cancel()
        finally:
            self.forget()

    def forget(self) -> None:
        """Ignore further events of this goal."""
        self._session.goals.pop(self._identity, None)


class OperationGoal(Goal):
    """One active goal of ROS 2."""

    def __init__(
        self, session: Session, action: str, type_name: str, goal: Mapping[str, Any], *, feedback: bool
    ) -> None:
        super().__init__(session, action, session.core.goals.send(action, type_name, goal, feedback=feedback))
        session.flush()

    async def cancel(self) -> None:
        """Ask the server to cancel the goal, if it is active; `result` returns whether it did."""
        self._session.check_thread()
        self._session.core.goals.cancel(self._identity)
        self._session.flush()

    def forget(self) -> None:
        """Ignore further events of this goal."""
        super().forget()
        self._session.core.goals.forget(self._identity)
