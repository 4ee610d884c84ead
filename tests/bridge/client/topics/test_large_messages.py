"""Messages that are too large, in both directions, cost only their own topic."""

import asyncio
import contextlib
from collections.abc import Mapping
from typing import Any
from unittest.mock import Mock

import pytest

from bridge.client import Ros, State, connect
from bridge.client.protocol import probation
from bridge.client.protocol.probation import Probation
from bridge.client.protocol.wire import SMALLEST_LIMIT
from bridge.errors import EncodeError, MessageTooLargeError, TopicLeftOutError
from bridge.hub.limits import HubLimits
from tests.bridge.hub.sockets import running_hub
from tests.fake_rosbridge import FakeRosbridge, _Client
from tests.patience import PATIENCE

LIMIT = 4000
LARGE = {"data": "x" * 2 * LIMIT}


class Unnamed(FakeRosbridge):
    """A server that writes the message before its topic, so that the beginning does not tell."""

    async def _say(self, client: _Client, data: Any) -> None:
        if isinstance(data, dict) and data["op"] == "publish":
            data = {"op": "publish", "msg": data["msg"], "topic": data["topic"]}
        await super()._say(client, data)


@contextlib.asynccontextmanager
async def publishing(fake: FakeRosbridge, messages: Mapping[str, dict[str, Any]]):
    """Publish these again and again."""

    async def play() -> None:
        while True:
            for topic, message in messages.items():
                await fake.publish(topic, message)
            await asyncio.sleep(0.02)

    task = asyncio.create_task(play())
    try:
        yield
    finally:
        task.cancel()


@pytest.mark.parametrize("server", [FakeRosbridge, Unnamed])
async def test_the_topic_that_ends_the_connection_is_left_out_and_others_go_on(
    server, either_reader, monkeypatch
):
    monkeypatch.setattr(probation, "FIRST_PATIENCE", 0.2)
    async with server() as fake, connect(fake.uri, max_size=LIMIT) as ros:
        names = ["/a", "/camera", "/silent", "/b"]
        a, camera, silent, b = (ros.subscribe(name, "p/T", queue_size=1) for name in names)
        async with publishing(fake, {"/a": {"n": 1}, "/b": {"n": 2}, "/camera": LARGE}):
            with pytest.raises(TopicLeftOutError) as caught:
                await camera.next(PATIENCE)
            assert "/camera" in str(caught.value)
            await ros.wait_for_state(State.CONNECTED, PATIENCE)
            await fake.wait_for_op("subscribe", topic="/silent")
            connections = fake.connections
            for _ in range(20):
                assert (await a.next(PATIENCE)).msg == {"n": 1}
                assert (await b.next(PATIENCE)).msg == {"n": 2}
        await fake.publish("/silent", {"n": 3})
        assert (await silent.next(PATIENCE)).msg == {"n": 3}
        assert fake.connections == connections
        # an existing subscription does not change it, and a new one tries again
        with pytest.raises(TopicLeftOutError):
            await anext(ros.subscribe("/camera", "p/T"))


async def test_a_topic_that_is_left_out_may_be_subscribed_again(fake, monkeypatch):
    async with connect(fake.uri, max_size=LIMIT) as ros:
        subscriptions = ros._session.core.subscriptions
        monkeypatch.setattr(subscriptions, "blame", blame := Mock(wraps=subscriptions.blame))
        for _ in range(2):
            camera = ros.subscribe("/camera", "p/T")
            async with publishing(fake, {"/camera": LARGE}):
                with pytest.raises(TopicLeftOutError):
                    await camera.next(PATIENCE)
            await camera.close()
            await ros.wait_for_state(State.CONNECTED, PATIENCE)
        camera = ros.subscribe("/camera", "p/T")
        async with publishing(fake, {"/camera": {"n": 1}}):
            assert (await camera.next(PATIENCE)).msg == {"n": 1}
        assert {each.args for each in blame.call_args_list} == {
            ("/camera",)
        }  # read from the refused messages


async def test_a_frame_of_an_impossible_length_leaves_no_topic_out(fake):
    async with connect(fake.uri) as ros:
        subscription = ros.subscribe("/a", "p/T")
        for number in range(1, 4):
            await fake.wait_for_op("subscribe", topic="/a", count=number)
            for client in fake._clients:
                client.connection.transport.write(b"\x81\x7f" + b"\xff" * 8)
            while ros.reconnections < number:
                await asyncio.sleep(0.01)
        await fake.wait_for_op("subscribe", topic="/a", count=4)
        await fake.publish("/a", {"n": 1})
        assert (await subscription.next(PATIENCE)).msg == {"n": 1}


async def test_an_answer_that_is_too_large_leaves_no_topic_out(fake):
    fake.serve("/large", lambda _args: LARGE)
    async with connect(fake.uri, max_size=LIMIT) as ros:
        subscription = ros.subscribe("/a", "p/T")
        for _ in range(3):
            await ros.wait_for_state(State.CONNECTED, PATIENCE)
            with contextlib.suppress(Exception):
                await ros.call("/large", timeout=PATIENCE)
        await ros.wait_for_state(State.CONNECTED, PATIENCE)
        async with publishing(fake, {"/a": {"n": 1}}):
            assert (await subscription.next(PATIENCE)).msg == {"n": 1}


@pytest.mark.parametrize(("timed", "settled"), [(True, True), (True, False), (False, True)])
async def test_the_next_suspect_waits_for_a_message_of_the_last_one(fake, monkeypatch, timed, settled):
    monkeypatch.setattr(Probation, "is_settled", settled)
    async with connect(fake.uri) as ros:
        session = ros._session
        session._probe_timer = Mock() if timed else None
        monkeypatch.setattr(session, "_release_suspect", release := Mock())
        session._take([b'{"op": "publish", "topic": "/a", "msg": {}}'])
        assert release.call_count == (timed and settled)


def lose(search: Probation, subscribed: list[str], guilty: str, noisy: str = "") -> list[str]:
    """Play losses because of `guilty`, which is slow, until it is found; return the left out topics."""
    found: list[str] = []
    for _ in range(20):
        on = [topic for topic in subscribed if not search.holds(topic)]
        while guilty not in on and (topic := search.release()) is not None:
            on.append(topic)
            if topic == noisy:
                search.hear(topic)
        if guilty not in on:
            return found
        culprit = search.blame(on, None, only_topics=True)
        found += [culprit] if culprit else []
    return found


@pytest.mark.parametrize("guilty", ["/a", "/b", "/c", "/d"])
@pytest.mark.parametrize("noisy", ["/a", "/b", "/c", "/d"])
def test_only_the_guilty_topic_is_found(guilty, noisy):
    assert lose(Probation(), ["/a", "/b", "/c", "/d"], guilty, noisy) == [guilty]


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


async def publishes_in_vain(ros: Ros, topic: str, size: int) -> None:
    publication = await ros.advertise(topic, "std_msgs/String")
    with pytest.raises(MessageTooLargeError):
        await publication.publish({"data": "x" * size})


async def test_the_limit_of_the_hub_is_known_at_once():
    async with (
        running_hub(limits=HubLimits(message_bytes=LIMIT)) as port,
        connect(f"ws://127.0.0.1:{port}") as ros,
    ):
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
