"""Goals of actions that this client sends and serves, through the hub."""

import asyncio

import numpy as np
import pytest

from bridge.client import State, connect
from bridge.client.actions import FEEDBACK_QUEUE_SIZE
from bridge.client.protocol.events import GoalFeedback, GoalStatus
from bridge.errors import ActionlibError, ConcurrentReadError, DisconnectedError, GoalError, NoAnswerError
from tests.bridge.hub.sockets import until
from tests.patience import PATIENCE

FIBONACCI = "actionlib_tutorials/Fibonacci"


async def count(goal):
    """Count to the order of the goal, and end it in the way that its order says."""
    order = goal.values["order"]
    goal.feed_back({"sequence": [0, 1]})
    if order == 1:
        goal.abort({"sequence": [1]})
        return None
    if order == 2:
        await goal.wait_canceling()
        return {"sequence": [2]}
    if order == 3:
        raise RuntimeError("a bug")
    return {"sequence": list(range(order))}


@pytest.fixture
async def serving(hub):
    """A client that serves /count, and another one."""
    async with (
        connect(hub) as server,
        connect(hub) as ros,
        await server.advertise_action("/count", FIBONACCI, count),
    ):
        await server.call("/rosapi/get_time", timeout=PATIENCE)  # the hub has the action then
        yield server, ros


@pytest.mark.parametrize(
    ("order", "status", "sequence"),
    [(5, GoalStatus.SUCCEEDED, [0, 1, 2, 3, 4]), (1, GoalStatus.ABORTED, [1]), (2, GoalStatus.CANCELED, [2])],
)
async def test_a_goal_is_fed_back_and_ends(serving, order, status, sequence):
    _server, ros = serving
    async with await ros.send_goal("/count", FIBONACCI, {"order": order}) as goal:
        assert await anext(goal) == {"sequence": [0, 1]}
        if order == 2:
            with pytest.raises(NoAnswerError, match="/count .* did not end within 0.05 s"):
                await goal.result(0.05)
            await goal.cancel()
        for _ in range(2):
            result = await goal.result(PATIENCE)
            assert (result.status, result.values) == (status, {"sequence": sequence})
        assert [feedback async for feedback in goal] == []
    assert not ros._session.goals


async def test_leaving_the_block_cancels_the_goal_and_feedback_is_optional(serving):
    server, ros = serving
    executed = server._session.action_servers["/count"]._goals
    async with await ros.send_goal("/count", FIBONACCI, {"order": np.int64(2)}, feedback=False) as goal:
        await until(lambda: executed)
    await until(lambda: not executed)  # it ends only if it is cancelled
    assert not goal._feedback
    for waiting in (anext(goal), goal.result(PATIENCE)):  # nothing more will come
        with pytest.raises(GoalError):
            await asyncio.wait_for(waiting, PATIENCE)


async def test_feedback_that_nobody_reads_is_bounded(serving):
    _server, ros = serving
    goal = await ros.send_goal("/count", FIBONACCI, {"order": 2})
    await anext(goal)
    for n in range(FEEDBACK_QUEUE_SIZE + 30):
        goal.receive(GoalFeedback(goal._identity, {"n": n}))
    await goal.cancel()
    await goal.result(PATIENCE)
    read = [feedback["n"] async for feedback in goal]
    assert read == list(range(30, FEEDBACK_QUEUE_SIZE + 30))
    assert goal.lost == 30


async def test_goals_end_with_the_connection_or_the_client(serving):
    _server, ros = serving
    goal = await ros.send_goal("/count", FIBONACCI, {"order": 2})
    await anext(goal)
    tasks = [asyncio.ensure_future(anext(goal)), asyncio.create_task(goal.result(PATIENCE))]
    await asyncio.sleep(0)
    with pytest.raises(ConcurrentReadError):
        await anext(goal)
    ros._session._websocket.abort()
    for waiting in (*tasks, goal.result(1)):
        with pytest.raises(DisconnectedError):
            await asyncio.wait_for(waiting, PATIENCE)
    await goal.cancel()
    await ros.wait_for_state(State.CONNECTED, PATIENCE)
    another = await ros.send_goal("/count", FIBONACCI, {"order": 2})
    await anext(another)
    await ros.close()
    with pytest.raises(DisconnectedError):
        await another.result(1)
    with pytest.raises(DisconnectedError):
        await ros.send_goal("/count", FIBONACCI)


@pytest.mark.parametrize("wrong", ["feedback", "result"])
async def test_feedback_or_a_result_of_another_type_aborts_the_goal(hub, wrong):
    async def handle(goal):
        goal.feed_back({"sequenze": [0]} if wrong == "feedback" else {"sequence": [0]})
        return {"sequence": [[0]]} if wrong == "result" else {"sequence": [0]}

    async with connect(hub) as ros, await ros.advertise_action("/wrong", FIBONACCI, handle):
        goal = await ros.send_goal("/wrong", FIBONACCI, {"order": 1})
        with pytest.raises(GoalError) as caught:
            await goal.result(PATIENCE)
    assert "sequence" in caught.value.reason


async def test_a_handler_that_fails_and_a_server_that_goes_away_end_the_goal(serving):
    server, ros = serving
    for action, order, why in (("/count", 3, "RuntimeError"), ("/nowhere", 3, "/nowhere")):
        failed = await ros.send_goal(action, FIBONACCI, {"order": order})
        with pytest.raises(GoalError, match=f"action {action} at ws://.* has no result") as caught:
            await failed.result(PATIENCE)
        assert why in caught.value.reason
    waiting = await ros.send_goal("/count", FIBONACCI, {"order": 2})
    await anext(waiting)
    await server.close()
    with pytest.raises(GoalError):
        await waiting.result(PATIENCE)


async def test_an_action_comes_back_with_its_connection_and_its_goals_do_not(fake, ros):
    started, cancelled = asyncio.Event(), asyncio.Event()

    async def wait(goal):
        started.set()
        try:
            await goal.wait_canceling()
        except asyncio.CancelledError:
            cancelled.set()
            raise

    await ros.advertise_action("/wait", "p/action/Wait", wait)
    await fake.wait_for_op("advertise_action", action="/wait", type="p/action/Wait")
    await fake.say({"op": "send_action_goal", "id": "1", "action": "/wait", "args": {}})
    await asyncio.wait_for(started.wait(), PATIENCE)
    await fake.cut()
    await asyncio.wait_for(cancelled.wait(), PATIENCE)
    await ros.wait_for_state(State.CONNECTED, PATIENCE)
    await fake.wait_for_op("advertise_action", count=2)
    await fake.say({"op": "send_action_goal", "id": "1", "action": "/other", "args": {}})
    assert (await fake.wait_for_op("action_result", id="1"))["result"] is False


@pytest.mark.parametrize("hub", [{"ros_version": 1}], indirect=True)
@pytest.mark.parametrize("configured", ["1", "auto"])
async def test_actions_of_ros_1_are_refused(hub, configured):
    async with connect(hub, ros_version=configured) as ros:
        with pytest.raises(ActionlibError):
            await ros.send_goal("/count", FIBONACCI, {"order": 5})
        with pytest.raises(ActionlibError):
            await ros.advertise_action("/count", FIBONACCI, count)
