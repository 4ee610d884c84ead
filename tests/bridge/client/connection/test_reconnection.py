"""Reconnection: a lost connection is restored with all that it had, and memory stays flat over many of them."""

import asyncio
import gc
import json
import re
import time
import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.client import State, connect
from bridge.client.session import FIRST_DELAY, MAX_DELAY
from bridge.codecs.fragments import split
from bridge.errors import DisconnectedError, StateTimeoutError
from tests.bridge.client.stand_ins import as_cbor, tcp_service
from tests.bridge.hub.sockets import until
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE


@pytest.fixture
def delays(monkeypatch):
    """The waits before attempts to reconnect, which take no time."""
    waits = []
    sleep = asyncio.sleep

    async def no_sleep(delay, *_result):
        if delay > 0:
            waits.append(delay)
        await sleep(0.001 if delay > 0 else 0)

    monkeypatch.setattr("bridge.client.session.asyncio.sleep", no_sleep)
    return waits


def clock(now):
    return SimpleNamespace(monotonic=lambda: now[0], time_ns=time.time_ns, monotonic_ns=time.monotonic_ns)


async def gone_and_back(fake, ros):
    await fake.vanish()
    await ros.wait_for_state(State.RECONNECTING, PATIENCE)
    fake.received.clear()
    await fake.come_back()
    await ros.wait_for_state(State.CONNECTED, PATIENCE)


async def test_everything_is_restored(fake):
    states = []

    def on_state(state, reason):
        states.append((state, reason))
        raise RuntimeError("a callback that fails breaks nothing")

    async def handler(args):
        return args

    async with connect(fake.uri, on_state=on_state, check_types=False) as ros:
        subscription = ros.subscribe("/in", "p/T", throttle_rate=20, queue_length=3)
        publication = await ros.advertise("/out", "p/T", latch=True, queue_size=7)
        await ros.advertise_service("/echo", "p/Echo", handler)
        closed = ros.subscribe("/closed", "p/T")
        await closed.close()
        await publication.publish({"n": 1})
        await fake.wait_for_op("publish")
        before = [received.op for received in fake.received]
        assert (before[0]["throttle_rate"], before[0]["queue_length"]) == (20, 3)
        assert (before[1]["latch"], before[1]["queue_size"]) == (True, 7)

        reading = asyncio.create_task(anext(subscription))
        await gone_and_back(fake, ros)
        assert ros.reconnections == 1
        await fake.wait_for_op("subscribe", topic="/in")
        after = [received.op for received in fake.received]
        assert after == [before[1], before[-1], before[2], before[0]]
        # In both directions, on the same handles.
        await fake.publish("/in", {"n": 2})
        assert (await asyncio.wait_for(reading, PATIENCE)).msg == {"n": 2}
        await publication.publish({"n": 3})
        await fake.wait_for_op("publish", msg={"n": 3})
        async with connect(fake.uri) as other:
            assert await other.call("/echo", {"n": 4}) == {"n": 4}
    expected = [State.CONNECTED, State.RECONNECTING, State.CONNECTED, State.CLOSED]
    assert [state for state, _reason in states] == expected
    assert states[1][1]
    assert ros.last_error


async def test_nothing_is_published_into_the_void(fake, ros):
    publication = await ros.advertise("/a", "p/T")
    await fake.vanish()
    await ros.wait_for_state(State.RECONNECTING, PATIENCE)
    with pytest.raises(DisconnectedError, match=fake.uri):
        await publication.publish({"n": 1})
    with pytest.raises(DisconnectedError):
        await ros.call("/s")
    # Requests in the meantime are sent later.
    later = ros.subscribe("/later", "p/T")
    new = await ros.advertise("/new", "p/T")
    await publication.close()
    await fake.come_back()
    await ros.wait_for_state(State.CONNECTED, PATIENCE)
    await fake.wait_for_op("subscribe", topic="/later")
    assert fake.ops("publish") == []
    await fake.publish("/later", {"n": 2})
    assert (await later.next(PATIENCE)).msg == {"n": 2}
    await new.publish({"n": 3})
    await fake.wait_for_op("publish", topic="/new")


async def test_the_waits_double_up_to_two_seconds(delays):
    assert (FIRST_DELAY, MAX_DELAY) == (0.1, 2.0)
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        await fake.vanish()
        while len(delays) < 12:
            await asyncio.get_running_loop().run_in_executor(None, time.sleep, 0.01)
        for number, delay in enumerate(delays):
            longest = min(0.1 * 2**number, MAX_DELAY)
            assert 0.8 * longest <= delay <= longest
        assert "refused" in ros.last_error


@pytest.mark.parametrize(("steady", "longest"), [(600.0, 2.0), (0.0, 0.1)])
async def test_only_a_steady_connection_resets_the_back_off(fake, ros, delays, monkeypatch, steady, longest):
    monkeypatch.setattr("bridge.client.session.STEADY", steady)
    for number in range(6):
        await fake.cut()
        await fake.wait_for_connections(number + 2)
        await ros.wait_for_state(State.CONNECTED, PATIENCE)
    assert 0.8 * longest <= max(delays) <= longest


@pytest.mark.parametrize("trouble", ["refuses", "something else listens"])
async def test_it_comes_back_whatever_was_there_meanwhile(fake, ros, trouble):
    if trouble == "refuses":
        fake.refuses = 503
        await fake.cut()
        await until(lambda: "HTTP 503" in ros.last_error)
        fake.refuses = None
    else:
        await fake.vanish()
        async with tcp_service(lambda _reader, writer: writer.write(b"220 mail\r\n"), fake.port):
            await until(lambda: "220 mail" in ros.last_error)
        await fake.come_back()
    await ros.wait_for_state(State.CONNECTED, PATIENCE)


@pytest.mark.parametrize(
    ("frame", "said"),
    [(b"\x88\x02\x03\xe9", 1001), (b"\x88\x02\x03\xf1", 1009), (b"\xff\xff not a frame", "protocol")],
)
async def test_a_server_that_ends_the_connection_and_does_not_hang_up(fake, ros, monkeypatch, frame, said):
    monkeypatch.setattr("bridge.client.websocket.CLOSE_TIMEOUT", 0.2)
    fake.freeze()
    (client,) = fake._clients
    client.connection.transport.write(frame)
    await ros.wait_for_state(State.RECONNECTING, PATIENCE)
    assert str(said) in ros.last_error
    await ros.wait_for_state(State.CONNECTED, PATIENCE)


@pytest.mark.parametrize("ros", [{"ping_interval": 0.2, "ping_timeout": 0.1}], indirect=True)
async def test_a_silent_peer_is_noticed(fake, ros):
    subscription = ros.subscribe("/a", "p/T")
    await fake.wait_for_op("subscribe")
    await fake.publish("/a", {})
    await subscription.next(PATIENCE)
    fake.freeze()
    frozen = ros._session._connected()
    ros._session._limits = replace(ros._session._limits, ping_timeout=PATIENCE)  # of the next connection
    await ros.wait_for_state(State.RECONNECTING, PATIENCE)
    assert re.search(r"server for \d+(\.\d+)? s", ros.last_error)
    await ros.wait_for_state(State.CONNECTED, PATIENCE)
    await fake.wait_for_op("subscribe", count=2)
    await fake.publish("/a", {})
    await subscription.next(PATIENCE)
    assert subscription.blind_seconds == ros._session._connected_at - frozen.last_heard, (
        "it counts from the last sign of life"
    )


@pytest.mark.parametrize("fake", [{"silent": True}], indirect=True)
@pytest.mark.parametrize("ros", [{"ping_interval": 0.01, "ping_timeout": 2 * PATIENCE}], indirect=True)
async def test_a_quiet_server_that_answers_pings_is_kept(fake, ros):
    websocket = ros._session._connected()
    await until(lambda: websocket._pinged_at is not None and websocket._pinged_at <= websocket.last_heard)
    for _ in range(5):
        heard = websocket.last_heard
        websocket._check_liveness(time.monotonic())  # as after `ping_timeout`
        await until(lambda heard=heard: websocket.last_heard > heard)
    assert (ros.state, ros.reconnections, fake.connections) == (State.CONNECTED, 0, 1)


@pytest.mark.parametrize("ros", [{"ping_interval": 0.01, "ping_timeout": 2 * PATIENCE}], indirect=True)
async def test_a_sleep_of_this_process_is_not_the_servers_silence(fake, ros):
    fake.freeze()
    websocket = ros._session._connected()
    await until(lambda: websocket._pinged_at is not None and websocket._pinged_at > websocket.last_heard)
    fake.thaw()
    heard = websocket.last_heard
    websocket._check_liveness(time.monotonic() - 2.5)  # it is called late, while the answer is in transit
    await until(lambda: websocket.last_heard > heard)
    assert (ros.state, ros.reconnections, fake.connections) == (State.CONNECTED, 0, 1)


async def test_waiting_for_a_state_is_bounded_and_closing_ends_it_and_the_reconnecting(fake, ros):
    subscription = ros.subscribe("/a", "p/T")
    await ros.wait_for_state(State.CONNECTED, 1)
    await fake.vanish()
    await ros.wait_for_state(State.RECONNECTING, PATIENCE)
    with pytest.raises(StateTimeoutError) as caught:
        await ros.wait_for_state(State.CONNECTED, 0.05)
    assert str(caught.value).startswith(
        f"the connection to {fake.uri} was not connected within 0.05 s, it is reconnecting ("
    )
    assert caught.value.exit_code == 3
    waiting = asyncio.create_task(ros.wait_for_state(State.CONNECTED, PATIENCE))
    await asyncio.sleep(0)
    await ros.close()
    for late in (waiting, ros.wait_for_state(State.CONNECTED, PATIENCE)):
        with pytest.raises(DisconnectedError, match="closed"):
            await late
    assert not [task for task in asyncio.all_tasks() if "Session." in repr(task.get_coro())]
    await fake.come_back()
    async with connect(fake.uri):
        assert (ros.state, fake.connections) == (State.CLOSED, 2)
    assert [message async for message in subscription] == []


async def test_closing_from_the_callback(fake):
    closing = []

    def on_state(state, _reason):
        if state is State.RECONNECTING:
            closing.append(asyncio.get_running_loop().create_task(ros.close()))

    ros = connect(fake.uri, on_state=on_state)
    async with ros:
        await fake.cut()
        await ros.wait_for_state(State.CLOSED, PATIENCE)
    await asyncio.gather(*closing)


async def test_a_subscription_says_how_long_it_was_dark(fake, monkeypatch):
    now = [1000.0]
    for module in ("session", "websocket", "handles"):
        monkeypatch.setattr(f"bridge.client.{module}.time", clock(now))
    monkeypatch.setattr("bridge.transport.websocket.time", clock(now))
    async with connect(fake.uri) as ros:
        subscription = ros.subscribe("/a", "p/T")
        await fake.wait_for_op("subscribe")
        await fake.publish("/a", {})
        await subscription.next(PATIENCE)
        assert subscription.blind_seconds == 0
        for _ in range(2):
            await fake.vanish()
            await ros.wait_for_state(State.RECONNECTING, PATIENCE)
            now[0] += 0.25
            between = ros.subscribe("/c", "p/T")
            now[0] += 0.5
            await fake.come_back()
            await ros.wait_for_state(State.CONNECTED, PATIENCE)
        late = ros.subscribe("/b", "p/T")
        await fake.wait_for_op("subscribe", topic="/b")
        assert subscription.blind_seconds == 1.5
        assert between.blind_seconds == 0.5, "of the second time, since it was made"
        assert late.blind_seconds == 0
        await subscription.close()
        await gone_and_back(fake, ros)
        assert subscription.blind_seconds == 1.5


#: Bytes that may be more in use after many rounds than after few: caches, not one object a round.
SLACK = 40_000


def growth(play, rounds):
    """Bytes by which memory in use grew over the later rounds."""
    play(rounds // 4)
    gc.collect()
    tracemalloc.start()
    try:
        play(rounds // 4)
        gc.collect()
        before, _peak = tracemalloc.get_traced_memory()
        play(rounds)
        gc.collect()
        after, _peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return after - before


def encoded_as(msg, kind):
    operation = {"op": "publish", "topic": "/a", "msg": msg}
    if kind == "cbor":
        return [as_cbor(operation)]
    data = json.dumps(operation).encode()
    return list(split(data, 100, 1)) if kind == "fragments" else [data]


@pytest.mark.asyncio(loop_factories=["asyncio"])
@pytest.mark.parametrize("kind", ["json", "cbor", "fragments", "broken"])
async def test_a_reader_that_never_reads(kind):
    """The queue is full at once; each further message takes the place of the oldest."""
    compression = "cbor" if kind == "cbor" else "none"
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        subscription = ros.subscribe("/a", "p/T", compression=compression, queue_size=8)
        values = np.arange(100.0)
        pieces = encoded_as({"data": values if kind == "cbor" else values.tolist()}, kind)
        if kind == "broken":
            pieces = [b"{", b"[1]", b"\xff\xfe", b'{"op":"fragment","id":1,"data":"x","num":0,"total":9}']
        take = ros._session._take

        def play(rounds):
            for number in range(rounds):
                for piece in pieces:
                    take([piece.replace(b'"id":1,', b'"id":%d,' % number) if kind == "broken" else piece])

        assert growth(play, 1200) < SLACK
        assert subscription.lost == (0 if kind == "broken" else 1800 - 8)
        assert ros.unusable >= (3 * 1800 if kind == "broken" else 0)


@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_calls_and_goals_that_come_and_go(fake, ros):
    fake.serve("/echo", lambda args: args)
    take = ros._session._take

    def play(rounds):
        core = ros._session.core
        for number in range(rounds):
            call = core.calls.send("/echo", {"n": number})
            take([b'{"op":"service_response","id":"%b","values":{},"result":true}' % call.encode()])
            goal = core.goals.send("/fly", "p/Fly", {}, feedback=True)
            take([b'{"op":"action_result","id":"%b","values":{},"status":4}' % goal.encode()])
            core.subscriptions.unsubscribe(core.subscriptions.subscribe("/b", "p/T"))
            core.data_to_send()

    assert growth(play, 1500) < SLACK
