"""Who may come in: tokens, origins of web pages, and the certificate that the hub shows.

A token arrives in the header ``Authorization: Bearer TOKEN``. Browsers cannot set that header: they offer the
subprotocols ``rosbridge`` and ``bearer.TOKEN``, of which the hub chooses the first, so that the token is not sent back.
Tokens are compared in constant time, and are in no log, no error and no ``repr``.
"""

import hmac
import ipaddress
import re
import ssl
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from typing import Final

from websockets.datastructures import MultipleValuesError
from websockets.http11 import Request
from websockets.typing import Origin, Subprotocol

from bridge.hub.errors import HubError

#: The subprotocol that the hub speaks with clients that ask for one.
SUBPROTOCOL: Final = Subprotocol("rosbridge")
_BEARER: Final = "bearer."
#: Characters that a header and a subprotocol both take.
_TOKEN: Final = re.compile(r"[A-Za-z0-9._~-]{16,1024}")
#: Web pages of this machine; pages from elsewhere could speak to a robot through their visitor's browser.
LOCAL_ORIGIN: Final = re.compile(r"https?://(localhost|127\.\d+\.\d+\.\d+|\[::1\])(:\d+)?")
_MAX_TOKENS: Final = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class Door:
    """What a client must show.

    Attributes:
        tokens: one of them must be shown; none are wanted where there are none.
        origins: web pages (``https://robot.example``) that may connect, besides those of this machine.
            Programs that are no browsers send no origin and may always connect.
        tls: the hub's certificate and key; without it nothing is encrypted.
    """

    tokens: tuple[str, ...] = field(default=(), repr=False)
    origins: tuple[str, ...] = ()
    tls: ssl.SSLContext | None = None

    def __post_init__(self) -> None:
        """Refuse tokens that cannot be sent, or are guessed.

        Raises:
            HubError: a token is too short, or has characters that a header does not take.
        """
        for number, token in enumerate(self.tokens, 1):
            if _TOKEN.fullmatch(token) is None:
                raise HubError(
                    f"token {number} of the hub is none: 16 to 1024 letters, digits, '.', '_', '~' and '-' make one "
                    "(for example of: python3 -c 'import secrets; print(secrets.token_urlsafe(32))')"
                )

    @property
    def allowed_origins(self) -> list[Origin | re.Pattern[str] | None]:
        """The origins for the WebSocket handshake; None stands for programs, which send none."""
        return [None, LOCAL_ORIGIN, *map(Origin, self.origins)]

    def refusal(self, request: Request) -> HTTPStatus | None:
        """Why a request may not come in, None if it may."""
        if not self.tokens or self._shows_token(_offered(request)):
            return None
        return HTTPStatus.UNAUTHORIZED

    def _shows_token(self, offered: Iterable[str]) -> bool:
        shown = False
        for one in offered:
            for token in self.tokens:  # all of them, however early one fits
                shown |= hmac.compare_digest(one.encode("utf-8", "replace"), token.encode())
        return shown


def _offered(request: Request) -> list[str]:
    """What a request shows as tokens."""
    offered = []
    try:
        scheme, _, token = request.headers.get("Authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            offered.append(token.strip())
    except MultipleValuesError:  # two of that header: nobody's client does so
        return []
    for line in request.headers.get_all("Sec-WebSocket-Protocol"):
        names = (name.strip() for name in line.split(","))
        offered += [name.removeprefix(_BEARER) for name in names if name.startswith(_BEARER)]
    return offered


def choose_subprotocol(offered: Sequence[Subprotocol]) -> Subprotocol | None:
    """The subprotocol to speak: ours if it is offered, else none, which clients that offered others refuse."""
    return SUBPROTOCOL if SUBPROTOCOL in offered else None


def read_tokens(path: Path) -> tuple[str, ...]:
    """The tokens in a file: one a line; empty lines and lines that begin with # do not count.

    Raises:
        HubError: it cannot be read, others than its owner may read it, or there is none in it.
    """
    try:
        mode = path.stat().st_mode
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no text"
        raise HubError(f"the hub cannot read its tokens in {path}: {why}") from None
    if mode & 0o077:
        raise HubError(f"others may read the hub's tokens in {path}: run chmod 600 {path}")
    tokens = tuple(line.strip() for line in lines if line.strip() and not line.startswith("#"))
    if not 1 <= len(tokens) <= _MAX_TOKENS:
        raise HubError(
            f"{path} has {len(tokens)} tokens for the hub, expected 1 to {_MAX_TOKENS}, one a line"
        )
    return tokens


def tls_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """What the hub encrypts with: TLS 1.2 or later.

    Args:
        certificate: its certificate and those between it and the root, as PEM.
        key: the certificate's private key, as PEM, without a passphrase.

    Raises:
        HubError: a file cannot be read, or the two do not belong together.
    """
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
            f"{certificate} and {key} are no certificate and its private key without a passphrase (PEM): "
            f"{getattr(error, 'reason', None) or error}"
        ) from None
    return context


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address to listen on."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
