"""The client on doubles of the real servers A, B and R, and on the hub: it accepts or reports each difference.

Ros ◀──WebSocket──▶ Double (A, B or R), or hub ◀──WebSocket──▶ another Ros
"""

import asyncio
import contextlib
from itertools import product

import numpy as np
import pytest

from bridge.client import connect
from bridge.codecs.serialised import MessageTypes
from bridge.errors import DecodeError, NoAnswerError, NoMessageError, ServiceError
from bridge.qos import Qos
from tests.bridge.client.doubles import Double
from tests.bridge.client.stand_ins import give_up
from tests.bridge.hub.sockets import until
from tests.patience import PATIENCE

TYPE = "std_msgs/Float64MultiArray"
SCAN_TYPE = "sensor_msgs/LaserScan"
VALUES = [1.5, 2.5, -3.0]
MSG = {"layout": {"dim": [], "data_offset": 0}, "data": VALUES}
SERVERS = pytest.mark.parametrize("double", ["A", "B", "R"], indirect=True)


@pytest.fixture
async def double(request):
    async with Double(request.param) as double:
        yield double


@pytest.fixture
async def ros(double):
    async with connect(double.uri) as ros:
        yield ros


@pytest.mark.parametrize(
    ("double", "compression"),
    [
        pair for pair in product("ABR", ["none", "cbor", "png"]) if pair != ("B", "png")
    ],  # B never delivers one
    indirect=["double"],
)
@pytest.mark.parametrize(("arrays", "fragment_size"), [("list", None), ("list", 16), ("numpy", 37)])
async def test_messages_come_from_every_server(double, ros, compression, arrays, fragment_size):
    subscription = ros.subscribe(
        "/a", TYPE, compression=compression, arrays=arrays, fragment_size=fragment_size
    )
    whole = ros.subscribe("/b", TYPE)  # a fragment size is for everything that follows
    await double.wait_for_op("subscribe", count=2)
    for topic, reader in (("/a", subscription), ("/b", whole), ("/a", subscription)):
        await double.publish(topic, MSG)
        message = await reader.next(PATIENCE)
        with pytest.raises(DecodeError, match=f"{topic} has no serialised bytes"):
            _ = message.raw
        data = message.msg["data"]
        assert isinstance(data, np.ndarray if reader is subscription and arrays == "numpy" else list)
        assert list(data) == VALUES
    assert ros.unusable == 0


@SERVERS
async def test_serialised_bytes_of_either_ros(double, ros):
    subscription = ros.subscribe("/a", TYPE, compression="cbor-raw")
    await double.wait_for_op("subscribe")
    await double.publish("/a", MSG)
    message = await subscription.next(PATIENCE)
    assert (message.msg["secs"], message.msg["nsecs"]) == (7, 5)
    assert MessageTypes().read(message.raw, TYPE)["data"].tolist() == VALUES


@pytest.mark.parametrize("double", ["R"], indirect=True)
async def test_refusals_of_the_server_are_reported(double, ros):
    double.known.remove("png")
    subscription = ros.subscribe("/a", TYPE, compression="png")
    waiting = asyncio.create_task(subscription.next(3600))
    await until(lambda: ros.statuses)
    give_up(subscription)
    with pytest.raises(NoMessageError, match="unsupported compression png$"):
        await waiting
    assert [status.level for status in ros.statuses] == ["error"]
    goal = await ros.send_goal("/fly", "p/Fly")
    await until(lambda: len(ros.statuses) == 2)
    with pytest.raises(NoAnswerError, match="unknown operation"):
        await goal.result(0.01)


@SERVERS
async def test_no_operation_of_the_client_makes_a_server_deaf(double):
    """A and B stop answering after JSON that is not an object."""

    async def echo(args):
        return args

    async with connect(double.uri, fragment_size=30) as ros:
        publication = await ros.advertise("/a", TYPE, latch=True)
        await publication.publish(MSG)
        await publication.publish({})
        async with ros.subscribe("/b", TYPE, throttle_rate=5), await ros.advertise_service("/s", "p/S", echo):
            goal = await ros.send_goal("/fly", "p/Fly")
            await goal.cancel()
        with contextlib.suppress(ServiceError):
            await ros.call("/nothing", {"x": [1, 2]}, timeout=PATIENCE)
        await publication.close()
        with contextlib.suppress(ServiceError):
            await ros.call("/nothing", timeout=PATIENCE)
        assert not any(client.dead for client in double._clients)
        assert all(received.op is not None for received in double.received)
        assert double.ops("fragment"), "what is larger than its fragments leaves in them"


@pytest.mark.parametrize(
    ("compression", "fragment_size", "arrays"),
    [("none", 50, "numpy"), ("png", None, "list"), ("cbor", None, "numpy"), ("cbor", 50, "list")],
)
async def test_a_scan_passes_the_hub_unchanged(hub, compression, fragment_size, arrays):
    options = {"compression": compression, "fragment_size": fragment_size, "arrays": arrays}
    async with connect(hub) as one, connect(hub, fragment_size=64) as other:
        scans = one.subscribe("/scan", SCAN_TYPE, qos=Qos(reliability="best_effort"), **options)
        await one.call("/rosapi/get_time", timeout=PATIENCE)
        publication = await other.advertise("/scan", SCAN_TYPE, qos=Qos(depth=5))
        await publication.publish(
            {"header": {"frame_id": "laser"}, "ranges": np.array([0.5, 1.5, 2.5], np.float32)}
        )
        msg = (await scans.next(PATIENCE)).msg
    assert (msg["header"]["frame_id"], list(msg["ranges"])) == ("laser", [0.5, 1.5, 2.5])
    assert isinstance(msg["ranges"], np.ndarray if arrays == "numpy" else list)
    if arrays == "numpy" and compression == "cbor":
        assert msg["ranges"].dtype == np.float32
