"""Messages that are too large, in both directions, cost only their own topic."""

import asyncio
import contextlib

import pytest

from bridge.client import State, connect
from bridge.client.protocol.wire import SMALLEST_LIMIT
from bridge.errors import DisconnectedError, EncodeError, MessageTooLargeError, TopicLeftOutError
from bridge.hub.limits import HubLimits
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE

LIMIT = 4000
LARGE = {"data": "x" * 2 * LIMIT}


class Unnamed(FakeRosbridge):
    """A server that writes the message before its topic, so that the beginning does not tell."""

    async def _say(self, client, data):
        if isinstance(data, dict) and data["op"] == "publish":
            data = {"op": "publish", "msg": data["msg"], "topic": data["topic"]}
        await super()._say(client, data)


@contextlib.asynccontextmanager
async def publishing(fake, messages):
    """Publish these again and again."""

    async def play():
        while True:
            for topic, message in messages.items():
                await fake.publish(topic, message)
            await asyncio.sleep(0.02)

    task = asyncio.create_task(play())
    try:
        yield
    finally:
        task.cancel()


async def test_the_topic_that_ends_the_connection_is_left_out_and_others_go_on(fake):
    async with connect(fake.uri, max_size=LIMIT) as ros:
        a, camera, silent = (
            ros.subscribe(name, "p/T", queue_size=1) for name in ("/a", "/camera", "/silent")
        )
        async with publishing(fake, {"/a": {"n": 1}, "/camera": LARGE}):
            with pytest.raises(TopicLeftOutError, match=rf"/camera .* {LIMIT} bytes"):
                await camera.next(PATIENCE)
            await ros.wait_for_state(State.CONNECTED, PATIENCE)
            for _ in range(20):
                assert (await a.next(PATIENCE)).msg == {"n": 1}
        await fake.publish("/silent", {"n": 3})
        assert (await silent.next(PATIENCE)).msg == {"n": 3}
        assert (fake.connections, len(fake.ops("subscribe", topic="/camera"))) == (2, 1)
        # a second subscription does not change it, and the first one after all are closed tries again
        second = ros.subscribe("/camera", "p/T")
        with pytest.raises(TopicLeftOutError):
            await anext(second)
        await camera.close()
        await second.close()
        async with publishing(fake, {"/camera": {"n": 4}}):
            assert (await ros.subscribe("/camera", "p/T").next(PATIENCE)).msg == {"n": 4}


async def test_a_message_that_does_not_name_its_topic_leaves_none_out_and_the_largest_is_named():
    async with Unnamed() as fake, connect(fake.uri, max_size=LIMIT) as ros:
        small, camera = ros.subscribe("/small", "p/T"), ros.subscribe("/camera", "p/T")
        await fake.wait_for_op("subscribe", topic="/camera")
        for topic, subscription in (("/camera", camera), ("/small", small)):
            for size in (1, 1000 if topic == "/camera" else 2):  # the second one has a known envelope
                await fake.publish(topic, {"data": "x" * size})
                await subscription.next(PATIENCE)
        await fake.publish("/camera", LARGE)
        await ros.wait_for_state(State.RECONNECTING, PATIENCE)
        assert f"{LIMIT} bytes" in ros.last_error
        assert "/camera" in ros.last_error
        await fake.wait_for_op("subscribe", topic="/camera", count=2)
        await fake.publish("/camera", {"n": 1})
        assert (await camera.next(PATIENCE)).msg == {"n": 1}


@pytest.mark.parametrize("what", ["a frame of an impossible length", "an answer that is too large"])
async def test_what_is_too_large_and_no_message_leaves_no_topic_out(fake, what):
    fake.serve("/large", lambda _args: LARGE)
    async with connect(fake.uri, max_size=LIMIT) as ros:
        subscription = ros.subscribe("/a", "p/T")
        for number in range(1, 4):
            await fake.wait_for_op("subscribe", topic="/a", count=number)
            if what == "an answer that is too large":
                with contextlib.suppress(DisconnectedError):
                    await ros.call("/large", timeout=PATIENCE)
            for client in fake._clients if what == "a frame of an impossible length" else ():
                client.connection.transport.write(b"\x81\x7f" + b"\xff" * 8)
            while ros.reconnections < number:
                await asyncio.sleep(0.01)
        await fake.wait_for_op("subscribe", topic="/a", count=4)
        await fake.publish("/a", {"n": 1})
        assert (await subscription.next(PATIENCE)).msg == {"n": 1}


async def test_messages_above_the_limit_of_their_topic_are_discarded_and_counted(fake):
    async with connect(fake.uri) as ros:
        large = ros.subscribe("/large", "p/T", max_bytes=LIMIT)
        small = ros.subscribe("/small", "p/T")
        await fake.wait_for_op("subscribe", topic="/small")
        for n in range(3):
            await fake.publish("/large", LARGE)
            await fake.publish("/large", {"n": n})
        await fake.publish("/small", LARGE)
        assert [(await large.next(PATIENCE)).msg for _ in range(3)] == [{"n": n} for n in range(3)]
        assert (await small.next(PATIENCE)).msg == LARGE
        assert (large.discarded, small.discarded, ros.reconnections) == (3, 0, 0)


async def publishes_in_vain(ros, topic, size):
    publication = await ros.advertise(topic, "std_msgs/String")
    with pytest.raises(MessageTooLargeError):
        await publication.publish({"data": "x" * size})


@pytest.mark.parametrize(
    "hub", [{"ros_version": 1, "limits": HubLimits(message_bytes=LIMIT)}], indirect=True, ids=["small"]
)
async def test_the_limit_of_the_hub_is_known_at_once(hub):
    async with connect(hub) as ros:
        await publishes_in_vain(ros, "/large", LIMIT)
        with pytest.raises(EncodeError):
            await ros.call("/rosapi/topic_type", {"topic": "x" * LIMIT})
        assert (await ros.topic_type("/large"), ros.reconnections) == ("std_msgs/String", 0)


@pytest.mark.parametrize("fake", [{"max_size": LIMIT}], indirect=True)
@pytest.mark.parametrize("latch", [True, False])
async def test_the_limit_of_another_server_is_learnt_from_one_loss(fake, latch):
    async with connect(fake.uri) as ros:
        subscription = ros.subscribe("/a", "p/T")
        publication = await ros.advertise("/large", "std_msgs/String", latch=latch)
        await publication.publish({"data": "x" * 2 * LIMIT})
        await ros.wait_for_state(State.RECONNECTING, PATIENCE)
        await ros.wait_for_state(State.CONNECTED, PATIENCE)
        for size in (2 * LIMIT, 3 * LIMIT):
            await publishes_in_vain(ros, "/other", size)
        await publication.publish({"data": "small"})
        await fake.wait_for_op("publish", topic="/large", msg={"data": "small"})
        async with publishing(fake, {"/a": {"n": 1}}):
            assert (await subscription.next(PATIENCE)).msg == {"n": 1}
        assert ros.reconnections == 1


async def test_a_server_that_takes_nothing_at_all_is_not_believed(fake):
    async with connect(fake.uri) as ros:
        publication = await ros.advertise("/a", "p/T")
        await fake.wait_for_op("advertise")
        await fake.hang_up(1009)
        await ros.wait_for_state(State.RECONNECTING, PATIENCE)
        await ros.wait_for_state(State.CONNECTED, PATIENCE)
        await publication.publish({"data": "x" * (SMALLEST_LIMIT - 100)})
        await fake.wait_for_op("publish")
