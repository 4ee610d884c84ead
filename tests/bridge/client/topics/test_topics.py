"""Publishing and subscribing through the fake server.

Ros (asyncio or uvloop) ◀──WebSocket──▶ FakeRosbridge (relays, or says what the test wants)
"""

import asyncio
import math
import re
import socket
import time
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from bridge import errors, stamps
from bridge.client import Message, State, connect
from bridge.qos import Qos
from tests.bridge.client.stand_ins import give_up
from tests.bridge.hub.sockets import until
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE


async def test_a_message_goes_round(fake, ros):
    async with (
        ros.subscribe("/a", "std_msgs/Float64MultiArray") as subscription,
        await ros.advertise("/a", "std_msgs/msg/Float64MultiArray") as publication,
    ):
        before = time.time_ns(), time.monotonic_ns()
        await publication.publish({"data": np.array([0.5, 1.0])})
        message = await subscription.next(PATIENCE)
        assert message == Message(
            "/a", {"data": [0.5, 1.0]}, message.received_ns, message.received_monotonic_ns
        )
        assert before[0] <= message.received_ns <= time.time_ns()
        assert before[1] <= message.received_monotonic_ns <= time.monotonic_ns()
    await subscription.close()
    await fake.wait_for_op("unsubscribe", topic="/a")
    await fake.wait_for_op("unadvertise", topic="/a")
    assert len(fake.ops("unsubscribe")) == 1
    with pytest.raises(errors.DisconnectedError):
        await publication.publish({})


async def test_messages_of_one_moment_leave_in_one_piece(fake, ros):
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
    assert [(await subscription.next(PATIENCE)).msg["n"] for _ in range(2)] == [2, 3]
    assert (await fake.wait_for_op("publish", topic="/a"))["msg"] == {"n": 1}
    with ros.together():
        await one.publish({"n": 4})
        await ros.close()
    with ros.together(), pytest.raises(errors.DisconnectedError):
        await one.publish({"n": 5})


async def test_a_connection_that_is_about_to_end_takes_no_message(fake, ros):
    publication = await ros.advertise("/a", "p/T")
    ros._session._websocket.abort()  # what the watchdog does; the end is reported in a later turn of the loop
    assert publication.must_wait
    with pytest.raises(errors.DisconnectedError):
        publication.publish_nowait({"n": 1})
    ros.subscribe("/b", "p/T")


async def test_a_message_that_need_not_wait_does_not(fake, ros):
    publication, closed = await ros.advertise("/a", "p/T"), await ros.advertise("/a", "p/T")
    await publication.ready()
    assert not publication.must_wait
    publication.publish_nowait({"n": 1})
    assert (await fake.wait_for_op("publish", topic="/a"))["msg"] == {"n": 1}
    with pytest.raises(errors.EncodeError, match="a message of /a cannot be published: n is NaN"):
        publication.publish_nowait({"n": math.nan})
    await closed.close()
    with pytest.raises(errors.DisconnectedError, match="^/a "):
        closed.publish_nowait({})
    await ros.close()
    assert publication.must_wait
    with pytest.raises(errors.DisconnectedError):
        publication.publish_nowait({})
    with pytest.raises(errors.DisconnectedError):
        await publication.publish({})
    with pytest.raises(errors.DisconnectedError):
        ros.subscribe("/a")
    with pytest.raises(errors.DisconnectedError):
        await ros.advertise("/b", "p/T")


async def test_iteration_ends_with_the_subscription_or_the_client():
    async def read(subscription):
        return [message.msg["n"] async for message in subscription]

    async with FakeRosbridge() as fake:
        async with connect(fake.uri) as ros:
            one, two = ros.subscribe("/a", "p/T"), ros.subscribe("/a", "p/T")
            readers = [asyncio.create_task(read(subscription)) for subscription in (one, two)]
            await fake.wait_for_op("subscribe")
            await fake.publish("/a", {"n": 1})
            await fake.publish("/a", {"n": 2})
            with pytest.raises(errors.ServiceError):
                await ros.call("/answers/after/the/messages")
            await one.close()
            assert await asyncio.wait_for(readers[0], PATIENCE) == [1, 2]
        assert await asyncio.wait_for(readers[1], PATIENCE) == [1, 2]
        with pytest.raises(errors.DisconnectedError, match="/a is closed"):
            await two.next(1)


async def test_what_was_published_before_the_end_still_goes_out():
    async with FakeRosbridge() as fake:
        async with connect(fake.uri) as ros:
            publication = await ros.advertise("/a", "p/T")
            for n in range(1000):
                await publication.publish({"n": n, "filling": "x" * 500})
        await fake.wait_for_op("publish", count=1000)
        assert [op["msg"]["n"] for op in fake.ops("publish")] == list(range(1000))


async def test_an_empty_queue_is_refused(fake, ros):
    for want in (ros.subscribe, ros.advertise):
        with pytest.raises(errors.OptionError):
            await want("/a", "p/T", queue_size=0)
    ros.subscribe("/a", "p/T", queue_size=1)
    await fake.wait_for_op("subscribe")
    assert len(fake.received) == 1


async def test_a_slow_reader_loses_its_own_oldest_messages_and_nobody_elses(fake, ros):
    slow = ros.subscribe("/a", "p/T", queue_size=5)
    fast = ros.subscribe("/a", "p/T", queue_size=100)
    await fake.wait_for_op("subscribe")
    for n in range(50):
        await fake.publish("/a", {"n": n})
    assert [(await fast.next(PATIENCE)).msg["n"] for _ in range(50)] == list(range(50))
    assert (slow.lost, fast.lost) == (45, 0)
    assert [(await slow.next(PATIENCE)).msg["n"] for _ in range(5)] == [45, 46, 47, 48, 49]
    await fake.publish("/a", {"n": 50})
    assert (await slow.next(PATIENCE)).msg["n"] == 50
    assert slow.lost == 45


async def test_a_second_reader_of_a_subscription_gets_an_error(fake, ros):
    subscription = ros.subscribe("/a", "p/T")
    given_up = asyncio.create_task(subscription.next(PATIENCE))
    await asyncio.sleep(0)
    given_up.cancel()
    with pytest.raises(asyncio.CancelledError):
        await given_up
    first = asyncio.create_task(subscription.next(0.3))
    await asyncio.sleep(0)
    with pytest.raises(errors.ConcurrentReadError, match="/a"):
        await subscription.next(3600)
    with pytest.raises(errors.NoMessageError):  # at its own time, not at the other's
        await asyncio.wait_for(first, PATIENCE)
    await fake.wait_for_op("subscribe")
    await fake.publish("/a", {"n": 1})
    assert (await subscription.next(PATIENCE)).msg == {"n": 1}


async def test_each_wait_ends_at_its_own_time(fake, ros, monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("bridge.client.handles.time", SimpleNamespace(monotonic=lambda: now[0]))
    subscription = ros.subscribe("/a", "p/T")
    await fake.wait_for_op("subscribe")

    async def begin(wait):
        waiting = asyncio.create_task(wait)
        await asyncio.sleep(0)
        return waiting

    async def hear(waiting):
        await fake.publish("/a", {})
        await waiting

    await hear(await begin(subscription.next(700)))  # its alarm rings in the middle of the next wait
    waiting = await begin(subscription.next(1000))
    now[0] += 700
    subscription._ring()
    await asyncio.sleep(0)
    assert not waiting.done()
    now[0] += 300
    subscription._ring()
    with pytest.raises(errors.NoMessageError, match="within 1000 s"):
        await waiting
    await hear(await begin(subscription.next(600)))  # its alarm is far away
    waiting = await begin(subscription.next(0.01))
    now[0] += 0.01
    with pytest.raises(errors.NoMessageError, match="within 0.01 s"):
        await waiting
    await hear(await begin(subscription.next(700)))  # its alarm rings while nobody has a limit
    waiting = await begin(anext(subscription))
    now[0] += 700
    subscription._ring()
    await asyncio.sleep(0)
    assert not waiting.done()
    await hear(waiting)


async def test_only_a_reader_of_prompt_answers_busy_waits_and_not_for_long(fake, ros, monkeypatch):
    now, looks = 1000.0, 0

    def monotonic():
        nonlocal looks
        looks += 1
        return now

    async def is_busy():
        before = looks
        for _ in range(5):  # turns of the event loop
            await asyncio.sleep(0)
        return looks > before

    async def hear(delay):
        """Return whether the reader busy-waits before and after the time until its message has passed."""
        nonlocal now
        waiting = asyncio.create_task(subscription.next(1000))
        await asyncio.sleep(0)
        with pytest.raises(errors.ConcurrentReadError):
            await subscription.next(1000)
        busy = await is_busy()
        now += delay
        await asyncio.sleep(0)
        later = await is_busy()
        await fake.publish("/a", {})
        await waiting
        return busy, later

    monkeypatch.setattr("bridge.client.handles.time", SimpleNamespace(monotonic=monotonic))
    subscription = ros.subscribe("/a", "p/T")
    await fake.wait_for_op("subscribe")
    assert [await hear(delay) for delay in (1e-4, 1e-4, 1e-2, 1e-4)] == [
        (False, False),
        (True, True),
        (True, False),
        (False, False),
    ]


@pytest.mark.parametrize(
    ("fake", "prepare", "said"),
    [
        ({"rosapi": False}, None, "^$"),
        ({"rosapi": True}, None, "know"),
        ({"rosapi": True}, "p/U", "p/U.* p/T"),
        ({"rosapi": True}, "p/msg/T", "publish"),
        ({"rosapi": True, "silent": True}, None, "rosapi.* 0.5 s"),
    ],
    indirect=["fake"],
)
async def test_a_topic_that_nobody_publishes_is_named(fake, ros, prepare, said):
    if prepare:
        fake.know("/quiet", prepare)
    with pytest.raises(errors.NoMessageError) as caught:
        await asyncio.wait_for(ros.subscribe("/quiet", "p/T").next(0.1), PATIENCE)
    what, _, why = str(caught.value).partition("; ")
    assert all(part in what for part in ("/quiet", fake.uri, "0.1 s"))
    assert re.search(said, why)
    assert caught.value.exit_code == 3


@pytest.mark.parametrize("fake", [{"statuses": True}], indirect=True)
async def test_what_the_server_says_about_it_is_passed_on(ros):
    subscription = ros.subscribe("/a")
    waiting = asyncio.create_task(subscription.next(3600))
    await until(lambda: ros.statuses)
    give_up(subscription)
    with pytest.raises(errors.NoMessageError, match="type is required: /a is not known$"):
        await waiting
    assert {status.level for status in ros.statuses} == {"error"}  # it may have been asked again
    # A status message before a wait does not concern that wait.
    with pytest.raises(errors.NoMessageError, match=r"within 0\.1 s$"):
        await ros.subscribe("/b", "p/T").next(0.1)


async def test_a_topic_of_unknown_type_is_found_when_it_appears(fake, monkeypatch):
    monkeypatch.setattr("bridge.client.session.SILENCE", 0.05)
    ros = connect(fake.uri)
    subscription = ros.subscribe("/late")
    async with ros:
        await fake.wait_for_op("subscribe", count=2, topic="/late")
        fake.know("/late", "p/T")
        await fake.wait_for_op("subscribe", count=4, topic="/late")
        await fake.publish("/late", {"n": 1})
        assert (await subscription.next(PATIENCE)).msg == {"n": 1}
        asked = len(fake.ops("subscribe", topic="/late"))
        ros.subscribe("/later")
        await fake.wait_for_op("subscribe", count=3, topic="/later")
        assert len(fake.ops("subscribe", topic="/late")) <= asked + 1, "it is not asked for any more"


@pytest.mark.parametrize("fake", [{"rosapi": True}], indirect=True)
async def test_a_best_effort_publisher_that_starts_late_is_heard(fake, monkeypatch):
    monkeypatch.setattr("bridge.client.session.SILENCE", 0.05)
    async with connect(fake.uri) as ros:
        subscription = ros.subscribe("/late", "p/T")
        await fake.wait_for_op("call_service", service="/rosapi/publishers", count=2)
        assert len(fake.ops("subscribe", topic="/late")) == 1, "nobody publishes it yet"
        fake.start_best_effort("/late", "p/T")
        assert await fake.publish("/late", {"n": 0}) == 0
        await fake.wait_for_op("subscribe", count=2, topic="/late")
        assert await fake.publish("/late", {"n": 1}) == 1
        assert (await subscription.next(PATIENCE)).msg == {"n": 1}
        asked = len(fake.ops("subscribe", topic="/late"))
        ros.subscribe("/other", "p/T")
        await fake.wait_for_op(
            "call_service", service="/rosapi/publishers", args={"topic": "/other"}, count=2
        )
        assert len(fake.ops("subscribe", topic="/late")) == asked, "it has a message, so that is enough"


@pytest.mark.parametrize("fake", [{"rosapi": True}], indirect=True)
async def test_a_type_that_a_server_cannot_write_as_cbor_comes_as_json(fake, monkeypatch, caplog):
    monkeypatch.setattr("bridge.client.session.SILENCE", 0.05)
    fake.fails_as_cbor.add("/imu")
    fake.start_best_effort("/imu", "sensor_msgs/Imu")
    async with connect(fake.uri) as ros:
        subscription = ros.subscribe("/imu", "sensor_msgs/Imu", compression="cbor", arrays="numpy")
        while not await fake.publish("/imu", {"covariance": [1.0, 2.0]}):
            await asyncio.sleep(0.02)
        message = await subscription.next(PATIENCE)
        assert message.msg["covariance"].tolist() == [1.0, 2.0]
        assert [op.get("compression") for op in fake.ops("subscribe", topic="/imu")] == ["cbor", "cbor", None]
    assert sum("/imu" in each.getMessage() for each in caplog.records if each.levelname == "WARNING") == 1


async def test_a_tight_loop_of_publications_lets_others_live(fake, ros):
    publication = await ros.advertise("/a", "p/T")
    turns = 0

    async def other():
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


async def test_who_waits_comes_first(fake, ros):
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


@pytest.mark.parametrize("ros", [{"max_size": 4096, "ping_interval": PATIENCE}], indirect=True, ids=["small"])
@pytest.mark.parametrize("kind", ["calls", "pings"])
async def test_a_server_that_causes_answers_and_reads_none_is_left(fake, ros, kind):
    transport = ros._session._connected()._transport
    (client,) = fake._clients
    transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    fake.freeze()

    call = b'{"op":"call_service","service":"/%b"}' % (b"a" * 2000)
    frame = (
        b"\x81\x7e%b%b" % (len(call).to_bytes(2, "big"), call)
        if kind == "calls"
        else b"\x89\x7d" + bytes(125)
    )

    async def flood():
        while not client.connection.transport.is_closing():
            if client.connection.transport.get_write_buffer_size() < 1 << 16:
                client.connection.transport.write(16 * frame)
            await asyncio.sleep(0)

    flooding = asyncio.create_task(flood())
    largest = 0
    while ros.state is State.CONNECTED:
        largest = max(largest, transport.get_write_buffer_size())
        await asyncio.sleep(0.001)
    flooding.cancel()
    assert "does not read" in ros.last_error
    assert largest < 1 << 17
    fake.thaw()


@pytest.mark.parametrize("ros", [{"ping_interval": PATIENCE}], indirect=True, ids=["no pings"])
async def test_a_server_that_takes_nothing_more(fake, ros):
    publication = await ros.advertise("/a", "p/T", queue_size=3)
    await fake.wait_for_op("advertise")
    fake.freeze()
    big = {"data": "x" * 500_000}
    sent = 0

    async def flood():
        nonlocal sent
        for _ in range(200):
            await publication.publish(big, timeout=0.2)
            sent += 1

    with pytest.raises(errors.SlowPeerError, match="/a") as caught:
        await flood()
    assert caught.value.exit_code == 3
    assert 0 < sent < 100, "what waits here is bounded"
    waiting = [asyncio.create_task(publication.publish({"n": n}, timeout=PATIENCE)) for n in range(4)]
    await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
    with pytest.raises(errors.SlowPeerError, match="3 messages of /a "):
        await waiting[3]
    with pytest.raises(errors.SlowPeerError, match="a call of /s"):
        await ros.call("/s", timeout=0.1)
    assert publication.must_wait
    with pytest.raises(errors.SlowPeerError, match="a message of /a "):
        publication.publish_nowait({"n": 9})
    with pytest.raises(errors.SlowPeerError, match="/a"):
        await publication.ready(timeout=0.1)
    fake.thaw()
    await asyncio.wait_for(asyncio.gather(*waiting[:3]), PATIENCE)
    await fake.wait_for_op("publish", count=sent + 3)
    assert [op["msg"]["n"] for op in fake.ops("publish")[-3:]] == [0, 1, 2], "in their order"


async def test_nonsense_is_counted_and_survived(fake, ros, caplog):
    subscription = ros.subscribe("/a", "p/T")
    await fake.wait_for_op("subscribe")
    for _ in range(50):
        await fake.say('{"op": "png", "data": ""}')
        await fake.say(b"\xff\x00")
    await fake.publish("/a", {"n": 1})
    assert (await subscription.next(PATIENCE)).msg == {"n": 1}
    assert (ros.unusable, ros.reconnections) == (100, 0)
    assert sum(record.levelname == "WARNING" for record in caplog.records) == 7


@pytest.mark.parametrize(
    ("fake", "ros", "version"),
    [
        ({"rosapi": True, "ros": 1}, {}, 1),
        ({"rosapi": True, "ros": 2}, {}, 2),
        ({"rosapi": True, "ros": 2}, {"ros_version": "1"}, 1),
        ({"rosapi": True, "ros": 1}, {"ros_version": "2"}, 2),
        ({"rosapi": False}, {}, None),
        ({"silent": True}, {}, None),
    ],
    indirect=["fake", "ros"],
)
async def test_the_version_that_is_configured_or_that_rosapi_tells(fake, ros, version):
    configured = ros.ros_version
    async with asyncio.timeout(PATIENCE):
        assert await ros.detect_ros_version(0.2 if fake.silent else PATIENCE) == ros.ros_version == version
    assert bool(fake.received) == (configured is None)
    if version == 1:  # it would log an error
        assert all("get_ros_version" not in str(each) for each in fake.received)
    ros.subscribe("/a", "p/T")
    op = await fake.wait_for_op("subscribe")
    assert op["type"] == ("p/msg/T" if version == 2 else "p/T")


@pytest.mark.parametrize("version", [1, 2])
async def test_stamps_tell_the_version(fake, ros, version):
    subscription = ros.subscribe("/a", "p/T")
    await fake.wait_for_op("subscribe")
    await fake.publish("/a", {"header": stamps.header(1, ros_version=version)})
    await subscription.next(PATIENCE)
    assert ros.ros_version == version
    assert await ros.detect_ros_version() == version
    assert fake.ops("call_service") == []
    ros.subscribe("/b", "p/msg/T")
    op = await fake.wait_for_op("subscribe", topic="/b")
    assert op["type"] == ("p/T" if version == 1 else "p/msg/T")


async def test_calls_from_another_thread_are_refused_and_change_nothing(fake, ros):
    publication = await ros.advertise("/a", "p/T")
    subscription = ros.subscribe("/b", "p/T")
    calls = (
        lambda: publication.publish_nowait({}),
        lambda: asyncio.run(publication.publish({})),
        lambda: ros.subscribe("/c", "p/T"),
        lambda: asyncio.run(ros.advertise("/c", "p/T")),
        lambda: asyncio.run(ros.call("/rosapi/topics")),
        lambda: asyncio.run(subscription.next(1)),
        lambda: asyncio.run(publication.close()),
        lambda: asyncio.run(ros.close()),
        ros.together,
    )
    for call in calls:
        with pytest.raises(errors.WrongThreadError):
            await asyncio.to_thread(call)
    await publication.publish({"n": 1})
    await fake.wait_for_op("publish", topic="/a")
    await fake.wait_for_op("subscribe", topic="/b")
    await fake.publish("/b", {"n": 2})
    assert (await subscription.next(PATIENCE)).msg == {"n": 2}


SCAN_TYPE = "sensor_msgs/LaserScan"
BOTH = pytest.mark.parametrize("hub", [{"ros_version": 1}, {"ros_version": 2}], indirect=True)


@BOTH
@pytest.mark.parametrize(
    ("compression", "fragment_size", "arrays"),
    [("none", 50, "numpy"), ("cbor", None, "numpy"), ("cbor-raw", None, "list")],
)
async def test_a_scan_arrives_in_every_form(hub, compression, fragment_size, arrays):
    options = {"compression": compression, "fragment_size": fragment_size, "arrays": arrays}
    async with connect(hub) as one, connect(hub) as other:
        scans = one.subscribe("/scan", SCAN_TYPE, qos=Qos(reliability="best_effort"), **options)
        await one.call("/rosapi/get_time", timeout=PATIENCE)
        publication = await other.advertise("/scan", SCAN_TYPE, qos=Qos(depth=5))
        sent = {"header": {"frame_id": "laser"}, "ranges": np.array([0.5, 1.5, 2.5], np.float32)}
        await publication.publish(sent)
        received = await scans.next(PATIENCE)
    if compression == "cbor-raw":
        assert received.msg["secs"] > 1_600_000_000
        is_cdr = received.raw.startswith(b"\0\1\0\0")
        store = get_typestore(Stores.ROS2_JAZZY if is_cdr else Stores.ROS1_NOETIC)
        read = store.deserialize_cdr if is_cdr else store.deserialize_ros1
        msg = asdict(read(received.raw, "sensor_msgs/msg/LaserScan"))
    else:
        msg = received.msg
        assert isinstance(msg["ranges"], np.ndarray if arrays == "numpy" else list)
        with pytest.raises(errors.DecodeError, match="/scan has no serialised bytes"):
            _ = received.raw
    assert (msg["header"]["frame_id"], list(msg["ranges"])) == ("laser", [0.5, 1.5, 2.5])
    if compression == "cbor":
        assert msg["ranges"].dtype == np.float32
