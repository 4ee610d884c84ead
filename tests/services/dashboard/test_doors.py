"""Admission to pages and sockets: the same rules for both."""

import pytest

from bridge.hub.access import AccessPolicy
from services.dashboard.doors import Doors

TOKEN = "a-token-of-sixteen-characters"
OURS = "127.0.0.1:8080"


async def knock(kind="http", *, host=OURS, origin=None, policy=None, loopback=True, query=b"", more=()):
    """The status of an answer, its headers, and whether the page behind the doors was reached."""
    inside, sent = [], []

    async def behind(scope, _receive, send):
        inside.append(scope["type"])
        if kind == "http":
            await send({"type": "http.response.start", "status": 200, "headers": []})
        else:
            await send({"type": "websocket.accept"})

    async def send(event):
        sent.append(event)

    headers = [(b"host", host.encode())] if host is not None else []
    if origin is not None:
        headers.append((b"origin", origin.encode()))
    headers += [(name, value.encode()) for name, value in more]
    scope = {"type": kind, "path": "/", "scheme": kind, "headers": headers, "query_string": query}
    await Doors(behind, policy or AccessPolicy(), loopback=loopback)(scope, None, send)
    first = sent[0]
    status = {"websocket.accept": 200, "websocket.close": 403}.get(first["type"]) or first["status"]
    assert (status == 200) is bool(inside)
    return status, dict(first.get("headers", ()))


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        (OURS, None, 200),
        (OURS, f"http://{OURS}", 200),
        ("localhost:8080", "http://localhost:8080", 200),
        ("[::1]:8080", None, 200),
        (OURS, "http://evil.example", 403),
        (OURS, "http://127.0.0.1:3000", 403),
        (OURS, "null", 403),
        ("evil.example:8080", None, 403),
        ("evil.example:8080", "http://evil.example:8080", 403),
        ("192.168.1.5:8080", None, 403),
        ("[::1%evil.example]", "http://[::1%evil.example]", 403),
        (None, None, 403),
    ],
)
async def test_another_sites_page_gets_nothing(kind, host, origin, status):
    assert (await knock(kind, host=host, origin=origin))[0] == status


@pytest.mark.parametrize(
    ("site", "kind", "status"),
    [
        ("cross-site", "image", 403),
        ("same-site", "iframe", 403),
        ("cross-site", "document", 200),
        ("same-origin", "script", 200),
        ("none", "document", 200),
    ],
)
async def test_another_sites_page_may_link_here_and_no_more(site, kind, status):
    more = [(b"sec-fetch-site", site), (b"sec-fetch-dest", kind)]
    assert (await knock(more=more))[0] == status


async def test_two_hosts_or_origins_mean_another():
    for name, value in ((b"host", OURS), (b"origin", f"http://{OURS}")):
        assert (await knock(origin=f"http://{OURS}", more=[(name, value)]))[0] == 403


@pytest.mark.parametrize(
    ("host", "status"), [("192.168.1.5:8080", 200), ("evil.example", 403), ("robot.example:8080", 200)]
)
async def test_elsewhere_an_address_or_a_given_name(host, status):
    policy = AccessPolicy(origins=("https://robot.example:8080",))
    assert (await knock(host=host, policy=policy, loopback=False))[0] == status
    assert (await knock("websocket", host=host, origin=f"https://{host}", policy=policy, loopback=False))[
        0
    ] == status


@pytest.mark.parametrize("kind", ["http", "websocket"])
async def test_a_token_opens_pages_and_sockets(kind):
    policy = AccessPolicy(tokens=(TOKEN,))
    refused = 401 if kind == "http" else 403
    assert (await knock(kind, policy=policy))[0] == refused
    wrong = [(b"cookie", "rosbayes=another-token-of-that-length")]
    assert (await knock(kind, policy=policy, more=wrong))[0] == refused
    for name, value in ((b"cookie", f"a=b; rosbayes={TOKEN}"), (b"authorization", f"Bearer {TOKEN}")):
        assert (await knock(kind, policy=policy, more=[(name, value)]))[0] == 200
        foreign = await knock(kind, policy=policy, origin="http://evil.example", more=[(name, value)])
        assert foreign[0] == 403


async def test_a_token_in_the_address_becomes_a_cookie():
    policy = AccessPolicy(tokens=(TOKEN,))
    status, headers = await knock(policy=policy, query=f"token={TOKEN}".encode())
    assert (status, headers[b"location"]) == (303, b"/")
    assert headers[b"set-cookie"].startswith(f"rosbayes={TOKEN};".encode())
    assert b"HttpOnly" in headers[b"set-cookie"]
    assert (await knock(policy=policy, query=b"token=wrong-token-of-that-length"))[0] == 401
    assert (await knock(policy=policy, query=b"token=x%0d%0aset-cookie:a"))[0] == 401
    assert (await knock(query=b"token=x%0d%0aset-cookie:a"))[0] == 200, "without tokens, it means nothing"


async def test_pages_load_from_this_server_alone():
    _, headers = await knock()
    assert b"default-src 'self'" in headers[b"content-security-policy"]
    assert b"http" not in headers[b"content-security-policy"]
