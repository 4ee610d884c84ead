"""The key that both ends of a TCP link share, and the proofs that an end has the key.

Before its greeting, a board with a key sends a challenge. The host answers with a proof that it has the key. Then the
board sends its own proof. Neither proof reveals the key, and neither proof is valid for another link.

    board                                   host
      │── AUTHENTICATE board nonce ─────────▶│
      │◀─ AUTHENTICATE host nonce, proof ────│   HMAC("rosbayes host" + both nonces)
      │── reply: proof, then the greeting ──▶│   HMAC("rosbayes board" + both nonces)

The proofs protect only the beginning of a link. If the network is not trusted, tunnel the link through ssh or
WireGuard.
"""

import hashlib
import hmac
import os
import re
from pathlib import Path
from typing import Final

from pcie_shim.errors import CredentialsError

NONCE_BYTES: Final = 32
PROOF_BYTES: Final = 32
_KEY: Final = re.compile(rb"[!-~]{16,1024}")
# The two proofs differ, so that a host's cannot be sent back as the board's.
_HOST: Final = b"rosbayes host"
_BOARD: Final = b"rosbayes board"


def nonce() -> bytes:
    """Return a number that is used once."""
    return os.urandom(NONCE_BYTES)


def host_proof(key: bytes, board_nonce: bytes, host_nonce: bytes) -> bytes:
    """Return the proof that a host has the key: HMAC-SHA256 of both nonces."""
    return hmac.digest(key, _HOST + board_nonce + host_nonce, hashlib.sha256)


def board_proof(key: bytes, board_nonce: bytes, host_nonce: bytes) -> bytes:
    """Return the proof that a board has the key: HMAC-SHA256 of both nonces."""
    return hmac.digest(key, _BOARD + board_nonce + host_nonce, hashlib.sha256)


def read_key(path: Path) -> bytes:
    """Read a key from a file.

    Raises a CredentialsError if the file cannot be read, contains no key, or is readable for other users.
    """
    try:
        mode = path.stat().st_mode
        with path.open("rb") as file:
            key = file.read(4096).strip()
    except OSError as error:
        raise CredentialsError(f"the key in {path} cannot be read: {error.strerror}") from None
    # checked before the content is used, because a key that others can read protects nothing
    if mode & 0o077:
        raise CredentialsError(f"others may read the key in {path}: run chmod 600 {path}")
    if _KEY.fullmatch(key) is None:
        raise CredentialsError(
            f"{path} is not a key: expected one line of 16 to 1024 printable characters without spaces "
            "(for example from: python3 -c 'import secrets; print(secrets.token_urlsafe(32))')"
        )
    return key
