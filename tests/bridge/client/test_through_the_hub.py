"""Every form of delivery and the actions, through a server that has them: the hub.

Ros ◀──WebSocket──▶ hub ◀──WebSocket──▶ another Ros, or a plain socket that works on goals
"""

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest
from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as plain_connect

from bridge.client import Ros, State, connect
from bridge.client.actions import FEEDBACK_QUEUE_SIZE
from bridge.client.protocol.events import GoalFeedback, GoalStatus
from bridge.errors import (
    ConcurrentReadError,
    DisconnectedError,
    GoalError,
    NoAnswerError,
)
from bridge.qos import Qos
from tests.bridge.hub.sockets import running_hub
from tests.patience import PATIENCE

SCAN = {
    "header": {"frame_id": "laser"},
    "angle_min": -1.5,
    "ranges": np.array([0.5, 1.5, 2.5], np.float32),
    "intensities": [],
}


@pytest.fixture
async def uri() -> AsyncIterator[str]:
    async with running_hub(ros_version=2) as port:
        yield f"ws://127.0.0.1:{port}"


@pytest.fixture
async def one(uri: str) -> AsyncIterator[Ros]:
    async with connect(uri) as one:
        yield one


@pytest.fixture
async def other(uri: str) -> AsyncIterator[Ros]:
    async with connect(uri, fragment_size=64) as other:
        yield other


async def settled(ros: Ros) -> None:
    await ros.call("/rosapi/get_time", timeout=PATIENCE)


@pytest.mark.parametrize("compression", ["none", "png", "cbor"])
@pytest.mark.parametrize("fragment_size", [None, 50])
@pytest.mark.parametrize("arrays", ["list", "numpy"])
async def test_a_scan_arrives_unchanged(one, other, compression, fragment_size, arrays):
    scans = one.subscribe(
        "/scan",
        "sensor_msgs/LaserScan",
        compression=compression,
        fragment_size=fragment_size,
        arrays=arrays,
        qos=Qos(reliability="best_effort"),
    )
    await settled(one)
    publication = await other.advertise("/scan", "sensor_msgs/LaserScan", qos=Qos(depth=5))
    await publication.publish(SCAN)
    msg = (await scans.next(PATIENCE)).msg
    assert (msg["header"]["frame_id"], msg["angle_min"]) == ("laser", -1.5)
    assert isinstance(msg["ranges"], np.ndarray if arrays == "numpy" else list)
    assert list(msg["ranges"]) == [0.5, 1.5, 2.5]
    if arrays == "numpy" and compression == "cbor":
        assert msg["ranges"].dtype == np.float32


class ActionServer:
    """Works on goals as the test tells it."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket

    async def say(self, **operation: Any) -> None:
        await self.socket.send(json.dumps(operation))

    async def end(self, goal: dict[str, Any], *, status: int, values: Any = None) -> None:
        answer = {"id": goal["id"], "action": "/fly", "values": values or {}, "status": status}
        await self.say(op="action_result", result=True, **answer)

    async def hear(self, op: str) -> dict[str, Any]:
        async with asyncio.timeout(PATIENCE):
            while True:
                operation: dict[str, Any] = json.loads(await self.socket.recv())
                if operation["op"] == op:
                    return operation


@pytest.fixture
async def server(uri: str) -> AsyncIterator[ActionServer]:
    async with plain_connect(uri) as socket:
        server = ActionServer(socket)
        await server.say(op="advertise_action", action="/fly", type="boat_msgs/action/Fly")
        await server.say(op="call_service", service="/rosapi/get_time", id="x")
        await server.hear("service_response")
        yield server


async def test_a_goal_with_feedback_and_result(one, server):
    async with await one.send_goal("/fly", "boat_msgs/Fly", {"to": np.array([1.5, 2.5])}) as goal:
        asked = await server.hear("send_action_goal")
        assert asked["args"] == {"to": [1.5, 2.5]}
        for n in range(3):
            await server.say(op="action_feedback", id=asked["id"], action="/fly", values={"n": n})
        await server.end(asked, status=4, values={"reached": True})
        assert [feedback["n"] async for feedback in goal] == [0, 1, 2]
        for _ in range(2):
            result = await goal.result(timeout=PATIENCE)
            assert (result.status, result.values) == (GoalStatus.SUCCEEDED, {"reached": True})
        assert goal.done


async def test_a_goal_is_cancelled_by_hand_and_by_leaving(one, server):
    goal = await one.send_goal("/fly", "boat_msgs/Fly", feedback=False)
    asked = await server.hear("send_action_goal")
    assert asked.get("feedback", False) is False
    with pytest.raises(NoAnswerError, match="/fly .* did not end within 0.05 s"):
        await goal.result(0.05)
    await goal.cancel()
    cancelled = await server.hear("cancel_action_goal")
    assert cancelled["id"] == asked["id"]
    await server.end(asked, status=5)
    assert (await goal.result(PATIENCE)).status is GoalStatus.CANCELED
    async with await one.send_goal("/fly", "boat_msgs/Fly"):
        asked = await server.hear("send_action_goal")
    assert (await server.hear("cancel_action_goal"))["id"] == asked["id"]
    assert not one._session.goals


async def test_a_goal_that_nobody_takes(one):
    goal = await one.send_goal("/nowhere", "boat_msgs/Fly")
    with pytest.raises(GoalError, match="action /nowhere at ws://.* has no result") as caught:
        await goal.result(PATIENCE)
    assert caught.value.reason
    assert [feedback async for feedback in goal] == []


async def test_feedback_that_nobody_reads_is_bounded(one, server):
    goal = await one.send_goal("/fly", "boat_msgs/Fly")
    asked = await server.hear("send_action_goal")
    for n in range(FEEDBACK_QUEUE_SIZE + 30):
        goal.receive(GoalFeedback(goal._identity, {"n": n}))
    await server.end(asked, status=4)
    await goal.result(PATIENCE)
    read = [feedback["n"] async for feedback in goal]
    assert read == list(range(30, FEEDBACK_QUEUE_SIZE + 30))
    assert goal.lost == 30


async def test_the_server_goes_while_a_goal_is_on_its_way(one, server):
    goal = await one.send_goal("/fly", "boat_msgs/Fly")
    await server.hear("send_action_goal")

    async def read() -> list[Any]:
        return [feedback async for feedback in goal]

    tasks = [asyncio.create_task(read()), asyncio.create_task(goal.result(PATIENCE))]
    await asyncio.sleep(0)
    with pytest.raises(ConcurrentReadError):
        await goal.__anext__()
    one._session._websocket.abort()
    for waiting in (*tasks, goal.result(1)):
        with pytest.raises(DisconnectedError):
            await asyncio.wait_for(waiting, PATIENCE)
    await goal.cancel()
    await one.wait_for_state(State.CONNECTED, PATIENCE)
    another = await one.send_goal("/fly", "boat_msgs/Fly")
    await server.hear("send_action_goal")
    await one.close()
    with pytest.raises(DisconnectedError):
        await another.result(1)
    with pytest.raises(DisconnectedError):
        await one.send_goal("/fly", "boat_msgs/Fly")
