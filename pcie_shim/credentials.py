"""Credentials of links over TCP: a key that host and board share, and TLS.

Before its greeting, a board with a key sends a challenge. The host answers with a proof that it has the key, and gets
the proof of the board. Neither proof reveals the key or is valid for another link. The proofs protect only the
beginning of a link; TLS protects the data that follows.
"""

import hashlib
import hmac
import os
import re
import ssl
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from pcie_shim.errors import CredentialsError

NONCE_BYTES: Final = 32
PROOF_BYTES: Final = 32
_KEY: Final = re.compile(rb"[!-~]{16,1024}")
_HOST: Final = b"rosbayes host"
_BOARD: Final = b"rosbayes board"


@dataclass(frozen=True, slots=True, kw_only=True)
class Credentials:
    """Credentials of a host or a board for links over TCP.

    Attributes:
        key: The shared key; empty for none.
        tls: The board's certificate, or the authorities that the host trusts; None for no TLS or the system's.
    """

    key: bytes = field(default=b"", repr=False)
    tls: ssl.SSLContext | None = None


NO_CREDENTIALS: Final = Credentials()


def nonce() -> bytes:
    """Return a number that is used once."""
    return os.urandom(NONCE_BYTES)


def host_proof(key: bytes, board_nonce: bytes, host_nonce: bytes) -> bytes:
    """Return the proof that a host has the key: HMAC-SHA256 of both nonces."""
    return hmac.digest(key, _HOST + board_nonce + host_nonce, hashlib.sha256)


def board_proof(key: bytes, board_nonce: bytes, host_nonce: bytes) -> bytes:
    """Return the proof that a board has the key."""
    return hmac.digest(key, _BOARD + board_nonce + host_nonce, hashlib.sha256)


def read_key(path: Path) -> bytes:
    """Read a file with a key.

    Raises:
        CredentialsError: The file cannot be read, other users may read it, or it is not a key.
    """
    try:
        mode = path.stat().st_mode
        with path.open("rb") as file:
            key = file.read(4096).strip()
    except OSError as error:
        raise CredentialsError(f"the key in {path} cannot be read: {error.strerror}") from None
    if mode & 0o077:
        raise CredentialsError(f"others may read the key in {path}: run chmod 600 {path}")
    if _KEY.fullmatch(key) is None:
        raise CredentialsError(
            f"{path} is not a key: expected one line of 16 to 1024 printable characters without spaces "
            "(for example from: python3 -c 'import secrets; print(secrets.token_urlsafe(32))')"
        )
    return key


def board_tls(certificate: Path, key: Path) -> ssl.SSLContext:
    """Return the TLS context (1.2 or later) of a board.

    Args:
        certificate: The board's certificate and the intermediate ones, as PEM.
        key: The certificate's private key, as PEM, without a passphrase.

    Raises:
        CredentialsError: A file cannot be read, or the two do not belong together.
    """
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(certificate, key, password=lambda: "")
    except (OSError, ValueError) as error:
        raise CredentialsError(
            f"{certificate} and {key} are not a certificate and its private key without a passphrase (PEM): "
            f"{getattr(error, 'reason', None) or getattr(error, 'strerror', None) or error}"
        ) from None
    return context


def host_tls(authorities: Path) -> ssl.SSLContext:
    """Return the TLS context of a host that trusts the certificates in a file (PEM), and no others.

    Raises:
        CredentialsError: The file cannot be read, or has no certificates.
    """
    try:
        return ssl.create_default_context(cafile=str(authorities))
    except OSError as error:
        raise CredentialsError(
            f"{authorities} has no certificates (PEM): {getattr(error, 'reason', None) or error.strerror or error}"
        ) from None
