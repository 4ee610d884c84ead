"""The first connection: rosbridge servers, and the errors for anything else at the URI."""

import asyncio
import contextlib
import gc
import re
import socket
from types import SimpleNamespace

import pytest
import uvloop
from websockets.frames import Frame, Opcode
from websockets.utils import accept_key

from bridge.client import State, connect
from bridge.client.websocket import WebSocket
from bridge.discovery import UnknownRobotError
from bridge.errors import (
    AccessRefusedError,
    BridgeError,
    DisconnectedError,
    NotRosbridgeError,
    OptionError,
    UnreachableError,
    UriError,
)
from tests.bridge.client.stand_ins import tcp_service
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import FACTOR, PATIENCE


async def fails(uri, error, **options):
    """Connecting fails as expected; what it said, with the URI in it."""
    with pytest.raises(error) as caught:
        async with connect(uri, **options):
            pytest.fail("it connected")
    assert caught.value.exit_code == (2 if error in {UriError, AccessRefusedError} else 3)
    assert uri in str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


async def test_it_connects_and_closes(fake):
    ros = connect(fake.uri)
    assert ros.state is State.CONNECTING
    async with ros:
        assert ros.state is State.CONNECTED
        assert ros.uri == fake.uri
    assert ros.state is State.CLOSED
    with pytest.raises(DisconnectedError, match=r"connect\(\)"):
        await ros.__aenter__()
    await ros.close()


async def test_a_uri_that_is_none():
    wrong = ("127.0.0.1:9090", "http://robot:9090", "ws://:9090", "", "ws://robot:70000", "ws://[::1")
    for uri in (*wrong, "ws://" + "a" * 100 + ".local"):
        assert repr(uri) in await fails(uri, UriError)


async def test_a_robots_name_is_looked_up_once(fake, monkeypatch):
    asked = []

    async def resolve(name, timeout):
        asked.append((name, timeout))
        if name == "Adam":
            raise UnknownRobotError("no robot called Adam")
        return fake.uri if name == "Zoë" else "http://robot:9090"

    monkeypatch.setattr("bridge.discovery.resolve", resolve)
    ros = connect("robot:Zoë", connect_timeout=7)
    assert (ros.uri, asked) == ("robot:Zoë", [])
    async with ros:
        assert ros.uri == fake.uri
        await fake.cut()
        await fake.wait_for_connections(2)
    assert asked == [("Zoë", 7)]  # within the time to connect
    for name, error in (("Adam", UnknownRobotError), ("Eve", UriError)):
        ros = connect(f"robot:{name}")
        with pytest.raises(error):
            await ros.__aenter__()
        assert ros.state is State.CLOSED
    # an option that does not suit the server
    with pytest.raises(OptionError, match="requires wss://"):
        await connect("robot:Zoë", ca_file="ca.pem").__aenter__()


@pytest.mark.parametrize(
    "option",
    [
        {"ros_version": "3"},
        {"connect_timeout": 0},
        {"max_size": 0},
        {"ping_interval": -1},
        {"ping_timeout": 0},
    ],
)
def test_an_option_that_is_none(option):
    with pytest.raises(OptionError, match=next(iter(option))):
        connect("ws://127.0.0.1:9090", **option)


async def test_nothing_is_there(unused_tcp_port):
    assert "connection refused" in await fails(f"ws://127.0.0.1:{unused_tcp_port}", UnreachableError)
    assert "host name" in await fails("ws://nowhere.invalid:9090", UnreachableError)


async def test_a_first_connection_is_tried_until_its_time_is_over(unused_tcp_port, monkeypatch):
    uri, now, waits = f"ws://127.0.0.1:{unused_tcp_port}", [0.0], []

    async def step(seconds):
        waits.append(seconds)
        now[0] += seconds

    with monkeypatch.context() as patch:
        patch.setattr("bridge.client.session.time", SimpleNamespace(monotonic=lambda: now[0]))
        patch.setattr("bridge.client.session.asyncio.sleep", step)
        with pytest.raises(UnreachableError):
            async with connect(uri, retry=True, connect_timeout=6):
                pass
    assert waits == [0.1, 0.2, 0.4, 0.8, 1.6, 2.0]


async def test_a_host_that_is_switched_on_later_is_not_missed(monkeypatch):
    """An attempt at a host that answers nothing must not use up the whole time for the first connection."""
    monkeypatch.setattr("bridge.client.session.ATTEMPT_TIMEOUT", 0.2)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        port = silent.getsockname()[1]
        states = []
        ros = connect(
            f"ws://127.0.0.1:{port}",
            retry=True,
            connect_timeout=3600,
            on_state=lambda state, _reason: states.append(state),
        )
        opening = asyncio.create_task(ros.__aenter__())
        async with asyncio.timeout(PATIENCE):
            while State.CONNECTING not in states:
                await asyncio.sleep(0.01)
    async with FakeRosbridge(port=port), asyncio.timeout(PATIENCE):
        await opening
        await ros.__aexit__(None, None, None)
    assert states[-3:] == [State.CONNECTING, State.CONNECTED, State.CLOSED]


def test_a_look_up_that_fails_after_the_time_is_over_is_not_reported_twice():
    """With uvloop, which looks names up in threads; the name is too long to leave this machine."""
    reported = []

    async def connect_late():
        asyncio.get_running_loop().set_exception_handler(lambda _, context: reported.append(context))
        host = ".".join("a" * 150)
        for _ in range(20):
            await fails(f"ws://{host}:9090", UnreachableError, connect_timeout=1e-6)
        with contextlib.suppress(OSError):
            await asyncio.get_running_loop().getaddrinfo(host, 9090)
        gc.collect()

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(connect_late())
    assert not reported


async def test_a_service_that_greets_before_it_is_asked(monkeypatch):
    handshake = WebSocket.handshake

    async def late_handshake(self, *headers):
        while not self.first_bytes:
            await asyncio.sleep(0)
        await handshake(self, *headers)

    monkeypatch.setattr(WebSocket, "handshake", late_handshake)
    async with tcp_service(lambda _reader, writer: writer.write(b"220 mail ready\r\n")) as port:
        uri = f"ws://127.0.0.1:{port}"
        assert "220 mail ready" in await fails(uri, NotRosbridgeError)


async def test_what_comes_in_one_piece_with_the_handshake_is_heard():
    async def serve(reader, writer):
        head = (await reader.readuntil(b"\r\n\r\n")).decode()
        key = accept_key(re.search(r"Sec-WebSocket-Key: (\S+)", head)[1]).encode()
        frames = Frame(Opcode.TEXT, b'{"op":"status","level":"error","msg":"welcome"}').serialize(mask=False)
        frames += Frame(Opcode.TEXT, b'{"op":"st', fin=False).serialize(mask=False)
        frames += Frame(Opcode.CONT, b'atus","msg":"again"}').serialize(mask=False)
        accepting = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: "
        writer.write(SWITCHING + accepting + key + b"\r\n\r\n" + frames)
        await reader.readexactly(8)
        writer.write(b"\x88\x02\x03\xe8")  # closed as it wishes

    async with tcp_service(serve) as port, connect(f"ws://127.0.0.1:{port}") as ros:
        assert [said.text for said in ros.statuses] == ["welcome", "again"]


SWITCHING = b"HTTP/1.1 101 Switching Protocols\r\n"
STREAM = b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace\r\n\r\n"


@pytest.mark.parametrize(
    ("answers", "stays", "error", "seen"),
    [
        ([], False, UnreachableError, r"without an answer|reset"),
        ([b""], True, UnreachableError, " within .* s"),
        ([b"SSH-2.0-OpenSSH_9.2\r\n"], False, NotRosbridgeError, "SSH-2.0-Op"),
        ([b"220 mail ready\r\n", b""], True, NotRosbridgeError, "220 mail r"),
        ([b"\x15\x03\x01\x00\x02\x02\x16\r\n", b""], True, NotRosbridgeError, r"x15.*x03"),
        ([b"x" * 9000], False, NotRosbridgeError, "x" * 10),
        ([STREAM, b"frame"], True, NotRosbridgeError, "HTTP/1.1 200 OK"),
        (
            [b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi"],
            False,
            NotRosbridgeError,
            r"a web server \(HTTP 200 OK\)",
        ),
        (
            [b"HTTP/1.1 302 Found\r\nLocation: http://robot/x\r\nContent-Length: 0\r\n\r\n"],
            False,
            NotRosbridgeError,
            "HTTP 302 Found, to http://robot/x",
        ),
        ([SWITCHING, b"\r\n"], False, NotRosbridgeError, "not answer as a WebSocket server"),
        (
            [SWITCHING, b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: x\r\n\r\n"],
            False,
            NotRosbridgeError,
            "not answer as a WebSocket server",
        ),
    ],
)
async def test_a_service_that_is_something_else(answers, stays, error, seen):
    asked = []

    async def serve(reader, writer):
        """Give the answers, the last one again and again if it ``stays``, and hang up otherwise."""
        asked.append(await reader.readuntil(b"\r\n\r\n"))
        for answer in answers:
            writer.write(answer)
        while stays:
            await asyncio.sleep(0.01)
            writer.write(answers[-1])
            await writer.drain()
        writer.close()

    # those that stay and answer with what looks like the beginning of an answer take all the time that they are given
    limit = FACTOR if answers in ([b""], [STREAM, b"frame"]) else PATIENCE
    async with tcp_service(serve) as port:
        assert re.search(seen, await fails(f"ws://127.0.0.1:{port}", error, connect_timeout=limit))
    assert b"Upgrade: websocket" in asked[0]
    assert b"Extensions" not in asked[0], "it asks for no compression"


@pytest.mark.parametrize(
    ("status", "error"),
    [(401, AccessRefusedError), (403, AccessRefusedError), (404, NotRosbridgeError), (503, UnreachableError)],
)
async def test_a_server_that_refuses(status, error):
    async with FakeRosbridge(refuses=status) as fake:
        assert f"HTTP {status}" in await fails(fake.uri, error)


async def test_tls_towards_a_server_without():
    async with FakeRosbridge() as fake:
        said = await fails(fake.uri.replace("ws:", "wss:"), BridgeError)
    assert "TLS" in said or "reset" in said


async def test_cancelling_an_attempt_leaves_nothing_behind():
    asked, gone = asyncio.Event(), asyncio.Event()

    async def answer(reader, writer):
        await reader.readuntil(b"\r\n\r\n")
        asked.set()
        with contextlib.suppress(ConnectionError):
            await reader.read(-1)
        gone.set()

    async with tcp_service(answer) as port:
        ros = connect(f"ws://127.0.0.1:{port}", connect_timeout=2 * PATIENCE)
        attempt = asyncio.create_task(ros.__aenter__())
        await asyncio.wait_for(asked.wait(), PATIENCE)
        attempt.cancel()
        with pytest.raises(asyncio.CancelledError):
            await attempt
        assert ros.state is State.CLOSED
        await asyncio.wait_for(gone.wait(), PATIENCE)


@pytest.mark.parametrize(
    ("fake", "ros"), [({"silent": True}, {"check_types": False})], indirect=True, ids=["silent"]
)
async def test_a_client_that_is_cancelled_at_its_farewell_is_closed(fake, ros):
    """Else it would go on for good: heard by nobody, and connecting again whenever it is lost."""
    publication = await ros.advertise("/a", "std_msgs/String")
    await publication.publish({"data": "x"})
    closing = asyncio.create_task(ros.close())
    await fake.wait_for_op("call_service", service="/rosapi/get_time")
    closing.cancel()
    with pytest.raises(asyncio.CancelledError):
        await closing
    assert ros.state is State.CLOSED


async def test_a_service_may_close_its_client(fake, ros):
    finished = asyncio.Event()

    async def handler(_args):
        await ros.close()
        finished.set()
        return {}

    await ros.advertise_service("/bye", "std_srvs/Empty", handler)
    async with connect(fake.uri) as other:
        await fake.wait_for_op("advertise_service")
        calling = asyncio.create_task(other.call("/bye", timeout=2 * PATIENCE))
        await asyncio.wait_for(finished.wait(), PATIENCE)
        calling.cancel()
        await asyncio.gather(calling, return_exceptions=True)
    assert ros.state is State.CLOSED
