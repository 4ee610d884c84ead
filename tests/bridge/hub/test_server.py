"""The hub on a socket, with well-behaved clients, and its limits."""

import asyncio
import dataclasses
import json
import platform
import re
import subprocess
import sys
from contextlib import AsyncExitStack
from types import SimpleNamespace

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from bridge.hub import server
from bridge.hub.access import AccessPolicy
from bridge.hub.limits import HubError, HubLimits
from bridge.hub.server import serve_hub
from tests.bridge.hub.sockets import RawClient, client, running_hub
from tests.patience import PATIENCE, PROCESS_PATIENCE


async def test_messages_of_every_length_arrive_whole():
    async with running_hub() as port, client(port) as ears:
        await ears.send(op="advertise", topic="/t", type="a/B")
        await ears.send(op="subscribe", topic="/t")
        for size in (0, 60, 80, 100, 200, 65_400, 65_500, 65_600, 200_000, (1 << 20) - 60):
            for letter in "xy":
                await ears.send(op="publish", topic="/t", msg={"data": letter * size})
            for letter in "xy":
                assert (await ears.receive())["msg"]["data"] == letter * size


async def test_what_is_due_happens_by_itself():
    limits = HubLimits(call_timeout=0.1)
    async with running_hub(limits=limits) as port, client(port) as ears, client(port) as offers:
        await ears.send(op="subscribe", topic="/t", type="a/B", throttle_rate=30, queue_length=10)
        for index in range(4):
            await ears.send(op="publish", topic="/t", msg={"i": index})
        assert [(await ears.receive())["msg"]["i"] for _ in range(4)] == [0, 1, 2, 3]
        await offers.send(op="advertise_service", service="/add", type="a/Add")
        await offers.sync()
        for number in range(2):  # and nobody answers
            await ears.send(op="call_service", service="/add", id=number)
            answer = await ears.receive()
            assert (answer["id"], answer["result"]) == (number, False)
            assert "/add" in answer["values"]


@pytest.mark.parametrize("path", ["/", "/rosbridge", "/a/b?c=d"])
async def test_any_path_will_do_and_nothing_is_compressed(path):
    async with (
        running_hub() as port,
        connect(f"ws://127.0.0.1:{port}{path}", compression="deflate") as socket,
    ):
        assert socket.response is not None
        assert "Sec-WebSocket-Extensions" not in socket.response.headers


async def test_a_client_can_leave_politely():
    async with running_hub() as port, client(port) as stays:
        async with client(port) as leaves:
            await leaves.send(op="subscribe", topic="/t", type="a/B")
            await leaves.sync()
        assert await leaves.closed() == 1000
        assert (await stays.ask("/rosapi/topics"))["topics"] == ["/rosout"]


async def test_the_end_of_the_hub_closes_its_clients_with_1001():
    async with AsyncExitStack() as clients, AsyncExitStack() as hub:
        port = await hub.enter_async_context(running_hub())
        ears = await clients.enter_async_context(client(port))
        await ears.sync()
        await hub.aclose()
        assert await ears.closed() == 1001
        with pytest.raises(OSError):  # noqa: PT011 - each event loop has its own class for a refused connection
            await connect(f"ws://127.0.0.1:{port}")


async def test_the_hub_ends_although_a_client_does_not(quick_sweeps):
    async with AsyncExitStack() as stack:
        port = await stack.enter_async_context(running_hub())
        deaf = await RawClient.connect(port)
        half = await RawClient.connect(port, handshake=False)
        ends = [asyncio.create_task(raw.ended()) for raw in (deaf, half)]
        await asyncio.sleep(0)
        await asyncio.wait_for(stack.aclose(), PATIENCE)
        assert await asyncio.gather(*ends) == [b"\x88\x0e\x03\xe9the hub ends", b""]


@pytest.mark.parametrize(
    ("host", "port"),
    [("127.0.0.1", None), ("192.0.2.1", 0), ("no-such-host.invalid", 0), ("127.0.0.1", 70000)],
)
async def test_an_address_that_is_in_use_or_not_ours_is_an_error(host, port):
    async with running_hub() as used:
        with pytest.raises(HubError, match=f"port {used}" if port is None else host):
            await serve_hub(host, used if port is None else port, stop=asyncio.Event())


async def test_too_many_clients_are_answered_503():
    async with running_hub(limits=HubLimits(clients=2)) as port:
        async with client(port) as one, client(port):
            with pytest.raises(InvalidStatus) as caught:
                await connect(f"ws://127.0.0.1:{port}")
            assert caught.value.response.status_code == 503
            await one.sync()
        async with client(port) as late:
            await late.sync()


@pytest.mark.parametrize(
    ("data", "answer"),
    [
        (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", rb"HTTP/1.1 426 (?s:.*)WebSocket"),  # a browser
        *((garbage, b"") for garbage in (b"\r\n\r\n", b"\x16\x03\x01" + b"\0" * 300, b"x" * 100_000)),
    ],
)
async def test_what_is_no_websocket_request_ends_the_connection(data, answer):
    async with running_hub() as port, client(port) as ears:
        raw = await RawClient.connect(port, handshake=False)
        raw.writer.write(data)
        raw.writer.write_eof()
        assert re.match(answer, await raw.ended())
        await ears.sync()


async def test_a_backlog_of_many_turns_arrives_in_order():
    # more than the sockets hold, then small messages for several turns
    sizes = [900_000] * 3 + [10] * (5 * server._TURN_MESSAGES)
    async with running_hub() as port, client(port) as robot:
        slow = await RawClient.connect(port, receive_buffer=4096)
        slow.send_operation(op="subscribe", topic="/t", type="a/B", queue_length=1000)
        await robot.wait_for("/rosapi/subscribers", bool, topic="/t")
        for number, size in enumerate(sizes):
            await robot.send(op="publish", topic="/t", type="a/B", msg={"i": number, "data": "x" * size})
        await robot.sync()
        assert [json.loads(await slow.message())["msg"]["i"] for _ in sizes] == list(range(len(sizes)))


@pytest.mark.process
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have other rules")
def test_the_memory_of_large_messages_is_retained():
    code = """
import asyncio, resource
from tests.bridge.hub.sockets import RawClient, client, running_hub

async def main():
    async with running_hub() as port, client(port) as ears:
        await ears.send(op="subscribe", topic="/t", type="a/B", queue_length=1000)
        raw, faults = await RawClient.connect(port), []
        for _ in range(20):
            for _ in range(50):
                raw.send_operation(op="publish", topic="/t", type="a/B", msg={"data": "x" * 17_000})
            for _ in range(50):
                await ears.receive()
            faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
        print(faults[-1] - faults[9])

asyncio.run(main())
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, timeout=PROCESS_PATIENCE
    )
    assert int(done.stdout) < 10 * 50  # pages; otherwise several for each of 500 messages


async def test_a_delayed_hub_closes_no_client():
    swept = []

    class Connection:
        def sweep(self, now):
            swept.append(now)

    hub = server._Hub(HubLimits(), AccessPolicy(), 1, loopback=True)
    hub.connections.add(Connection())  # a double with the one method that is called
    hub._swept -= 10
    hub.sweep()
    assert not swept
    hub.sweep()
    assert swept
    hub.connections.clear()
    await hub.close()


async def test_only_prompt_responses_keep_the_hub_awake(monkeypatch):
    polls: list[None] = []
    poll = server._Hub._poll
    monkeypatch.setattr(server._Hub, "_poll", lambda hub: (polls.append(None), poll(hub)))
    monkeypatch.setattr(server, "_AWAKE", 3600.0)
    async with running_hub() as port, client(port) as hears, client(port) as robot:
        await hears.send(op="subscribe", topic="/t", type="a/B")
        await hears.sync()  # the first message is not a response, and a single response is no habit
        for _ in range(3):
            await robot.send(op="publish", topic="/t", type="a/B", msg={})
            await hears.receive()
        assert not polls
        await hears.sync()
        await hears.sync()
        assert polls  # and the hub still works, and ends


async def test_polling_in_vain_is_not_repeated_at_once(monkeypatch):
    now = 0.0
    monkeypatch.setattr(server, "time", SimpleNamespace(monotonic=lambda: now))
    hub = server._Hub(HubLimits(), AccessPolicy(), 1, loopback=True)

    async def polls_after(*responses: int) -> bool:
        nonlocal now
        for microseconds in responses:
            now = microseconds * 1e-6
            hub.stay_awake(now)
        await asyncio.sleep(0)
        return hub._is_polling

    async def nothing_until(microseconds: int) -> None:
        nonlocal now
        now = microseconds * 1e-6
        await asyncio.sleep(0)

    assert not await polls_after(0)
    assert await polls_after(100)
    await nothing_until(400)  # but as soon as the core is free
    assert not await polls_after(450, 600, 1300, 1400)
    assert await polls_after(1550)
    await nothing_until(1900)
    assert not await polls_after(1950, 3000, 3100, 3900)  # twice as long
    assert await polls_after(4050, 4100)  # not in vain
    await nothing_until(4500)
    assert not await polls_after(4550, 5500)
    assert await polls_after(5650)
    await nothing_until(6000)
    assert not await polls_after(100_000)
    assert await polls_after(100_100)  # a pause of the client is not held against polling
    await nothing_until(100_500)
    assert not await polls_after(100_600)
    assert await polls_after(100_700)  # nor a slow response


def test_every_limit_must_be_positive():
    for field in dataclasses.fields(HubLimits):
        with pytest.raises(HubError, match=field.name):
            HubLimits(**{field.name: 0})


def test_limits_that_contradict_each_other_are_refused():
    with pytest.raises(HubError, match="client_bytes"):
        HubLimits(message_bytes=1000, client_bytes=999)
    with pytest.raises(HubError, match="depth"):
        HubLimits(depth=251)
    assert HubError.exit_code == 2
