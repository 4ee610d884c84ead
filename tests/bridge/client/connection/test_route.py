"""The route to a server: certificates on both sides, tokens and headers; secrets are never shown.

Ros ──(TLS)──▶ WebSocket server of the test (keeps what it was shown)
"""

import base64
import contextlib
import logging
import ssl
from http import HTTPStatus
from types import SimpleNamespace

import pytest
from websockets.asyncio.server import serve

from bridge.client import State, connect
from bridge.client.route import shown
from bridge.errors import AccessRefusedError, BridgeError, OptionError, UnreachableError, UriError
from tests.certificates import issue
from tests.patience import PATIENCE

TOKEN = "s3cret-token"


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """A CA, a server's certificate and a client's of it, and another CA that vouches for nobody."""
    folder = tmp_path_factory.mktemp("certificates")
    for name, ca in (("ca", None), ("other", None), ("server", "ca"), ("client", "ca")):
        issue(folder, name, ca=ca)
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
    context = ssl.create_default_context(cafile=certificates / "ca.pem")
    context.load_cert_chain(certificates / "client.pem", certificates / "client.key")
    async with access(server_context(certificates, asks=True)) as server:
        uri, ca_file = f"wss://localhost:{server.port}", certificates / "ca.pem"
        async with connect(uri, tls=context):
            pass
        # TLS 1.3 sends its alert after the handshake, so whether it is received is a race.
        assert "client certificate" in await refused(uri, BridgeError, ca_file=ca_file)


TLS = ssl.create_default_context()


@pytest.mark.parametrize(
    ("uri", "options", "said"),
    [
        ("wss://localhost:1", {"ca_file": "nowhere.pem"}, "ca_file nowhere.pem cannot be used: No such file"),
        ("wss://localhost:1", {"ca_file": __file__}, "ca_file"),
        ("wss://localhost:1", {"tls": TLS, "ca_file": "x"}, "tls and ca_file"),
        ("ws://localhost:1", {"ca_file": "x"}, "ca_file"),
        ("ws://localhost:1", {"tls": TLS}, "tls"),
        ("ws://localhost:1", {"token": ""}, "token must be"),
        ("ws://localhost:1", {"token": "a\r\nX: y"}, "token must be"),
        ("ws://localhost:1", {"token": "\u00e4"}, "token must be"),
        ("ws://u:y@localhost:1", {"token": "x"}, "token and"),
        ("ws://localhost:1", {"token": "x", "headers": {"authorization": "y"}}, "token and"),
        ("ws://localhost:1", {"headers": {"a b": "y"}}, "header name"),
        ("ws://localhost:1", {"headers": {"a": "x\r\nB: y"}}, "value of header a"),
        ("ws://localhost:1", {"headers": {"a": 5}}, "value of header a"),
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
