"""Goals that this client sends over the topics of actionlib: to its own server, to roslibpy's, and to faulty ones."""

import asyncio
import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from bridge.client import Ros, connect
from bridge.client.protocol.events import GoalStatus
from bridge.client.protocol.goals import MAX_GOALS
from bridge.errors import (
    DisconnectedError,
    GoalError,
    MessageTypeError,
    NoAnswerError,
    SlowPeerError,
    TypeConflictError,
)
from tests.bridge.client.actions.counting import FIBONACCI, count
from tests.bridge.hub.sockets import running_hub
from tests.patience import PATIENCE, PROCESS_PATIENCE

ANY = "p/Count"
"""A type that the hub does not know."""
ROSLIBPY = Path(__file__).with_name("roslibpy_actionlib.py")


@contextlib.asynccontextmanager
async def two_clients():
    async with running_hub(ros_version=1) as port:
        uri = f"ws://127.0.0.1:{port}"
        async with connect(uri) as server, connect(uri) as ros:
            yield server, ros


@contextlib.asynccontextmanager
async def roslibpy(part: str, uri: str):
    """Run roslibpy's server or client in a process."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, str(ROSLIBPY), part, uri.rpartition(":")[2].rstrip("/")),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "ROSLIBPY_TRANSPORT": "asyncio"},
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


@pytest.mark.parametrize(
    ("order", "status", "sequence"),
    [
        (5, GoalStatus.SUCCEEDED, [0, 1, 2, 3, 4]),
        (1, GoalStatus.ABORTED, [1]),
        (2, GoalStatus.CANCELED, [2]),
    ],
)
@pytest.mark.parametrize(
    "type_name", [FIBONACCI, f"{FIBONACCI}Action", "actionlib_tutorials/action/Fibonacci"]
)
async def test_a_goal_is_fed_back_and_ends(order, status, sequence, type_name):
    async with two_clients() as (server, ros), await server.advertise_action("/count", type_name, count):
        await ros.detect_ros_version()
        async with await ros.send_goal("/count", type_name, {"order": order}) as goal:
            assert await anext(goal) == {"sequence": [0, 1]}
            if order == 2:
                await goal.cancel()
            result = await goal.result(PATIENCE)
            assert (result.status, result.values) == (status, {"sequence": sequence})
            assert [feedback async for feedback in goal] == []


async def test_goals_at_the_same_time_do_not_get_the_results_of_each_other():
    async with two_clients() as (server, ros), await server.advertise_action("/count", FIBONACCI, count):
        goals = [await ros.send_goal("/count", FIBONACCI, {"order": order}) for order in (4, 5, 2, 6)]
        assert len((await goals[0].result(PATIENCE)).values["sequence"]) == 4
        assert len((await goals[3].result(PATIENCE)).values["sequence"]) == 6
        assert not goals[2].done
        async with goals[2]:  # which cancels it
            await anext(goals[2])
        silent = await ros.send_goal("/count", FIBONACCI, {"order": 5}, feedback=False)
        assert [feedback async for feedback in silent] == []


async def test_a_failure_of_the_handler_comes_with_its_text():
    async with two_clients() as (server, ros), await server.advertise_action("/count", FIBONACCI, count):
        result = await (await ros.send_goal("/count", FIBONACCI, {"order": 3})).result(PATIENCE)
        assert (result.status, result.values.get("sequence", [])) == (GoalStatus.ABORTED, [])
        assert "RuntimeError" in result.text


async def test_an_action_that_nobody_serves_is_an_error_at_once():
    async with two_clients() as (_server, ros):
        goal = await asyncio.wait_for(ros.send_goal("/nowhere", FIBONACCI, timeout=PATIENCE), PATIENCE / 2)
        assert goal.done
        with pytest.raises(GoalError) as caught:
            await goal.result(PATIENCE)
        assert "/nowhere/goal" in caught.value.reason
        assert [feedback async for feedback in goal] == []


async def test_a_subscriber_without_a_status_is_not_a_server():
    async with two_clients() as (server, ros), server.subscribe("/count/goal", f"{FIBONACCI}ActionGoal"):
        await server.call("/rosapi/get_time")
        goal = await ros.send_goal("/count", FIBONACCI, timeout=0.3)
        with pytest.raises(GoalError) as caught:
            await goal.result(PATIENCE)
        assert "/count/status" in caught.value.reason


class Robot:
    """A server whose messages the test chooses."""

    def __init__(self, ros: Ros) -> None:
        self._ros = ros

    async def start(self) -> None:
        """Advertise and subscribe."""
        self.goals = self._ros.subscribe("/count/goal", f"{ANY}ActionGoal")
        self.cancels = self._ros.subscribe("/count/cancel", "actionlib_msgs/GoalID")
        self._status = await self._ros.advertise(
            "/count/status", "actionlib_msgs/GoalStatusArray", latch=True
        )
        self.results = await self._ros.advertise("/count/result", f"{ANY}ActionResult")
        self.feedback = await self._ros.advertise("/count/feedback", f"{ANY}ActionFeedback")
        await self.list()

    async def list(self, **statuses: int) -> None:
        """Publish the statuses of goals."""
        listed = [{"goal_id": {"id": goal}, "status": status} for goal, status in statuses.items()]
        await self._status.publish({"status_list": listed})


@contextlib.asynccontextmanager
async def with_a_robot():
    async with two_clients() as (server, ros):
        robot = Robot(server)
        await robot.start()
        goal = await ros.send_goal("/count", ANY, {"order": 5}, timeout=PATIENCE)
        message = (await robot.goals.next(PATIENCE)).msg
        assert message["goal"] == {"order": 5}
        assert message["goal_id"]["stamp"]["secs"] > 0
        yield robot, goal, message["goal_id"]["id"]


async def test_a_goal_that_the_server_no_longer_lists_is_lost():
    async with with_a_robot() as (robot, goal, identity):
        await robot.list(another=1)
        with pytest.raises(NoAnswerError):
            await goal.result(0.1)  # it may not have it yet
        await robot.list(**{identity: 1})
        await robot.list(another=1)
        with pytest.raises(GoalError):
            await goal.result(PATIENCE)


@pytest.mark.parametrize(("status", "end"), [(5, None), (9, None), (8, GoalStatus.CANCELED)])
async def test_other_ends_of_goals(status, end):
    async with with_a_robot() as (robot, goal, identity):
        await robot.list(**{identity: status})
        await robot.list()
        await robot.feedback.publish({"status": {"goal_id": {"id": "another"}}, "feedback": {}})
        await robot.feedback.publish({"status": [], "feedback": {"sequence": [7]}})
        await robot.results.publish({"status": {"goal_id": {"id": [identity]}, "status": "3"}})
        await robot.results.publish({"status": {"goal_id": {"id": identity}, "status": status, "text": "no"}})
        if end is None:
            with pytest.raises(GoalError) as caught:
                await goal.result(PATIENCE)
            assert caught.value.reason == "no"
        else:
            assert (await goal.result(PATIENCE)).status is end


async def test_cancelling_names_the_goal():
    async with with_a_robot() as (robot, goal, identity):
        await goal.cancel()
        message = (await robot.cancels.next(PATIENCE)).msg
        assert (message["id"], message["stamp"]) == (identity, {"secs": 0, "nsecs": 0})


async def test_a_lost_connection_ends_goals_and_later_ones_wait_for_a_status(fake):
    async with connect(fake.uri, ros_version="1") as ros:

        async def live() -> None:
            while True:
                await fake.publish("/count/status", {"status_list": []})
                await asyncio.sleep(0.02)

        living = asyncio.create_task(live())
        goal = await ros.send_goal("/count", FIBONACCI, timeout=PATIENCE)
        living.cancel()
        await fake.cut()
        with pytest.raises(DisconnectedError):
            await goal.result(PATIENCE)
        with pytest.raises(DisconnectedError):
            await anext(goal)
        await goal.cancel()
        async with asyncio.timeout(PATIENCE):
            while ros.reconnections == 0:
                await asyncio.sleep(0.02)
        unserved = await ros.send_goal("/count", FIBONACCI, timeout=0.2)
        assert unserved.done


def typedef(name: str, **fields: str) -> dict[str, Any]:
    """Return a definition as rosapi does."""
    lengths = [-1] * len(fields)
    return {
        "type": name,
        "fieldnames": [*fields],
        "fieldtypes": [*fields.values()],
        "fieldarraylen": lengths,
    }


async def test_wrong_goals_are_errors_and_leave_nothing(fake):
    goal_type = typedef("p/CountActionGoal", header="std_msgs/Header", goal_id="g/Id", goal="p/CountGoal")
    definitions = {"typedefs": [goal_type, typedef("p/CountGoal", order="int32")]}
    fake.serve(
        "/rosapi/message_details",
        lambda args: definitions if args["type"] == goal_type["type"] else "unknown",
    )
    async with connect(fake.uri, ros_version="1") as ros:
        sending = asyncio.create_task(ros.send_goal("/count", "p/Count", {"ordre": 1}, timeout=PATIENCE))
        await fake.wait_for_op("subscribe", topic="/count/status")
        await fake.publish("/count/status", {"status_list": "none"})
        with pytest.raises(MessageTypeError):
            await sending
        goals = [await ros.send_goal("/count", "p/Count", {"order": 1}) for _ in range(MAX_GOALS)]
        with pytest.raises(SlowPeerError):
            await ros.send_goal("/count", "p/Count", {"order": 1})
        with pytest.raises(TypeConflictError):
            await ros.send_goal("/count", "p/Other")
        await goals[0].__aexit__()
        await ros.send_goal("/count", "p/Count", {"order": 1})


@pytest.mark.parametrize(
    ("version", "type_name", "op"),
    [
        ("auto", "p/CountAction", "subscribe"),
        ("auto", "actionlib_tutorials/Fibonacci", "subscribe"),
        ("auto", "p/Count", "send_action_goal"),
        ("auto", "p/action/Count", "send_action_goal"),
        ("2", "p/CountAction", "send_action_goal"),
        ("1", "p/action/Count", "subscribe"),
    ],
)
async def test_the_version_or_else_the_type_decides(fake, version, type_name, op):
    async with connect(fake.uri, ros_version=version) as ros:
        await ros.send_goal("/count", type_name, timeout=0.1)
        await fake.wait_for_op(op)
        other = "subscribe" if op == "send_action_goal" else "send_action_goal"
        assert not fake.ops(other)


@pytest.mark.thorough
async def test_goals_to_the_server_of_roslibpy():
    async with two_clients() as (_server, ros), roslibpy("server", ros.uri) as process:
        assert await asyncio.wait_for(process.stdout.readline(), PROCESS_PATIENCE) == b"serving\n"
        async with asyncio.timeout(PATIENCE):
            while not await ros.subscribers("/count/goal"):
                await asyncio.sleep(0.05)
        async with await ros.send_goal("/count", FIBONACCI, {"order": 5}) as goal:
            assert [feedback async for feedback in goal] == [{"sequence": [0, 1]}]
            result = await goal.result(PATIENCE)
            assert (result.status, result.values) == (GoalStatus.SUCCEEDED, {"sequence": [0, 1, 2, 3, 4]})
        async with await ros.send_goal("/count", FIBONACCI, {"order": 2}) as goal:
            await anext(goal)
            await goal.cancel()
            assert (await goal.result(PATIENCE)).status is GoalStatus.CANCELED


@pytest.mark.thorough
async def test_goals_of_roslibpy_to_this_server():
    async with (
        two_clients() as (server, _ros),
        await server.advertise_action("/count", FIBONACCI, count),
        roslibpy("client", server.uri) as process,
    ):
        out, _errors = await asyncio.wait_for(process.communicate(), PROCESS_PATIENCE)
        found = json.loads(out)
        assert found == {
            "feedback": [{"sequence": [0, 1]}],
            "result": {"sequence": [0, 1, 2, 3, 4]},
            "status": 3,
            "cancelled": {"sequence": [2]},
            "cancelled_status": 2,
        }
