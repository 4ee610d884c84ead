"""Admission of requests by host, origin and token, for pages and sockets alike.

    request ──▶ host? ──▶ origin? ──▶ token? ──▶ page, socket

A browser sends the token once, as `/?token=TOKEN`, and gets it back as a cookie that scripts cannot read.
"""

import ipaddress
import re
import socket
from collections.abc import Awaitable, Callable, MutableMapping
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any, Final
from urllib.parse import parse_qs

from websockets.datastructures import Headers
from websockets.http11 import Request

from bridge.hub.access import AccessPolicy

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

COOKIE: Final = "rosbayes"
_PORT: Final = re.compile(r":\d+$")
# The browser itself refuses whatever would leave this server; the framework compiles templates and adds styles.
_CONTENT: Final = (
    b"default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    b"img-src 'self' data: blob:; font-src 'self' data:; frame-ancestors 'none'; base-uri 'self'; form-action 'self'"
)
_HEADERS: Final = [
    (b"content-security-policy", _CONTENT),
    (b"x-content-type-options", b"nosniff"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"referrer-policy", b"no-referrer"),
]


class Doors:
    """An ASGI application that admits requests to another one.

    Args:
        app: The application behind the doors.
        policy: Tokens, and other web pages that may connect.
        loopback: Whether only this machine can reach the server.
    """

    def __init__(self, app: App, policy: AccessPolicy, *, loopback: bool) -> None:
        self._app = app
        self._policy = policy
        self._loopback = loopback

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass an admitted request on, and refuse any other."""
        if scope["type"] not in {"http", "websocket"}:  # start and end of the server
            await self._app(scope, receive, send)
            return
        headers = Headers(
            [(name.decode("latin-1"), value.decode("latin-1")) for name, value in scope["headers"]]
        )
        token = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        refused = self.refusal(headers, token)
        if refused is not None:
            await _refuse(scope, send, refused)
        elif token and self._policy.tokens and scope["type"] == "http":
            await self._give_cookie(scope, send, token)
        else:
            await self._app(scope, receive, _with_headers(send))

    def refusal(self, headers: Headers, token: str = "") -> HTTPStatus | None:
        """Return the status that refuses a request with these headers, or None to admit it."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_our_name(hosts[0]):
            return HTTPStatus.FORBIDDEN
        # a page of ours, or one that was named; programs send no origin
        ours = {f"http://{hosts[0]}", f"https://{hosts[0]}", *self._policy.origins}
        if len(origins) > 1 or not set(origins) <= ours:
            return HTTPStatus.FORBIDDEN
        # another site's picture or frame sends no origin, and each page costs memory; a link may lead here
        elsewhere = {"cross-site", "same-site"} & set(headers.get_all("Sec-Fetch-Site"))
        if not origins and elsewhere and headers.get_all("Sec-Fetch-Dest") != ["document"]:
            return HTTPStatus.FORBIDDEN
        presented = Headers(headers)
        found = token or _cookie(headers)
        # others are no tokens, and no headers
        if found and found.isascii() and found.isprintable():
            presented.pop("Authorization", None)
            presented["Authorization"] = f"Bearer {found}"
        # the host was checked above, by stricter rules where others can reach the server
        return self._policy.refusal(Request("/", presented), loopback=False)

    def _is_our_name(self, host: str) -> bool:
        """Return whether a request is for this server, and not for a name that another site has let point to it."""
        if host in {origin.partition("://")[2] for origin in self._policy.origins}:
            return True
        name = _PORT.sub("", host).lower()
        if name == "localhost":
            return True
        try:
            # the name of a site is never an address
            address = ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
        except ValueError:
            own = socket.gethostname().lower()
            return not self._loopback and name in {own, f"{own}.local"}
        # a zone, as in [::1%evil.example], may be any text
        return "%" not in name and (address.is_loopback or not self._loopback)

    async def _give_cookie(self, scope: Scope, send: Send, token: str) -> None:
        # so that the token does not stay in the address bar
        secure = "; Secure" if scope.get("scheme") == "https" else ""
        cookie = f"{COOKIE}={token}; Path=/; HttpOnly; SameSite=Strict{secure}"
        headers = [(b"location", b"/"), (b"set-cookie", cookie.encode()), (b"content-length", b"0")]
        await send({"type": "http.response.start", "status": HTTPStatus.SEE_OTHER, "headers": headers})
        await send({"type": "http.response.body", "body": b""})


def _cookie(headers: Headers) -> str:
    for line in headers.get_all("Cookie"):
        try:
            if (found := SimpleCookie(line).get(COOKIE)) is not None:
                return found.value
        except CookieError:
            continue
    return ""


def _with_headers(send: Send) -> Send:
    async def send_with_headers(event: MutableMapping[str, Any]) -> None:
        if event["type"] == "http.response.start":
            event["headers"] = [*event.get("headers", ()), *_HEADERS]
        await send(event)

    return send_with_headers


async def _refuse(scope: Scope, send: Send, status: HTTPStatus) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": ""})  # before it is accepted: 403
        return
    why = b"forbidden\n"
    if status is HTTPStatus.UNAUTHORIZED:
        why = b"this page needs a token: add ?token=TOKEN to its address\n"
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(why)).encode())]
    await send({"type": "http.response.start", "status": int(status), "headers": headers})
    await send({"type": "http.response.body", "body": why})
