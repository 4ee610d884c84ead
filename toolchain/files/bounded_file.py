"""Bounded reading of a file given by a user."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

if TYPE_CHECKING:
    from toolchain.errors import ToolchainError

_PIECE: Final = 1 << 18


def open_regular(path: Path, error: type[ToolchainError], most: int | None = None) -> BinaryIO:
    """Open a regular file for reading, because a FIFO or a device could block forever or never end.

    Raises:
        error: The file is missing, cannot be read, is not a regular file, or has more than `most` bytes.
    """
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # otherwise, opening a FIFO waits for a writer
    except OSError as reason:
        raise error(f"{path} cannot be read: {reason.strerror or reason}") from None
    state = os.fstat(number)
    if stat.S_ISREG(state.st_mode) and (most is None or state.st_size <= most):
        return os.fdopen(number, "rb")
    os.close(number)
    if not stat.S_ISREG(state.st_mode):
        raise error(f"{path} is not a regular file")
    raise error(f"{path} has more than {most} bytes, the maximum")


def read_bounded(path: Path, most: int, error: type[ToolchainError]) -> bytes:
    """Return the content of a regular file of at most `most` bytes, or raise the error."""
    try:
        with open_regular(path, error, most) as file:
            pieces, size = [], 0
            while size <= most and (
                piece := file.read(_PIECE)
            ):  # read(most) would allocate that much at once
                pieces.append(piece)
                size += len(piece)
    except OSError as reason:
        raise error(f"{path} cannot be read: {reason.strerror or reason}") from None
    if size > most:  # it has grown, or is a file in /proc, which reports the size 0
        raise error(f"{path} has more than {most} bytes, the maximum")
    return b"".join(pieces)
