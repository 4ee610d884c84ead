"""roslibpy, the client that most Python users have, on the hub; both of its transports."""

import asyncio
import json
import os
import sys
import time
from pathlib import Path

import pytest

from bridge.client import connect
from tests.bridge.hub.sockets import running_hub
from tests.patience import PROCESS_PATIENCE

_SESSION = Path(__file__).with_name("roslibpy_session.py")
_ACTIONLIB = Path(__file__).with_name("roslibpy_actionlib.py")


@pytest.mark.parametrize(
    "transport",
    [pytest.param("twisted", marks=pytest.mark.thorough), pytest.param("asyncio", marks=pytest.mark.process)],
)
@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_a_session_of_roslibpy(transport):
    before = int(time.time())
    async with running_hub() as port:
        session = await asyncio.create_subprocess_exec(
            sys.executable,
            str(_SESSION),
            str(port),
            env={**os.environ, "ROSLIBPY_TRANSPORT": transport},
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            output, complaints = await asyncio.wait_for(session.communicate(), PROCESS_PATIENCE)
        finally:
            if session.returncode is None:
                session.kill()
                await session.wait()
    assert session.returncode == 0, complaints.decode()
    found = json.loads(output)
    assert found["topics"] == {
        "messages": [f"hello {index}" for index in range(5)],
        "topics": ["/chatter", "/rosout"],
        "type": "std_msgs/String",
        "for_type": ["/chatter"],
    }
    header = {"seq": 7, "stamp": {"secs": 12, "nsecs": 34}, "frame_id": "map"}
    assert [(message["header"], message["x"]) for message in found["header"]] == [(header, None)] * 2
    services = found["services"]
    assert (services["sum"], services["called_back"]) == (3, 7)
    assert services["type"] == "rospy_tutorials/AddTwoInts"
    assert services["for_type"] == ["/add"]
    assert (
        services["refused"] is None
    )  # the reference server of ROS 1 passes such an answer on, and so does the hub
    assert services["nowhere"] == "Service /nowhere does not exist"
    assert found["parameters"] == {
        "value": {"max": 1.5},
        "names": ["/robot/speed"],
        "deleted": None,
        "names_after": [],
    }
    assert found["graph"]["nodes"] == 3
    assert found["graph"]["rosapi_serves"] > 15
    assert found["graph"]["action_servers"] == {"action_servers": []}
    assert before <= found["graph"]["seconds"] <= time.time()


@pytest.mark.thorough
@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_actionlib_of_roslibpy_on_both_sides():
    async def start(part):
        return await asyncio.create_subprocess_exec(
            *(sys.executable, str(_ACTIONLIB), part, str(port)),
            env={**os.environ, "ROSLIBPY_TRANSPORT": "asyncio"},
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
        )

    async with running_hub(ros_version=1) as port, connect(f"ws://127.0.0.1:{port}") as ros:
        server = await start("server")
        try:
            async with asyncio.timeout(PROCESS_PATIENCE):
                while not await ros.subscribers("/count/goal"):
                    await asyncio.sleep(0.05)
                client = await start("client")
                found = json.loads((await client.communicate())[0])
        finally:
            server.kill()
            await server.communicate()
    assert found == {
        "feedback": [{"sequence": [0, 1]}],
        "result": {"sequence": [0, 1, 2, 3, 4]},
        "status": 3,
        "cancelled": {"sequence": []},
        "cancelled_status": 2,
    }
