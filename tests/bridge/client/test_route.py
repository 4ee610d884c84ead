"""The way to a server: certificates on both sides, tokens and headers, a proxy; and that no secret is ever shown.

Ros ──(TLS)──▶ CONNECT proxy of the test ──▶ WebSocket server of the test (keeps what it was shown)
"""

import asyncio
import base64
import contextlib
import logging
import ssl
import subprocess
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.server import ServerConnection, serve
from websockets.http11 import Request, Response

from bridge.client import State, connect
from bridge.client.route import shown
from bridge.errors import AccessRefusedError, BridgeError, OptionError, UnreachableError, UriError

TOKEN = "s3cret-token"
PATIENCE = 60.0


def openssl(*words: str) -> None:
    subprocess.run(["openssl", *words], check=True, capture_output=True, timeout=240)


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A CA, a server's certificate for localhost, a client's, and another CA that vouches for nobody."""
    folder = tmp_path_factory.mktemp("certificates")
    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")
    for ca in ("ca", "other"):
        openssl(
            *("req", "-x509", *key, "-subj", f"/CN={ca}", "-days", "2"),
            *("-keyout", str(folder / f"{ca}.key"), "-out", str(folder / f"{ca}.pem")),
        )
    (folder / "names").write_text("subjectAltName=DNS:localhost,IP:127.0.0.1\n")
    for name in ("server", "client"):
        request = str(folder / f"{name}.csr")
        openssl("req", *key, "-subj", f"/CN={name}", "-keyout", str(folder / f"{name}.key"), "-out", request)
        openssl(
            *("x509", "-req", "-in", request, "-days", "2", "-extfile", str(folder / "names")),
            *("-CA", str(folder / "ca.pem"), "-CAkey", str(folder / "ca.key"), "-CAcreateserial"),
            *("-out", str(folder / f"{name}.pem")),
        )
    both = (folder / "client.pem").read_text() + (folder / "client.key").read_text()
    (folder / "both.pem").write_text(both)
    openssl(
        *("ec", "-in", str(folder / "client.key"), "-aes256", "-passout", "pass:word"),
        *("-out", str(folder / "locked.key")),
    )
    return folder


@dataclass
class AccessPolicy:
    """A WebSocket server, what it wants, and what it was shown."""

    port: int = 0
    wants: str | None = None
    shown: list[Request] = field(default_factory=list)


@contextlib.asynccontextmanager
async def access(
    tls: ssl.SSLContext | None = None, wants: str | None = None, host: str = "127.0.0.1"
) -> AsyncIterator[AccessPolicy]:
    made = AccessPolicy(wants=wants)

    def look(connection: ServerConnection, request: Request) -> Response | None:
        made.shown.append(request)
        if made.wants is not None and request.headers.get("Authorization") != made.wants:
            return connection.respond(HTTPStatus.UNAUTHORIZED, "who are you?\n")
        return None

    async def stay(connection: ServerConnection) -> None:
        await connection.wait_closed()

    # The server's own log would show what it was shown.
    silent = logging.getLogger("test_route.server")
    silent.setLevel(logging.CRITICAL)
    async with serve(stay, host, 0, ssl=tls, process_request=look, logger=silent) as server:
        made.port = next(iter(server.sockets)).getsockname()[1]
        yield made


def server_context(certificates: Path, *, asks: bool = False) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificates / "server.pem", certificates / "server.key")
    if asks:
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(certificates / "ca.pem")
    return context


# Certificates


async def test_a_ca_of_ones_own_vouches_for_the_server(certificates):
    async with access(server_context(certificates)) as server:
        uri = f"wss://localhost:{server.port}"
        async with connect(uri, ca_file=certificates / "ca.pem") as ros:
            assert ros.state is State.CONNECTED
        async with connect(uri.replace("localhost", "127.0.0.1"), ca_file=str(certificates / "ca.pem")):
            pass
        for options in ({}, {"ca_file": certificates / "other.pem"}):
            with pytest.raises(UnreachableError, match=r"not to be trusted: its certificate"):
                await connect(uri, **options).__aenter__()


async def test_the_certificate_must_be_of_that_host(certificates):
    async with access(server_context(certificates), host="127.0.0.2") as server:
        context = ssl.create_default_context(cafile=certificates / "ca.pem")
        with pytest.raises(UnreachableError, match=r"not to be trusted: its certificate: .*mismatch"):
            await connect(f"wss://127.0.0.2:{server.port}", tls=context).__aenter__()


@pytest.mark.parametrize("files", [1, 2])
async def test_a_server_that_asks_for_a_certificate(certificates, files):
    certificate: Any = certificates / "both.pem"
    if files == 2:
        certificate = (certificates / "client.pem", certificates / "client.key")
    async with access(server_context(certificates, asks=True)) as server:
        uri = f"wss://localhost:{server.port}"
        async with connect(uri, ca_file=certificates / "ca.pem", client_certificate=certificate):
            pass
        with pytest.raises(BridgeError) as caught:
            await connect(uri, ca_file=certificates / "ca.pem").__aenter__()
        # What TLS 1.3 says comes after its handshake, so it is a race whether it is heard.
        assert "client_certificate" in str(caught.value)
        assert uri in str(caught.value)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"ca_file": "nowhere.pem"}, "ca_file nowhere.pem cannot be used: No such file"),
        ({"ca_file": __file__}, "ca_file .* cannot be used"),
        ({"client_certificate": "nowhere.pem"}, "client_certificate nowhere.pem cannot be used: No such"),
        ({"client_certificate": (__file__, __file__)}, "client_certificate .* and .* cannot be used"),
        ({"tls": ssl.create_default_context(), "ca_file": "x"}, "tls and ca_file exclude"),
    ],
)
def test_files_that_are_none(options, said):
    with pytest.raises(OptionError, match=said):
        connect("wss://localhost:1", **options)


def test_a_key_with_a_password_is_refused_not_asked_for(certificates):
    files = (certificates / "client.pem", certificates / "locked.key")
    with pytest.raises(OptionError, match="client_certificate"):
        connect("wss://localhost:1", client_certificate=files)


@pytest.mark.parametrize("name", ["ca_file", "client_certificate", "tls"])
def test_certificates_without_tls(name):
    value = ssl.create_default_context() if name == "tls" else "x"
    with pytest.raises(OptionError, match=name):
        connect("ws://localhost:1", **{name: value})


# Tokens and headers


async def test_a_token_and_headers_are_shown_at_the_door_and_nowhere_else(caplog, capfd):
    caplog.set_level(logging.DEBUG)
    async with access(wants=f"Bearer {TOKEN}") as server:
        uri = f"ws://127.0.0.1:{server.port}"
        ros = connect(uri, token=TOKEN, headers={"X-Robot": "boat-s3cret"})
        async with ros:
            said = [
                repr(ros),
                repr(ros.__dict__),
                repr(vars(ros._session)),
                repr(ros._session._route),
                str(ros.uri),
            ]
        assert server.shown[0].headers["X-Robot"] == "boat-s3cret"
        for options in ({}, {"token": f"not-{TOKEN}"}):
            with pytest.raises(AccessRefusedError, match="does not let this client in.*401") as caught:
                await connect(uri, **options).__aenter__()
            said.append(str(caught.value))
        server.wants = None
        said += [caplog.text, *capfd.readouterr()]
    assert "s3cret" not in "".join(said)


async def test_credentials_in_the_uri_are_shown_at_the_door_and_nowhere_else(caplog):
    caplog.set_level(logging.DEBUG)
    wanted = "Basic " + base64.b64encode(b"user:s3cret").decode()
    async with access(wants=wanted) as server:
        uri = f"ws://user:s3cret@127.0.0.1:{server.port}/path?key=s3cret"
        async with connect(uri) as ros:
            assert ros.uri == f"ws://127.0.0.1:{server.port}/path?***"
            held = repr(vars(ros._session))
        assert server.shown[0].path == "/path?key=s3cret"
        server.wants = "else"
        with pytest.raises(AccessRefusedError) as caught:
            await connect(uri).__aenter__()
    with pytest.raises(UriError) as wrong:
        connect("ws://user:s3cret@robot:port")
    assert "s3cret" not in caplog.text + str(caught.value) + str(wrong.value) + held.replace(
        "query='key=s3cret'", ""
    )


async def test_the_token_is_shown_again_after_a_loss():
    async with access(wants=f"Bearer {TOKEN}") as server:
        async with connect(f"ws://127.0.0.1:{server.port}", token=TOKEN) as ros:
            ros._session._websocket.abort()
            await ros.wait_for_state(State.RECONNECTING, PATIENCE)
            await ros.wait_for_state(State.CONNECTED, PATIENCE)
        assert len(server.shown) == 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"token": ""}, "token must be"),
        ({"token": "a b"}, "token must be"),
        ({"token": "a\r\nX: y"}, "token must be"),
        ({"token": "\u00e4"}, "token must be"),
        ({"token": "x", "uri": "ws://u:y@localhost:1"}, "exclude each other"),
        ({"token": "x", "headers": {"authorization": "y"}}, "exclude each other"),
        ({"headers": {"a b": "x"}}, "header name"),
        ({"headers": {"a": "x\r\nB: y"}}, "value of header a"),
        ({"headers": {"a": 5}}, "value of header a"),
    ],
)
def test_headers_that_are_none(options, said):
    with pytest.raises(OptionError, match=said) as caught:
        connect(**{"uri": "ws://localhost:1", **options})
    assert "y" not in str(caught.value).split()


@pytest.mark.parametrize(
    ("uri", "warned"),
    [
        ("ws://robot:9090", True),
        ("ws://192.168.1.10:9090", True),
        ("ws://localhost:9090", False),
        ("ws://[::1]:9090", False),
        ("ws://127.3.2.1:9090", False),
        ("wss://robot:9090", False),
    ],
)
def test_a_secret_in_the_clear_is_warned_of(uri, warned, caplog):
    connect(uri, token=TOKEN)
    assert ("unencrypted" in caplog.text) == warned
    assert TOKEN not in caplog.text


@pytest.mark.parametrize(
    ("uri", "without"),
    [
        ("ws://robot:9090", "ws://robot:9090"),
        ("ws://u:p@robot:9090/x", "ws://robot:9090/x"),
        ("ws://u:p@q@robot:9090/x@y", "ws://robot:9090/x@y"),
        ("wss://robot/?token=abc", "wss://robot/?***"),
        ("wss://robot?a=b@c#d", "wss://robot?***#d"),
        ("u:p@robot", "robot"),
    ],
)
def test_what_is_shown_of_a_uri(uri, without):
    assert shown(uri) == without


# Proxies


@dataclass
class ConnectProxy:
    """A proxy for CONNECT: it keeps what it was asked, and answers as told."""

    port: int = 0
    answer: bytes = b"HTTP/1.1 200 Connection established\r\n\r\n"
    asked: list[bytes] = field(default_factory=list)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            head = await reader.readuntil(b"\r\n\r\n")
            self.asked.append(head)
            writer.write(self.answer)
            await writer.drain()
            if b" 200 " in self.answer[:20]:
                host, _, port = head.split()[1].decode().rpartition(":")
                there, back = await asyncio.open_connection(host.strip("[]"), int(port))
                await asyncio.gather(self._pass(reader, back), self._pass(there, writer))
        writer.close()

    @staticmethod
    async def _pass(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(65536):
                writer.write(data)
                await writer.drain()
            writer.close()


@contextlib.asynccontextmanager
async def connect_proxy(**options: Any) -> AsyncIterator[ConnectProxy]:
    proxy = ConnectProxy(**options)
    server = await asyncio.start_server(proxy.serve, "127.0.0.1", 0)
    proxy.port = server.sockets[0].getsockname()[1]
    try:
        yield proxy
    finally:
        server.close()


@pytest.mark.parametrize("secure", [False, True])
async def test_through_a_proxy(certificates, secure):
    context = server_context(certificates) if secure else None
    options = {"ca_file": certificates / "ca.pem"} if secure else {}
    async with access(context, wants=f"Bearer {TOKEN}") as server, connect_proxy() as proxy:
        uri = f"{'wss' if secure else 'ws'}://localhost:{server.port}"
        through = f"http://user:s3cret@127.0.0.1:{proxy.port}"
        async with connect(uri, proxy=through, token=TOKEN, **options) as ros:
            assert ros.state is State.CONNECTED
            assert "s3cret" not in repr(ros._session._route)
    assert len(server.shown) == 1
    (asked,) = proxy.asked
    assert asked.startswith(f"CONNECT localhost:{server.port} HTTP/1.1\r\n".encode())
    assert b"Proxy-Authorization: Basic " + base64.b64encode(b"user:s3cret") in asked
    assert TOKEN.encode() not in asked, "the token is for the server alone"


async def test_the_proxy_of_the_environment(monkeypatch):
    async with access() as server, connect_proxy() as proxy:
        for name in ("no_proxy", "NO_PROXY", "all_proxy", "ALL_PROXY", "ws_proxy", "socks_proxy"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setenv("https_proxy", f"http://127.0.0.1:{proxy.port}")
        uri = f"ws://127.0.0.1:{server.port}"
        async with connect(uri):
            assert not proxy.asked, "only who asks for it goes through it"
        async with connect(uri, proxy="environment"):
            assert len(proxy.asked) == 1
        monkeypatch.setenv("no_proxy", "127.0.0.1")
        async with connect(uri, proxy="environment"):
            assert len(proxy.asked) == 1


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (b"HTTP/1.1 403 Forbidden\r\n\r\n", r"refuses \(HTTP 403 Forbidden\)"),
        (b"HTTP/1.1 407 Proxy Authentication Required\r\n\r\n", r"refuses \(HTTP 407 "),
        (b"SSH-2.0-OpenSSH\r\n\r\n", "fails: "),
        (b"", "fails: "),
    ],
)
async def test_a_proxy_that_does_not_let_through(answer, said):
    async with access() as server, connect_proxy(answer=answer) as proxy:
        uri = f"ws://127.0.0.1:{server.port}"
        through = f"http://user:s3cret@127.0.0.1:{proxy.port}"
        with pytest.raises(UnreachableError, match=said) as caught:
            await connect(uri, proxy=through).__aenter__()
        assert uri in str(caught.value)
        assert f"http://127.0.0.1:{proxy.port}" in str(caught.value)
        assert "s3cret" not in str(caught.value)
        assert not server.shown


async def test_a_proxy_that_is_not_there(unused_tcp_port):
    with pytest.raises(UnreachableError, match="proxy http://127.0.0.1:.* fails"):
        await connect("ws://robot:9090", proxy=f"http://127.0.0.1:{unused_tcp_port}").__aenter__()


async def test_a_proxy_that_says_nothing():
    async def stay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read()
        writer.close()

    async with await asyncio.start_server(stay, "127.0.0.1", 0) as server:
        through = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        with pytest.raises(UnreachableError, match="did not answer within 0.3 s"):
            await connect("ws://robot:9090", proxy=through, connect_timeout=0.3).__aenter__()


@pytest.mark.parametrize(
    "proxy", ["", "proxy:3128", "ftp://proxy", "http://", "http://proxy:port", "http://p/x"]
)
def test_a_proxy_that_is_none(proxy):
    with pytest.raises(OptionError, match="proxy .* cannot be used"):
        connect("ws://robot:9090", proxy=proxy)


class SocksProxy(ConnectProxy):
    """A SOCKS 5 proxy (RFC 1928) that wants a name and a password (RFC 1929)."""

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            _, methods = await reader.readexactly(2)
            await reader.readexactly(methods)
            writer.write(b"\x05\x02")
            _, length = await reader.readexactly(2)
            name = await reader.readexactly(length)
            password = await reader.readexactly((await reader.readexactly(1))[0])
            known = (name, password) == (b"user", b"s3cret")
            writer.write(b"\x01\x00" if known else b"\x01\x01")
            if known:
                head = await reader.readexactly(4)
                assert head == b"\x05\x01\x00\x03", "CONNECT, by the server's name"
                host = await reader.readexactly((await reader.readexactly(1))[0])
                port = int.from_bytes(await reader.readexactly(2), "big")
                self.asked.append(host + b":%d" % port)
                there, back = await asyncio.open_connection(host.decode(), port)
                writer.write(b"\x05\x00\x00\x01" + bytes(6))
                await asyncio.gather(self._pass(reader, back), self._pass(there, writer))
        writer.close()


@pytest.mark.parametrize("secure", [False, True])
async def test_through_socks(certificates, secure):
    context = server_context(certificates) if secure else None
    options = {"ca_file": certificates / "ca.pem"} if secure else {}
    proxy = SocksProxy()
    async with (
        access(context, wants=f"Bearer {TOKEN}") as server,
        await asyncio.start_server(proxy.serve, "127.0.0.1", 0) as listening,
    ):
        port = listening.sockets[0].getsockname()[1]
        uri = f"{'wss' if secure else 'ws'}://localhost:{server.port}"
        async with connect(
            uri, proxy=f"socks5h://user:s3cret@127.0.0.1:{port}", token=TOKEN, **options
        ) as ros:
            assert ros.state is State.CONNECTED
            assert "s3cret" not in repr(ros._session._route)
        assert proxy.asked == [f"localhost:{server.port}".encode()]
        with pytest.raises(UnreachableError, match="proxy socks5h") as caught:
            await connect(uri, proxy=f"socks5h://user:wr0ng@127.0.0.1:{port}", token=TOKEN).__aenter__()
        assert "wr0ng" not in str(caught.value)


async def test_socks_that_is_not_there(unused_tcp_port):
    with pytest.raises(UnreachableError, match="proxy socks5h"):
        await connect("ws://robot:9090", proxy=f"socks5h://127.0.0.1:{unused_tcp_port}").__aenter__()


async def test_socks_without_its_package(monkeypatch):
    async def missing(*_: object) -> None:
        raise ImportError  # what websockets puts there when it finds no python-socks

    monkeypatch.setattr("bridge.client.route.connect_socks_proxy", missing)
    with pytest.raises(OptionError, match="needs the package python-socks"):
        await connect("ws://robot:9090", proxy="socks5h://127.0.0.1:1").__aenter__()
