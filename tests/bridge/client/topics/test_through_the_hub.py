"""Scans in every form and transforms through the hub, and large messages in fragments."""

import asyncio

import numpy as np
import pytest

from bridge.client import connect
from bridge.codecs.serialised import MessageTypes
from bridge.errors import DecodeError, FrameUnknownError
from bridge.qos import Qos
from tests.bridge.test_transforms import SECOND, message, turned
from tests.patience import PATIENCE

SCAN_TYPE = "sensor_msgs/LaserScan"
BOTH = pytest.mark.parametrize("hub", [{"ros_version": 1}, {"ros_version": 2}], indirect=True)


@BOTH
@pytest.mark.parametrize(
    ("compression", "fragment_size", "arrays"),
    [("none", 50, "numpy"), ("png", 60, "list"), ("cbor", None, "numpy"), ("cbor-raw", None, "list")],
)
async def test_a_scan_arrives_in_every_form(hub, compression, fragment_size, arrays):
    options = {"compression": compression, "fragment_size": fragment_size, "arrays": arrays}
    async with connect(hub) as one, connect(hub, fragment_size=64) as other:
        scans = one.subscribe("/scan", SCAN_TYPE, qos=Qos(reliability="best_effort"), **options)
        await one.call("/rosapi/get_time", timeout=PATIENCE)
        publication = await other.advertise("/scan", SCAN_TYPE, qos=Qos(depth=5))
        sent = {"header": {"frame_id": "laser"}, "ranges": np.array([0.5, 1.5, 2.5], np.float32)}
        await publication.publish(sent)
        received = await scans.next(PATIENCE)
    if compression == "cbor-raw":
        assert received.msg["secs"] > 1_600_000_000
        msg = MessageTypes().read(received.raw, SCAN_TYPE)
    else:
        msg = received.msg
        assert isinstance(msg["ranges"], np.ndarray if arrays == "numpy" else list)
        with pytest.raises(DecodeError, match="/scan has no serialised bytes"):
            _ = received.raw
    assert (msg["header"]["frame_id"], list(msg["ranges"])) == ("laser", [0.5, 1.5, 2.5])
    if compression == "cbor":
        assert msg["ranges"].dtype == np.float32


@BOTH
async def test_a_lookup_waits_for_both_topics(hub):
    async with connect(hub) as ros:
        static = await ros.advertise("/tf_static", "tf2_msgs/TFMessage", latch=True)
        await static.publish(message("base", "laser", turned(0.5, 0, SECOND)))
        async with ros.transforms() as transforms:
            with pytest.raises(FrameUnknownError):
                await transforms.lookup("map", "laser", timeout=0.05)
            waiting = asyncio.create_task(transforms.lookup("map", "laser", 3 * SECOND, PATIENCE))
            moving = await ros.advertise("/tf", "tf2_msgs/TFMessage")
            for second in (2, 4):
                await moving.publish(message("map", "base", turned(second, 0, second * SECOND)))
            assert np.allclose((await waiting).apply([0, 0, 0]), [3.5, 0, 0])
        await transforms.close()


@pytest.mark.parametrize("ros", [{"fragment_size": 300}], indirect=True)
async def test_what_is_larger_than_its_fragments_leaves_in_them(fake, ros):
    publication = await ros.advertise("/a", "p/T")
    await publication.publish({"data": [1.5] * 200})
    assert (await fake.wait_for_op("fragment", count=3))["total"] >= 3
    assert not fake.ops("publish")
