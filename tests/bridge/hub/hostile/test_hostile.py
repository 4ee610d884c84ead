"""The hub on a socket, with clients that are broken, silent, greedy or hostile.

Each test ends with a well-behaved client being served as if nothing had happened.
"""

import asyncio
import base64
import json
import os
from contextlib import asynccontextmanager

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.frames import Opcode

from bridge.hub.limits import HubLimits
from tests.bridge.hub.sockets import RawClient, client, running_hub
from tests.patience import FACTOR, PATIENCE


@asynccontextmanager
async def _hub_and_witness(limits=None):
    """A hub, and a client of it that hears its own messages before, and must do so after."""
    async with running_hub(limits=limits) as port, client(port) as witness:
        await witness.send(op="advertise", topic="/witness", type="a/B")
        await witness.send(op="subscribe", topic="/witness")
        await _serves(witness)
        yield port, witness
        await _serves(witness)


async def _serves(witness):
    await witness.send(op="publish", topic="/witness", msg={"well": True})
    assert (await witness.receive())["msg"] == {"well": True}


# --- wrong messages


@pytest.mark.parametrize("fragments", [1, 3])
async def test_a_message_that_is_too_large_costs_the_connection(fragments, caplog):
    limits = HubLimits(message_bytes=10_000)
    async with _hub_and_witness(limits) as (port, _witness), client(port) as greedy:
        await greedy.sync()
        part = "x" * (10_001 // fragments + 1)
        await greedy.websocket.send(part if fragments == 1 else [part] * fragments)
        assert await greedy.closed() == 1009
    assert len([record for record in caplog.records if record.name == "bridge.hub.server"]) == 1


@pytest.mark.parametrize(
    ("frame", "code"),
    [
        (b"\x81\x02{}", 1002),  # not masked
        (b"\x83\x80mask", 1002),  # no opcode
        (b"\xc1\x80mask", 1002),  # a reserved bit
        (b"\x80\x80mask", 1002),  # continues nothing
        (b"\x89\xfe\x00\x7emask" + b"x" * 126, 1002),  # a control frame that is too long
        (
            b"\x81\xff" + (1 << 62).to_bytes(8, "big") + b"mask" + b"x" * 100,
            1009,
        ),  # before all of it has come
    ],
)
async def test_broken_and_huge_frames_cost_the_connection(frame, code):
    async with _hub_and_witness() as (port, _witness):
        raw = await RawClient.connect(port)
        raw.writer.write(frame)
        data = await raw.ended()
        assert data[:1] == b"\x88"
        assert data[2:4] == code.to_bytes(2, "big")


@given(st.lists(st.binary(max_size=200), max_size=5), st.booleans())
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
async def test_any_bytes_after_the_handshake(chunks, handshake):
    async with _hub_and_witness() as (port, witness):
        raw = await RawClient.connect(port, handshake=handshake)
        for chunk in chunks:
            raw.writer.write(chunk)
            await witness.sync()
        raw.cut()


# --- floods


async def test_a_flood_of_nonsense_is_reported_and_leaves_others_served():
    async with _hub_and_witness() as (port, witness), client(port, max_queue=None) as listener:
        await listener.send(op="subscribe", topic="/rosout", queue_length=10)
        await listener.sync()
        raw = await RawClient.connect(port)
        raw.send_operation(op="set_level", level="error")
        flood = b"\x81\x82mask\x59\x53" * 20_000  # "42"

        async def write():
            while True:
                raw.writer.write(flood)
                await raw.writer.drain()

        flooding = asyncio.create_task(write())
        assert (await listener.receive())["topic"] == "/rosout"
        for _ in range(30):
            await _serves(witness)
        flooding.cancel()
        raw.cut()


async def test_a_flood_of_calls_without_reading_costs_the_connection(quick_sweeps):
    limits = HubLimits(message_bytes=200_000, client_bytes=200_000, topics=2000, stuck_timeout=0.3)
    async with _hub_and_witness(limits) as (port, witness):
        for index in range(1500):  # so that one answer has 50 kB
            await witness.send(op="subscribe", topic=f"/a/long/name/of/a/topic/{index}")
        await witness.sync()
        raw = await RawClient.connect(port, receive_buffer=4096)
        for _ in range(1000):
            raw.send_operation(op="call_service", service="/rosapi/topics")
        await _gone(witness, raw)


# --- those who take nothing


async def until_subscribed(witness, topic, count=1):
    await witness.wait_for("/rosapi/subscribers", lambda nodes: len(nodes) == count, topic=topic)


async def _gone(witness, raw):
    """Wait until the hub has forgotten all clients but the witness."""
    await witness.wait_for("/rosapi/nodes", lambda nodes: len(nodes) == 2)
    await raw.ended()


@pytest.mark.parametrize(
    "wish",
    [{}, {"compression": "cbor"}, {"compression": "png"}, {"fragment_size": 16}, {"compression": "cbor-raw"}],
)
async def test_a_client_that_never_reads_is_closed_and_costs_others_nothing(wish, quick_sweeps):
    limits = HubLimits(stuck_timeout=0.3)
    async with _hub_and_witness(limits) as (port, witness), client(port) as reader:
        await reader.send(op="subscribe", topic="/big", type="std_msgs/String")
        await reader.sync()
        stuck = await RawClient.connect(port, receive_buffer=4096)
        stuck.send_operation(op="subscribe", topic="/big", **wish)
        await until_subscribed(witness, "/big", 2)
        noise = base64.b85encode(os.urandom(15_000)).decode()  # its picture is not smaller
        async with asyncio.timeout(PATIENCE):
            while len((await witness.ask("/rosapi/subscribers", topic="/big"))["subscribers"]) == 2:
                await witness.send(op="publish", topic="/big", msg={"data": noise})
                assert (await reader.receive())["msg"] == {"data": noise}
        await stuck.ended()


# --- those who vanish


async def test_a_silent_client_is_pinged_and_then_closed(quick_sweeps):
    limits = HubLimits(ping_interval=0.1, ping_timeout=FACTOR)
    async with _hub_and_witness(limits) as (port, witness):
        raw = await RawClient.connect(port)
        assert await raw.frame() == (Opcode.PING, b"")
        await _gone(witness, raw)


async def test_a_client_that_answers_pings_may_be_silent(quick_sweeps):
    limits = HubLimits(ping_interval=0.02, ping_timeout=PATIENCE)
    async with _hub_and_witness(limits) as (port, _witness):
        raw = await RawClient.connect(port)
        for _ in range(10):
            assert (await raw.frame())[0] == Opcode.PING
            raw.send(b"", opcode=Opcode.PONG)
        raw.send_operation(op="call_service", service="/rosapi/get_ros_version")
        answer = await raw.message()  # the next sweep's ping may come before it
        assert json.loads(answer)["result"] is True
        raw.cut()


async def test_a_connection_without_a_handshake_is_closed(quick_sweeps):
    async with _hub_and_witness(HubLimits(handshake_timeout=0.5 * FACTOR)) as (port, _witness):
        silent = await RawClient.connect(port, handshake=False)
        assert await silent.ended() == b""
        slow = await RawClient.connect(port, handshake=False)
        slow.writer.write(b"GET / HTTP/1.1\r\n")
        assert await slow.ended() == b""


@pytest.mark.parametrize("how", ["reset", "eof", "mid-message"])
async def test_a_vanished_client_leaves_nothing(how):
    async with _hub_and_witness() as (port, witness):
        raw = await RawClient.connect(port)
        raw.send_operation(op="subscribe", topic="/t", type="a/B")
        raw.send_operation(op="advertise", topic="/t", type="a/B", latch=True)
        raw.send_operation(op="publish", topic="/t", msg={})
        await until_subscribed(witness, "/t")
        if how == "mid-message":
            raw.writer.write(b"\x81\xfe\x01\x00maskpart of it")
            await raw.writer.drain()
        if how == "eof":
            raw.writer.write_eof()
        else:
            raw.cut()
        await witness.wait_for("/rosapi/publishers", lambda nodes: nodes == [], topic="/t")
