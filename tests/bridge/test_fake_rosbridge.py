"""The fake works with an independent client, as a double of real servers must."""

import asyncio
import json
import time

import pytest
import roslibpy
from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as raw_connect

from bridge.client import connect
from tests.fake_rosbridge import SERVER, FakeRosbridge
from tests.patience import PATIENCE


def speak_roslibpy(port: int) -> dict[str, object]:
    """All that the fake offers, as roslibpy sees it (which blocks, so: in a thread)."""
    ros = roslibpy.Ros("127.0.0.1", port)
    ros.run(timeout=PATIENCE)
    try:
        got: list[object] = []
        roslibpy.Topic(ros, "/chatter", "std_msgs/String").subscribe(got.append)
        talker = roslibpy.Topic(ros, "/chatter", "std_msgs/String")
        talker.advertise()
        end = time.monotonic() + PATIENCE
        while not got and time.monotonic() < end:
            talker.publish({"data": "hello"})
            time.sleep(0.05)
        echo = roslibpy.Service(ros, "/echo", "p/Echo")
        answer = echo.call(roslibpy.ServiceRequest({"n": 1}), timeout=PATIENCE)
        return {
            "got": got[0],
            "topics": ros.get_topics(),
            "type": ros.get_topic_type("/chatter"),
            "answer": dict(answer),
        }
    finally:
        ros.terminate()


@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_roslibpy_gets_along_with_the_fake_and_with_our_client():
    async with FakeRosbridge(rosapi=True) as fake, connect(fake.uri) as ros:
        fake.serve("/echo", lambda args: args)
        ours = ros.subscribe("/chatter", "std_msgs/msg/String")
        seen = await asyncio.to_thread(speak_roslibpy, fake.port)
        assert seen == {
            "got": {"data": "hello"},
            "topics": ["/chatter", "/rosout"],
            "type": "std_msgs/String",
            "answer": {"n": 1},
        }
        assert (await ours.next(PATIENCE)).msg == {"data": "hello"}


async def hear(client: ClientConnection) -> object:
    return json.loads(await asyncio.wait_for(client.recv(), PATIENCE))


async def test_errors_are_silent_or_reported():
    bad = json.dumps({"op": "nonsense"})
    async with FakeRosbridge() as fake, raw_connect(fake.uri) as client:
        await client.send(bad)
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(client.recv(), 0.1)
        fake.statuses = True
        await client.send(bad)
        assert await hear(client) == {"op": "status", "level": "error", "msg": "unknown operation 'nonsense'"}


@pytest.mark.parametrize("zombies", [False, True])
async def test_a_zombie_serves_nothing_more(zombies):
    async with FakeRosbridge(zombies=zombies) as fake, raw_connect(fake.uri) as client:
        await client.send("{")
        await client.send("[1]")
        await client.send(json.dumps({"op": "call_service", "service": "/x", "id": "1"}))
        if zombies:
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(client.recv(), 0.1)
            await asyncio.wait_for(await client.ping(), PATIENCE)
        else:
            await hear(client)
        assert [received.op is None for received in fake.received] == [True, True, False]


async def test_two_ids_bring_the_first_message_twice_and_throttling_drops():
    async with FakeRosbridge() as fake, raw_connect(fake.uri) as client:
        for number in ("1", "2"):
            subscribe = {"op": "subscribe", "topic": "/a", "type": "p/T", "id": number, "throttle_rate": 0}
            await client.send(json.dumps(subscribe))
        await fake.wait_for_op("subscribe", count=2)
        for n in range(3):
            await fake.publish("/a", {"n": n})
        heard = [await hear(client) for _ in range(4)]
        assert [message["msg"]["n"] for message in heard] == [0, 0, 1, 2]
        for number in ("1", "2"):
            await client.send(json.dumps(subscribe | {"id": number, "throttle_rate": 60_000}))
        await fake.wait_for_op("subscribe", count=4)
        assert await fake.publish("/a", {"n": 3}) == 0


async def test_unadvertised_topics_are_not_relayed_and_null_can_be_refused():
    async with FakeRosbridge(refuses_null=True) as fake, raw_connect(fake.uri) as client:
        assert client.response is not None
        assert client.response.headers["Server"] == SERVER
        fake.latch("/map", {"n": 1})
        for operation in (
            {"op": "subscribe", "topic": "/map", "type": "p/T"},
            {"op": "subscribe", "topic": "/a", "type": "p/T"},
            {"op": "publish", "topic": "/a", "msg": {"n": 0}},
            {"op": "advertise", "topic": "/a", "type": "p/T"},
            {"op": "publish", "topic": "/a", "msg": {"n": None}},
            {"op": "publish", "topic": "/a", "msg": {"n": 1}},
        ):
            await client.send(json.dumps(operation))
        for topic in ("/map", "/a"):
            assert await hear(client) == {"op": "publish", "topic": topic, "msg": {"n": 1}}
