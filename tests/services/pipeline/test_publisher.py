"""Results: in order, and to several servers, one of which may be away."""

import asyncio
from contextlib import asynccontextmanager
from types import MappingProxyType, SimpleNamespace
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest

from bridge.client import State
from machines.kind import BoardResult
from posteriors.frame_report import VariableReading
from services.boards.frames import encode_boards
from services.pipeline.connections import NotReceivableError
from services.pipeline.inference import infer, report_of
from services.pipeline.publisher import Publisher
from services.pipeline.result_topics import ResultTopics
from services.pipeline.standard_topics import StandardTopics
from services.settings import Settings
from services.sockets.records import Begin, FrameResult, Notice, Outcome, Publish, Published, Rosbridge, Seen
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import FACTOR, PATIENCE
from tests.services.pipeline.conftest import running
from toolchain.deployment import Output

REASON = 1
"""Of a board that stopped: a counter had reached its target."""


@asynccontextmanager
async def topics_of(boat, first, second):
    outputs = Output(topic="/BMresults", uri=first.uri), Output(topic="/second", uri=second.uri)
    deployment = boat.model_copy(update={"outputs": outputs})
    topics = ResultTopics(Settings(), deployment)
    async with topics.opened():
        yield topics


def result(boat, number, count=1):
    boards = [
        BoardResult(np.full(board.lines, count, "<u4").tobytes(), 9, REASON if count else 4)
        for board in boat.boards
    ]
    return Publish(FrameResult(number, encode_boards(boards), 0, 0, 0, 0), 0, 0, 0, 0, 0)


async def gone(topics, fake):
    await fake.vanish()
    ros = topics.rosbridges[fake.uri]
    if ros.state is State.CONNECTED:
        await ros.wait_for_state(State.RECONNECTING, PATIENCE)


class FakeTopics:
    """Topics of a server that takes a result when it is allowed to, one after the other."""

    must_wait = True
    rosbridges = MappingProxyType({})
    advertised = ()
    reports = None

    def __init__(self):
        self.standard = StandardTopics(Settings(), Mock(), "publisher")
        self.published = []
        self.allowed = asyncio.Semaphore(0)

    @asynccontextmanager
    async def opened(self, _on_state):
        yield "here"

    def publish_now(self, publish):
        self.published.append(publish.result.number)
        return Published(publish.result.number, Outcome.PUBLISHED, None, 0, 1.0, 9, 9)

    async def publish(self, publish, *, look):
        await self.allowed.acquire()
        return self.publish_now(publish)


async def settled():
    """Let every task go on until it waits for something that does not come."""
    for _ in range(20):
        await asyncio.sleep(0)


async def test_results_stay_in_order_while_the_queue_drains(boat, link):
    publisher = Publisher(Settings(), boat, link.make)
    topics = publisher._topics = FakeTopics()
    task = asyncio.create_task(publisher.run())
    await settled()
    for number in (1, 2, 3):
        link.take(result(boat, number))
    topics.must_wait = False
    topics.allowed.release()  # the first is published, and the second waits
    while topics.published != [1]:
        await asyncio.sleep(0.001)
    await settled()
    link.take(result(boat, 4))
    for _ in range(3):
        topics.allowed.release()
    while len(topics.published) < 4:
        await asyncio.sleep(0.001)
    await settled()
    link.take(result(boat, 5))  # at once: nothing waits any more
    assert topics.published == [1, 2, 3, 4, 5]
    assert publisher.status().frames.completed == 5
    task.cancel()
    await asyncio.wait([task])


async def test_the_master_learns_that_no_server_is_there_and_that_one_is_back(boat, link):
    async with FakeRosbridge() as fake:
        publisher = Publisher(Settings(uri=fake.uri), boat, link.make)
        async with running(publisher, link):
            assert (publisher.status().ready, publisher.status().why) == (True, publisher._where)
            ros = publisher._topics.rosbridges[fake.uri]
            ros._session._delay = 600.0  # unless the master says that one is back
            await gone(publisher._topics, fake)
            assert not publisher.status().ready
            await fake.come_back()
            assert [each.connected for each in link.of(Rosbridge)] == [False]
            link.take(Rosbridge(connected=True))  # the subscriber has reached it
            await ros.wait_for_state(State.CONNECTED, PATIENCE)
            assert [each.connected for each in link.of(Rosbridge)] == [False, True]
            assert [each.level for each in link.of(Notice)] == ["warning", "info"]


@pytest.mark.parametrize(
    ("refused", "away", "outcome", "missed"),
    [("/a", 0, Outcome.PUBLISHED, 1), ("/a", 2, Outcome.PUBLISHED, 2), ("/a /b /c", 1, Outcome.REFUSED, 0)],
)
async def test_a_result_counts_as_refused_if_every_topic_is(boat, link, refused, away, outcome, missed):
    publisher = Publisher(Settings(), boat, link.make)
    publisher._topics = FakeTopics()
    publisher._topics.advertised = [SimpleNamespace(name=name) for name in ("/a", "/b", "/c")]
    publisher._refused = dict.fromkeys(refused.split(), "why")
    publisher._report(Published(7, Outcome.PUBLISHED, None, 0, 1.0, 9, 9, missed=away))
    (published,) = link.sent
    assert (published.outcome, published.missed) == (outcome, missed)


async def test_results_go_on_where_a_server_is(boat):
    async with FakeRosbridge() as first, FakeRosbridge() as second, topics_of(boat, first, second) as topics:
        both = await topics.publish(result(boat, 1), look=False)
        assert (both.outcome, both.missed) == (Outcome.PUBLISHED, 0)
        await second.wait_for_op("publish", topic="/second")
        await gone(topics, second)
        assert not topics.must_wait  # because one server is connected
        for number in (2, 3):
            one = await topics.publish(result(boat, number), look=False)
            assert (one.outcome, one.missed) == (Outcome.PUBLISHED, 1)
        await first.wait_for_op("publish", topic="/BMresults", count=3)
        assert len(first.ops("publish", topic="/bm/frame")) == 3
        await second.come_back()
        await topics.rosbridges[second.uri].wait_for_state(State.CONNECTED, PATIENCE)
        await gone(topics, first)
        other = await topics.publish(result(boat, 4), look=False)
        assert (other.outcome, other.missed) == (Outcome.PUBLISHED, 1)
        await second.wait_for_op("publish", topic="/second", count=2)
        # whose data would be on the first
        assert (await topics.publish(result(boat, 5, count=0), look=False)).outcome == Outcome.ROSBRIDGE_AWAY
        await gone(topics, second)
        assert topics.must_wait
        assert (await topics.publish(result(boat, 6), look=False)).outcome == Outcome.ROSBRIDGE_AWAY


async def test_a_result_for_a_connection_that_is_about_to_end_is_not_published(boat):
    async with FakeRosbridge() as fake, topics_of(boat, fake, fake) as topics:
        await topics.rosbridges[fake.uri].wait_for_state(State.CONNECTED, PATIENCE)
        assert topics.publish_now(result(boat, 1)).outcome is Outcome.PUBLISHED
        topics.rosbridges[fake.uri]._session._websocket.abort()
        assert topics.must_wait
        assert topics.publish_now(result(boat, 2)).outcome is Outcome.ROSBRIDGE_AWAY
        assert (await topics.publish(result(boat, 3), look=False)).outcome is Outcome.ROSBRIDGE_AWAY


async def test_a_server_that_takes_nothing_keeps_nobody_else_from_results(boat, monkeypatch):
    async with FakeRosbridge() as first, FakeRosbridge() as second, topics_of(boat, first, second) as topics:
        monkeypatch.setattr("bridge.client.handles.Publication.ready.__defaults__", (0.2,))
        second.freeze()
        (frozen,) = (publication for _, publication in topics._outputs if publication.topic == "/second")
        for _ in range(10_000):  # what the two sockets hold, and then some
            if frozen.must_wait:
                break
            frozen.publish_nowait({"data": [0.5] * 20000})
            await asyncio.sleep(0)
        assert topics.must_wait
        one = await topics.publish(result(boat, 1), look=False)
        assert (one.outcome, one.missed) == (Outcome.PUBLISHED, 1)
        await first.wait_for_op("publish", topic="/BMresults")
        second.thaw()


async def test_the_largest_posterior_goes_out(boat):
    async with FakeRosbridge() as first, FakeRosbridge() as second, topics_of(boat, first, second) as topics:
        await topics.publish_array(np.full(64 * 4096, np.nextafter(1 / 262145, 1)))
        said = await first.wait_for_op("publish", topic="/BMresults")
        assert len(said["msg"]["data"]) == 64 * 4096


def publisher_of(boat, link, uri):
    return running(Publisher(Settings(uri=uri, seen_timeout=0.2 * FACTOR), boat, link.make), link)


async def outcome_of(link):
    await link.until(lambda: link.of(Published))
    return link.of(Published)[-1].outcome, link.of(Published)[-1].missed


def refuse_results(fake, other):
    """Let the server know the topic with another type, or, with an empty one, not allow it."""
    if other:
        fake.know("/BMresults", other)
    else:
        fake.refused_topics.add("/BMresults")


@pytest.mark.parametrize("other", ["std_msgs/msg/String", ""])
async def test_results_that_nobody_can_receive_are_lost(boat, link, monkeypatch, other):
    """The topic has another type, or the server's `topics_glob` refuses it."""
    monkeypatch.setattr("services.pipeline.publisher.SETTLED_TIME", 0.01)
    monkeypatch.setattr("services.pipeline.publisher.CHECK_INTERVAL", 0.01)
    async with FakeRosbridge(rosapi=True) as fake:
        refuse_results(fake, other)
        async with publisher_of(boat, link, fake.uri):
            await link.until(lambda: link.of(Notice))
            link.take(result(boat, 1))
            assert await outcome_of(link) == (Outcome.REFUSED, 0)
            fake.types.pop("/BMresults", None)
            fake.know("/BMresults", "std_msgs/msg/Float64MultiArray")
            outcome, number = None, 2
            while outcome != (Outcome.PUBLISHED, 0):  # as soon as the publisher has asked again
                link.sent.clear()
                link.take(result(boat, number))
                outcome, number = await outcome_of(link), number + 1


async def test_reports_that_nobody_can_receive_cost_no_results(boat, link):
    async with FakeRosbridge(rosapi=True) as fake:
        fake.know("/bm/frame", "std_msgs/msg/Empty")
        async with publisher_of(boat, link, fake.uri):
            (notice,) = link.of(Notice)
            assert notice.sentence.startswith("/bm/frame ")
            link.take(result(boat, 1))
            assert await outcome_of(link) == (Outcome.PUBLISHED, 0)


@pytest.mark.parametrize("other", ["std_msgs/msg/String", ""])
async def test_one_result_that_nobody_can_receive_is_an_error(boat, link, other):
    async with FakeRosbridge(rosapi=True) as fake:
        refuse_results(fake, other)
        async with publisher_of(boat, link, fake.uri) as task:
            link.take(Begin(once=True))
            link.take(result(boat, 1))
            with pytest.raises(NotReceivableError) as caught:
                await task
        assert caught.value.exit_code == 3
        assert not link.of(Published)


async def test_a_server_that_discards_results_silently_is_noticed(boat, link):
    async with FakeRosbridge() as fake:
        fake.refused_topics.add("/BMresults")
        fake.statuses = False
        async with publisher_of(boat, link, fake.uri):
            link.take(Begin(once=False))
            link.take(result(boat, 1))
            await link.until(lambda: link.of(Seen))
            (notice,) = link.of(Notice)
            assert (notice.level, notice.sentence.split(" on ")[1].split()[0]) == ("warning", "/BMresults")
            fake.refused_topics.clear()
            fake.know("/BMresults", "std_msgs/Float64MultiArray")
            await fake.vanish()
            await fake.come_back()
            number = 1
            while len(link.of(Seen)) < 2:
                link.take(result(boat, number := number + 1))
                await asyncio.sleep(0.01)
            assert [each.seen for each in link.of(Seen)] == [False, True]


async def test_results_are_looked_for_until_one_is_seen(boat, link):
    async with FakeRosbridge() as fake, publisher_of(boat, link, fake.uri):
        link.take(Begin(once=False))
        link.take(result(boat, 1))
        await link.until(lambda: link.of(Seen))
        assert ([each.seen for each in link.of(Seen)], link.of(Notice)) == ([True], [])
        await fake.wait_for_op("unsubscribe", topic="/BMresults")


def test_the_stages_of_a_report_are_the_whole_time_of_its_frame(boat):
    boards = result(boat, 1).result.boards
    publish = Publish(
        FrameResult(1, boards, 3_000, 70_000, 5_000, 60_000, 5_200, 8), 8, 9, 100_000, 120_000, 11_000
    )
    inference = infer(publish.result, boat)
    report = report_of(publish, inference, boat, now=(1, 300_000), previous_out_ns=4_000)
    stages = report.stages
    assert (report.link_bytes, report.link_transfers) == (5_200, 8)
    assert report.link_us("pcie-gen2") == pytest.approx(2 + 8 * 0.5)
    assert (stages.rosbridge_in, stages.waited, stages.rosbridge_out) == (20, 11, 4)
    assert (stages.register_writes, stages.compute, stages.reads, stages.boards_compute) == (3, 70, 5, 60)
    assert stages.local_hops == 300 - 120 - 11 - (3 + 70 + 5)  # what no process has measured


def test_a_report_has_the_readings_with_their_ages(boat):
    names = [variable.name for variable in boat.variables]
    publish = msgspec.structs.replace(
        result(boat, 1), received_tick=4_000_000, addresses=[3, None, -1], values=[3.2, None, None]
    )
    inference = infer(publish.result, boat)

    def report(publish):
        return report_of(publish, inference, boat, now=(1, 5_000_000), previous_out_ns=0)

    assert report(publish).missing == (names[1],)
    assert report(publish).readings == {names[0]: VariableReading(3.2, 3, 1.0)}
    of_topics = msgspec.structs.replace(publish, ticks=[1_000_000, 0, 4_000_000])
    assert report(of_topics).readings == {names[0]: VariableReading(3.2, 3, 4.0)}
