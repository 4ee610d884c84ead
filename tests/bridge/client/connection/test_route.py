"""The route to a server: certificates on both sides, tokens, headers and proxies; secrets are never shown.

Ros ──(TLS)──▶ CONNECT proxy of the test ──▶ WebSocket server of the test (keeps what it was shown)
"""

import asyncio
import base64
import contextlib
import logging
import re
import ssl
from http import HTTPStatus
from types import SimpleNamespace

import pytest
from websockets.asyncio.server import serve

from bridge.client import State, connect
from bridge.client.route import shown
from bridge.errors import AccessRefusedError, BridgeError, OptionError, UnreachableError, UriError
from tests.bridge.client.stand_ins import tcp_service
from tests.certificates import issue
from tests.patience import PATIENCE

TOKEN = "s3cret-token"


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """A CA, a server's certificate and a client's of it, and another CA that vouches for nobody."""
    folder = tmp_path_factory.mktemp("certificates")
    for name, ca in (("ca", None), ("other", None), ("server", "ca"), ("client", "ca")):
        issue(folder, name, ca=ca)
    both = (folder / "client.pem").read_text() + (folder / "client.key").read_text()
    (folder / "both.pem").write_text(both)
    issue(folder, "locked", ca="ca", password=b"word")
    return folder


@contextlib.asynccontextmanager
async def access(tls=None, wants=None, host="127.0.0.1"):
    """Run a WebSocket server: its port, what it wants, and what it was shown."""
    made = SimpleNamespace(wants=wants, shown=[])

    def look(connection, request):
        made.shown.append(request)
        if made.wants is not None and request.headers.get("Authorization") != made.wants:
            return connection.respond(HTTPStatus.UNAUTHORIZED, "who are you?\n")
        return None

    async def stay(connection):
        await connection.wait_closed()

    # The server's own log would show what it was shown.
    silent = logging.getLogger("test_route.server")
    silent.setLevel(logging.CRITICAL)
    async with serve(stay, host, 0, ssl=tls, process_request=look, logger=silent) as server:
        made.port = next(iter(server.sockets)).getsockname()[1]
        yield made


def server_context(certificates, *, asks=False):
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificates / "server.pem", certificates / "server.key")
    if asks:
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(certificates / "ca.pem")
    return context


async def refused(uri, error, **options):
    with pytest.raises(error) as caught:
        await connect(uri, **options).__aenter__()
    assert uri.rpartition("@")[2].partition("?")[0] in str(caught.value)
    return str(caught.value)


# Certificates


async def test_a_ca_of_ones_own_vouches_for_the_server(certificates):
    async with access(server_context(certificates), host="0.0.0.0") as server:  # noqa: S104 - the test needs two loopback addresses
        for host in ("localhost", "127.0.0.1"):
            async with connect(f"wss://{host}:{server.port}", ca_file=certificates / "ca.pem") as ros:
                assert ros.state is State.CONNECTED
        context = ssl.create_default_context(cafile=certificates / "ca.pem")
        for host, options in (
            ("localhost", {}),
            ("localhost", {"ca_file": str(certificates / "other.pem")}),
            ("127.0.0.2", {"tls": context}),  # the certificate is for another host
        ):
            assert "certificate" in await refused(f"wss://{host}:{server.port}", UnreachableError, **options)


async def test_a_server_that_asks_for_a_certificate(certificates):
    pair = (certificates / "client.pem", certificates / "client.key")
    async with access(server_context(certificates, asks=True)) as server:
        uri, ca_file = f"wss://localhost:{server.port}", certificates / "ca.pem"
        for certificate in (certificates / "both.pem", pair):
            async with connect(uri, ca_file=ca_file, client_certificate=certificate):
                pass
        # TLS 1.3 sends its alert after the handshake, so whether it is received is a race.
        assert "client_certificate" in await refused(uri, BridgeError, ca_file=ca_file)


def test_a_key_with_a_password_is_refused_not_asked_for(certificates):
    files = (certificates / "locked.pem", certificates / "locked.key")
    with pytest.raises(OptionError, match="client_certificate"):
        connect("wss://localhost:1", client_certificate=files)


TLS = ssl.create_default_context()


@pytest.mark.parametrize(
    ("uri", "options", "said"),
    [
        ("wss://localhost:1", {"ca_file": "nowhere.pem"}, "ca_file nowhere.pem cannot be used: No such file"),
        ("wss://localhost:1", {"ca_file": __file__}, "ca_file"),
        ("wss://localhost:1", {"client_certificate": "nowhere.pem"}, "client_certificate nowhere.pem"),
        ("wss://localhost:1", {"client_certificate": (__file__, __file__)}, "client_certificate .* and "),
        ("wss://localhost:1", {"tls": TLS, "ca_file": "x"}, "tls and ca_file"),
        ("ws://localhost:1", {"ca_file": "x"}, "ca_file"),
        ("ws://localhost:1", {"client_certificate": "x"}, "client_certificate"),
        ("ws://localhost:1", {"tls": TLS}, "tls"),
        ("ws://localhost:1", {"token": ""}, "token must be"),
        ("ws://localhost:1", {"token": "a\r\nX: y"}, "token must be"),
        ("ws://localhost:1", {"token": "\u00e4"}, "token must be"),
        ("ws://u:y@localhost:1", {"token": "x"}, "token and"),
        ("ws://localhost:1", {"token": "x", "headers": {"authorization": "y"}}, "token and"),
        ("ws://localhost:1", {"headers": {"a b": "y"}}, "header name"),
        ("ws://localhost:1", {"headers": {"a": "x\r\nB: y"}}, "value of header a"),
        ("ws://localhost:1", {"headers": {"a": 5}}, "value of header a"),
    ]
    + [
        ("ws://localhost:1", {"proxy": proxy}, "proxy .* cannot be used")
        for proxy in ("", "proxy:3128", "ftp://proxy", "http://", "http://proxy:port", "http://p/x")
    ],
)
def test_options_that_are_refused(uri, options, said):
    with pytest.raises(OptionError, match=said) as caught:
        connect(uri, **options)
    assert "y" not in str(caught.value).split()


# Tokens and headers


async def test_a_token_and_headers_are_shown_at_the_door_and_nowhere_else(caplog, capfd):
    caplog.set_level(logging.DEBUG)
    async with access(wants=f"Bearer {TOKEN}") as server:
        uri = f"ws://127.0.0.1:{server.port}"
        async with connect(uri, token=TOKEN, headers={"X-Robot": "boat-s3cret"}) as ros:
            said = [repr(each) for each in (ros, vars(ros), vars(ros._session), ros._session._located)]
            ros._session._websocket.abort()
            await ros.wait_for_state(State.RECONNECTING, PATIENCE)
            await ros.wait_for_state(State.CONNECTED, PATIENCE)
        assert [request.headers["X-Robot"] for request in server.shown] == ["boat-s3cret"] * 2
        said += [await refused(uri, AccessRefusedError, token=token) for token in (None, f"not-{TOKEN}")]
    assert "s3cret" not in "".join([*said, caplog.text, *capfd.readouterr()])


async def test_credentials_in_the_uri_are_shown_at_the_door_and_nowhere_else(caplog):
    caplog.set_level(logging.DEBUG)
    async with access(wants="Basic " + base64.b64encode(b"user:s3cret").decode()) as server:
        uri = f"ws://user:s3cret@127.0.0.1:{server.port}/path?key=s3cret"
        async with connect(uri) as ros:
            assert ros.uri == f"ws://127.0.0.1:{server.port}/path?***"
            said = repr(vars(ros._session)).replace("query='key=s3cret'", "")
        assert server.shown[0].path == "/path?key=s3cret"
        server.wants = "else"
        said += await refused(uri, AccessRefusedError)
    with pytest.raises(UriError) as wrong:
        connect("ws://user:s3cret@robot:port")
    assert "s3cret" not in caplog.text + said + str(wrong.value)


def test_a_secret_in_the_clear_is_warned_of(caplog):
    for uri in ("wss://robot:9090", *(f"ws://{host}:9090" for host in ("localhost", "[::1]", "127.3.2.1"))):
        connect(uri, token=TOKEN)
    assert not caplog.text
    for number, uri in enumerate(("ws://robot:9090", "ws://192.168.1.10:9090"), start=1):
        connect(uri, token=TOKEN)
        assert caplog.text.count("unencrypted") == number
    assert TOKEN not in caplog.text


@pytest.mark.parametrize(
    ("uri", "without"),
    [
        ("ws://u:p@q@robot:9090/x@y", "ws://robot:9090/x@y"),
        ("wss://robot/?token=abc", "wss://robot/?***"),
        ("wss://robot?a=b@c#d", "wss://robot?***#d"),
        ("u:p@robot", "robot"),
    ],
)
def test_what_is_shown_of_a_uri(uri, without):
    assert shown(uri) == without


# Proxies


class ConnectProxy:
    """A proxy for CONNECT: it keeps what it was asked, and answers as told."""

    scheme = "http"

    def __init__(self, answer=b"HTTP/1.1 200 Connection established\r\n\r\n"):
        self.answer = answer
        self.asked = []

    async def __aenter__(self):
        self._server = await asyncio.start_server(self.serve, "127.0.0.1", 0)
        self.where = f"127.0.0.1:{self._server.sockets[0].getsockname()[1]}"
        self.uri = f"{self.scheme}://user:s3cret@{self.where}"
        return self

    async def __aexit__(self, *_exception):
        self._server.close()

    async def serve(self, reader, writer):
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            if (target := await self.greet(reader, writer)) is not None:
                there, back = await asyncio.open_connection("localhost", int(target.rpartition(b":")[2]))
                await asyncio.gather(self._pass(reader, back), self._pass(there, writer))
        writer.close()

    async def greet(self, reader, writer):
        """Let a client in: where to, or None if it may not."""
        self.asked.append(await reader.readuntil(b"\r\n\r\n"))
        writer.write(self.answer)
        await writer.drain()
        return self.asked[-1].split()[1] if b" 200 " in self.answer[:20] else None

    @staticmethod
    async def _pass(reader, writer):
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(65536):
                writer.write(data)
                await writer.drain()
            writer.close()


class SocksProxy(ConnectProxy):
    """A SOCKS 5 proxy (RFC 1928) that wants a name and a password (RFC 1929)."""

    scheme = "socks5h"

    async def greet(self, reader, writer):
        _, methods = await reader.readexactly(2)
        await reader.readexactly(methods)
        writer.write(b"\x05\x02")
        _, length = await reader.readexactly(2)
        name = await reader.readexactly(length)
        password = await reader.readexactly((await reader.readexactly(1))[0])
        known = (name, password) == (b"user", b"s3cret")
        writer.write(b"\x01\x00" if known else b"\x01\x01")
        if not known:
            return None
        assert await reader.readexactly(4) == b"\x05\x01\x00\x03", "CONNECT, by the server's name"
        host = await reader.readexactly((await reader.readexactly(1))[0])
        self.asked.append(host + b":%d" % int.from_bytes(await reader.readexactly(2), "big"))
        writer.write(b"\x05\x00\x00\x01" + bytes(6))
        return self.asked[-1]


@pytest.mark.parametrize("secure", [False, True])
@pytest.mark.parametrize("kind", [ConnectProxy, SocksProxy])
async def test_through_a_proxy(certificates, secure, kind):
    context = server_context(certificates) if secure else None
    options = {"ca_file": certificates / "ca.pem"} if secure else {}
    async with access(context, wants=f"Bearer {TOKEN}") as server, kind() as proxy:
        uri = f"{'wss' if secure else 'ws'}://localhost:{server.port}"
        async with connect(uri, proxy=proxy.uri, token=TOKEN, **options) as ros:
            assert ros.state is State.CONNECTED
            assert "s3cret" not in repr(ros._session._located)
        if kind is SocksProxy:
            wrong = proxy.uri.replace("s3cret", "wr0ng")
            assert "wr0ng" not in await refused(uri, UnreachableError, proxy=wrong)
    assert len(server.shown) == 1
    (asked,) = proxy.asked
    assert f"localhost:{server.port}".encode() in asked
    assert TOKEN.encode() not in asked, "the token is for the server alone"
    if kind is ConnectProxy:
        assert asked.startswith(b"CONNECT localhost:")
        assert b"Proxy-Authorization: Basic " + base64.b64encode(b"user:s3cret") in asked


async def test_the_proxy_of_the_environment(monkeypatch):
    async with access() as server, ConnectProxy() as proxy:
        for name in ("no_proxy", "NO_PROXY", "all_proxy", "ALL_PROXY", "ws_proxy", "socks_proxy"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setenv("https_proxy", proxy.uri)
        uri = f"ws://127.0.0.1:{server.port}"
        for exempt, option, asked in (
            (None, None, 0),
            (None, "environment", 1),
            ("127.0.0.1", "environment", 1),
        ):
            if exempt:
                monkeypatch.setenv("no_proxy", exempt)
            async with connect(uri, proxy=option):
                assert len(proxy.asked) == asked


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
    async with access() as server, ConnectProxy(answer) as proxy:
        error = await refused(f"ws://127.0.0.1:{server.port}", UnreachableError, proxy=proxy.uri)
        assert re.search(f"http://{proxy.where} {said}", error)
        assert "s3cret" not in error
        assert not server.shown


@pytest.mark.parametrize("scheme", ["http", "socks5h"])
async def test_a_proxy_that_is_not_there_or_says_nothing(unused_tcp_port, scheme):
    through = f"{scheme}://127.0.0.1:{unused_tcp_port}"
    assert f"proxy {through} fails" in await refused("ws://robot:9090", UnreachableError, proxy=through)
    async with tcp_service(lambda _reader, _writer: None) as port:
        through = f"{scheme}://127.0.0.1:{port}"
        options = {"proxy": through, "connect_timeout": 0.3}
        assert "within 0.3 s" in await refused("ws://robot:9090", UnreachableError, **options)


async def test_socks_without_its_package(monkeypatch):
    async def missing(*_):
        raise ImportError  # what websockets puts there when it finds no python-socks

    monkeypatch.setattr("bridge.client.route.connect_socks_proxy", missing)
    with pytest.raises(OptionError, match="needs the package python-socks"):
        await connect("ws://robot:9090", proxy="socks5h://127.0.0.1:1").__aenter__()
