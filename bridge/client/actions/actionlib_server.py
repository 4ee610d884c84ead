"""Actions of ROS 1 that this client serves, over the topics of actionlib."""

import asyncio
import time
from collections.abc import Mapping
from contextlib import AsyncExitStack, suppress
from typing import TYPE_CHECKING, Any, Final, Self

from bridge import stamps
from bridge.client.actions.actionlib import GOAL_ID, STATUS_ARRAY, ActionlibStatus, base_type, with_header
from bridge.client.actions.server import GoalHandler, GoalRequest, execute
from bridge.client.protocol.actions import MAX_SERVED_GOALS
from bridge.client.protocol.events import GoalStatus
from bridge.client.session import Session
from bridge.errors import BridgeError, DisconnectedError, SlowPeerError

if TYPE_CHECKING:
    from bridge.client.ros import Ros

STATUS_INTERVAL: Final = 0.2
MAX_ID: Final = 1024
"""Maximum length of a goal's id in characters; goals with a longer one are ignored."""
_LATEST: Final = 2**62
KEPT: Final = 5.0
"""Seconds for which the status of an ended goal is repeated."""
MAX_KEPT: Final = MAX_SERVED_GOALS
"""Maximum number of ended goals whose status is repeated after a new goal."""
_ENDS: Final = {
    GoalStatus.SUCCEEDED: ActionlibStatus.SUCCEEDED,
    GoalStatus.ABORTED: ActionlibStatus.ABORTED,
    GoalStatus.CANCELED: ActionlibStatus.PREEMPTED,
}
_Values = dict[str, Any]


class _Tracked:
    """One goal: its id in ROS, its status, and its handler."""

    def __init__(self, goal_id: _Values) -> None:
        self.id = goal_id
        self.status = ActionlibStatus.ACTIVE
        self.text = ""
        self.ended_at = 0.0
        self.request: GoalRequest | None = None
        self.task: asyncio.Task[None] | None = None

    def as_message(self) -> _Values:
        return {"goal_id": self.id, "status": self.status, "text": self.text}


class ActionlibServer:
    """One action of ROS 1 that this client serves.

    Attributes:
        name: Name of the action.
    """

    def __init__(self, ros: "Ros", session: Session, name: str, type_name: str, handler: GoalHandler) -> None:
        self.name = name
        self._ros = ros
        self._session = session
        self._type = base_type(type_name)
        self._handler = handler
        self._goals: dict[str, _Tracked] = {}
        self._changed = asyncio.Event()
        self._open = AsyncExitStack()
        self._tasks: list[asyncio.Task[None]] = []

    async def start(self) -> Self:
        """Advertise and subscribe to the topics."""
        advertise, enter, name = self._ros.advertise, self._open.enter_async_context, self.name
        self._status = await enter(await advertise(f"{name}/status", STATUS_ARRAY))
        self._feedback = await enter(await advertise(f"{name}/feedback", f"{self._type}ActionFeedback"))
        self._result = await enter(await advertise(f"{name}/result", f"{self._type}ActionResult"))
        goals = await enter(self._ros.subscribe(f"{name}/goal", f"{self._type}ActionGoal"))
        cancels = await enter(self._ros.subscribe(f"{name}/cancel", GOAL_ID))

        async def start_goals() -> None:
            async for message in goals:
                self._start(message.msg)

        async def cancel_goals() -> None:
            async for message in cancels:
                self._cancel(message.msg)

        loop = asyncio.get_running_loop()
        self._tasks = [loop.create_task(each()) for each in (start_goals, cancel_goals, self._repeat_status)]
        self._session.on_closed.add(self._end)
        return self

    def _end(self) -> list[asyncio.Task[None]]:
        """Cancel everything that runs, except the caller, and return it."""
        tasks = [*self._tasks, *(goal.task for goal in self._goals.values() if goal.task is not None)]
        tasks = [task for task in tasks if task is not asyncio.current_task()]
        for task in tasks:
            task.cancel()
        return tasks

    async def close(self) -> None:
        """Abort all goals, and withdraw the topics. Further calls have no effect."""
        for goal in list(self._goals.values()):
            if goal.request is not None:
                goal.request.abort(f"action {self.name} is no longer served")
        self._session.on_closed.discard(self._end)
        await asyncio.gather(*self._end(), return_exceptions=True)
        await self._open.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_exception: object) -> None:
        await self.close()

    def _start(self, message: _Values) -> None:
        goal_id, values = message.get("goal_id"), message.get("goal")
        if not isinstance(goal_id, dict) or not isinstance(values, dict):
            return
        identity = goal_id.get("id")
        if not isinstance(identity, str) or len(identity) > MAX_ID or identity in self._goals:
            return
        stamp = stamps.stamp_ns(goal_id.get("stamp")) or 0
        ended = [each for each, goal in self._goals.items() if goal.ended_at]
        is_full = len(self._goals) - len(ended) >= MAX_SERVED_GOALS
        goal = _Tracked({"stamp": stamps.stamp(stamp if 0 <= stamp < _LATEST else 0, 1), "id": identity})

        def end(status: GoalStatus, result: Mapping[str, Any] | str) -> None:
            goal.status, goal.ended_at = _ENDS[status], time.monotonic()
            goal.text = result if isinstance(result, str) else ""
            fields = {} if isinstance(result, str) else dict(result)
            self._publish(self._result, {"status": goal.as_message(), "result": fields})
            self._changed.set()

        def feed_back(feedback: Mapping[str, Any]) -> None:
            self._publish(self._feedback, {"status": goal.as_message(), "feedback": dict(feedback)})

        goal.request = GoalRequest(values, feed_back, end)
        if is_full:
            goal.request.abort(f"{MAX_SERVED_GOALS} goals are already executed here")
            return
        for oldest in ended[: max(len(ended) - MAX_KEPT, 0)]:
            del self._goals[oldest]
        self._goals[identity] = goal
        goal.task = asyncio.get_running_loop().create_task(execute(goal.request, self._handler, self.name))
        self._changed.set()

    def _cancel(self, message: _Values) -> None:
        """Cancel one goal, or all if the id is empty; cancelling all before a time is cancelling all."""
        wanted = message.get("id")
        for key, goal in self._goals.items():
            if (not wanted or key == wanted) and goal.request is not None and not goal.ended_at:
                goal.status = ActionlibStatus.PREEMPTING
                goal.request.ask_to_cancel()
        self._changed.set()

    async def _repeat_status(self) -> None:
        while True:
            now = time.monotonic()
            old = [key for key, goal in self._goals.items() if goal.ended_at and now - goal.ended_at > KEPT]
            for key in old:
                del self._goals[key]
            statuses = [goal.as_message() for goal in self._goals.values()]
            with suppress(BridgeError):
                self._publish(self._status, {"status_list": statuses})
            self._changed.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout(STATUS_INTERVAL):
                    await self._changed.wait()

    def _publish(self, publication: Any, message: _Values) -> None:
        with suppress(DisconnectedError, SlowPeerError):  # the status is repeated
            publication.publish_nowait(with_header(message))
