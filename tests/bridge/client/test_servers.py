"""The client on doubles of the real servers, A, B and R: what each does otherwise is either taken or told.

Ros ◀──WebSocket──▶ Double (A, B or R)
"""

import asyncio
import contextlib
import logging

import numpy as np
import pytest

from bridge.client import connect
from bridge.codecs.serialised import MessageTypes
from bridge.errors import NoAnswerError, NoMessageError, ServiceError
from tests.bridge.client.doubles import DEPTH, Double

PATIENCE = 60.0
TYPE = "std_msgs/Float64MultiArray"
VALUES = [1.5, 2.5, -3.0]
MSG = {"layout": {"dim": [], "data_offset": 0}, "data": VALUES}
SERVERS = pytest.mark.parametrize("server", ["A", "B", "R"])


@SERVERS
@pytest.mark.parametrize("compression", ["none", "cbor"])
@pytest.mark.parametrize("arrays", ["list", "numpy"])
async def test_messages_come_from_every_server(server, compression, arrays):
    async with Double(server) as double, connect(double.uri) as ros:
        subscription = ros.subscribe("/a", TYPE, compression=compression, arrays=arrays)
        await double.wait_for_op("subscribe")
        await double.publish("/a", MSG)
        data = (await subscription.next(PATIENCE)).msg["data"]
        assert isinstance(data, np.ndarray if arrays == "numpy" else list)
        assert list(data) == VALUES
        assert ros.unusable == 0


@SERVERS
async def test_serialised_bytes_of_either_ros(server):
    types = MessageTypes()
    async with Double(server) as double, connect(double.uri) as ros:
        subscription = ros.subscribe("/a", TYPE, compression="cbor-raw")
        await double.wait_for_op("subscribe")
        await double.publish("/a", MSG)
        message = await subscription.next(PATIENCE)
        assert (message.msg["secs"], message.msg["nsecs"]) == (7, 5)
        assert types.read(message.raw, TYPE)["data"].tolist() == VALUES


@SERVERS
@pytest.mark.parametrize("fragment_size", [16, 37, 100_000])
async def test_fragments_with_totals_that_are_no_whole_numbers(server, fragment_size):
    async with Double(server) as double, connect(double.uri) as ros:
        subscription = ros.subscribe("/a", TYPE, fragment_size=fragment_size)
        sticky = ros.subscribe("/b", TYPE)
        await double.wait_for_op("subscribe", count=2)
        for topic, reader in (("/a", subscription), ("/b", sticky), ("/a", subscription)):
            await double.publish(topic, MSG)
            assert (await reader.next(PATIENCE)).msg == MSG
        assert ros.unusable == 0


@pytest.mark.parametrize("server", ["A", "R"])
@pytest.mark.parametrize("fragment_size", [None, 50])
async def test_pictures(server, fragment_size):
    async with Double(server) as double, connect(double.uri) as ros:
        subscription = ros.subscribe("/a", TYPE, compression="png", fragment_size=fragment_size)
        await double.wait_for_op("subscribe")
        await double.publish("/a", MSG)
        assert (await subscription.next(PATIENCE)).msg == MSG


async def test_a_picture_that_never_comes():
    async with Double("B") as double, connect(double.uri) as ros:
        subscription = ros.subscribe("/a", TYPE, compression="png")
        await double.wait_for_op("subscribe")
        await double.publish("/a", MSG)
        with pytest.raises(NoMessageError, match="no message of /a"):
            await subscription.next(0.2)


async def test_a_compression_that_the_server_refuses_is_told():
    async with Double("R") as double, connect(double.uri) as ros:
        double.known.remove("png")
        subscription = ros.subscribe("/a", TYPE, compression="png")
        with pytest.raises(NoMessageError, match="unsupported compression png$"):
            await subscription.next(0.5)
        assert [status.level for status in ros.statuses] == ["error"]


@pytest.mark.parametrize("server", ["A", "B"])
async def test_json_and_serialised_bytes_exclude_each_other_between_clients(server):
    """Nothing tells the second client: all it can do is name the topic, the server and the time."""
    async with Double(server) as double, connect(double.uri) as one, connect(double.uri) as two:
        first = one.subscribe("/a", TYPE)
        second = two.subscribe("/a", TYPE, compression="cbor-raw")
        await double.wait_for_op("subscribe", count=2)
        await double.publish("/a", MSG)
        assert (await first.next(PATIENCE)).msg == MSG
        with pytest.raises(NoMessageError, match=r"/a .*within 0.2 s"):
            await second.next(0.2)


@SERVERS
async def test_no_first_message_comes_twice(server):
    """Two readers of a topic are one subscription on the wire, so that no server takes them for two ids."""
    async with Double(server) as double, connect(double.uri) as ros:
        one, two = ros.subscribe("/a", TYPE), ros.subscribe("/a", TYPE)
        await double.wait_for_op("subscribe")
        for number in range(2):
            await double.publish("/a", MSG | {"data": [float(number)]})
        for reader in (one, two):
            assert [(await reader.next(PATIENCE)).msg["data"] for _ in range(2)] == [[0.0], [1.0]]
        assert len(double.ops("subscribe")) == 1


@SERVERS
async def test_the_newest_of_a_burst_arrives(server):
    async with Double(server) as double, connect(double.uri) as ros:
        subscription = ros.subscribe("/a", TYPE, queue_size=4)
        await double.wait_for_op("subscribe")
        await double.burst("/a", [MSG | {"data": [float(n)]} for n in range(50)])
        with contextlib.suppress(ServiceError):
            await ros.call("/comes/after/the/messages", timeout=PATIENCE)
        data = [(await subscription.next(PATIENCE)).msg["data"][0] for _ in range(4)]
        assert data == [46.0, 47.0, 48.0, 49.0]
        assert subscription.lost == (46 if server == "A" else DEPTH - 4)


@SERVERS
async def test_no_operation_of_the_client_makes_a_server_deaf(server):
    """A and B never answer again once they have read JSON that is no object."""

    async def echo(args):
        return args

    async with Double(server) as double, connect(double.uri, fragment_size=30) as ros:
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


async def test_a_server_without_actions_says_so_or_nothing():
    """What is not known is silence on A, and a status from R."""
    for server, said in (("A", "did not end within 0.3 s$"), ("R", "unknown operation")):
        async with Double(server) as double, connect(double.uri) as ros:
            goal = await ros.send_goal("/fly", "p/Fly")
            with pytest.raises(NoAnswerError, match=said):
                await goal.result(0.3)


@pytest.mark.parametrize("server", ["A", "B"])
async def test_a_server_that_is_deaf_is_noticed_by_what_was_asked(server, caplog):
    caplog.set_level(logging.CRITICAL)
    async with Double(server) as double, connect(double.uri) as ros:
        ros._session._websocket.send([b"[1,2,3]"])  # what other clients do
        async with asyncio.timeout(PATIENCE):
            while not any(client.dead for client in double._clients):
                await asyncio.sleep(0.01)
        subscription = ros.subscribe("/a", TYPE)
        await double.wait_for_op("subscribe")
        await double.publish("/a", MSG)
        with pytest.raises(NoMessageError):
            await subscription.next(0.2)
