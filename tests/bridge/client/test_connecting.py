"""The first connection: what is at the URI, and what is said when it is no rosbridge server."""

import asyncio
import contextlib
import socket
import ssl
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from bridge.client import State, connect
from bridge.client.websocket import WebSocket
from bridge.errors import (
    AccessRefusedError,
    BridgeError,
    DisconnectedError,
    NotRosbridgeError,
    OptionError,
    UnreachableError,
    UriError,
)
from tests.fake_rosbridge import FakeRosbridge


@contextlib.asynccontextmanager
async def tcp_service(
    answer: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Any],
) -> AsyncIterator[int]:
    """Something that is no WebSocket server, on a port of this machine."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            await answer(reader, writer)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()


async def fails(uri: str, error: type[BridgeError], **options: Any) -> str:
    """Connecting fails as expected, in time; what it said, with the URI in it."""
    begun = time.monotonic()
    with pytest.raises(error) as caught:
        async with connect(uri, **options):
            pytest.fail("it connected")
    assert time.monotonic() - begun < options.get("connect_timeout", 10) + 20
    assert caught.value.exit_code == (2 if error in {UriError, AccessRefusedError} else 3)
    assert uri in str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


async def test_it_connects_and_closes():
    async with FakeRosbridge() as fake:
        states: list[tuple[State, str]] = []
        ros = connect(fake.uri, on_state=lambda state, reason: states.append((state, reason)))
        assert ros.state is State.CONNECTING
        async with ros:
            assert ros.state is State.CONNECTED
            assert ros.uri == fake.uri
        assert ros.state is State.CLOSED
        assert [state for state, _reason in states] == [State.CONNECTED, State.CLOSED]
        with pytest.raises(DisconnectedError, match="connect\\(\\) makes a new one"):
            await ros.__aenter__()
        await ros.close()


async def test_no_compression_is_asked_for():
    seen: list[bytes] = []

    async def answer(reader: asyncio.StreamReader, _writer: asyncio.StreamWriter) -> None:
        seen.append(await reader.readuntil(b"\r\n\r\n"))

    async with tcp_service(answer) as port:
        await fails(f"ws://127.0.0.1:{port}", UnreachableError)
    assert b"Upgrade: websocket" in seen[0]
    assert b"Extensions" not in seen[0]


@pytest.mark.parametrize(
    "uri",
    [
        "127.0.0.1:9090",
        "http://robot:9090",
        "ws://",
        "ws://:9090",
        "",
        "robot",
        "ws://robot:port",
        "ws://robot:70000",
        "ws://[::1",
        "tcp://robot:9090",
        "ws://" + "a" * 100 + ".local",
    ],
)
async def test_a_uri_that_is_none(uri):
    assert "like ws://" in await fails(uri, UriError)


@pytest.mark.parametrize(
    "options",
    [
        {"ros_version": "3"},
        {"connect_timeout": 0},
        {"max_size": 0},
        {"ping_interval": -1},
        {"ping_timeout": 0},
    ],
)
def test_an_option_that_is_none(options):
    with pytest.raises(OptionError, match=next(iter(options))) as caught:
        connect("ws://127.0.0.1:9090", **options)
    assert caught.value.exit_code == 2


async def test_nothing_listens():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        said = await fails(f"ws://127.0.0.1:{unused.getsockname()[1]}", UnreachableError)
    assert "connection refused" in said


async def test_no_such_host():
    assert "host name is not known" in await fails("ws://nowhere.invalid:9090", UnreachableError)


async def test_a_host_that_takes_nothing():
    with socket.socket() as full:
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        # What the kernel does not take any more gets no answer at all, as from a host that is not there.
        fillers = [socket.socket() for _ in range(4)]
        for filler in fillers:
            filler.setblocking(False)
            filler.connect_ex(full.getsockname())
        uri = f"ws://127.0.0.1:{full.getsockname()[1]}"
        assert "did not answer within 0.3 s" in await fails(uri, UnreachableError, connect_timeout=0.3)
        for filler in fillers:
            filler.close()


async def test_a_service_that_says_nothing():
    async with tcp_service(lambda reader, _writer: reader.read()) as port:
        said = await fails(f"ws://127.0.0.1:{port}", UnreachableError, connect_timeout=2)
    assert "took the connection but did not answer within 2 s" in said


async def test_a_service_that_hangs_up():
    async def answer(_reader: asyncio.StreamReader, _writer: asyncio.StreamWriter) -> None:
        pass

    async with tcp_service(answer) as port:
        said = await fails(f"ws://127.0.0.1:{port}", UnreachableError)
    assert "closed the connection without an answer" in said or "reset" in said


@pytest.mark.parametrize("stays", [False, True])
@pytest.mark.parametrize(
    "greeting",
    [b"SSH-2.0-OpenSSH_9.2\r\n", b"\x15\x03\x01\x00\x02\x02\x16\r\n", b"220 mail ready\r\n", b"x" * 9000],
)
async def test_a_service_that_speaks_something_else(greeting, stays):
    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(greeting)
        await reader.readuntil(b"\r\n\r\n")
        if stays:
            await asyncio.sleep(60)

    async with tcp_service(answer) as port:
        begun = time.monotonic()
        said = await fails(f"ws://127.0.0.1:{port}", NotRosbridgeError, connect_timeout=60)
        assert time.monotonic() - begun < 30, "garbage is known at once"
    assert repr(greeting[:10])[1:-1] in said


async def test_a_service_that_greets_before_it_is_asked(monkeypatch):
    handshake = WebSocket.handshake

    async def late_handshake(self: WebSocket, *headers: Any) -> None:
        await asyncio.sleep(0.1)
        await handshake(self, *headers)

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"220 mail ready\r\n")
        await reader.read()

    monkeypatch.setattr(WebSocket, "handshake", late_handshake)
    async with tcp_service(answer) as port:
        assert "220 mail ready" in await fails(f"ws://127.0.0.1:{port}", NotRosbridgeError)


async def test_a_service_that_never_ends_its_answer():
    async def answer(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace\r\n\r\n")
        while True:
            writer.write(b"frame")
            await writer.drain()
            await asyncio.sleep(0.01)

    async with tcp_service(answer) as port:
        said = await fails(f"ws://127.0.0.1:{port}", NotRosbridgeError, connect_timeout=2)
    assert "HTTP/1.1 200 OK" in said


@pytest.mark.parametrize(
    ("answer", "seen"),
    [
        (b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi", "a web server (HTTP 200 OK)"),
        (
            b"HTTP/1.1 302 Found\r\nLocation: http://robot/x\r\nContent-Length: 0\r\n\r\n",
            "HTTP 302 Found, to http://robot/x",
        ),
        (b"HTTP/1.1 101 Switching Protocols\r\n\r\n", "not answer as a WebSocket server"),
        (
            (
                b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                b"Sec-WebSocket-Accept: x\r\n\r\n"
            ),
            "not answer as a WebSocket server",
        ),
    ],
)
async def test_a_web_server(answer, seen):
    async def reply(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(answer)
        await writer.drain()

    async with tcp_service(reply) as port:
        assert seen in await fails(f"ws://127.0.0.1:{port}", NotRosbridgeError)


@pytest.mark.parametrize(
    ("status", "error"),
    [
        (401, AccessRefusedError),
        (403, AccessRefusedError),
        (404, NotRosbridgeError),
        (503, UnreachableError),
    ],
)
async def test_a_server_that_refuses(status, error):
    async with FakeRosbridge(refuses=status) as fake:
        assert f"HTTP {status}" in await fails(fake.uri, error)


async def test_tls_towards_a_server_without():
    async with FakeRosbridge() as fake:
        said = await fails(fake.uri.replace("ws:", "wss:"), BridgeError)
    assert "TLS" in said or "reset" in said


async def test_tls_with_a_certificate_that_nobody_vouches_for(tmp_path):
    certificate, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    making = await asyncio.create_subprocess_exec(
        *["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=localhost", "-days", "1"],
        *["-keyout", str(key), "-out", str(certificate)],
        stderr=asyncio.subprocess.DEVNULL,
    )
    if await making.wait() != 0:
        pytest.skip("openssl makes no certificate here")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    server = await asyncio.start_server(lambda _reader, writer: writer.close(), "127.0.0.1", 0, ssl=context)
    async with server:
        said = await fails(f"wss://localhost:{server.sockets[0].getsockname()[1]}", UnreachableError)
    assert "certificate" in said


async def test_cancelling_an_attempt_leaves_nothing_behind():
    gone = asyncio.Event()

    async def answer(reader: asyncio.StreamReader, _writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            await reader.read(-1)
        gone.set()

    async with tcp_service(answer) as port:
        ros = connect(f"ws://127.0.0.1:{port}")
        attempt = asyncio.create_task(ros.__aenter__())
        await asyncio.sleep(0.1)
        attempt.cancel()
        with pytest.raises(asyncio.CancelledError):
            await attempt
        assert ros.state is State.CLOSED
        await asyncio.wait_for(gone.wait(), 30)


async def test_a_client_that_is_cancelled_at_its_farewell_is_closed():
    """Else it would go on for good: heard by nobody, and connecting again whenever it is lost."""
    async with FakeRosbridge(silent=True) as fake:
        ros = connect(fake.uri)
        await ros.__aenter__()
        publication = await ros.advertise("/a", "std_msgs/String")
        await publication.publish({"data": "x"})
        closing = asyncio.create_task(ros.close())
        await fake.wait_for_op("call_service")
        closing.cancel()
        with pytest.raises(asyncio.CancelledError):
            await closing
        assert ros.state is State.CLOSED


async def test_closing_leaves_no_task_behind():
    async with FakeRosbridge() as fake:
        ros = connect(fake.uri)
        await ros.__aenter__()
        await fake.hang_up()
        await ros.wait_for_state(State.RECONNECTING, 30)
        await ros.close()
        tasks = [repr(task.get_coro()) for task in asyncio.all_tasks()]
        assert not [task for task in tasks if "Session." in task]


async def test_a_service_may_close_its_client():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros:
        finished = asyncio.Event()

        async def handler(_args: dict[str, Any]) -> dict[str, Any]:
            await ros.close()
            finished.set()
            return {}

        await ros.advertise_service("/bye", "std_srvs/Empty", handler)
        async with connect(fake.uri) as other:
            await fake.wait_for_op("advertise_service")
            with contextlib.suppress(BridgeError):
                await other.call("/bye", timeout=1)
            await asyncio.wait_for(finished.wait(), 30)
        assert ros.state is State.CLOSED


async def test_a_silence_in_which_the_connection_was_lost_says_so():
    async with FakeRosbridge() as fake, connect(fake.uri, max_size=2000) as ros:
        subscription = ros.subscribe("/a", "std_msgs/String")
        await fake.wait_for_op("subscribe", topic="/a")
        waiting = asyncio.create_task(subscription.next(timeout=3))
        await asyncio.sleep(0)
        await fake.publish("/a", {"data": "x" * 5000})
        with pytest.raises(BridgeError, match=r"a message of more than 2000 bytes \(max_size allows"):
            await waiting
