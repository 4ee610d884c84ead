"""Simulated time: at any rate, paused and begun again, readings are paired and age by it.

/clock, /range (stamped), /cells (without a header; may be missing) ──▶ FakeRosbridge ──▶ Subscriber ──▶ link.sent
"""

import asyncio
import contextlib

import pytest

from bridge.client import connect
from bridge.stamps import stamp
from services.pipeline.clock import Clock
from services.pipeline.result_topics import ResultTopics
from services.pipeline.subscriber import Subscriber
from services.settings import Settings
from services.sockets.records import Begin, Notice, Reading
from tests.fake_rosbridge import FakeRosbridge
from tests.integration.conftest import build_corridor
from tests.patience import PATIENCE
from tests.services.conftest import until
from tests.services.pipeline.conftest import running
from tests.services.pipeline.test_publisher import result
from tests.services.pipeline.test_standard_topics import values
from toolchain.deployment import load_deployment

MS = 1_000_000
KNOWN = 'known("near"), known("cell", on_missing="missing")'
SOURCES = """
source = [
    {{ uri = "{uri}", topic = "/range", type = "sensor_msgs/Range", variables = {{ near = "range" }} }},
    {{ uri = "{uri}", topic = "/cells", type = "std_msgs/UInt8MultiArray", variables = {{ cell = "data[0]" }} }},
]
"""


class Simulation:
    """A simulator on a fake server; a step of its clock takes as much real time as is wanted."""

    def __init__(self, fake, clock, *, ros_version=2, real_s=0.0):
        self._fake, self._clock, self._version, self._real_s = fake, clock, ros_version, real_s
        self.ms = 0

    async def at(self, ms):
        """Publish the clock in steps of 10 ms up to a time; a time before it is a new beginning."""
        steps = range(self.ms + 10, ms + 1, 10) if ms > self.ms else (ms,)
        for self.ms in steps:
            await asyncio.sleep(self._real_s)
            await self._fake.publish("/clock", {"clock": self.stamp()})
            await until(lambda: self._clock.time_ns() == self.ms * MS)

    def stamp(self):
        return stamp(self.ms * MS, self._version)

    async def range(self, value):
        await self._fake.publish("/range", {"header": {"stamp": self.stamp()}, "range": value})

    async def cells(self, value):
        await self._fake.publish("/cells", {"layout": {"dim": []}, "data": [value]})


@contextlib.asynccontextmanager
async def simulated(link, tmp_path, **options):
    async with FakeRosbridge() as fake:
        deployment = load_deployment(build_corridor(tmp_path, KNOWN, SOURCES.format(uri=fake.uri)))
        subscriber = Subscriber(
            Settings(use_sim_time=True, ready_timeout=0.2, first_data_timeout=PATIENCE), deployment, link.make
        )
        async with running(subscriber, link):
            link.take(Begin(once=False))
            for topic in ("/range", "/cells", "/clock"):
                await fake.wait_for_op("subscribe", topic=topic)
            yield Simulation(fake, subscriber._clock, **options), subscriber


@pytest.mark.parametrize("ros_version", [1, 2])
async def test_ticks_go_on_when_the_clock_begins_again(ros_version):
    clock, heard = Clock(simulated=True), []
    assert (clock.time_ns(), clock.tick()) == (0, 0)
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        following = asyncio.create_task(
            clock.follow(ros, lambda: heard.append((clock.time_ns(), clock.tick())))
        )
        await fake.wait_for_op("subscribe", topic="/clock")
        times = [7_000_000_000, 7_000_000_005, 7_000_000_005, 3, 4, 2**31 * 10**9, 0, 2**31 * 10**9]
        for count, time_ns in enumerate(times, 1):
            await fake.publish("/clock", {"clock": "noon"})
            await fake.publish("/clock", {"clock": stamp(time_ns, ros_version)})
            await until(lambda count=count: len(heard) == count)
        following.cancel()
    hour = 3600 * 10**9
    assert heard == list(zip(times, [0, 5, 5, 5, 6, 6 + hour, 6 + hour, 6 + 2 * hour], strict=True))


@pytest.mark.parametrize("real_s", [0.0, 0.05], ids=["faster", "at a fifth of the rate"])
async def test_a_topic_is_waited_for_as_long_as_simulated_time_says(link, tmp_path, real_s):
    """The tolerance is 50 ms, in which a slow simulation takes a quarter of a second; without a header, it stamps."""
    async with simulated(link, tmp_path, real_s=real_s) as (simulation, subscriber):
        for turn in range(1, 4):
            await simulation.at(100 * turn)
            await simulation.range(turn)
            await simulation.at(100 * turn + 40)
            await simulation.cells(turn)
            await link.until(lambda turn=turn: len(link.of(Reading)) == turn)
        assert [(each.stamp_ns, each.addresses) for each in link.of(Reading)] == [
            ((100 * turn + 40) * MS, [turn, turn]) for turn in range(1, 4)
        ]
        # older by simulated time
        last = link.of(Reading)[-1]
        assert last.received_tick - last.ticks[0] == 40 * MS
        # the other topic brings nothing: after 50 ms it is left out, and not before
        await simulation.at(400)
        await simulation.range(4)
        await simulation.at(440)
        assert len(link.of(Reading)) == 3
        await until(lambda: "and /clock has brought nothing for" in subscriber.status().why)
        await simulation.at(460)
        await link.until(lambda: len(link.of(Reading)) == 4)
        assert link.of(Reading)[-1].addresses == [4, None]


async def test_a_paused_simulation_is_ready_and_one_that_begins_again_goes_on(link, tmp_path):
    async with simulated(link, tmp_path) as (simulation, subscriber):
        for begin in (2_000, 0):
            before = len(link.of(Reading))
            for turn in range(1, 3):
                await simulation.at(begin + 100 * turn)
                await simulation.range(turn)
                await simulation.cells(turn)
                await link.until(lambda count=before + turn: len(link.of(Reading)) == count)
            assert [each.addresses for each in link.of(Reading)[before:]] == [[1, 1], [2, 2]]
            # by this computer's clock the last reading is too old
            await until(lambda: subscriber.status().frames.last_age_s > 0.5)
            assert subscriber.status().ready
            await simulation.at(simulation.ms + 250)
            assert "no complete reading for 0 s" in subscriber.status().why
        assert link.of(Notice) == []


async def test_what_is_published_ages_by_simulated_time(boat):
    async with FakeRosbridge() as fake:
        topics = ResultTopics(Settings(uri=fake.uri, use_sim_time=True, ready_timeout=0.2), boat)
        async with topics.opened():
            standard = topics.standard
            following = asyncio.create_task(standard.follow_clock())
            await fake.wait_for_op("subscribe", topic="/clock")
            simulation = Simulation(fake, standard._clock)
            publish = result(boat, 1)
            await simulation.at(publish.stamp_ns // MS + 30)
            topics.publish_now(publish)
            await fake.wait_for_op("publish", topic="/bm/decision")
            (decision,) = fake.ops("publish", topic="/bm/decision")
            assert float(values(decision["msg"]["status"][0])["age_ms"]) == pytest.approx(30, abs=1)
            (health,) = fake.ops("publish", topic="/diagnostics")
            assert health["msg"]["header"]["stamp"] == stamp(simulation.ms * MS, 2)
            await simulation.at(simulation.ms + 190)
            assert {each["level"] for each in standard._health()["status"]} == {0}
            await simulation.at(simulation.ms + 20)
            assert {each["level"] for each in standard._health()["status"]} == {3}
            following.cancel()


async def test_the_time_of_a_simulation_that_is_not_followed_is_reported(link, tmp_path, monkeypatch):
    monkeypatch.setattr("services.pipeline.connections.AFTER", 0.05)
    async with FakeRosbridge(rosapi=True) as fake, connect(fake.uri) as simulator:
        await simulator.advertise("/clock", "rosgraph_msgs/Clock")
        await fake.wait_for_op("advertise", topic="/clock")
        deployment = load_deployment(build_corridor(tmp_path, KNOWN, SOURCES.format(uri=fake.uri)))
        async with running(Subscriber(Settings(), deployment, link.make), link):
            link.take(Begin(once=False))
            await link.until(lambda: any("--use-sim-time" in each.sentence for each in link.of(Notice)))
