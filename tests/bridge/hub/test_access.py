"""Access to the hub: tokens, TLS, and answers to refused clients."""

import ssl

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from bridge.hub.access import AccessPolicy, is_loopback, read_tokens, tls_context
from bridge.hub.limits import HubError
from tests.bridge.hub.sockets import Client, RawClient, running_hub
from tests.certificates import issue

TOKEN = "correct-horse-battery-staple"
OTHER = "another.token_of~the-same-hub"


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    return issue(tmp_path_factory.mktemp("certificate"), "server")


async def test_a_token_opens_the_door():
    cases = [
        ([], 401),
        ([f"Authorization: Bearer {TOKEN}"], 101),
        ([f"Authorization: bearer   {OTHER} "], 101),
        ([f"Authorization: Bearer {TOKEN}x"], 401),
        ([f"Authorization: Bearer {TOKEN[:-1]}"], 401),
        (["Authorization: Bearer "], 401),
        (["Authorization: Bearer \xff\xfe"], 401),
        ([f"Authorization: Basic {TOKEN}"], 401),
        ([f"Authorization: {TOKEN}"], 401),
        ([f"Authorization: Bearer {TOKEN}", f"Authorization: Bearer {TOKEN}"], 401),
        ([f"Sec-WebSocket-Protocol: rosbridge, bearer.{OTHER}"], 101),
        (["Sec-WebSocket-Protocol: rosbridge", f"Sec-WebSocket-Protocol: bearer.{TOKEN}"], 101),
        (["Sec-WebSocket-Protocol: rosbridge, bearer.wrong"], 401),
        (["Sec-WebSocket-Protocol: rosbridge, bearer."], 401),
        (["Authorization: Bearer wrong", f"Sec-WebSocket-Protocol: rosbridge, bearer.{TOKEN}"], 101),
        (["Authorization: Bearer wrong"], 401),
        ([f"Authorization: Bearer {TOKEN}", "Origin: https://evil.example"], 403),
    ]
    async with running_hub(access=AccessPolicy(tokens=(TOKEN, OTHER))) as port:
        for headers, status in cases:
            raw = await RawClient.connect(port, handshake=False)
            assert f" {status} " in await raw.request(*headers), headers
            raw.cut()


@pytest.mark.parametrize(
    ("tokens", "offered"), [((TOKEN,), ["rosbridge", f"bearer.{TOKEN}"]), ((), ["rosbridge"])]
)
async def test_a_browsers_token_is_not_sent_back(tokens, offered):
    async with (
        running_hub(access=AccessPolicy(tokens=tokens)) as port,
        connect(f"ws://127.0.0.1:{port}", subprotocols=offered) as socket,
    ):
        assert socket.subprotocol == "rosbridge"
        assert socket.response is not None
        assert TOKEN not in str(socket.response.headers)
        await Client(socket).sync()


OWN_PAGES = ("https://robot.example:8000", "null")


async def test_a_page_needs_a_known_origin_and_this_machines_name():
    cases = [
        ("127.0.0.1", None, 101),
        ("[::1]:9090", None, 101),
        *(
            ("localhost:9090", f"http://{host}", 101)
            for host in ("localhost", "127.0.0.1:8443", "[::1]:3000")
        ),
        ("robot.example:8000", "https://robot.example:8000", 101),
        ("localhost", "null", 101),
        *((f"{host}attacker.example", None, 403) for host in ("", "localhost.")),
        ("attacker.example:9090", "http://attacker.example", 403),
        *(
            ("localhost", origin, 403)
            for origin in (
                *("https://robot.example", "http://robot.example:8000", "http://attacker.example", ""),
                *("http://localhost.attacker.example", "http://localhost:80@attacker.example"),
            )
        ),
    ]
    async with running_hub(access=AccessPolicy(origins=OWN_PAGES)) as port:
        for host, origin, status in cases:
            raw = await RawClient.connect(port, handshake=False)
            headers = [] if origin is None else [f"Origin: {origin}"]
            assert f" {status} " in await raw.request(*headers, host=host), (host, origin)
            raw.cut()


@pytest.mark.parametrize("hosts", [[], ["localhost", "localhost"], ["localhost", "attacker.example"]])
async def test_a_request_names_one_host(hosts):
    async with running_hub() as port:
        raw = await RawClient.connect(port, handshake=False)
        lines = [*(f"Host: {host}" for host in hosts), "Upgrade: websocket", "Connection: Upgrade"]
        lines += ["Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version: 13"]
        raw.writer.write("\r\n".join(["GET / HTTP/1.1", *lines, "", ""]).encode())
        assert (await raw.ended()).startswith(b"HTTP/1.1 403 ")


@pytest.mark.parametrize("origin", ["", "Origin: https://evil.example\r\n"])
async def test_a_browser_is_told_where_the_page_is_and_nothing_else(origin):
    """Every browser gets the same text, and does not become a client."""
    async with running_hub(access=AccessPolicy(tokens=(TOKEN,))) as port:
        raw = await RawClient.connect(port, handshake=False)
        request = f"GET /?token={TOKEN} HTTP/1.1\r\nHost: robot.example:{port}\r\n{origin}\r\n"
        raw.writer.write(request.encode())
        head, _, body = (await raw.ended()).partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 426 ")
    assert b"\r\nContent-Type: text/plain" in head
    assert b"\r\nUpgrade: websocket" in head
    assert b"http://127.0.0.1:8080" in body
    assert all(word not in head + body for word in (TOKEN.encode(), b"robot.example", b"evil"))


async def test_without_a_list_no_page_but_of_this_machine_is_let_in():
    async with running_hub() as port:
        raw = await RawClient.connect(port, handshake=False)
        assert " 403 " in await raw.request("Origin: null")


async def test_tokens_are_in_no_log_and_no_answer(caplog):
    access = AccessPolicy(tokens=(TOKEN,))
    assert TOKEN not in repr(access)
    async with running_hub(access=access) as port:
        guess = "guess-of-a-stranger"
        with pytest.raises(InvalidStatus) as caught:
            await connect(f"ws://127.0.0.1:{port}", additional_headers={"Authorization": f"Bearer {guess}"})
        response = caught.value.response
        assert response.headers["WWW-Authenticate"] == "Bearer"
        assert b"token" in (response.body or b"")
    for secret in (TOKEN, guess):
        assert secret not in caplog.text
        assert secret not in str(response.headers) + repr(response.body)
    assert "401" in caplog.text


@pytest.mark.parametrize(
    "token", ["", "short", "x" * 1025, "with spaces in the middle", "ümlaut" * 5, "a/b" * 9]
)
def test_a_token_that_is_guessed_or_cannot_be_sent_is_refused(token):
    with pytest.raises(HubError) as caught:
        AccessPolicy(tokens=(TOKEN, token))
    assert caught.value.exit_code == 2
    if token:
        assert token not in str(caught.value)


def test_tokens_are_read_from_a_file_that_nobody_else_reads(tmp_path):
    path = tmp_path / "tokens"
    path.write_text(f"# robots\n{TOKEN}\n\n  {OTHER}  \n")
    path.chmod(0o600)
    assert read_tokens(path) == (TOKEN, OTHER)
    path.chmod(0o640)
    with pytest.raises(HubError):
        read_tokens(path)
    path.chmod(0o600)
    for content in (b"# none\n", b"\xff\xfe", b"x\n" * 1001):
        path.write_bytes(content)
        with pytest.raises(HubError):
            read_tokens(path)
    with pytest.raises(HubError):
        read_tokens(tmp_path / "missing")


async def test_tls_and_a_token(certificate):
    access = AccessPolicy(tokens=(TOKEN,), tls=tls_context(*certificate))
    trusting = ssl.create_default_context(cafile=str(certificate[0]))
    async with running_hub(access=access) as port:
        headers = {"Authorization": f"Bearer {TOKEN}"}
        async with connect(f"wss://localhost:{port}", ssl=trusting, additional_headers=headers) as socket:
            ears = Client(socket)
            await ears.send(op="subscribe", topic="/t", type="a/B")
            for size in (0, 100, 100_000, 1_000_000):
                await ears.send(op="publish", topic="/t", msg={"data": "x" * size})
                assert (await ears.receive())["msg"] == {"data": "x" * size}
        with pytest.raises(ssl.SSLCertVerificationError):
            await connect(f"wss://localhost:{port}", additional_headers=headers)
        leaves = await connect(f"wss://localhost:{port}", ssl=trusting, additional_headers=headers)
        plain = await RawClient.connect(port, handshake=False)
        plain.writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert b"101" not in await plain.ended()
    assert await Client(leaves).closed() == 1001


def test_unusable_certificates_are_an_error(certificate, tmp_path):
    nothing, missing = tmp_path / "nothing.pem", tmp_path / "missing.pem"
    nothing.write_text("nothing")
    cert, key = certificate
    for files in ((nothing, key), (cert, nothing), (cert, missing)):
        with pytest.raises(HubError) as caught:
            tls_context(*files)
        assert "\n" not in str(caught.value)


def test_loopback_addresses_are_recognised():
    assert all(map(is_loopback, ["127.0.0.1", "127.8.9.10", "::1", "localhost"]))
    elsewhere = ["0.0.0.0", "::", "192.168.1.10", "robot.example", "localhost.example", ""]  # noqa: S104 - the test needs an address that is not loopback
    assert not any(map(is_loopback, elsewhere))
