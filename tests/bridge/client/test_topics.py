"""Publishing and subscribing through the fake server.

Ros (asyncio or uvloop) ◀──WebSocket──▶ FakeRosbridge (relays, or says what the test wants)
"""

import asyncio
import math
import time
from typing import Any

import numpy as np
import pytest

from bridge import stamps
from bridge.client import Message, connect
from bridge.errors import (
    ConcurrentReadError,
    DisconnectedError,
    EncodeError,
    NameFormError,
    NoMessageError,
    OptionError,
    ServiceError,
    SlowPeerError,
    TypeConflictError,
)
from tests.fake_rosbridge import FakeRosbridge


async def test_a_message_goes_round():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        subscription = ros.subscribe("/a", "std_msgs/Float64MultiArray")
        publication = await ros.advertise("/a", "std_msgs/msg/Float64MultiArray")
        before = time.time_ns(), time.monotonic_ns()
        await publication.publish({"data": np.array([0.5, 1.0])})
        message = await subscription.next(30)
        assert message == Message(
            "/a", {"data": [0.5, 1.0]}, message.received_ns, message.received_monotonic_ns
        )
        assert before[0] <= message.received_ns <= time.time_ns()
        assert before[1] <= message.received_monotonic_ns <= time.monotonic_ns()
        await subscription.close()
        await publication.close()
        await subscription.close()
        await fake.wait_for_op("unsubscribe", topic="/a")
        await fake.wait_for_op("unadvertise", topic="/a")
        with pytest.raises(DisconnectedError, match="/a is not advertised any more"):
            await publication.publish({})


async def test_messages_of_one_moment_leave_in_one_piece():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        subscription = ros.subscribe("/b", "p/T")
        one, two = await ros.advertise("/a", "p/T"), await ros.advertise("/b", "p/T")
        await fake.wait_for_op("advertise", topic="/b")
        transport = ros._session._websocket._transport
        written, write = [], transport.write

        class Noting:
            def __getattr__(self, name):
                return getattr(transport, name)

            def write(self, data):
                written.append(bytes(data))
                write(data)

        ros._session._websocket._transport = Noting()
        with ros.together():
            await one.publish({"n": 1})
            await two.publish({"n": 2})
            assert not written
        assert len(written) == 1
        await two.publish({"n": 3})
        assert len(written) == 2
        assert [(await subscription.next(30)).msg["n"] for _ in range(2)] == [2, 3]
        assert (await fake.wait_for_op("publish", topic="/a"))["msg"] == {"n": 1}


async def test_the_end_in_the_middle_of_such_a_moment():
    async with FakeRosbridge() as fake:
        ros = connect(fake.uri)
        await ros.__aenter__()
        publication = await ros.advertise("/a", "p/T")
        with ros.together():
            await publication.publish({"n": 1})
            await ros.close()
        with ros.together(), pytest.raises(DisconnectedError):
            await publication.publish({"n": 2})


async def test_a_message_that_need_not_wait_does_not():
    async with FakeRosbridge() as fake:
        async with connect(fake.uri) as ros:
            publication = await ros.advertise("/a", "p/T")
            await publication.ready()
            assert not publication.must_wait
            publication.publish_nowait({"n": 1})
            assert (await fake.wait_for_op("publish", topic="/a"))["msg"] == {"n": 1}
            with pytest.raises(EncodeError, match="n is NaN"):
                publication.publish_nowait({"n": math.nan})
            await publication.close()
            with pytest.raises(DisconnectedError, match="/a is not advertised any more"):
                publication.publish_nowait({})
        assert publication.must_wait
        with pytest.raises(DisconnectedError):
            publication.publish_nowait({})


async def test_iteration_ends_with_the_subscription_or_the_client():
    async def read(subscription: Any) -> list[int]:
        return [message.msg["n"] async for message in subscription]

    async with FakeRosbridge() as fake:
        async with connect(fake.uri) as ros:
            one, two = ros.subscribe("/a", "p/T"), ros.subscribe("/a", "p/T")
            readers = [asyncio.create_task(read(subscription)) for subscription in (one, two)]
            await fake.wait_for_op("subscribe")
            await fake.publish("/a", {"n": 1})
            await fake.publish("/a", {"n": 2})
            with pytest.raises(ServiceError):
                await ros.call("/answers/after/the/messages")
            await one.close()
            assert await asyncio.wait_for(readers[0], 120) == [1, 2]
        assert await asyncio.wait_for(readers[1], 120) == [1, 2]
        with pytest.raises(DisconnectedError, match="/a is closed"):
            await two.next(1)


async def test_a_closed_client_gives_nothing_more():
    async with FakeRosbridge() as fake:
        async with connect(fake.uri) as ros:
            publication = await ros.advertise("/a", "p/T")
        with pytest.raises(DisconnectedError, match="was closed"):
            ros.subscribe("/a")
        with pytest.raises(DisconnectedError, match="was closed"):
            await ros.advertise("/b", "p/T")
        with pytest.raises(DisconnectedError, match="was closed"):
            await publication.publish({})


async def test_handles_close_with_their_block():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        async with ros.subscribe("/a", "p/T"), await ros.advertise("/b", "p/T"):
            await fake.wait_for_op("advertise")
        await fake.wait_for_op("unsubscribe", topic="/a")
        await fake.wait_for_op("unadvertise", topic="/b")


async def test_what_was_published_before_the_end_still_goes_out():
    async with FakeRosbridge() as fake:
        async with connect(fake.uri) as ros:
            publication = await ros.advertise("/a", "p/T")
            for n in range(1000):
                await publication.publish({"n": n, "filling": "x" * 500})
        await fake.wait_for_op("publish", count=1000)
        assert [op["msg"]["n"] for op in fake.ops("publish")] == list(range(1000))


async def test_throttle_and_queue_are_asked_of_the_server():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        ros.subscribe("/a", "p/T", throttle_rate=250, queue_length=4)
        op = await fake.wait_for_op("subscribe")
        assert (op["throttle_rate"], op["queue_length"]) == (250, 4)
        assert type(op["throttle_rate"]) is int


@pytest.mark.parametrize(
    "options", [{"throttle_rate": 0.0}, {"throttle_rate": -1}, {"queue_length": 1.5}, {"queue_size": 0}]
)
async def test_wrong_numbers_are_refused(options):
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        with pytest.raises(OptionError, match=next(iter(options))):
            ros.subscribe("/a", "p/T", **options)
        with pytest.raises(OptionError):
            await ros.advertise("/a", "p/T", queue_size=0)
        with pytest.raises(NameFormError):
            ros.subscribe("/a b", "p/T")
        with pytest.raises(NameFormError):
            await ros.advertise("/a", "T")
        ros.subscribe("/a", "p/T")
        with pytest.raises(TypeConflictError):
            ros.subscribe("/a", "p/U")
        await fake.wait_for_op("subscribe")
        assert len(fake.received) == 1


async def test_a_slow_reader_loses_its_own_oldest_messages_and_nobody_elses():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        slow = ros.subscribe("/a", "p/T", queue_size=5)
        fast = ros.subscribe("/a", "p/T", queue_size=100)
        await fake.wait_for_op("subscribe")
        for n in range(50):
            await fake.publish("/a", {"n": n})
        assert [(await fast.next(30)).msg["n"] for _ in range(50)] == list(range(50))
        assert (slow.lost, fast.lost) == (45, 0)
        assert [(await slow.next(30)).msg["n"] for _ in range(5)] == [45, 46, 47, 48, 49]
        await fake.publish("/a", {"n": 50})
        assert (await slow.next(30)).msg["n"] == 50
        assert slow.lost == 45


async def test_two_readers_of_one_subscription_are_told():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        subscription = ros.subscribe("/a", "p/T")
        first = asyncio.create_task(subscription.next(30))
        await asyncio.sleep(0)
        with pytest.raises(ConcurrentReadError, match="/a"):
            await subscription.next(30)
        await fake.wait_for_op("subscribe")
        await fake.publish("/a", {"n": 1})
        assert (await first).msg == {"n": 1}


async def test_a_wait_in_vain_can_be_given_up_and_begun_again():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        subscription = ros.subscribe("/a", "p/T")
        waiting = asyncio.create_task(subscription.next(30))
        await asyncio.sleep(0)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        await fake.wait_for_op("subscribe")
        await fake.publish("/a", {"n": 1})
        assert (await subscription.next(30)).msg == {"n": 1}


async def test_each_wait_ends_at_its_own_time():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros, asyncio.timeout(60):
        subscription = ros.subscribe("/a", "p/T")
        await fake.wait_for_op("subscribe")
        await fake.publish("/a", {"n": 1})
        await subscription.next(1.5)  # its alarm rings in the middle of the next wait
        begun = time.monotonic()
        with pytest.raises(NoMessageError, match="within 2 s"):
            await subscription.next(2)
        assert time.monotonic() - begun >= 2
        await fake.publish("/a", {"n": 2})
        await subscription.next(600)  # its alarm is far away
        with pytest.raises(NoMessageError, match="within 0.1 s"):
            await subscription.next(0.1)
        await fake.publish("/a", {"n": 3})
        await subscription.next(1.5)  # its alarm rings while nobody has a limit
        waiting = asyncio.create_task(anext(subscription))
        await asyncio.sleep(2)
        assert not waiting.done()
        await fake.publish("/a", {"n": 4})
        assert (await waiting).msg == {"n": 4}


async def test_who_may_not_wait_does_not_end_anothers_wait():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros, asyncio.timeout(30):
        subscription = ros.subscribe("/a", "p/T")
        first = asyncio.create_task(subscription.next(0.3))
        await asyncio.sleep(0)
        with pytest.raises(ConcurrentReadError):
            await subscription.next(600)
        with pytest.raises(NoMessageError, match="within 0.3 s"):
            await first


@pytest.mark.parametrize(
    ("rosapi", "prepare", "said"),
    [
        (False, None, ""),
        (True, None, "; the server does not know the topic"),
        (True, "p/U", "; the server knows it as p/U, not as p/T"),
        (True, "p/msg/T", "; nobody publishes it"),
    ],
)
async def test_a_topic_that_nobody_publishes_is_named(rosapi, prepare, said):
    async with FakeRosbridge(rosapi=rosapi) as fake, connect(fake.uri) as ros:
        if prepare:
            fake.know("/quiet", prepare)
        with pytest.raises(NoMessageError) as caught:
            await ros.subscribe("/quiet", "p/T").next(0.1)
        assert str(caught.value) == f"no message of /quiet came from {fake.uri} within 0.1 s{said}"
        assert caught.value.exit_code == 3


async def test_a_wait_is_bounded_even_if_rosapi_says_nothing():
    async with FakeRosbridge(silent=True, rosapi=True) as fake, connect(fake.uri) as ros:
        begun = time.monotonic()
        with pytest.raises(
            NoMessageError, match=r"within 0\.1 s; nor did it answer .*: is it a rosbridge server\?$"
        ):
            await ros.subscribe("/quiet", "p/T").next(0.1)
        assert time.monotonic() - begun < 30


async def test_what_the_server_says_about_it_is_passed_on():
    async with FakeRosbridge(statuses=True) as fake, connect(fake.uri) as ros:
        with pytest.raises(NoMessageError, match="type is required: /a is not known$"):
            await ros.subscribe("/a").next(2)
        assert {status.level for status in ros.statuses} == {"error"}  # it may have been asked again
        # What it said before a wait is not about that wait.
        with pytest.raises(NoMessageError, match=r"within 0\.1 s$"):
            await ros.subscribe("/b", "p/T").next(0.1)


async def test_a_topic_of_unknown_type_is_found_when_it_appears(monkeypatch):
    monkeypatch.setattr("bridge.client.session.UNTYPED_RETRY", 0.05)
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        subscription = ros.subscribe("/late")
        await fake.wait_for_op("subscribe", count=2, topic="/late")
        fake.know("/late", "p/T")
        await fake.wait_for_op("subscribe", count=4, topic="/late")
        await fake.publish("/late", {"n": 1})
        assert (await subscription.next(30)).msg == {"n": 1}
        asked = len(fake.ops("subscribe"))
        await asyncio.sleep(0.3)
        assert len(fake.ops("subscribe")) <= asked + 1, "it is not asked for any more"
        ros.subscribe("/later")
        await fake.wait_for_op("subscribe", count=3, topic="/later")


async def test_what_was_subscribed_before_connecting_is_asked_for_too(monkeypatch):
    monkeypatch.setattr("bridge.client.session.UNTYPED_RETRY", 0.05)
    async with FakeRosbridge() as fake:
        ros = connect(fake.uri)
        subscription = ros.subscribe("/late")
        async with ros:
            await fake.wait_for_op("subscribe", count=2)
            fake.know("/late", "p/T")
            await fake.wait_for_op("subscribe", count=4)
            await fake.publish("/late", {"n": 1})
            assert (await subscription.next(30)).msg == {"n": 1}


async def test_a_nan_is_not_published():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        publication = await ros.advertise("/a", "p/T")
        with pytest.raises(
            EncodeError, match=r"a message of /a cannot be published: scan\.ranges\[1\] is NaN"
        ):
            await publication.publish({"scan": {"ranges": [1.0, math.nan]}})
        await publication.publish({"scan": {"ranges": [1.0, None]}})
        await fake.wait_for_op("publish", msg={"scan": {"ranges": [1.0, None]}})
        assert len(fake.ops("publish")) == 1


async def test_a_tight_loop_of_publications_lets_others_live():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        publication = await ros.advertise("/a", "p/T")
        turns = 0

        async def other() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        task = asyncio.create_task(other())
        await asyncio.sleep(0)
        for _ in range(500):
            await publication.publish({})
        task.cancel()
        assert turns > 10
        await fake.wait_for_op("publish", count=500)


async def test_who_waits_comes_first():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        publication = await ros.advertise("/a", "p/T")
        websocket = ros._session._connected()
        websocket.pause_writing()
        waiting = [asyncio.create_task(publication.publish({"n": n})) for n in range(3)]
        await asyncio.sleep(0)
        websocket.resume_writing()
        await publication.publish({"n": 3})
        await asyncio.gather(*waiting)
        await fake.wait_for_op("publish", count=4)
        assert [op["msg"]["n"] for op in fake.ops("publish")] == [0, 1, 2, 3]


async def test_a_server_that_takes_nothing_more():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        publication = await ros.advertise("/a", "p/T", queue_size=3)
        await fake.wait_for_op("advertise")
        fake.freeze()
        big = {"data": "x" * 500_000}
        sent = 0

        async def flood() -> None:
            nonlocal sent
            for _ in range(200):
                await publication.publish(big, timeout=0.2)
                sent += 1

        with pytest.raises(SlowPeerError, match="/a") as caught:
            await flood()
        assert caught.value.exit_code == 3
        assert 0 < sent < 100, "what waits here is bounded"
        waiting = [asyncio.create_task(publication.publish({"n": n}, timeout=120)) for n in range(4)]
        await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        with pytest.raises(SlowPeerError, match="3 messages of /a wait already"):
            await waiting[3]
        with pytest.raises(SlowPeerError, match="a call of /s"):
            await ros.call("/s", timeout=0.1)
        assert publication.must_wait
        with pytest.raises(SlowPeerError, match="does not keep up: a message of /a would have to wait"):
            publication.publish_nowait({"n": 9})
        with pytest.raises(SlowPeerError, match="/a"):
            await publication.ready(timeout=0.1)
        fake.thaw()
        await asyncio.wait_for(asyncio.gather(*waiting[:3]), 120)
        await fake.wait_for_op("publish", count=sent + 3)
        assert [op["msg"]["n"] for op in fake.ops("publish")[-3:]] == [0, 1, 2], "in their order"


# Servers that are late or wrong


async def test_a_late_server():
    async with FakeRosbridge(delay=0.3) as fake, connect(fake.uri) as ros:
        subscription = ros.subscribe("/a", "p/T")
        await fake.wait_for_op("subscribe")
        await fake.publish("/a", {"n": 1})
        with pytest.raises(NoMessageError):
            await subscription.next(0.05)
        assert (await subscription.next(30)).msg == {"n": 1}


@pytest.mark.parametrize(
    "nonsense",
    [
        "",
        "{",
        "[1, 2]",
        "42",
        "null",
        '"op"',
        '{"op": 5}',
        '{"op": "publish", "topic": "/a", "msg": []}',
        b"\xff\x00",
        '{"op": "png", "data": ""}',
        '{"op":"publish","topic":"/a","msg":' + '{"a":' * 100 + "1" + "}" * 101,
    ],
)
async def test_nonsense_is_counted_and_survived(nonsense):
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        subscription = ros.subscribe("/a", "p/T")
        await fake.wait_for_op("subscribe")
        await fake.say(nonsense)
        await fake.publish("/a", {"n": 1})
        assert (await subscription.next(30)).msg == {"n": 1}
        assert ros.unusable == 1
        assert ros.reconnections == 0


async def test_much_nonsense_does_not_fill_the_log(caplog):
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        subscription = ros.subscribe("/a", "p/T")
        await fake.wait_for_op("subscribe")
        for _ in range(100):
            await fake.say("{")
        await fake.publish("/a", {})
        await subscription.next(30)
        assert ros.unusable == 100
        assert sum(record.levelname == "WARNING" for record in caplog.records) == 7


async def test_servers_that_differ():
    async with (
        FakeRosbridge(leaks_nan=True, doubles_first=True, escapes=True) as fake,
        connect(fake.uri) as ros,
    ):
        subscription = ros.subscribe("/a/b", "p/T")
        await fake.wait_for_op("subscribe")
        await fake.publish("/a/b", {"n": math.nan, "path": "x/y"})
        await fake.publish("/a/b", {"n": math.inf})
        got = [(await subscription.next(30)).msg for _ in range(3)]
        assert got == [{"n": None, "path": "x/y"}, {"n": None, "path": "x/y"}, {"n": None}]
        assert ros.unusable == 0


async def test_a_message_in_many_frames():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        subscription = ros.subscribe("/a", "p/T")
        await fake.wait_for_op("subscribe")
        (client,) = fake._clients
        await client.connection.send(
            iter(['{"op": "publish", "top', 'ic": "/a", ', "", '"msg": {"n": "', "ä", '"}}'])
        )
        await fake.publish("/a", {"n": 2})
        assert [(await subscription.next(30)).msg["n"] for _ in range(2)] == ["ä", 2]


@pytest.mark.parametrize("ros", [1, 2])
async def test_type_names_as_the_server_wants_them(ros):
    # The fake of ROS 1 refuses names of the ROS 2 form without a word, as the real one does.
    async with FakeRosbridge(ros=ros) as fake, connect(fake.uri) as client:
        subscription = client.subscribe("/a", "std_msgs/msg/String")
        publication = await client.advertise("/a", "std_msgs/msg/String")
        await publication.publish({"data": "x"})
        assert (await subscription.next(30)).msg == {"data": "x"}


# Which ROS


@pytest.mark.parametrize("ros", [1, 2])
async def test_rosapi_tells_the_version(ros):
    async with FakeRosbridge(ros=ros, rosapi=True) as fake, connect(fake.uri) as client:
        assert client.ros_version is None
        assert await client.detect_ros_version() == ros
        assert client.ros_version == ros
        client.subscribe("/a", "std_msgs/String")
        op = await fake.wait_for_op("subscribe")
        assert op["type"] == ("std_msgs/String" if ros == 1 else "std_msgs/msg/String")


@pytest.mark.parametrize("ros", [1, 2])
async def test_stamps_tell_the_version(ros):
    async with FakeRosbridge() as fake, connect(fake.uri) as client:
        subscription = client.subscribe("/a", "p/T")
        await fake.wait_for_op("subscribe")
        await fake.publish("/a", {"header": stamps.header(1, ros_version=ros)})
        await subscription.next(30)
        assert client.ros_version == ros
        assert await client.detect_ros_version() == ros
        assert fake.ops("call_service") == []
        client.subscribe("/b", "p/msg/T")
        op = await fake.wait_for_op("subscribe", topic="/b")
        assert op["type"] == ("p/T" if ros == 1 else "p/msg/T")


async def test_without_rosapi_the_version_is_unknown():
    async with FakeRosbridge() as fake, connect(fake.uri) as client:
        assert await client.detect_ros_version() is None


async def test_a_silent_server_does_not_hang_the_question():
    async with FakeRosbridge(silent=True) as fake, connect(fake.uri) as client:
        begun = time.monotonic()
        assert await client.detect_ros_version(0.2) is None
        assert time.monotonic() - begun < 30


async def test_what_was_told_counts():
    async with FakeRosbridge(ros=2, rosapi=True) as fake, connect(fake.uri, ros_version="1") as client:
        assert await client.detect_ros_version() == 1
        assert fake.received == []
