"""Actions that this client serves: execution of goals by a handler, over the operations of ROS 2.

`bridge.client.actions.actionlib_server` executes goals of ROS 1 with the same handlers.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from bridge.client.handles import Handle
from bridge.client.protocol.events import CancelRequested, GoalRequested, GoalStatus
from bridge.client.session import Session
from bridge.codecs.message_check import MessageCheck
from bridge.errors import BridgeError
from bridge.names import absolute

_log = logging.getLogger("bridge")

FeedBack = Callable[[Mapping[str, Any]], None]
End = Callable[[GoalStatus, Mapping[str, Any] | str], None]


class GoalRequest:
    """A goal that this client executes, for its handler.

    The first of `succeed`, `abort` and `cancel` ends it; the handler may continue, to clean up.

    Attributes:
        values: Fields of the goal.
    """

    def __init__(self, values: dict[str, Any], feed_back: FeedBack, end: End) -> None:
        self.values = values
        self._feed_back = feed_back
        self._end = end
        self._canceling = asyncio.Event()
        self.ended = False

    @property
    def canceling(self) -> bool:
        """True if the sender has cancelled the goal."""
        return self._canceling.is_set()

    async def wait_canceling(self) -> None:
        """Wait until the sender has cancelled the goal."""
        await self._canceling.wait()

    def ask_to_cancel(self) -> None:
        """Tell the handler that the sender has cancelled the goal."""
        self._canceling.set()

    def feed_back(self, values: Mapping[str, Any]) -> None:
        """Send feedback; no effect after the end."""
        if not self.ended:
            self._feed_back(values)

    def succeed(self, values: Mapping[str, Any] | None = None) -> None:
        """End the goal with its result."""
        self._finish(GoalStatus.SUCCEEDED, values or {})

    def abort(self, values: Mapping[str, Any] | str | None = None) -> None:
        """End the goal without success, with a result or the text of a reason."""
        self._finish(GoalStatus.ABORTED, values or {})

    def cancel(self, values: Mapping[str, Any] | None = None) -> None:
        """End the goal as cancelled, with the values reached so far."""
        self._finish(GoalStatus.CANCELED, values or {})

    def _finish(self, status: GoalStatus, values: Mapping[str, Any] | str) -> None:
        if not self.ended:
            self._end(status, values)
            self.ended = True


GoalHandler = Callable[[GoalRequest], Awaitable[Mapping[str, Any] | None]]


async def execute(goal: GoalRequest, handler: GoalHandler, action: str) -> None:
    """Have a handler execute a goal, which ends even if the handler fails."""
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
    """One action of ROS 2 that this client serves.

    Attributes:
        name: Name of the action.
        result_check: The check of results, if their type is known.
        feedback_check: The check of feedback, if its type is known.
    """

    def __init__(self, session: Session, name: str, type_name: str, handler: GoalHandler) -> None:
        super().__init__(session)
        self.name = name
        self.result_check: MessageCheck | None = None
        self.feedback_check: MessageCheck | None = None
        self._handler = handler
        self._goals: dict[str, tuple[GoalRequest, asyncio.Task[None]]] = {}
        session.core.actions.advertise(name, type_name)
        session.action_servers[absolute(name)] = self
        self._register()

    def receive(self, event: GoalRequested | CancelRequested) -> None:
        """Start a goal, or ask its handler to cancel it."""
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
        """Cancel the handlers of a lost connection, because nobody waits for their results."""
        for _goal, task in self._goals.values():
            task.cancel()

    def end(self) -> None:
        """Cancel the handlers."""
        super().end()
        self.lost()

    def _withdraw(self) -> None:
        for goal, _task in self._goals.values():
            goal.abort(f"action {self.name} is no longer served")
        del self._session.action_servers[absolute(self.name)]
        self._session.core.actions.unadvertise(self.name)
