"""Route of a connection to its server: TLS and certificates, headers and tokens, proxies.

Secrets do not appear in logs and errors: the repr of a `Route` does not contain headers, and `shown` removes
credentials and queries from a URI.
"""

import asyncio
import ipaddress
import logging
import re
import ssl
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from os import PathLike, fspath
from socket import SOCK_STREAM, socket
from typing import Any, Final, TypeVar

from websockets.asyncio.client import connect_http_proxy, connect_socks_proxy
from websockets.exceptions import InvalidHandshake, InvalidProxy, InvalidProxyStatus
from websockets.headers import build_authorization_basic
from websockets.proxy import Proxy, get_proxy, parse_proxy
from websockets.uri import WebSocketURI

from bridge.errors import OptionError, UnreachableError

FROM_ENVIRONMENT: Final = "environment"
"""Use the proxy from the environment (`HTTPS_PROXY`, `ALL_PROXY`, `NO_PROXY` ...)."""

_log = logging.getLogger("bridge")

_CREDENTIALS = re.compile(r"^([A-Za-z][A-Za-z0-9+.-]*://)?[^/?#]*@")
_QUERY = re.compile(r"\?[^#]+")
_HEADER_NAME = re.compile(r"[!#$%&'*+.^_`|~0-9A-Za-z-]+")
_HEADER_VALUE = re.compile(r"[\t\x20-\x7e\x80-\xff]*")

Path = str | PathLike[str]
_ConnectionT = TypeVar("_ConnectionT", bound=asyncio.Protocol)


def shown(uri: str) -> str:
    """Return a URI without user, password and query."""
    return _QUERY.sub("?***", _CREDENTIALS.sub(r"\1", uri))


@dataclass(frozen=True, slots=True)
class Route:
    """The route to a server.

    Attributes:
        tls: TLS settings; None for `ws://`.
        headers: Additional headers of the handshake.
        proxy: The proxy, or None for a direct connection.
    """

    tls: ssl.SSLContext | None = None
    headers: tuple[tuple[str, str], ...] = field(default=(), repr=False)
    proxy: Proxy | None = field(default=None, repr=False)


def make_route(
    uri: WebSocketURI,
    *,
    token: str | None = None,
    headers: Mapping[str, str] | None = None,
    ca_file: Path | None = None,
    client_certificate: Path | tuple[Path, Path] | None = None,
    tls: ssl.SSLContext | None = None,
    proxy: str | None = None,
) -> Route:
    """Check the options of a route (see `bridge.client.connect`); credentials in the URI become a header.

    Raises:
        OptionError: An option is invalid; the sentence names it, without secrets.
    """
    # Only one source of credentials, because a server could use either of two.
    fields = dict(headers or {})
    authorized = any(name.lower() == "authorization" for name in fields)
    if token is not None:
        if authorized or uri.user_info is not None:
            raise OptionError("token and an Authorization header or a user in the URI exclude each other")
        if not token or not token.isascii() or not token.isprintable() or " " in token:
            raise OptionError("token must be printable ASCII characters without spaces")
        fields["Authorization"] = f"Bearer {token}"
    elif uri.user_info is not None and not authorized:
        fields["Authorization"] = build_authorization_basic(*uri.user_info)
    for name, value in fields.items():
        if _HEADER_NAME.fullmatch(name) is None:
            raise OptionError(f"{name!r} is not a header name")
        if not isinstance(value, str) or _HEADER_VALUE.fullmatch(value) is None:
            raise OptionError(f"the value of header {name} has characters that are not allowed in headers")
    # Only a warning, because many robots have no certificate, and a network of their own.
    if (authorized or "Authorization" in fields) and not uri.secure and not _is_loopback(uri.host):
        _log.warning("credentials are sent to %s unencrypted: wss:// would protect them", uri.host)
    return Route(_tls(uri, ca_file, client_certificate, tls), tuple(fields.items()), _proxy(uri, proxy))


def _tls(
    uri: WebSocketURI,
    ca_file: Path | None,
    client_certificate: Path | tuple[Path, Path] | None,
    tls: ssl.SSLContext | None,
) -> ssl.SSLContext | None:
    # Refused without TLS, because a program that sets one of them relies on TLS.
    options = {"ca_file": ca_file, "client_certificate": client_certificate}
    given = [name for name, value in options.items() if value is not None]
    if not uri.secure:
        if given or tls is not None:
            raise OptionError(f"{(*given, 'tls')[0]} requires wss://")
        return None
    if tls is not None:
        if given:
            raise OptionError(f"tls and {given[0]} exclude each other")
        return tls
    try:
        context = ssl.create_default_context(cafile=None if ca_file is None else fspath(ca_file))
    except (OSError, ssl.SSLError) as error:
        raise OptionError(f"ca_file {fspath(ca_file or '')} cannot be used: {reason_of(error)}") from None
    if client_certificate is not None:
        certificate, key = (
            client_certificate if isinstance(client_certificate, tuple) else (client_certificate, None)
        )
        try:
            # Without a password argument, OpenSSL would ask for one on the terminal.
            context.load_cert_chain(certificate, key, password=lambda: b"")
        except (OSError, ssl.SSLError, ValueError) as error:
            named = fspath(certificate) + (f" and {fspath(key)}" if key is not None else "")
            raise OptionError(f"client_certificate {named} cannot be used: {reason_of(error)}") from None
    return context


def _proxy(uri: WebSocketURI, proxy: str | None) -> Proxy | None:
    if proxy == FROM_ENVIRONMENT:
        proxy = get_proxy(uri)
    if proxy is None:
        return None
    try:
        return parse_proxy(proxy)
    except (InvalidProxy, ValueError) as error:
        reason = error.msg if isinstance(error, InvalidProxy) else "it is not a URL"
        raise OptionError(
            f"proxy {shown(proxy)!r} cannot be used ({reason}): expected, for example, http://proxy:3128"
        ) from None


async def connect_along(
    route: Route, uri: WebSocketURI, shown_uri: str, factory: Callable[[], _ConnectionT]
) -> _ConnectionT:
    """Open the transport of a WebSocket connection; `shown_uri` identifies the server in errors.

    Raises:
        UnreachableError: The proxy refuses or fails.
        OptionError: The proxy needs a package that is not installed.
        OSError: The connection failed.
    """
    loop = asyncio.get_running_loop()
    # The certificate is checked against the host of the URI, also through a proxy.
    hostname = uri.host if route.tls is not None else None
    passage = None if route.proxy is None else await _connect_proxy(route.proxy, uri, shown_uri)
    secured: dict[str, Any] = {"ssl": route.tls, "server_hostname": hostname}
    if passage is None:
        return await _connect_host(uri, factory, secured)
    if isinstance(passage, socket):
        return (await loop.create_connection(factory, sock=passage, **secured))[1]
    # An HTTP proxy returns a transport that is already connected, so the protocol must be attached by hand.
    try:
        connection = factory()
        passage.set_protocol(connection)
        if route.tls is not None:
            passage = (
                await loop.start_tls(passage, connection, route.tls, server_hostname=hostname) or passage
            )
        connection.connection_made(passage)
    except BaseException:
        passage.abort()
        raise
    return connection


async def _connect_host(
    uri: WebSocketURI, factory: Callable[[], _ConnectionT], secured: dict[str, Any]
) -> _ConnectionT:
    """Connect to the first address of a host that accepts; the error is that of the last one."""
    loop = asyncio.get_running_loop()
    # not by `create_connection`, in which uvloop reports a look-up that fails after the attempt has timed out
    found: list[Any] = await loop.getaddrinfo(uri.host, uri.port, type=SOCK_STREAM)
    while True:
        *_, address = found.pop(0)
        # an IPv6 address has its zone at the end
        host = f"{address[0]}%{address[3]}" if any(address[3:]) else address[0]
        try:
            return (await loop.create_connection(factory, host, address[1], **secured))[1]
        except OSError as error:
            if not found or isinstance(error, ssl.SSLError):
                raise


async def _connect_proxy(proxy: Proxy, uri: WebSocketURI, shown_uri: str) -> socket | asyncio.Transport:
    # Without the user and password of its URI.
    name = f"{proxy.scheme}://{proxy.host}:{proxy.port}"
    try:
        if proxy.scheme.startswith("socks"):
            return await connect_socks_proxy(proxy, uri)
        to_proxy = ssl.create_default_context() if proxy.scheme == "https" else None
        return await connect_http_proxy(proxy, uri, ssl=to_proxy)
    except ImportError:
        raise OptionError(
            f"the proxy {name} needs the package python-socks: pip install python-socks"
        ) from None
    except InvalidProxyStatus as error:
        why = f"refuses (HTTP {error.response.status_code} {error.response.reason_phrase[:80]})"
    except (InvalidHandshake, OSError) as error:
        why = f"fails: {reason_of(error)}"
    raise UnreachableError(f"{shown_uri} is unreachable: the proxy {name} {why}")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")


def reason_of(error: Exception) -> str:
    """Return the text of an error, without the operating system's number."""
    match error:
        case ConnectionRefusedError():
            return "connection refused"
        case ConnectionResetError():
            return "the connection was reset"
        case ssl.SSLError():
            return error.reason or "OpenSSL refuses it"
    return (error.strerror if isinstance(error, OSError) else None) or str(error) or type(error).__name__
