"""Settings of a connection that are not in the server's URI: TLS and certificates, headers and tokens.

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
from socket import SOCK_STREAM
from typing import Any, TypeVar

from websockets.headers import build_authorization_basic
from websockets.uri import WebSocketURI

from bridge.errors import OptionError

_log = logging.getLogger("bridge")

_CREDENTIALS = re.compile(r"^([A-Za-z][A-Za-z0-9+.-]*://)?[^/?#]*@")
_QUERY = re.compile(r"\?[^#]+")
_HEADER_NAME = re.compile(r"[!#$%&'*+.^_`|~0-9A-Za-z-]+")
_HEADER_VALUE = re.compile(r"[\t\x20-\x7e\x80-\xff]*")

Path = str | PathLike[str]
_ConnectionT = TypeVar("_ConnectionT", bound=asyncio.Protocol)


def shown(uri: str) -> str:
    """Return a URI without user and password, with `***` for the query."""
    return _QUERY.sub("?***", _CREDENTIALS.sub(r"\1", uri))


@dataclass(frozen=True, slots=True)
class Route:
    """Settings of a connection that are not in the server's URI.

    Attributes:
        tls: TLS settings, or None for `ws://`.
        headers: Additional headers of the handshake.
    """

    tls: ssl.SSLContext | None = None
    headers: tuple[tuple[str, str], ...] = field(default=(), repr=False)


def make_route(
    uri: WebSocketURI,
    *,
    token: str | None = None,
    headers: Mapping[str, str] | None = None,
    ca_file: Path | None = None,
    tls: ssl.SSLContext | None = None,
) -> Route:
    """Check the options of a route (see `bridge.client.connect`), and return the route.

    Credentials in the URI become a header of the handshake.

    Raises:
        OptionError: An option is invalid. The error names the option, but shows no secret.
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
    return Route(_tls(uri, ca_file, tls), tuple(fields.items()))


def _tls(uri: WebSocketURI, ca_file: Path | None, tls: ssl.SSLContext | None) -> ssl.SSLContext | None:
    if not uri.secure:
        # Refused without TLS, because a program that sets one of them relies on TLS.
        if ca_file is not None or tls is not None:
            raise OptionError(f"{'tls' if ca_file is None else 'ca_file'} requires wss://")
        return None
    if tls is not None:
        if ca_file is not None:
            raise OptionError("tls and ca_file exclude each other")
        return tls
    try:
        return ssl.create_default_context(cafile=None if ca_file is None else fspath(ca_file))
    except (OSError, ssl.SSLError) as error:
        raise OptionError(f"ca_file {fspath(ca_file or '')} cannot be used: {reason_of(error)}") from None


async def connect_along(route: Route, uri: WebSocketURI, factory: Callable[[], _ConnectionT]) -> _ConnectionT:
    """Connect to the first address of the host that accepts.

    Raises an error of TLS at once. If no address accepts, raises the OSError of the last address.
    """
    loop = asyncio.get_running_loop()
    # not by `create_connection`, in which uvloop reports a look-up that fails after the attempt has timed out
    found: list[Any] = await loop.getaddrinfo(uri.host, uri.port, type=SOCK_STREAM)
    while True:
        *_, address = found.pop(0)
        # an IPv6 address has its zone at the end
        host = f"{address[0]}%{address[3]}" if any(address[3:]) else address[0]
        try:
            # the certificate is checked against the host of the URI
            name = uri.host if route.tls is not None else None
            return (
                await loop.create_connection(factory, host, address[1], ssl=route.tls, server_hostname=name)
            )[1]
        except OSError as error:
            if not found or isinstance(error, ssl.SSLError):
                raise


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")


def reason_of(error: Exception) -> str:
    """Return the reason of an error as text, without a prefix `[Errno ...]`."""
    match error:
        case ConnectionRefusedError():
            return "connection refused"
        case ConnectionResetError():
            return "the connection was reset"
        case ssl.SSLError():
            return error.reason or "OpenSSL refuses it"
    return (error.strerror if isinstance(error, OSError) else None) or str(error) or type(error).__name__
