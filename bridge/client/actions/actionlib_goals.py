"""Goals of ROS 1 for their sender, over the topics of actionlib."""

import asyncio
import time
import uuid
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any, Final, Self

from bridge import stamps
from bridge.client.actions.actionlib import GOAL_ID, STATUS_ARRAY, ActionlibStatus, base_type, with_header
from bridge.client.actions.goals import Goal
from bridge.client.handles import Subscription
from bridge.client.protocol.events import GoalEnded, GoalFeedback, GoalStatus
from bridge.client.protocol.goals import MAX_GOALS
from bridge.client.protocol.subscription_options import Delivery
from bridge.client.session import Message, Session
from bridge.errors import SlowPeerError

if TYPE_CHECKING:
    from bridge.client.ros import Ros

SERVED_FOR: Final = 2.0
"""Seconds for which a status shows that a server runs; servers publish it two to five times per second."""
_ROSAPI_TIMEOUT: Final = 1.0
_ACTIVE: Final = frozenset(
    {
        ActionlibStatus.PENDING,
        ActionlibStatus.ACTIVE,
        ActionlibStatus.PREEMPTING,
        ActionlibStatus.RECALLING,
    }
)
_ENDS: Final[Mapping[int, GoalStatus]] = {
    ActionlibStatus.SUCCEEDED: GoalStatus.SUCCEEDED,
    ActionlibStatus.ABORTED: GoalStatus.ABORTED,
    ActionlibStatus.PREEMPTED: GoalStatus.CANCELED,
    ActionlibStatus.RECALLED: GoalStatus.CANCELED,
}
_Values = dict[str, Any]


class ActionlibGoal(Goal):
    """One active goal of ROS 1."""

    def __init__(self, session: Session, sender: "ActionlibSender", *, feedback: bool) -> None:
        identity = f"{sender.action}-{uuid.uuid4().hex}"
        super().__init__(session, sender.action, identity)
        self.identity = identity
        self.wants_feedback = feedback
        self._sender = sender
        self._was_active = False

    async def cancel(self) -> None:
        """Ask the server to cancel the goal, if it is active; `result` returns whether it did."""
        self._session.check_thread()
        if not self.done and self._session.is_open:
            await self._sender.cancel(self.identity)

    def see(self, status: int | None) -> None:
        """Handle the goal's status in a list of the server; a goal that was active and is not listed is lost."""
        if status is None and self._was_active:
            self.refuse("the server no longer knows the goal")
        self._was_active = status in _ACTIVE

    def refuse(self, reason: str) -> None:
        """End the goal without a result, with the reason for `GoalError`."""
        self.receive(GoalEnded(self.identity, ok=False, status=GoalStatus.UNKNOWN, values=reason))
        self.forget()

    def fail(self, reason: str) -> None:
        """End the goal because the connection was lost."""
        super().fail(reason)
        self.forget()

    def forget(self) -> None:
        """Ignore further events of this goal."""
        super().forget()
        self._sender.goals.pop(self.identity, None)


class _Listener(Subscription):
    """A subscription whose messages go to a function at once, in the order of their arrival."""

    def __init__(
        self, session: Session, topic: str, type_name: str, listen: Callable[[_Values], None]
    ) -> None:
        self._listen = listen
        delivery = Delivery()
        super().__init__(
            session, topic, type_name, throttle_rate=0, queue_length=0, queue_size=1, delivery=delivery
        )

    def _receive(self, message: Message) -> None:
        self._listen(message.msg)


class ActionlibSender:
    """The topics of one action, shared by all its goals, and kept until the client is closed.

    Attributes:
        action: Name of the action.
        goals: Its active goals, by id.
    """

    def __init__(self, ros: "Ros", session: Session, action: str, type_name: str) -> None:
        self.action = action
        self.goals: dict[str, ActionlibGoal] = {}
        self._ros = ros
        self._session = session
        self._type = base_type(type_name)
        self._served_until = 0.0
        self._served_on = -1  # number of reconnections at that time
        self._served = asyncio.Event()

    async def start(self) -> Self:
        """Subscribe to the topics of the server, and advertise those of its clients."""
        session, action, type_name = self._session, self.action, self._type
        async with AsyncExitStack() as opened:
            for topic, its_type, listen in (
                ("feedback", f"{type_name}ActionFeedback", self._take_feedback),
                ("result", f"{type_name}ActionResult", self._take_result),
                ("status", STATUS_ARRAY, self._take_statuses),
            ):
                await opened.enter_async_context(_Listener(session, f"{action}/{topic}", its_type, listen))
            advertise, enter = self._ros.advertise, opened.enter_async_context
            self._goal = await enter(await advertise(f"{action}/goal", f"{type_name}ActionGoal"))
            self._cancel = await enter(await advertise(f"{action}/cancel", GOAL_ID))
            opened.pop_all()
        return self

    async def send(self, values: Mapping[str, Any], limit: float, *, feedback: bool) -> Goal:
        """Send a goal; without a server, it ends at once, as in ROS 2."""
        if len(self._session.goals) >= MAX_GOALS:
            raise SlowPeerError(f"{MAX_GOALS} goals are active, so none was sent to {self.action}")
        deadline = time.monotonic() + limit
        goal = ActionlibGoal(self._session, self, feedback=feedback)
        try:
            if unserved := await self._why_unserved(limit):
                goal.refuse(unserved)
                return goal
            self.goals[goal.identity] = goal
            goal_id = {"stamp": stamps.stamp(time.time_ns(), 1), "id": goal.identity}
            message = with_header({"goal_id": goal_id, "goal": values})
            await self._goal.publish(message, timeout=max(0.0, deadline - time.monotonic()))
        except BaseException:
            goal.forget()
            raise
        return goal

    async def cancel(self, goal: str) -> None:
        """Ask the server to cancel a goal."""
        await self._cancel.publish({"stamp": stamps.stamp(0, 1), "id": goal})

    async def _why_unserved(self, limit: float) -> str:
        """Wait for a status, after which the server's other topics are connected too; return why there is none."""
        begun = time.monotonic()
        topic = f"{self.action}/goal"
        if await self._ros.subscribers(topic, min(limit, _ROSAPI_TIMEOUT)) == []:
            return f"nobody subscribes to {topic}"
        try:
            async with asyncio.timeout(max(0.0, begun + limit - time.monotonic())):
                while not self._is_served():
                    self._served.clear()
                    await self._served.wait()
        except TimeoutError:
            context = self._session.context_since(begun)
            return f"nobody published {self.action}/status within {limit:g} s{context}"
        return ""

    def _is_served(self) -> bool:
        return self._served_on == self._session.reconnections and time.monotonic() < self._served_until

    def _take_statuses(self, msg: _Values) -> None:
        self._served_on, self._served_until = self._session.reconnections, time.monotonic() + SERVED_FOR
        self._served.set()
        found, listed = msg.get("status_list"), {}
        for each in found if isinstance(found, list) else []:
            match each:
                case {"goal_id": {"id": str(goal)}, "status": int(status)}:
                    listed[goal] = status
        for identity, active in list(self.goals.items()):
            active.see(listed.get(identity))

    def _take_feedback(self, msg: _Values) -> None:
        match msg:
            case {"status": {"goal_id": {"id": str(identity)}}, "feedback": dict(values)}:
                goal = self.goals.get(identity)
                if goal is not None and goal.wants_feedback:
                    goal.receive(GoalFeedback(identity, values))

    def _take_result(self, msg: _Values) -> None:
        match msg:
            case {"status": {"goal_id": {"id": str(identity)}, "status": int(status), **rest}}:
                goal = self.goals.get(identity)
                if goal is None:
                    return
                text = str(rest.get("text", ""))
                if status not in _ENDS:
                    goal.refuse(text or f"the goal ended with status {status}")
                    return
                result = msg.get("result")
                values = result if isinstance(result, dict) else {}
                goal.receive(GoalEnded(identity, ok=True, status=_ENDS[status], values=values, text=text))
                goal.forget()
