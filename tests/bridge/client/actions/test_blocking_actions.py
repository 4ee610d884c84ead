"""Actions of the blocking client: handlers on threads, and goals to them, over both versions of ROS."""

import asyncio
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from bridge.client.blocking import BlockingGoalRequest, BlockingRos, connect
from bridge.client.protocol.actions import MAX_SERVED_GOALS
from bridge.client.protocol.events import GoalStatus
from bridge.errors import BridgeError, DisconnectedError, EncodeError, GoalError, SlowPeerError
from tests.bridge.client.actions.counting import FIBONACCI
from tests.bridge.hub.sockets import running_hub
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE


async def with_two_clients(version: int, program: Callable[[BlockingRos, BlockingRos], Any]) -> None:
    """Run a blocking program with two clients of a hub."""

    def run(uri: str) -> None:
        with connect(uri) as server, connect(uri) as ros:
            program(server, ros)

    async with running_hub(ros_version=version) as port:
        await asyncio.wait_for(asyncio.to_thread(run, f"ws://127.0.0.1:{port}"), PATIENCE)


def count(goal: BlockingGoalRequest) -> dict[str, Any] | None:
    """Count to the order of the goal, and end it in the way that its order says."""
    order = goal.values["order"]
    assert threading.current_thread().daemon
    with pytest.raises(EncodeError):
        goal.feed_back({"sequence": [float("nan")]})
    goal.feed_back({"sequence": [0, 1]})
    if order == 1:
        goal.abort({"sequence": [1]})
        goal.feed_back({"sequence": [9]})  # too late
    if order == 5:
        assert not goal.wait_canceling(0.01)
    if order == 2:
        assert goal.wait_canceling(PATIENCE)
        return {"sequence": [2]}
    if order == 3:
        raise RuntimeError("a bug")
    if order == 7:
        sys.exit("of the handler")
    if order == 8:
        return {"sequence": [float("nan")]}
    if order == 4:
        goal.cancel({"sequence": [4]})
    if order == 6:
        goal.succeed({"sequence": [6]})
    return {"sequence": list(range(order))}


@pytest.mark.parametrize("version", [1, 2])
async def test_a_goal_is_executed_on_a_thread(version):
    def program(server: BlockingRos, ros: BlockingRos) -> None:
        with server.advertise_action("/count", FIBONACCI, count) as action:
            assert action.name == "/count"
            server.call("/rosapi/get_time", timeout=PATIENCE)
            for order, status, sequence in (
                (5, GoalStatus.SUCCEEDED, [0, 1, 2, 3, 4]),
                (1, GoalStatus.ABORTED, [1]),
                (2, GoalStatus.CANCELED, [2]),
                (4, GoalStatus.CANCELED, [4]),
                (6, GoalStatus.SUCCEEDED, [6]),
            ):
                with ros.send_goal("/count", FIBONACCI, {"order": order}, timeout=PATIENCE) as goal:
                    assert next(goal) == {"sequence": [0, 1]}
                    if order == 2:
                        goal.cancel()
                    result = goal.result(PATIENCE)
                    assert (result.status, result.values) == (status, {"sequence": sequence})
                    assert list(goal) == []
            for order in (3, 7, 8):  # an error, an exit, and a result that cannot be sent
                with ros.send_goal("/count", FIBONACCI, {"order": order}, timeout=PATIENCE) as goal:
                    if version == 1:
                        result = goal.result(PATIENCE)
                        assert result.status is GoalStatus.ABORTED
                        assert result.text
                    else:
                        with pytest.raises(GoalError):
                            goal.result(PATIENCE)
        with (
            ros.send_goal("/count", FIBONACCI, {"order": 5}, timeout=PATIENCE) as goal,
            pytest.raises(GoalError),
        ):
            goal.result(PATIENCE)

    await with_two_clients(version, program)


@pytest.mark.parametrize("version", [1, 2])
async def test_closing_tells_a_handler_that_nobody_waits(version):
    def program(server: BlockingRos, ros: BlockingRos) -> None:
        started, told, closed, refused = (threading.Event() for _ in range(4))

        def wait(goal: BlockingGoalRequest) -> None:
            started.set()
            deadline = time.monotonic() + PATIENCE
            while not goal.canceling and time.monotonic() < deadline:
                time.sleep(0.01)
            if goal.canceling:
                told.set()
            closed.wait(PATIENCE)
            with pytest.raises(DisconnectedError):
                goal.wait_canceling(PATIENCE)
            refused.set()

        server.advertise_action("/wait", FIBONACCI, wait)
        server.call("/rosapi/get_time", timeout=PATIENCE)
        ros.send_goal("/wait", FIBONACCI, {"order": 2})
        assert started.wait(PATIENCE)
        server.close()
        closed.set()
        assert told.wait(PATIENCE)
        assert refused.wait(PATIENCE)

    await with_two_clients(version, program)


async def test_a_lost_connection_tells_a_handler_that_nobody_waits():
    started, told = threading.Event(), threading.Event()

    def wait(goal: BlockingGoalRequest) -> None:
        started.set()
        if goal.wait_canceling(PATIENCE):
            told.set()

    def run(uri: str) -> None:
        with connect(uri) as ros:
            ros.advertise_action("/wait", "p/action/Wait", wait)
            assert told.wait(PATIENCE)

    async with FakeRosbridge() as fake:
        running = asyncio.create_task(asyncio.to_thread(run, fake.uri))
        await fake.wait_for_op("advertise_action")
        await fake.say({"op": "send_action_goal", "id": "1", "action": "/wait", "args": {}})
        assert await asyncio.to_thread(started.wait, PATIENCE)
        await fake.cut()
        await asyncio.wait_for(running, PATIENCE)


async def test_threads_that_go_on_after_the_end_of_their_goals_are_limited():
    def program(server: BlockingRos, ros: BlockingRos) -> None:
        release = threading.Event()

        def linger(goal: BlockingGoalRequest) -> None:
            goal.succeed()
            release.wait(PATIENCE)

        with server.advertise_action("/linger", "p/action/Linger", linger):
            server.call("/rosapi/get_time", timeout=PATIENCE)
            for _ in range(MAX_SERVED_GOALS):
                assert (
                    ros.send_goal("/linger", "p/action/Linger").result(PATIENCE).status
                    is GoalStatus.SUCCEEDED
                )
            with pytest.raises(GoalError):
                ros.send_goal("/linger", "p/action/Linger").result(PATIENCE)
            release.set()

    await with_two_clients(2, program)


async def test_publishing_without_waiting():
    def program(server: BlockingRos, ros: BlockingRos) -> None:
        words = server.subscribe("/words", "std_msgs/String", timeout=PATIENCE)
        publication = ros.advertise("/words", "std_msgs/String")
        publication.publish_nowait({"data": "a"})
        assert next(words).msg["data"] == "a"
        publication._async._session.must_wait = lambda: True  # as behind a slow server
        with pytest.raises(SlowPeerError):
            publication.publish_nowait({"data": "b"})
        ros.close()
        with pytest.raises(BridgeError):
            publication.publish_nowait({"data": "c"})

    await with_two_clients(2, program)
