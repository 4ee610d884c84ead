"""Goals of actions that this client serves: over the operations of ROS 2, and over the topics of actionlib."""

import asyncio
import contextlib

import pytest

from bridge.client import GoalRequest, State, connect
from bridge.client.actions import actionlib_server
from bridge.client.actions.actionlib_server import MAX_ID
from bridge.client.protocol.events import GoalStatus
from bridge.errors import GoalError
from tests.bridge.client.actions.counting import FIBONACCI, count
from tests.bridge.hub.sockets import running_hub
from tests.patience import PATIENCE


@contextlib.asynccontextmanager
async def serving(version: int):
    async with running_hub(ros_version=version) as port:
        uri = f"ws://127.0.0.1:{port}"
        async with (
            connect(uri) as server,
            connect(uri) as ros,
            await server.advertise_action("/count", FIBONACCI, count),
        ):
            await server.call("/rosapi/get_time", timeout=PATIENCE)  # it has the action then
            yield server, ros


@pytest.mark.parametrize(
    ("order", "status", "sequence"),
    [
        (5, GoalStatus.SUCCEEDED, [0, 1, 2, 3, 4]),
        (1, GoalStatus.ABORTED, [1]),
        (2, GoalStatus.CANCELED, [2]),
    ],
)
async def test_a_goal_of_ros_2_is_fed_back_and_ends(order, status, sequence):
    async with (
        serving(2) as (_server, ros),
        await ros.send_goal("/count", FIBONACCI, {"order": order}) as goal,
    ):
        assert await anext(goal) == {"sequence": [0, 1]}
        if order == 2:
            await goal.cancel()
        result = await goal.result(PATIENCE)
        assert (result.status, result.values) == (status, {"sequence": sequence})


@pytest.mark.parametrize("wrong", ["feedback", "result"])
async def test_feedback_or_a_result_of_another_type_aborts_the_goal(wrong):
    async def handle(goal):
        goal.feed_back({"sequenze": [0]} if wrong == "feedback" else {"sequence": [0]})
        return {"sequence": [[0]]} if wrong == "result" else {"sequence": [0]}

    async with (
        running_hub(ros_version=2) as port,
        connect(f"ws://127.0.0.1:{port}") as ros,
        await ros.advertise_action("/wrong", FIBONACCI, handle),
    ):
        goal = await ros.send_goal("/wrong", FIBONACCI, {"order": 1})
        with pytest.raises(GoalError) as caught:
            await goal.result(PATIENCE)
    assert "sequence" in caught.value.reason


async def test_a_handler_that_fails_and_a_server_that_goes_away_end_the_goal():
    async with serving(2) as (server, ros):
        failed = await ros.send_goal("/count", FIBONACCI, {"order": 3})
        with pytest.raises(GoalError) as caught:
            await failed.result(PATIENCE)
        assert "RuntimeError" in caught.value.reason
        waiting = await ros.send_goal("/count", FIBONACCI, {"order": 2})
        await anext(waiting)
        await server.close()
        with pytest.raises(GoalError):
            await waiting.result(PATIENCE)


async def test_an_action_comes_back_with_its_connection_and_its_goals_do_not(fake, ros):
    started, cancelled = asyncio.Event(), asyncio.Event()

    async def wait(goal: GoalRequest) -> None:
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


@pytest.mark.parametrize(
    ("order", "status", "sequence"), [(5, 3, [0, 1, 2, 3, 4]), (1, 4, [1]), (2, 2, [2]), (3, 4, [])]
)
async def test_a_goal_of_ros_1_goes_over_the_topics_of_actionlib(order, status, sequence):
    async with serving(1) as (_server, ros):
        feedback = ros.subscribe("/count/feedback", f"{FIBONACCI}ActionFeedback")
        results = ros.subscribe("/count/result", f"{FIBONACCI}ActionResult")
        statuses = ros.subscribe("/count/status", "actionlib_msgs/GoalStatusArray")
        goals = await ros.advertise("/count/goal", f"{FIBONACCI}ActionGoal")
        cancel = await ros.advertise("/count/cancel", "actionlib_msgs/GoalID")
        await statuses.next(PATIENCE)
        assert (await ros.call("/rosapi/action_servers"))["action_servers"] == ["/count"]
        await goals.publish({"goal_id": {"id": "g"}, "goal": {"order": order}})
        assert (await feedback.next(PATIENCE)).msg["feedback"] == {"sequence": [0, 1]}
        if order == 2:
            await cancel.publish({"id": "g"})
        result = (await results.next(PATIENCE)).msg
        assert (result["status"]["goal_id"]["id"], result["status"]["status"]) == ("g", status)
        assert result["result"].get("sequence", []) == sequence
        async with asyncio.timeout(PATIENCE):
            async for message in statuses:
                if [each["status"] for each in message.msg["status_list"]] == [status]:
                    break


async def test_a_goal_of_ros_1_with_a_strange_id_is_ignored_or_repeated_in_its_form():
    async with serving(1) as (_server, ros):
        results = ros.subscribe("/count/result", f"{FIBONACCI}ActionResult")
        async with connect(ros.uri, check_types=False) as other:
            goals = await other.advertise("/count/goal", f"{FIBONACCI}ActionGoal")
            for goal_id in (
                {"id": 5 * "long" * MAX_ID},
                {"id": [1]},
                "no",
                {"stamp": {"secs": 2**63}, "id": "g"},
            ):
                await goals.publish({"goal_id": goal_id, "goal": {"order": 5}})
            result = (await results.next(PATIENCE)).msg
            assert (result["status"]["goal_id"]["id"], result["status"]["status"]) == ("g", 3)
            assert result["status"]["goal_id"]["stamp"] == {"secs": 0, "nsecs": 0}


@pytest.mark.parametrize(("fake", "ros"), [({"ros": 1}, {"ros_version": "1"})], indirect=True, ids=["ros1"])
async def test_a_flood_of_goals_takes_no_memory(fake, ros, monkeypatch):
    monkeypatch.setattr(actionlib_server, "MAX_SERVED_GOALS", 3)
    monkeypatch.setattr(actionlib_server, "MAX_KEPT", 5)
    monkeypatch.setattr(actionlib_server, "KEPT", 3600.0)

    def lists():
        return [op["msg"]["status_list"] for op in fake.ops("publish", topic="/count/status")]

    async with await ros.advertise_action("/count", FIBONACCI, count):
        await fake.wait_for_op("subscribe", topic="/count/goal")
        for number in range(20):  # they end one by one
            await fake.publish("/count/goal", {"goal_id": {"id": f"{number}"}, "goal": {"order": 5}})
            await fake.wait_for_op("publish", topic="/count/result", count=number + 1)
        for number in range(20, 40):  # the first three wait, the others are refused
            await fake.publish("/count/goal", {"goal_id": {"id": f"{number}"}, "goal": {"order": 2}})
        await fake.wait_for_op("publish", topic="/count/result", count=37)
        async with asyncio.timeout(PATIENCE):
            while len(lists()[-1]) != 8:
                await asyncio.sleep(0.05)
        active = [each["goal_id"]["id"] for each in lists()[-1] if each["status"] == 1]
        assert active == ["20", "21", "22"]
        assert max(map(len, lists())) <= 8
