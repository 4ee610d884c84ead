"""One model whose variables come from several topics of two servers, with other clocks, formats and sizes.

robot one: /range (Range), /cells (UInt8MultiArray, base64, no header)  ->  server 1  ->  Subscriber  ->  link.sent
robot two: /scan (LaserScan, CBOR), /imu (Imu)                          ->  server 2  ->      "
"""

import asyncio
import contextlib
import json
import time
from contextlib import asynccontextmanager

import pytest

from bridge.client import State
from bridge.errors import AccessRefusedError, UnreachableError
from bridge.hub.access import AccessPolicy, tls_context
from bridge.stamps import header
from services.pipeline.connections import connect_all
from services.pipeline.frames import UNPAIRED_WARNING
from services.pipeline.subscriber import Subscriber
from services.pipes.subscriber import print_addresses
from services.settings import Settings
from services.sockets.records import Begin, LossReason, Notice, Reading, Unusable
from services.sockets.status import why_not_connected
from tests.bridge.hub.sockets import running_hub
from tests.certificates import issue
from tests.fake_rosbridge import FakeRosbridge
from tests.integration.conftest import build_corridor
from tests.patience import PATIENCE
from tests.services.conftest import until
from tests.services.pipeline.conftest import running
from toolchain.deployment import load_deployment

KNOWN = """
    known("near", 0.5, 8), known("left", 0.25, 8), known("ahead", 1.0, 8),
    known("turn", 0.5, 8, offset=-2.0), known("cell", 1.0, 8)"""
SOURCES = """
source = [
    {{ uri = "{one}", topic = "/range", type = "sensor_msgs/Range", variables = {{ near = "range" }} }},
    {{ uri = "{two}", topic = "/scan", type = "sensor_msgs/LaserScan", compression = "cbor", variables = {{ left = "ranges[9]", ahead = "ranges[0]" }} }},
    {{ uri = "{two}", topic = "/imu", type = "sensor_msgs/Imu", variables = {{ turn = "angular_velocity.z" }} }},
    {{ uri = "{one}", topic = "/cells", type = "std_msgs/UInt8MultiArray", variables = {{ cell = "data[2]" }} }},
]
"""


async def publish(one, two, *, late_s=0, beams=10):
    """Publish what is read in place 2 on all four topics; the second robot's clock may be late."""
    now, late = (header(time.time_ns() - by * 10**9, "robot", 2) for by in (0, late_s))
    await one.publish("/range", {"header": now, "range": 2.0})
    await one.publish("/cells", {"layout": {"dim": []}, "data": "CQkE"})  # 9, 9, 4
    await two.publish("/scan", {"header": late, "ranges": [4.0, *[7.0] * (beams - 2), 1.0]})
    await two.publish("/imu", {"header": late, "angular_velocity": {"x": 9.0, "y": 9.0, "z": 0.0}})


@asynccontextmanager
async def subscribed(link, deployment, *, topics, **settings):
    """A subscriber in a run, which has subscribed to each server's topics."""
    subscriber = Subscriber(Settings(**settings), deployment, link.make)
    async with running(subscriber, link):
        link.take(Begin(once=False))
        for fake, topic in topics:
            await fake.wait_for_op("subscribe", topic=topic)
        yield subscriber


async def test_four_topics_of_two_servers_are_paired(link, tmp_path, capsys):
    async with FakeRosbridge() as one, FakeRosbridge() as two:
        sources = SOURCES.format(one=one.uri, two=two.uri)
        deployment = load_deployment(build_corridor(tmp_path, KNOWN, sources, "--tolerance", "0.5"))
        topics = (one, "/range"), (one, "/cells"), (two, "/scan"), (two, "/imu")

        async def have(count):
            await link.until(lambda: len(link.of(Reading)) >= count)
            reading = link.of(Reading)[-1]
            assert (len(link.of(Reading)), reading.addresses) == (count, [4, 4, 4, 4, 4])
            return reading

        async with subscribed(link, deployment, topics=topics, queue="all") as subscriber:
            await publish(one, two)
            await have(1)
            # clocks that disagree
            for _ in range(UNPAIRED_WARNING + 1):
                await publish(one, two, late_s=5)
            await link.until(lambda: link.of(Notice))
            (notice,) = link.of(Notice)
            assert notice.level == "warning"
            assert "--tolerance" in notice.sentence
            await publish(one, two)
            unpaired = (await have(2)).unpaired
            assert unpaired > 0
            assert subscriber.status().frames.lost[LossReason.UNPAIRED] >= unpaired
            # a server that goes and comes
            await two.vanish()
            await subscriber._rosbridges[two.uri].wait_for_state(State.RECONNECTING, PATIENCE)
            await one.publish("/range", {"range": 2.0})
            await two.come_back()
            for topic in ("/scan", "/imu"):
                await two.wait_for_op("subscribe", topic=topic, count=2)
            await publish(one, two)
            await have(3)
            gone, back = link.of(Notice)[1:]
            assert (gone.level, back.level) == ("warning", "info")
            assert two.uri in gone.sentence
            assert two.uri in back.sentence
            # a beam that does not exist
            await publish(one, two, beams=9)
            await link.until(lambda: link.of(Unusable))
            assert "/scan: the message has no field 'ranges[9]'" in link.of(Unusable)[0].sentence

        printing = asyncio.create_task(print_addresses(Settings(), deployment, 1))
        for fake, topic in topics:
            await fake.wait_for_op("subscribe", topic=topic, count=2 if fake is one else 3)
            asked = {each.get("compression") for each in fake.ops("subscribe", topic=topic)}
            assert asked == {"cbor" if topic == "/scan" else None}
        await publish(one, two)
        assert await asyncio.wait_for(printing, PATIENCE) == 0
        assert json.loads(capsys.readouterr().out)["addresses"] == [4, 4, 4, 4, 4]


CAMERA = """
source = [
    {{ uri = "{uri}", topic = "/range", type = "sensor_msgs/Range", variables = {{ near = "range" }} }},
    {{ uri = "{uri}", topic = "/camera", type = "sensor_msgs/Image", variables = {{ red = "data[0]" }}{more} }},
]
"""


@pytest.mark.parametrize(
    ("more", "settings", "is_left_out"),
    [
        (", topic_bytes = 100000", {}, False),
        (", topic_bytes = 3000000", {"topic_bytes": 100_000}, False),
        ("", {"message_bytes": 1_000_000}, True),
    ],
)
async def test_readings_go_on_beside_a_camera_with_large_pictures(
    link, tmp_path, more, settings, is_left_out
):
    known = 'known("near"), known("red", on_missing="missing")'
    async with FakeRosbridge() as fake:
        sources = CAMERA.format(uri=fake.uri, more=more)
        deployment = load_deployment(build_corridor(tmp_path, known, sources))
        topics = (fake, "/range"), (fake, "/camera")
        async with subscribed(link, deployment, topics=topics, **settings) as subscriber:
            await fake.publish("/camera", {"data": "A" * 1_200_000})
            if is_left_out:
                await link.until(
                    lambda: "; frames go on" in "".join(each.sentence for each in link.of(Notice))
                )
                await fake.wait_for_op("subscribe", topic="/range", count=2)
            await fake.publish("/range", {"range": 4.0})
            await link.until(lambda: link.of(Reading))
            assert link.of(Reading)[0].addresses == [4, None]
            lost = subscriber.status().frames.lost
            assert lost == ({} if is_left_out else {LossReason.TOO_LARGE: 1})


# --- connections ---


async def test_a_certificate_that_only_the_settings_know(tmp_path):
    certificate, key = issue(tmp_path, "localhost")
    async with running_hub(access=AccessPolicy(tls=tls_context(certificate, key))) as port:
        uris = [f"wss://localhost:{port}"]
        async with contextlib.AsyncExitStack() as stack:
            by_uri = await connect_all(stack, Settings(ca=certificate), uris)
            assert by_uri[uris[0]].state == "connected"
        async with contextlib.AsyncExitStack() as stack:
            with pytest.raises((AccessRefusedError, UnreachableError)):
                await connect_all(stack, Settings(connect_timeout=0.5), uris)


async def test_a_robot_of_the_deployment_is_looked_up(monkeypatch):
    async with running_hub() as port:

        async def resolve(name, _timeout):
            assert name == "Robot 7"
            return f"ws://127.0.0.1:{port}"

        monkeypatch.setattr("bridge.discovery.resolve", resolve)
        async with contextlib.AsyncExitStack() as stack:
            by_uri = await connect_all(stack, Settings(), ["robot:Robot 7"])
            assert by_uri["robot:Robot 7"].state == "connected"


async def test_a_server_that_is_waited_for_is_named(unused_tcp_port):
    uri, by_uri = f"ws://127.0.0.1:{unused_tcp_port}", {}
    async with contextlib.AsyncExitStack() as stack:
        connecting = asyncio.create_task(
            connect_all(stack, Settings(connect_timeout=PATIENCE), [uri], by_uri)
        )
        await until(lambda: by_uri and by_uri[uri].last_error)
        assert uri in why_not_connected(by_uri)
        async with running_hub(port=unused_tcp_port):
            await connecting
            assert not why_not_connected(by_uri)
