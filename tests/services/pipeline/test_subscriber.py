"""The subscriber's counters: what is lost reaches the master once, and stays in the status."""

import asyncio
import contextlib
import time
from contextlib import nullcontext
from unittest.mock import AsyncMock, Mock

import pytest

from bridge.client import Message
from bridge.errors import TopicLeftOutError
from services.errors import RosbridgeLostError
from services.pipeline.connections import NotReceivableError
from services.pipeline.subscriber import Subscriber, newest_message
from services.settings import Settings
from services.sockets.records import Begin, LossReason, Notice, Reading, Ready, Rosbridge, Unusable
from tests.fake_rosbridge import FakeRosbridge
from tests.integration.conftest import READING
from tests.patience import PATIENCE
from tests.services.pipeline.conftest import running

BUSY = 1 << 19
"""Bytes that wait for a master that is too slow."""


def test_passed_over_readings_are_reported_once_and_counted_in_all(boat, link):
    subscriber = Subscriber(Settings(), boat, link.make)
    for passed_over in (2, 3, 0):
        link.backlog = BUSY
        for _ in range(passed_over):
            subscriber._read(0, Message("/boat/sensors", dict(READING), 1, 2))
        link.backlog = 0
        subscriber._read(0, Message("/boat/sensors", dict(READING), 1, 2))
    assert [reading.passed_over for reading in link.sent] == [2, 3, 0]
    assert 0 < link.sent[0].sent_tick <= link.sent[-1].sent_tick <= time.monotonic_ns()
    frames = subscriber.status().frames
    assert (frames.completed, frames.lost) == (3, {LossReason.PASSED_OVER: 5})


@pytest.mark.parametrize("queue", ["all", "latest"])
def test_a_slow_master_gets_every_reading_if_all_are_kept(boat, link, queue):
    subscriber = Subscriber(Settings(queue=queue), boat, link.make)
    link.backlog = BUSY
    subscriber._read(0, Message("/boat/sensors", dict(READING), 1, 2))
    assert len(link.sent) == (1 if queue == "all" else 0)
    assert subscriber.status().frames.lost == ({} if queue == "all" else {LossReason.PASSED_OVER: 1})


def test_unpaired_messages_are_reported_once_and_a_wait_ends_by_itself(boat, link):
    """Every other variable has a topic of its own, which may be missing."""
    source = boat.sources[0]
    variables = tuple(
        each.model_copy(update={"source": at % 2, "on_missing": "missing" if at % 2 else "error"})
        for at, each in enumerate(boat.variables)
    )
    sources = source, source.model_copy(update={"topic": "/second"})
    deployment = boat.model_copy(update={"sources": sources, "variables": variables, "tolerance_s": 0.02})

    async def read():
        subscriber = Subscriber(Settings(), deployment, link.make)
        for at, stamp in ((1, 1), (1, 2), (0, 3), (1, 4), (0, 5)):  # two, one
            stamped = READING | {"header": {"stamp": {"sec": stamp, "nanosec": 0}}}
            now = time.monotonic_ns()
            subscriber._read(at, Message("/t", stamped, now, now))
        await link.until(lambda: len(link.of(Reading)) == 2)  # the last one waits for the second topic
        assert subscriber.status().frames.lost == {LossReason.UNPAIRED: 3}

    asyncio.run(read())
    assert [reading.unpaired for reading in link.of(Reading)] == [2, 1]


def test_readings_without_a_master_are_counted_as_passed_over(boat, link, monkeypatch):
    subscriber = Subscriber(Settings(), boat, link.make)
    with monkeypatch.context() as away:
        away.setattr(link, "send", lambda _record: False)
        subscriber._read(0, Message("/boat/sensors", dict(READING), 1, 2))
    assert subscriber.status().frames.lost == {LossReason.PASSED_OVER: 1}
    subscriber._read(0, Message("/boat/sensors", dict(READING), 1, 2))
    assert [reading.passed_over for reading in link.sent] == [1]


def test_a_dropped_reading_of_two_topics_counts_as_two_messages(boat, link):
    """The master divides the number of messages by that of the topics, for the steps of a filter."""
    sources = boat.sources[0], boat.sources[0].model_copy(update={"topic": "/second"})
    variables = tuple(each.model_copy(update={"source": at % 2}) for at, each in enumerate(boat.variables))
    subscriber = Subscriber(
        Settings(), boat.model_copy(update={"sources": sources, "variables": variables}), link.make
    )
    for backlog in (BUSY, 0):
        link.backlog = backlog
        for at in range(2):
            subscriber._read(at, Message("/t", dict(READING), 1, 2))
    assert [reading.passed_over for reading in link.sent] == [2]


def test_an_unusable_message_is_reported_by_its_cause(boat, link):
    subscriber = Subscriber(Settings(), boat, link.make)
    for value in ("x", "y"):
        subscriber._read(0, Message("/boat/sensors", READING | {"D2": value}, 1, 2))
    first, second = link.sent
    assert isinstance(first, Unusable)
    assert first.cause == second.cause
    assert subscriber.status().frames.lost == {LossReason.UNUSABLE: 2}


@pytest.mark.parametrize(("existing", "hinted"), [("/boat/sensors2", True), ("/elsewhere", False)])
async def test_a_topic_that_nobody_publishes_is_reported_with_similar_names(
    boat, link, monkeypatch, existing, hinted
):
    monkeypatch.setattr("services.pipeline.connections.AFTER", 0.05)
    async with FakeRosbridge(rosapi=True) as fake:
        fake.know(existing, "boat_msgs/Sensors")
        async with running(Subscriber(Settings(uri=fake.uri), boat, link.make), link):
            await link.until(lambda: link.of(Notice))  # before the run begins
        (notice,) = link.of(Notice)
        assert notice.level == "warning"
        assert (existing in notice.sentence) is hinted


@pytest.mark.parametrize("publishers", [["/robot"], []])
async def test_a_topic_of_another_type_is_an_error_at_once_if_somebody_publishes_it(boat, link, publishers):
    async with FakeRosbridge(rosapi=True) as fake:
        fake.know("/boat/sensors", "std_msgs/String")
        fake.serve("/rosapi/publishers", lambda _: {"publishers": publishers})
        async with running(Subscriber(Settings(uri=fake.uri), boat, link.make), link) as task:
            if publishers:
                with pytest.raises(NotReceivableError, match=r"^/boat/sensors is std_msgs/String at "):
                    await task
        assert bool(link.of(Ready)) is not bool(publishers)


@pytest.mark.parametrize(
    ("limit", "expected"), [(4 << 20, nullcontext()), (1 << 20, pytest.raises(TopicLeftOutError))]
)
async def test_a_large_message_is_taken_up_to_the_limit_of_the_settings(boat, link, limit, expected):
    """As a camera beside the readings sends them; without its needed topic, the subscriber ends."""
    async with FakeRosbridge() as fake:
        subscriber = Subscriber(Settings(uri=fake.uri, message_bytes=limit), boat, link.make)
        async with running(subscriber, link) as task:
            link.take(Begin(once=False))
            await fake.wait_for_op("subscribe", topic="/boat/sensors")
            await fake.publish("/boat/sensors", READING | {"image": "x" * (2 << 20)})
            with expected:
                await link.until(lambda: link.of(Reading) or (task.done() and task.result()))


async def test_of_what_a_server_sends_from_before_only_the_newest_counts(boat, link, monkeypatch):
    async def messages():
        yield 2
        yield 3
        await asyncio.Event().wait()

    assert await newest_message(messages(), 1) == (3, 2)
    older = AsyncMock(side_effect=lambda _, message: (message, 2))
    monkeypatch.setattr("services.pipeline.subscriber.newest_message", older)
    async with FakeRosbridge() as fake, running(Subscriber(Settings(uri=fake.uri), boat, link.make), link):
        link.take(Begin(once=False))
        for count in range(1, 5):
            if count == 3:
                await fake.vanish()
                await fake.come_back()
            await fake.wait_for_op("subscribe", topic="/boat/sensors", count=(count + 1) // 2)
            await fake.publish("/boat/sensors", READING)
            await link.until(lambda count=count: len(link.of(Reading)) == count)
    assert [each.passed_over for each in link.of(Reading)] == [2, 0, 2, 0]


def test_the_status_shows_the_time_without_readings(boat, link, monkeypatch):
    monkeypatch.setattr("services.pipeline.subscriber.why_not_connected", lambda _: "")
    now = [1_000_000_000_000]
    monkeypatch.setattr("time.monotonic_ns", lambda: now[0])
    subscriber = Subscriber(Settings(ready_timeout=5), boat, link.make)
    assert subscriber.status().ready  # no run needs readings yet
    link.take(Begin(once=False))
    status = subscriber.status()
    assert (status.ready, status.frames.last_age_s) == (False, None)
    assert "/boat/sensors" in status.why
    subscriber._read(0, Message("/boat/sensors", dict(READING), 1, now[0]))
    now[0] += 5_000_000_000
    assert subscriber.status().ready
    now[0] += 1_000_000_000
    status = subscriber.status()
    assert (status.ready, status.frames.last_age_s) == (False, 6.0)
    assert "6 s" in status.why


@pytest.mark.parametrize("once", [True, False])
async def test_only_a_single_reading_needs_a_server_that_stays(boat, link, tmp_path, monkeypatch, once):
    serving = Mock(return_value=contextlib.nullcontext())
    monkeypatch.setattr("services.sockets.serving.serve_status", serving)
    async with FakeRosbridge() as fake:
        subscriber = Subscriber(Settings(uri=fake.uri, run_directory=tmp_path), boat, link.make)
        async with running(subscriber, link) as task:
            link.take(Begin(once=once))
            await fake.wait_for_op("subscribe", topic="/boat/sensors")
            assert serving.call_args.args == (tmp_path, "subscriber", subscriber.status)
            await fake.vanish()
            if once:
                with pytest.raises(RosbridgeLostError):
                    await asyncio.wait_for(task, PATIENCE)
                return
            await fake.come_back()

            def is_back():
                link.take(Rosbridge(connected=True))  # the publisher has reached it
                return Rosbridge(connected=True) in link.sent

            await link.until(is_back)
            assert [each.connected for each in link.of(Rosbridge)] == [False, True]
            assert [each.level for each in link.of(Notice)] == ["warning", "info"]
            assert not task.done()
