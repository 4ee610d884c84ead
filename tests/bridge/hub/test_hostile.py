"""The hub on a socket, with clients that are broken, silent, greedy or hostile.

Each test ends with a well-behaved client being served as if nothing had happened.
"""

import asyncio
import base64
import json
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.frames import Opcode

from bridge.hub.limits import HubLimits
from tests.bridge.hub.sockets import PATIENCE, Client, RawClient, client, running_hub


@asynccontextmanager
async def _hub_and_witness(limits: HubLimits | None = None) -> AsyncIterator[tuple[int, Client]]:
    """A hub, and a client of it that hears its own messages before, and must do so after."""
    async with running_hub(limits=limits) as port, client(port) as witness:
        await witness.send(op="advertise", topic="/witness", type="a/B")
        await witness.send(op="subscribe", topic="/witness")
        await _serves(witness)
        yield port, witness
        await _serves(witness)


async def _serves(witness: Client) -> None:
    await witness.send(op="publish", topic="/witness", msg={"well": True})
    assert (await witness.receive())["msg"] == {"well": True}


# --- wrong messages


@pytest.mark.parametrize("fragments", [1, 3])
async def test_a_message_that_is_too_large_costs_the_connection(fragments: int) -> None:
    limits = HubLimits(message_bytes=10_000)
    async with _hub_and_witness(limits) as (port, _witness), client(port) as greedy:
        await greedy.sync()
        part = "x" * (10_001 // fragments + 1)
        await greedy.websocket.send(part if fragments == 1 else [part] * fragments)
        assert await greedy.closed() == 1009


async def test_a_huge_message_is_refused_before_it_has_come() -> None:
    async with _hub_and_witness() as (port, _witness):
        raw = await RawClient.connect(port)
        raw.writer.write(b"\x81\xff" + (1 << 62).to_bytes(8, "big") + b"mask" + b"x" * 100)
        data = await raw.ended()
        assert data[:1] == b"\x88"
        assert data[2:4] == (1009).to_bytes(2, "big")


@pytest.mark.parametrize(
    "data",
    [
        b"42",
        b"[1,2,3]",
        b"",
        b"{",
        b"\xff\xfe\xfd",
        b'{"op":"publish","topic":"/witness","msg":{"a":"\xff"}}',
        b'{"op":"publish","topic":"/witness","msg":{"a":%b%b}}' % (b"[" * 100_000, b"]" * 100_000),
        b'{"op":"publish","topic":"/witness","msg":{"a":%bNaN%b}}' % (b"[" * 100_000, b"]" * 100_000),
    ],
    ids=lambda data: repr(data[:50]),
)
@pytest.mark.parametrize("opcode", [Opcode.TEXT, Opcode.BINARY])
async def test_nonsense_leaves_no_zombie(data: bytes, opcode: Opcode) -> None:
    async with _hub_and_witness() as (port, _witness):
        raw = await RawClient.connect(port)
        raw.send(data, opcode=opcode)
        raw.send_operation(op="call_service", service="/rosapi/get_ros_version", id=1)
        assert json.loads(await raw.message())["values"]["version"] == 1
        raw.cut()


@pytest.mark.parametrize(
    "frame",
    [
        b"\x81\x02{}",  # not masked
        b"\x83\x80mask",  # no opcode
        b"\xc1\x80mask",  # a reserved bit
        b"\x80\x80mask",  # continues nothing
        b"\x09\x80mask",  # a control frame in fragments
        b"\x89\xfe\x00\x7emask" + b"x" * 126,  # a control frame that is too long
        b"\x88\x81maskx",  # a close frame of one byte
    ],
)
async def test_broken_frames_cost_the_connection(frame: bytes) -> None:
    async with _hub_and_witness() as (port, _witness):
        raw = await RawClient.connect(port)
        raw.writer.write(frame)
        data = await raw.ended()
        assert data[:1] == b"\x88"
        assert data[2:4] == (1002).to_bytes(2, "big")


async def test_fragments_without_end_and_without_content_take_nothing() -> None:
    limits = HubLimits(message_bytes=1000)
    async with _hub_and_witness(limits) as (port, witness):
        raw = await RawClient.connect(port)
        raw.send(b"", fin=False)
        for _ in range(20_000):
            raw.send(b"", opcode=Opcode.CONT, fin=False)
        await raw.writer.drain()
        await witness.sync()
        raw.send(b'{"op":"call_service","service":"/rosapi/get_ros_version"}', opcode=Opcode.CONT)
        assert json.loads(await raw.message())["result"] is True
        raw.cut()


@given(st.lists(st.binary(max_size=200), max_size=5), st.booleans())
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
async def test_any_bytes_after_the_handshake(chunks: list[bytes], handshake: bool) -> None:
    async with _hub_and_witness() as (port, witness):
        raw = await RawClient.connect(port, handshake=handshake)
        for chunk in chunks:
            raw.writer.write(chunk)
            await witness.sync()
        raw.cut()


# --- floods


async def test_a_flood_of_nonsense_leaves_others_served() -> None:
    async with _hub_and_witness() as (port, witness):
        raw = await RawClient.connect(port)
        flood = b"\x81\x82mask\x59\x53" * 20_000  # "42"
        flooding = asyncio.create_task(_flood(raw, flood))
        for _ in range(30):
            await _serves(witness)
        flooding.cancel()
        raw.cut()


async def _flood(raw: RawClient, data: bytes) -> None:
    while True:
        raw.writer.write(data)
        await raw.writer.drain()


async def test_a_flood_of_messages_reaches_its_readers_and_leaves_others_served() -> None:
    async with _hub_and_witness() as (port, witness), client(port) as reader:
        await reader.send(op="subscribe", topic="/flood", type="a/B", queue_length=1)
        await reader.sync()
        raw = await RawClient.connect(port)
        for index in range(5000):
            raw.send_operation(op="publish", topic="/flood", msg={"i": index})
        for _ in range(10):
            await _serves(witness)
        heard = -1
        while heard < 4999:  # some may be dropped, the last never, and none comes out of order
            index = (await reader.receive())["msg"]["i"]
            assert index > heard
            heard = index
        raw.cut()


async def test_a_flood_of_calls_without_reading_costs_the_connection(quick_sweeps: None) -> None:
    limits = HubLimits(message_bytes=200_000, client_bytes=200_000, topics=2000)
    async with _hub_and_witness(limits) as (port, witness):
        for index in range(1500):  # so that one answer has 50 kB
            await witness.send(op="subscribe", topic=f"/a/long/name/of/a/topic/{index}")
        await witness.sync()
        raw = await RawClient.connect(port, receive_buffer=4096)
        for _ in range(1000):
            raw.send_operation(op="call_service", service="/rosapi/topics")
        await _gone(witness, raw)


async def test_thousands_of_topics() -> None:
    async with _hub_and_witness() as (port, witness), client(port) as many:
        for index in range(3000):
            await many.send(op="advertise", topic=f"/t{index}", type="a/B")
            await many.send(op="subscribe", topic=f"/t{index}")
        for index in range(3000):
            await many.send(op="publish", topic=f"/t{index}", msg={"i": index})
        for index in range(3000):
            assert (await many.receive())["msg"] == {"i": index}
        assert len((await witness.ask("/rosapi/topics"))["topics"]) == 3002


# --- those who take nothing


async def test_a_slow_client_misses_the_oldest_and_then_has_the_newest() -> None:
    async with _hub_and_witness() as (port, witness):
        slow = await RawClient.connect(port, receive_buffer=4096)
        slow.send_operation(op="subscribe", topic="/big", type="a/B", queue_length=2)
        await until_subscribed(witness, "/big")
        for count in range(300):  # 15 MB: more than socket buffers take
            await witness.send(op="publish", topic="/big", msg={"i": count, "data": "x" * 50_000})
        await witness.sync()
        heard = []
        while not heard or heard[-1] < 299:
            async with asyncio.timeout(PATIENCE):
                heard.append(json.loads(await slow.message())["msg"]["i"])
        assert heard == sorted(set(heard))
        assert len(heard) < 250
        assert heard[-2:] == [298, 299]
        slow.cut()


async def until_subscribed(witness: Client, topic: str, count: int = 1) -> None:
    await witness.wait_for("/rosapi/subscribers", lambda nodes: len(nodes) == count, topic=topic)


async def _gone(witness: Client, raw: RawClient) -> None:
    """Wait until the hub has forgotten all clients but the witness."""
    await witness.wait_for("/rosapi/nodes", lambda nodes: len(nodes) == 2)
    await raw.ended()


async def test_a_client_that_never_reads_is_closed_and_costs_others_nothing(quick_sweeps: None) -> None:
    limits = HubLimits(stuck_timeout=0.2)
    async with _hub_and_witness(limits) as (port, witness), client(port) as reader:
        await reader.send(op="subscribe", topic="/big", type="a/B")
        await reader.sync()
        stuck = await RawClient.connect(port, receive_buffer=4096)
        stuck.send_operation(op="subscribe", topic="/big")
        await until_subscribed(witness, "/big", 2)
        count = 0
        async with asyncio.timeout(PATIENCE):
            while len((await witness.ask("/rosapi/subscribers", topic="/big"))["subscribers"]) == 2:
                await witness.send(op="publish", topic="/big", msg={"i": count, "data": "x" * 50_000})
                assert (await reader.receive())["msg"]["i"] == count
                count += 1
        assert count > 5
        await stuck.ended()


async def test_a_client_that_only_publishes_and_never_reads_may_stay(quick_sweeps: None) -> None:
    limits = HubLimits(ping_interval=0.05, ping_timeout=10.0)
    async with _hub_and_witness(limits) as (port, witness):
        raw = await RawClient.connect(port)
        raw.send_operation(op="advertise", topic="/t", type="a/B")
        for _ in range(20):
            raw.send_operation(op="publish", topic="/t", msg={})
            await asyncio.sleep(0.02)
        assert (await witness.ask("/rosapi/publishers", topic="/t"))["publishers"]
        raw.cut()


# --- fragments, forms, actions


async def test_fragments_that_never_end_take_nothing_from_others() -> None:
    limits = HubLimits(message_bytes=20_000)
    async with _hub_and_witness(limits) as (port, witness):
        raw = await RawClient.connect(port)
        for index in range(2000):
            raw.send_operation(op="fragment", id=index % 50, data="x" * 5000, num=index % 60, total=60)
        raw.send_operation(op="fragment", id="whole", data='{"op":"call_service",', num=0, total=2)
        raw.send_operation(
            op="fragment", id="whole", data='"service":"/rosapi/get_ros_version","id":"f"}', num=1, total=2
        )
        await raw.writer.drain()
        answer = json.loads(await raw.message())
        assert (answer["id"], answer["result"]) == ("f", True)
        await _serves(witness)
        raw.cut()


async def test_fragments_within_fragments_go_nowhere() -> None:
    async with _hub_and_witness() as (port, _witness):
        raw = await RawClient.connect(port)
        operation = {"op": "call_service", "service": "/rosapi/get_time"}
        for _ in range(8):  # each one makes the next three times as large
            operation = {"op": "fragment", "id": "f", "data": json.dumps(operation), "num": 0, "total": 1}
        raw.send_operation(**operation)
        raw.send_operation(op="call_service", service="/rosapi/get_ros_version", id="after")
        assert json.loads(await raw.message())["id"] == "after"
        raw.cut()


@pytest.mark.parametrize(
    "wish",
    [{"compression": "cbor"}, {"compression": "png"}, {"fragment_size": 16}, {"compression": "cbor-raw"}],
)
async def test_a_slow_client_that_wants_another_form_costs_others_nothing(
    wish: dict[str, Any], quick_sweeps: None
) -> None:
    limits = HubLimits(stuck_timeout=0.3)
    async with _hub_and_witness(limits) as (port, witness):
        stuck = await RawClient.connect(port, receive_buffer=4096)
        stuck.send_operation(op="subscribe", topic="/big", type="std_msgs/String", **wish)
        await until_subscribed(witness, "/big")
        await witness.send(op="advertise", topic="/big", type="std_msgs/String")
        noise = base64.b85encode(os.urandom(15_000)).decode()  # a picture of it is no smaller
        async with asyncio.timeout(PATIENCE):
            while (await witness.ask("/rosapi/subscribers", topic="/big"))["subscribers"]:
                await witness.send(op="publish", topic="/big", msg={"data": noise})
        await stuck.ended()


async def test_binary_messages_that_are_no_json_are_refused() -> None:
    async with _hub_and_witness() as (port, _witness):
        raw = await RawClient.connect(port)
        deep = b"\x81" * 100_000
        for data in (
            b"\xa1bopgpublish",
            deep,
            b"\xbf" * 1000,
            b"\xd8\x56\x5b\xff\xff\xff\xff\xff\xff\xff\xff",
        ):
            raw.send(data, opcode=Opcode.BINARY)
        raw.send_operation(op="call_service", service="/rosapi/get_ros_version", id="after")
        assert json.loads(await raw.message())["id"] == "after"
        raw.cut()


async def test_a_flood_of_goals_is_bounded_and_answered() -> None:
    limits = HubLimits(goals_per_client=10)
    async with _hub_and_witness(limits) as (port, _witness), client(port) as server, client(port) as asker:
        await server.send(op="advertise_action", action="/slow", type="a/action/Slow")
        await server.sync()
        for number in range(500):
            await asker.send(op="send_action_goal", id=number, action="/slow", feedback=True)
        answers = [await asker.receive() for _ in range(490)]
        assert {answer["result"] for answer in answers} == {False}
        assert {answer["id"] for answer in answers} == set(range(10, 500))
        keys = [(await server.receive())["id"] for _ in range(10)]
        for index in range(2000):
            await server.send(op="action_feedback", id=keys[0], values={"i": index})
        for key in keys:
            await server.send(op="action_result", id=key, values={})
        ended = 0
        while ended < 10:
            ended += (await asker.receive())["op"] == "action_result"


async def test_a_server_of_actions_that_hangs_up_fails_its_goals() -> None:
    async with _hub_and_witness() as (port, witness):
        server = await RawClient.connect(port)
        server.send_operation(op="advertise_action", action="/dock", type="a/action/Dock")
        await witness.wait_for("/rosapi/action_servers", lambda names: "/dock" in names)
        await witness.send(op="send_action_goal", id="x", action="/dock")
        assert json.loads(await server.message())["op"] == "send_action_goal"
        server.cut()
        answer = await witness.receive()
        assert (answer["op"], answer["id"], answer["result"]) == ("action_result", "x", False)


async def test_a_flood_of_refusals_is_reported_without_harm() -> None:
    async with _hub_and_witness() as (port, witness), client(port, max_queue=None) as listener:
        await listener.send(op="subscribe", topic="/rosout", queue_length=10)
        await listener.sync()
        raw = await RawClient.connect(port)
        raw.send_operation(op="set_level", level="error")
        for _ in range(5000):
            raw.send(b"42")
        assert (await listener.receive())["topic"] == "/rosout"
        await _serves(witness)
        raw.cut()


# --- those who vanish


async def test_a_silent_client_is_pinged_and_then_closed(quick_sweeps: None) -> None:
    limits = HubLimits(ping_interval=0.1, ping_timeout=2.0)
    async with _hub_and_witness(limits) as (port, witness):
        raw = await RawClient.connect(port)
        assert await raw.frame() == (Opcode.PING, b"")
        await _gone(witness, raw)


async def test_a_client_that_answers_pings_may_be_silent(quick_sweeps: None) -> None:
    limits = HubLimits(ping_interval=0.02, ping_timeout=10.0)
    async with _hub_and_witness(limits) as (port, _witness):
        raw = await RawClient.connect(port)
        for _ in range(10):
            assert (await raw.frame())[0] == Opcode.PING
            raw.send(b"", opcode=Opcode.PONG)
        raw.send_operation(op="call_service", service="/rosapi/get_ros_version")
        answer = await raw.message()  # the next sweep's ping may come before it
        assert json.loads(answer)["result"] is True
        raw.cut()


async def test_a_connection_without_a_handshake_is_closed(quick_sweeps: None) -> None:
    async with _hub_and_witness(HubLimits(handshake_timeout=0.5)) as (port, _witness):
        silent = await RawClient.connect(port, handshake=False)
        assert await silent.ended() == b""
        slow = await RawClient.connect(port, handshake=False)
        slow.writer.write(b"GET / HTTP/1.1\r\n")
        assert await slow.ended() == b""


async def test_a_server_that_hangs_up_during_a_call_fails_it() -> None:
    async with _hub_and_witness() as (port, witness):
        server = await RawClient.connect(port)
        server.send_operation(op="advertise_service", service="/add", type="a/Add")
        await witness.wait_for("/rosapi/services", lambda names: "/add" in names)
        await witness.send(op="call_service", service="/add", id="x")
        assert json.loads(await server.message())["op"] == "call_service"
        server.cut()
        answer = await witness.receive()
        assert (answer["id"], answer["result"]) == ("x", False)


@pytest.mark.parametrize("how", ["reset", "eof", "mid-message"])
async def test_a_vanished_client_leaves_nothing(how: str) -> None:
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


async def test_clients_that_come_and_go_leave_nothing() -> None:
    async with _hub_and_witness() as (port, witness):
        for _ in range(100):
            raw = await RawClient.connect(port)
            raw.send_operation(op="subscribe", topic="/witness")
            await _serves(witness)
            raw.cut()
        await witness.wait_for("/rosapi/nodes", lambda nodes: len(nodes) == 2)
