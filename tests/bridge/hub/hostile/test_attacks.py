"""The hub under attack: memory stays within the budgets, and work within a turn, whatever a client sends.

Memory is the peak of this process's resident set, which includes the attackers themselves.
"""

import asyncio
import contextlib
import gc
import json
import logging
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from websockets.frames import Frame, Opcode

from bridge.codecs import cbor_codec, json_codec
from bridge.codecs.fragments import Reassembler
from bridge.hub import server
from bridge.hub.broker import TURN_WORK
from bridge.hub.limits import HubLimits
from tests.bridge.hub.broker_harness import Harness, publisher_and_subscriber
from tests.bridge.hub.sockets import RawClient, client, running_hub

MEBIBYTE = 1 << 20
MARGIN = 64 * MEBIBYTE
"""Growth of the process beyond the hub's budgets."""


def _status(field):
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(field)).split()[1])


@contextmanager
def memory_bounded(budget=0):
    """Fail if the process grows by more than a budget and the margin, even for a moment."""
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before = _status("VmRSS")
    yield
    assert _status("VmHWM") - before <= budget + MARGIN


def subscribed(compression, type_name, ros_version=1):
    publisher, subscriber = publisher_and_subscriber(type_name, ros_version, compression=compression)
    publisher.publish("/t", {})  # loads the definitions
    subscriber.read()
    return publisher, subscriber


# --- conversions


@pytest.mark.parametrize(
    ("type_name", "message"),
    [
        ("sensor_msgs/Image", {"data": 300_000_000}),
        ("sensor_msgs/Image", {"data": 10**13}),
        ("sensor_msgs/Image", {"data": [1, 256]}),
        ("sensor_msgs/Image", {"data": [True]}),
        ("sensor_msgs/Image", {"data": "no base64"}),
        ("sensor_msgs/Imu", {"orientation_covariance": [0, 1, 2]}),
        ("sensor_msgs/LaserScan", {"ranges": 10**9}),
        ("sensor_msgs/LaserScan", {"ranges": [0, "x"]}),
        ("std_msgs/Int32MultiArray", {"data": [1 << 31]}),
        ("std_msgs/Int32MultiArray", {"layout": {"dim": {}}}),
        ("std_msgs/Int32", {"data": 1.5}),
        ("std_msgs/Int32", {"data": True}),
        ("std_msgs/Float32", {"data": 1e300}),
        ("std_msgs/Bool", {"data": 2}),
    ],
)
def test_a_message_that_does_not_fit_its_type_is_neither_converted_nor_serialised(type_name, message):
    publisher, subscriber = subscribed("cbor", type_name)
    raw_publisher, raw_subscriber = subscribed("cbor-raw", type_name)
    with memory_bounded():
        publisher.publish("/t", message)
        raw_publisher.publish("/t", message)
    (received,) = subscriber.messages()
    field, value = next(iter(message.items()))
    if field != "layout":
        assert repr(received[field]) == repr(value)  # integers have not become floats either
    assert [operation["op"] for operation in raw_subscriber.read()] == ["status"]


def test_a_number_beyond_float32_is_not_converted_to_infinity():
    publisher, subscriber = subscribed("cbor", "sensor_msgs/LaserScan")
    publisher.publish("/t", {"ranges": [1e300, None]})
    payload = subscriber.client.outbox.pop()
    assert payload is not None
    ranges = cbor_codec.decode(payload, arrays="numpy")["msg"]["ranges"]
    assert (ranges.dtype, ranges[0]) == ("f8", 1e300)


@pytest.mark.parametrize("ros_version", [1, 2])
def test_defaults_of_left_out_fields_are_bounded(ros_version):
    publisher, subscriber = subscribed("cbor-raw", "visualization_msgs/MarkerArray", ros_version)
    with memory_bounded():
        publisher.send_raw(b'{"op":"publish","topic":"/t","msg":{"markers":[%b{}]}}' % (b"{}," * 300_000))
    assert (publisher.client.refused, subscriber.read()) == (1, [])
    publisher.publish("/t", {"markers": [{}] * 500})
    assert len(subscriber.messages()) == 1


# --- fragments


def test_incomplete_messages_expire_without_another_fragment():
    hub = Harness()
    peers = [hub.connect() for _ in range(2)]
    for peer in peers:
        peer.send(op="fragment", id="f", data="{", num=0, total=2)
        hub.advance(4)
    hub.advance(3)
    assert [len(peer.client.fragments or ()) for peer in peers] == [0, 1]
    hub.advance(10)
    assert [len(peer.client.fragments or ()) for peer in peers] == [0, 0]


async def test_fragments_are_written_in_turns(monkeypatch):
    written, sizes = 0, []
    send, flush = server._Connection.send, server._Connection.flush

    def count(connection, messages):
        nonlocal written
        written += sum(map(len, messages))
        send(connection, messages)

    def measure(connection):
        before = written
        flush(connection)
        sizes.append(written - before)

    monkeypatch.setattr(server._Connection, "send", count)
    monkeypatch.setattr(server._Connection, "flush", measure)
    async with running_hub() as port, client(port, max_queue=None) as reader:
        await reader.send(op="subscribe", topic="/t", type="a/B", fragment_size=16)
        await reader.sync()
        await reader.send(op="publish", topic="/t", msg={"data": "x" * 1_000_000})
        box, whole = Reassembler(), None
        while whole is None:
            whole = box.take(await reader.receive(), 0.0)
    assert json.loads(whole)["msg"] == {"data": "x" * 1_000_000}
    assert max(sizes) <= 32 * 400  # fragments of 256 bytes, which take as long as longer ones


# --- output that a client causes


async def _pipeline_calls(raw):
    for index in range(64):
        raw.send_operation(op="call_service", service="/rosapi/get_param", args={"name": "/large"}, id=index)


async def _pipeline_subscriptions(raw):
    for index in range(64):
        raw.send_operation(op="subscribe", topic="/large", id=index, queue_length=100)


@pytest.mark.parametrize("attack", [_pipeline_calls, _pipeline_subscriptions])
async def test_output_of_one_turn_counts(attack):
    limits = HubLimits(message_bytes=MEBIBYTE // 2, client_bytes=MEBIBYTE)
    value = "x" * 400_000
    async with running_hub(limits=limits) as port, client(port) as witness:
        await witness.ask("/rosapi/set_param", name="/large", value=json.dumps(value))
        await witness.send(op="publish", topic="/large", type="a/B", msg={"data": value}, latch=True)
        await witness.sync()
        attackers = [await RawClient.connect(port, receive_buffer=4096) for _ in range(20)]
        budget = len(attackers) * (limits.client_bytes + 2 * limits.message_bytes)
        with memory_bounded(budget):
            for raw in attackers:
                await attack(raw)
                await raw.writer.drain()
            for _ in range(20):
                await witness.sync()
        for raw in attackers:
            raw.cut()


async def test_a_client_that_reads_gets_all_answers_that_it_asked_for_at_once():
    limits = HubLimits(message_bytes=MEBIBYTE // 2, client_bytes=MEBIBYTE // 2)
    async with running_hub(limits=limits) as port, client(port) as reader:
        await reader.ask("/rosapi/set_param", name="/large", value=json.dumps("x" * 400_000))
        raw = await RawClient.connect(port)
        await _pipeline_calls(raw)
        assert [json.loads(await raw.message())["id"] for _ in range(64)] == list(range(64))
        raw.cut()


async def test_a_client_that_reads_no_pongs_is_not_read_either():
    pings = Frame(Opcode.PING, b"x" * 125).serialize(mask=True) * 500
    async with running_hub() as port, client(port) as witness:
        raw = await RawClient.connect(port, receive_buffer=4096)
        sent = 0
        with contextlib.suppress(TimeoutError):
            while sent < 50 * MEBIBYTE:
                raw.writer.write(pings)
                sent += len(pings)
                await asyncio.wait_for(raw.writer.drain(), 0.5)
        assert sent < 50 * MEBIBYTE
        await witness.sync()
        raw.cut()


# --- work of one turn


def test_depth_is_checked_without_visiting_the_values():
    opcodes = 0

    def trace(frame, event, _arg):
        nonlocal opcodes
        if frame.f_code.co_filename != json_codec.__file__:
            return None  # callbacks of the garbage collector, for example
        frame.f_trace_opcodes = True
        opcodes += event == "opcode"
        return trace

    data = b'{"a":[%b[]]}' % (b"[]," * 300_000)
    sys.settrace(trace)
    try:
        json_codec.decode(data)
    finally:
        sys.settrace(None)
    assert opcodes < 10_000


def _resubscribe(hub):
    peer = hub.connect()
    for index in range(4096):
        hub.broker.receive(peer.client, b'{"op":"subscribe","topic":"/t","id":%d}' % index, 0.0)
    return {"op": "subscribe", "topic": "/t", "id": 7}


def _list_topics(hub):
    for half in range(2):
        peer = hub.connect()
        for index in range(4096):
            hub.broker.receive(peer.client, b'{"op":"subscribe","topic":"/%d/%d"}' % (half, index), 0.0)
    return {"op": "call_service", "service": "/rosapi/topics"}


def _replay(hub):
    hub.connect().publish("/t", {"data": "x" * 1_000_000}, type="a/B", latch=True)
    return {"op": "subscribe", "topic": "/t", "id": 7}


def _publish_to_many(hub):
    hub.connect()
    for _ in range(1000):
        hub.broker.receive(hub.connect().client, b'{"op":"subscribe","topic":"/t"}', 0.0)
    return {"op": "publish", "topic": "/t", "type": "std_msgs/Empty", "msg": {}}


def _publish_incomplete(hub):
    hub.connect()
    hub.connect().subscribe("/t")
    message = {"markers": [{}] * 2000}  # almost a mebibyte with the default values of its fields
    return {"op": "publish", "topic": "/t", "type": "visualization_msgs/MarkerArray", "msg": message}


@pytest.mark.parametrize(
    "prepare", [_resubscribe, _list_topics, _replay, _publish_to_many, _publish_incomplete]
)
def test_a_turn_ends_after_a_bounded_amount_of_work(prepare):
    hub = Harness(client_bytes=100 * MEBIBYTE, clients=2000)
    operation = prepare(hub)
    peer = next(iter(hub.broker.graph.clients.values()))
    messages = [json.dumps(operation | ({"id": index})).encode() for index in range(64)]
    if (
        operation["op"] == "publish"
    ):  # with the type the first time, and then with an envelope that becomes known
        del operation["type"]
        messages[1:] = [json.dumps(operation).encode()] * 63
    if prepare is _resubscribe:
        messages = [json.dumps(operation).encode()] * 64
    turns = 0
    while messages:
        performed = hub.broker.receive_turn(peer, messages, 0.0)
        assert performed > 0
        assert hub.broker._dispatcher.work <= 4 * TURN_WORK
        messages = messages[performed:]
        turns += 1
    assert turns > 5


# --- connections


async def test_silent_connections_do_not_lock_newcomers_out():
    async with running_hub(limits=HubLimits(clients=3, handshake_timeout=1000)) as port:
        silent = [await RawClient.connect(port, handshake=False) for _ in range(400)]
        async with client(port) as newcomer:
            await newcomer.sync()
        for raw in silent[: 400 - server._HANDSHAKES]:
            assert await raw.ended() == b""
        assert not silent[-1].reader.at_eof()
        for raw in silent[400 - server._HANDSHAKES :]:
            raw.cut()


async def test_refused_handshakes_do_not_flood_the_log(caplog):
    async with running_hub() as port:
        for _ in range(100):
            raw = await RawClient.connect(port, handshake=False)
            assert " 403 " in await raw.request("Origin: https://evil.example")
            raw.cut()
    assert 1 <= len([record for record in caplog.records if record.levelno == logging.WARNING]) <= 11
