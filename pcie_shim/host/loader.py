"""The loader, which programs a board through its programming port (thesis 3.4: SofLoader)."""

import hashlib
from pathlib import Path
from typing import Final

from pcie_shim import framing, register_map
from pcie_shim.endpoint import Endpoint, parse_endpoint
from pcie_shim.errors import AccessError, ImageMismatchError
from pcie_shim.host.socket_link import SocketLink
from pcie_shim.programming_file import Image, image_bytes, image_from_bytes, read_bytes
from pcie_shim.register_map import ErrorCode

PART_BYTES: Final = 4 * framing.MAX_PAYLOAD_WORDS


def program(
    endpoint: Endpoint | str, image: Image | Path, *, timeout: float = 30.0, token: bytes = framing.NO_TOKEN
) -> str:
    """Program the board whose registers are at `endpoint`, and return the image hash that the board then reports.

    The file and the board's register map are checked before the board is changed. Connecting, transferring the file
    and loading the machine may each take `timeout` seconds.

    If this host has a link to the board, `token` must be the token in the link's greeting. The token proves that this
    host is the one that holds the board. Without a link, omit `token`.

    Raises:
        ImageError: The file is missing, damaged, or for another register map.
            It is also raised if the board refuses the file.
        GreetingMismatchError: The board has another register map.
        HeldError: Another host holds the board, or another loader is programming it.
        LinkError: The board is unreachable, or the link is broken.
    """
    where = parse_endpoint(endpoint) if isinstance(endpoint, str) else endpoint
    # everything is read and checked before the board is touched
    content, expected = _content(image)
    with SocketLink.open(where.programming, timeout=timeout) as link:
        begin = framing.ProgramBegin(size=len(content), sha256=hashlib.sha256(content).digest(), token=token)
        _request(link, framing.BEGIN, 0, begin.encode())
        # parts are not acknowledged: the reply to END is that of the whole file
        for offset in range(0, len(content), PART_BYTES):
            part = content[offset : offset + PART_BYTES]
            padded = part + bytes(-len(part) % 4)
            link.post_part(offset, padded)
        _request(link, framing.END, len(content), b"")
        identity = link.read32(register_map.ID)
        found = link.read_block(register_map.IMAGE_HASH, register_map.IMAGE_HASH.words).hex()
    # the board may have loaded something else than it was sent
    if identity != register_map.ID_VALUE or found != expected:
        raise ImageMismatchError(
            f"The board at {where} reads ID {identity:#010x} and image {found} after programming; "
            f"{register_map.ID_VALUE:#010x} and {expected} were expected"
        )
    return found


def _content(image: Image | Path) -> tuple[bytes, str]:
    """Return the bytes of the programming file, and the expected image hash."""
    if isinstance(image, Image):
        return image_bytes(image), image.image_hash
    content = read_bytes(image)
    return content, image_from_bytes(content, str(image)).image_hash


def _request(link: SocketLink, flag: int, offset: int, payload: bytes) -> None:
    try:
        link.request(framing.PROGRAM, flag, offset, len(payload) // 4, payload)
    except AccessError as error:
        if error.code != ErrorCode.BAD_IMAGE:
            raise
        raise ImageMismatchError(f"The board at {link.endpoint} refuses the image: {error.detail}") from error
