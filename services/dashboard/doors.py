"""Admission of requests for pages and WebSockets by host, origin and token.

    request ──▶ host? ──▶ origin? ──▶ token? ──▶ page, socket

A browser sends the token once, as `/?token=TOKEN`. The server returns the token in a cookie that scripts cannot read.
"""

import ipaddress
import re
import socket
from http import HTTPStatus
from typing import Final

from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose
from websockets.datastructures import Headers
from websockets.http11 import Request

from bridge.hub.access import AccessPolicy

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
    """An ASGI application that admits requests to another ASGI application.

    Args:
        app: The application that gets the admitted requests.
        policy: The accepted tokens, and the origins whose web pages may connect. The server's own pages may always
            connect.
        loopback: True if the server listens on loopback, so that only programs on this computer can reach the server.
    """

    def __init__(self, app: ASGIApp, policy: AccessPolicy, *, loopback: bool) -> None:
        self._app = app
        self._policy = policy
        self._loopback = loopback

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass an admitted request on, and refuse any other."""
        if scope["type"] not in {"http", "websocket"}:  # start and end of the server
            await self._app(scope, receive, send)
            return
        request = HTTPConnection(scope)
        token = next(filter(None, request.query_params.getlist("token")), "")
        refused = self.refusal(Headers(request.headers.items()), token or request.cookies.get(COOKIE, ""))
        if refused is not None:
            await _refusal_of(scope, refused)(scope, receive, send)
        elif token and self._policy.tokens and scope["type"] == "http":
            # so that the token does not stay in the address bar
            response = RedirectResponse("/", HTTPStatus.SEE_OTHER)
            secure = scope.get("scheme") == "https"
            response.set_cookie(COOKIE, token, httponly=True, samesite="strict", secure=secure)
            await response(scope, receive, send)
        else:
            await self._app(scope, receive, _with_headers(send))

    def refusal(self, headers: Headers, token: str = "") -> HTTPStatus | None:
        """Return the HTTP status that refuses a request with these headers, or None to admit the request."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_our_name(hosts[0]):
            return HTTPStatus.FORBIDDEN
        # a page of this server, or an origin that was allowed by name; programs send no origin
        ours = {f"http://{hosts[0]}", f"https://{hosts[0]}", *self._policy.origins}
        if len(origins) > 1 or not set(origins) <= ours:
            return HTTPStatus.FORBIDDEN
        # a picture or frame of another site sends no origin, and each page costs memory; only a link may lead here
        elsewhere = {"cross-site", "same-site"} & set(headers.get_all("Sec-Fetch-Site"))
        if not origins and elsewhere and headers.get_all("Sec-Fetch-Dest") != ["document"]:
            return HTTPStatus.FORBIDDEN
        presented = Headers(headers)
        # other texts are no tokens, and cannot be put into a header
        if token and token.isascii() and token.isprintable():
            presented.pop("Authorization", None)
            presented["Authorization"] = f"Bearer {token}"
        # the host was checked above, by stricter rules where others can reach the server
        return self._policy.refusal(Request("/", presented), loopback=False)

    def _is_our_name(self, host: str) -> bool:
        """Return whether a Host header names this server, not another site whose name resolves to its address."""
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


def _with_headers(send: Send) -> Send:
    async def send_with_headers(event: Message) -> None:
        if event["type"] == "http.response.start":
            event["headers"] = [*event.get("headers", ()), *_HEADERS]
        await send(event)

    return send_with_headers


def _refusal_of(scope: Scope, status: HTTPStatus) -> ASGIApp:
    if scope["type"] == "websocket":
        return WebSocketClose(1008)  # before it is accepted: 403
    why = "forbidden\n"
    if status is HTTPStatus.UNAUTHORIZED:
        why = "this page needs a token: add ?token=TOKEN to its address\n"
    return PlainTextResponse(why, status)
