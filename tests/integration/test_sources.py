"""One model whose variables come from four topics of two servers, by real processes.

robot one: /range (Range), /cells (UInt8MultiArray, base64, no header)  ->  hub 1  ->  subscriber, master  ->  hub 1
robot two: /scan (LaserScan, CBOR), /imu (Imu)                          ->  hub 2  ->      "
"""

import asyncio
import contextlib
import json
import signal
import time

import numpy as np
import pytest

from bridge.client import connect
from bridge.errors import BridgeError
from bridge.stamps import header
from posteriors.listening import posteriors
from tests.fake_rosbridge import FakeRosbridge
from tests.integration.conftest import build_corridor, only_error
from tests.patience import PROCESS_PATIENCE

KNOWN = """
    known("near", 0.5, 8), known("left", 0.25, 8), known("ahead", 1.0, 8),
    known("turn", 0.5, 8, offset=-2.0), known("cell", 1.0, 8)"""
SOURCES = """
source = [
    {{ uri = "{one}", topic = "/range", type = "sensor_msgs/Range", variables = {{ near = "range" }} }},
    {{ uri = "{two}", topic = "/scan", type = "sensor_msgs/LaserScan", compression = "cbor", variables = {{ left = "ranges[90]", ahead = "ranges[0]" }} }},
    {{ uri = "{two}", topic = "/imu", type = "sensor_msgs/Imu", variables = {{ turn = "angular_velocity.z" }} }},
    {{ uri = "{one}", topic = "/cells", type = "std_msgs/UInt8MultiArray", variables = {{ cell = "data[2]" }} }},
]
"""
ADDRESSES = [4, 4, 4, 4, 4]
"""Readings of a robot in place 2, in the order of the columns."""


class Robots:
    """Publish what is read in place 2 on all four topics; a hub that goes away is waited for.

    Attributes:
        late_s: How far the clock of the second robot is behind, seconds.
    """

    def __init__(self, one, two):
        self.uris = (one, two)
        self.late_s = 0.0
        self._tasks = []

    async def __aenter__(self):
        self._tasks = [
            asyncio.create_task(self._publish(uri, read))
            for uri, read in zip(self.uris, (self._first, self._second), strict=True)
        ]
        return self

    async def __aexit__(self, *_):
        for task in self._tasks:
            task.cancel()
        for ended in await asyncio.gather(*self._tasks, return_exceptions=True):
            assert isinstance(ended, asyncio.CancelledError), ended

    async def _publish(self, uri, read):
        async with connect(uri, ros_version="2", connect_timeout=PROCESS_PATIENCE) as ros:
            topics = [await ros.advertise(topic, type_) for topic, type_, _ in read()]
            while True:
                with contextlib.suppress(BridgeError):
                    for topic, (_, _, message) in zip(topics, read(), strict=True):
                        await topic.publish(message)
                await asyncio.sleep(0.05)

    def _first(self):
        now = header(time.time_ns(), "robot", 2)
        cells = {"layout": {"dim": []}, "data": bytes([9, 9, 4])}
        return (
            ("/range", "sensor_msgs/Range", {"header": now, "max_range": 4.0, "range": 2.0}),
            ("/cells", "std_msgs/UInt8MultiArray", cells),
        )

    def _second(self):
        now = header(time.time_ns() - round(self.late_s * 1e9), "robot", 2)
        beams = np.full(360, np.float32(7))
        beams[0], beams[90] = 4.0, 1.0
        turn, felt = {"x": 9.0, "y": 9.0, "z": 0.0}, {"x": 1.0, "y": 1.0, "z": 9.8}
        moved = {"header": now, "angular_velocity": turn, "linear_acceleration": felt}
        return ("/scan", "sensor_msgs/LaserScan", {"header": now, "ranges": beams}), (
            "/imu",
            "sensor_msgs/Imu",
            moved,
        )


@pytest.fixture
async def robots(stage):
    (_, one), (_, two) = await stage.hub(), await stage.hub()
    async with Robots(one, two) as robots:
        yield robots


@pytest.fixture
def deployment(stage, robots):
    one, two = robots.uris
    return build_corridor(stage.where, KNOWN, SOURCES.format(one=one, two=two), "--tolerance", "0.5")


@pytest.mark.process
async def test_four_topics_of_two_servers_are_paired(stage, deployment):
    subscriber = stage.start("subscriber", "-d", str(deployment), "--count", "3")
    assert await subscriber.end() == 0
    printed = [json.loads(line) for line in subscriber.out.splitlines()]
    assert [each["addresses"] for each in printed] == [ADDRESSES] * 3


@pytest.mark.thorough
async def test_the_subscriber_alone(stage, deployment):
    async with FakeRosbridge() as server:  # a topic may come as CBOR
        stage.start("subscriber", "-d", str(deployment), "--uri", server.uri)
        for topic, asked in (("/scan", "cbor"), ("/imu", None)):
            await server.wait_for_op("subscribe", topic=topic, timeout=PROCESS_PATIENCE)
            (operation,) = server.ops("subscribe", topic=topic)
            assert operation.get("compression") == asked
    # and a beam that does not exist
    sources = (stage.where / "sources.toml").read_text().replace("ranges[90]", "ranges[360]")
    build_corridor(stage.where, KNOWN, sources)
    subscriber = stage.start("subscriber", "-d", str(deployment))
    assert await subscriber.end() == 4
    assert "/scan: the message has no field 'ranges[360]'" in only_error(subscriber)


@pytest.mark.thorough
async def test_clocks_that_disagree_are_named_and_what_is_unpaired_is_counted(stage, deployment, robots):
    robots.late_s = 5.0
    earliest_ns = time.time_ns() - 5 * 10**9
    async with connect(robots.uris[0]) as ros, posteriors(ros) as heard:
        command = ("master", "--loop", "--count", "3", "-d", str(deployment))
        master = stage.start(*command, environment={"BM_RUN_DIRECTORY": str(stage.runs)})
        await master.says(r"\b\d+(\.\d+)? s .*--tolerance")
        await stage.status("subscriber", lambda status: status["frames"]["lost"].get("unpaired", 0) > 20)
        robots.late_s = 0.0
        for _ in range(3):
            posterior = await heard.next(PROCESS_PATIENCE)
            assert posterior.best() == {"s": 2}
            assert posterior.probability > 0.9
            assert earliest_ns <= posterior.stamp_ns <= time.time_ns()
        assert await master.end() == 0
    assert "3 results published" in master.err
    unpaired = int(master.err.rsplit(" unpaired", 1)[0].rsplit(None, 1)[1])
    assert unpaired > 20


@pytest.mark.thorough
async def test_one_server_may_go_and_come(stage, deployment, robots):
    async with connect(robots.uris[0]) as ros, posteriors(ros) as heard:
        master = stage.start("master", "--loop", "-d", str(deployment))
        await heard.next(PROCESS_PATIENCE)
        port = int(robots.uris[1].rsplit(":", 1)[1])
        (second,) = (hub for hub in stage.running if hub.name == "hub" and f":{port}" in hub.err)
        second.send(signal.SIGKILL)
        await second.end()
        await master.says(rf"\[warning\] .*:{port} ")
        with contextlib.suppress(BridgeError):  # what was under way
            while True:
                await heard.next(1.0)
        await stage.hub(port)
        await master.says(rf"(?s)\[warning\] [^\n]*:{port} .*\n(?![^\n]*warning)[^\n]*:{port} ")
        for _ in range(3):
            assert (await heard.next(PROCESS_PATIENCE)).best() == {"s": 2}
        master.send(signal.SIGINT)
        assert await master.end() == 130
    assert "--tolerance" not in master.err
    await stage.nothing_left("hub")
