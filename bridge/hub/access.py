"""Access control: tokens, origins of web pages, and the certificate that the hub presents.

A token arrives in the header `Authorization: Bearer TOKEN`. Browsers cannot set this header. They offer the
subprotocols `rosbridge` and `bearer.TOKEN` instead. The hub chooses `rosbridge`, so it does not send the token back.
Tokens are compared in constant time and never appear in a log, an error or a `repr`.
"""

import hmac
import ipaddress
import re
import ssl
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from typing import Final

from websockets.datastructures import MultipleValuesError
from websockets.http11 import Request
from websockets.typing import Origin, Subprotocol

from bridge.hub.limits import HubError

SUBPROTOCOL: Final = Subprotocol("rosbridge")
"""The hub's subprotocol, which a client may request.

The hub accepts no other subprotocol. A client that requests only other subprotocols disconnects by itself.
"""
_BEARER: Final = "bearer."
# Tokens of characters that both a header and a subprotocol accept.
_TOKEN: Final = re.compile(r"[A-Za-z0-9._~-]{16,1024}")
_LOCAL: Final = r"(localhost|127\.\d+\.\d+\.\d+|\[::1\])(:\d+)?"
# Web pages of this machine; any other page could control a robot through its visitor's browser.
LOCAL_ORIGIN: Final = re.compile(f"https?://{_LOCAL}")
_LOCAL_HOST: Final = re.compile(_LOCAL)
_MAX_TOKENS: Final = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class AccessPolicy:
    """The credentials that the hub expects from clients, and the certificate that it presents.

    Attributes:
        tokens: The accepted tokens. A client must present one token. If there are no tokens, every client may connect.
        origins: Origins of the web pages that may connect, for example `https://robot.example`. `null` stands for pages
            opened from a file. Pages of this machine may always connect. So may programs that are not browsers,
            because they send no origin.
        tls: The hub's certificate and key. If it is None, connections are not encrypted.
    """

    tokens: tuple[str, ...] = field(default=(), repr=False)
    origins: tuple[str, ...] = ()
    tls: ssl.SSLContext | None = None

    def __post_init__(self) -> None:
        """Refuse tokens that cannot be sent or are easy to guess, with a HubError."""
        for number, token in enumerate(self.tokens, 1):
            if _TOKEN.fullmatch(token) is None:
                raise HubError(
                    f"token {number} of the hub is malformed: expected 16 to 1024 letters, digits, '.', '_', '~' and '-' "
                    "(for example from: python3 -c 'import secrets; print(secrets.token_urlsafe(32))')"
                )

    @property
    def allowed_origins(self) -> list[Origin | re.Pattern[str] | None]:
        """Return the origins that the handshake accepts.

        The element `None` stands for a request without an origin, as programs send it. Only browsers send an origin.
        """
        return [None, LOCAL_ORIGIN, *map(Origin, self.origins)]

    def refusal(self, request: Request, *, loopback: bool) -> HTTPStatus | None:
        """Return the HTTP status with which to refuse a request, or None to admit it.

        If the hub listens on a loopback address (`loopback`), the request's `Host` must be this machine or the host of
        an allowed web page. Another `Host` is a sign of DNS rebinding: a page made its name resolve to this machine.
        """
        if loopback and not self._is_for_this_machine(request):
            return HTTPStatus.FORBIDDEN
        if not self.tokens:
            return None
        matches = False
        for candidate in _presented(request):
            # compare all of them, even after a match, because the time must not reveal anything
            for token in self.tokens:
                matches |= hmac.compare_digest(candidate.encode("utf-8", "replace"), token.encode())
        return None if matches else HTTPStatus.UNAUTHORIZED

    def _is_for_this_machine(self, request: Request) -> bool:
        # A request with several hosts could pass here with one and mean another.
        hosts = request.headers.get_all("Host")
        known = {origin.partition("://")[2] for origin in self.origins}
        return len(hosts) == 1 and (_LOCAL_HOST.fullmatch(hosts[0]) is not None or hosts[0] in known)


def _presented(request: Request) -> list[str]:
    """Return the tokens in a request."""
    presented = []
    try:
        scheme, _, token = request.headers.get("Authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            presented.append(token.strip())
    except MultipleValuesError:  # legitimate clients send this header only once
        return []
    for line in request.headers.get_all("Sec-WebSocket-Protocol"):
        names = (name.strip() for name in line.split(","))
        presented += [name.removeprefix(_BEARER) for name in names if name.startswith(_BEARER)]
    return presented


def read_tokens(path: Path) -> tuple[str, ...]:
    """Read a file of tokens, one per line. Empty lines and lines that begin with # are ignored.

    Raises:
        HubError: The file cannot be read, is readable by other users, or has no tokens or more than 1000.
    """
    try:
        mode = path.stat().st_mode
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not text"
        raise HubError(f"the hub cannot read its tokens in {path}: {why}") from None
    # A token is a password: in a file that others can read, it is no longer secret.
    if mode & 0o077:
        raise HubError(f"others may read the hub's tokens in {path}: run chmod 600 {path}")
    tokens = tuple(line.strip() for line in lines if line.strip() and not line.startswith("#"))
    if not 1 <= len(tokens) <= _MAX_TOKENS:
        raise HubError(
            f"{path} has {len(tokens)} tokens for the hub, expected 1 to {_MAX_TOKENS}, one per line"
        )
    return tokens


def tls_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """Return the context for TLS 1.2 or later, from the certificate and the private key of the hub.

    Raises:
        HubError: A file cannot be read, the key has a passphrase, or the key does not belong to the certificate.
    """
    # An error of `load_cert_chain` does not say which file cannot be read, so they are read first.
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    for path in (certificate, key):
        try:
            path.read_bytes()
        except OSError as error:
            raise HubError(f"the hub cannot read {path} for TLS: {error.strerror}") from None
    try:
        context.load_cert_chain(certificate, key, password=lambda: "")
    except (ssl.SSLError, OSError, ValueError) as error:
        raise HubError(
            f"{certificate} and {key} are not a certificate and its private key without a passphrase (PEM): "
            f"{getattr(error, 'reason', None) or error}"
        ) from None
    return context


def is_loopback(host: str) -> bool:
    """Return whether a listening address can be reached only from this machine."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
