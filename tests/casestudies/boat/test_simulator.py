"""The boat that anybody moves and switches, in this process at a fake server; a step takes longer than any test.

client ─ /boat/set_pose, call_service /boat/... ─▶ fake server ─▶ simulate ─▶ /boat/true_pose, /boat/raw
"""

import asyncio
import contextlib
import json
import math

import pytest
import websockets

from casestudies import topics
from casestudies.boat import simulator
from casestudies.boat.sensors import BEACONS, SENSOR_NAMES, SET_POSE_TOPIC
from casestudies.boat.simulator import SWITCHES, Boat, simulate
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE


def pose(x, y):
    return {"pose": {"position": {"x": x, "y": y}}}


@contextlib.asynccontextmanager
async def simulated(fake, tmp_path, monkeypatch, **options):
    """A simulator that has published its first reading and serves its switches."""
    monkeypatch.setenv("BM_RUN_DIRECTORY", str(tmp_path))
    sailing = asyncio.create_task(simulate(fake.uri, boat=Boat(1, 60), rate=0.001, **options))
    await fake.wait_for_op("publish", topic="/boat/raw")
    await fake.wait_for_op("advertise_service", count=len(SWITCHES))
    await fake.wait_for_op("subscribe", topic=SET_POSE_TOPIC)
    try:
        yield
    finally:
        sailing.cancel()
        await asyncio.gather(sailing, return_exceptions=True)


async def call(fake, service, args):
    async with websockets.connect(fake.uri) as socket:
        await socket.send(json.dumps({"op": "call_service", "service": service, "args": args}))
        return json.loads(await socket.recv())["values"]


async def reading(fake, count):
    """The last of so many readings, and the true position with its stamp."""
    await fake.wait_for_op("publish", topic="/boat/raw", count=count)
    raw, true = fake.ops("publish", topic="/boat/raw")[-1], fake.ops("publish", topic="/boat/true_pose")[-1]
    assert raw["msg"].get("header", true["msg"]["header"]) == true["msg"]["header"]
    position = true["msg"]["pose"]["position"]
    return raw["msg"], (position["x"], position["y"])


async def test_a_pose_and_a_switch_show_at_once(tmp_path, monkeypatch):
    async with FakeRosbridge(rosapi=True) as fake, simulated(fake, tmp_path, monkeypatch):
        await fake.publish(SET_POSE_TOPIC, pose(20.0, -30.0))
        assert (await reading(fake, 2))[1] == (20.0, -30.0)
        answers = [await call(fake, "/boat/noise", {"data": False})]
        exact = (await reading(fake, 3))[0]
        answers.append(await call(fake, "/boat/D1/plugged", {"data": False}))
        unplugged = (await reading(fake, 4))[0]
        assert (await call(fake, "/boat/sail", {"data": "yes"}))["success"] is False
        answers.append(await call(fake, "/boat/sail", {"data": True}))
        assert (await reading(fake, 5))[1] == (20.0, -30.0)
        (markers,) = fake.ops("publish", topic="/boat/beacons")
        services = {op["service"]: op["type"] for op in fake.ops("advertise_service")}
    assert exact["D3"] == pytest.approx(math.dist((20, -30), BEACONS[2]))
    assert set(unplugged) == {"header", *SENSOR_NAMES} - {"D1"}
    assert answers == [
        {"success": True, "message": text}
        for text in (SWITCHES["noise"][1], SWITCHES["D1/plugged"][1], SWITCHES["sail"][0])
    ]
    assert set(services.values()) == {"std_srvs/srv/SetBool"}
    assert {"/boat/sail", "/boat/beacon3/works", "/boat/B3/plugged"} < set(services)
    found = [
        (each["id"], each["text"], each["type"], each["pose"]["position"]["x"], each["pose"]["position"]["y"])
        for each in markers["msg"]["markers"]
    ]
    assert found == [(number, f"beacon{number}", 2, *at) for number, at in enumerate(BEACONS, 1)]


async def test_changes_right_after_a_reading_wait(tmp_path, monkeypatch):
    monkeypatch.setattr(simulator, "_SHORTEST", 1e6)
    async with FakeRosbridge(rosapi=True) as fake, simulated(fake, tmp_path, monkeypatch):
        await fake.publish(SET_POSE_TOPIC, pose(20.0, -30.0))
        for on in (False, True, False):  # each answer comes after a reading that the one before caused
            await call(fake, "/boat/noise", {"data": on})
        assert len(fake.ops("publish", topic="/boat/raw")) == 1


async def test_an_unplugged_sensor_is_null_in_an_array(tmp_path, monkeypatch):
    async with FakeRosbridge(rosapi=True) as fake, simulated(fake, tmp_path, monkeypatch, array=True):
        await call(fake, "/boat/B1/plugged", {"data": False})
        data = (await reading(fake, 2))[0]["data"]
    assert [value is None for value in data] == [False] * 3 + [True] + [False] * 2


async def test_hostile_poses_are_refused_with_a_line_for_each_coordinate(tmp_path, monkeypatch, capsys):
    async with FakeRosbridge() as fake, simulated(fake, tmp_path, monkeypatch):
        said = ""
        async with asyncio.timeout(PATIENCE):
            await fake.publish(SET_POSE_TOPIC, pose(1, "\x1b[31m"))
            while SET_POSE_TOPIC not in said:
                await asyncio.sleep(0.01)
                said += capsys.readouterr().err
        for bad in ({}, {"pose": 5}, pose("1", 2), pose(None, 2), pose(1, True)) * 5:
            await fake.publish(SET_POSE_TOPIC, bad)
        await fake.publish(SET_POSE_TOPIC, pose(-1000, 3.5))
        assert (await reading(fake, 2))[1] == (-50.0, 3.5)
    said += capsys.readouterr().err
    assert said.count("warning: ") <= 2
    assert "\x1b" not in said


@pytest.mark.parametrize(
    ("known", "status", "warnings"),
    [
        ({"type": ""}, False, 1),
        ({"type": "std_srvs/srv/SetBool"}, True, 0),
        ("no rosapi", True, 1),
        ("no rosapi", False, 0),
    ],
)
async def test_a_server_without_std_srvs_is_reported(known, status, warnings, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(topics, "SETTLED_S", 0)
    asked = asyncio.Event()
    async with FakeRosbridge(rosapi=True) as fake:

        def details(_args):  # asked for when the first service is advertised
            if status:
                told.append(asyncio.create_task(fake.say('{"op": "status", "level": "error", "msg": "no"}')))
            return "unknown"

        told = []
        fake.serve("/rosapi/service_response_details", details)
        fake.serve("/rosapi/service_type", lambda _args: asked.set() or known)
        async with simulated(fake, tmp_path, monkeypatch):
            await asked.wait()
            await fake.publish(SET_POSE_TOPIC, pose(1, 2))
            await reading(fake, 2)
        await asyncio.gather(*told)
    assert capsys.readouterr().err.count("std_srvs/SetBool") == warnings
