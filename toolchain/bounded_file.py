"""Reads a file that a user names: whole, but never more of it than makes sense."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from toolchain.errors import ToolchainError


def read_bounded(path: Path, most: int, error: type[ToolchainError], larger: str) -> bytes:
    """Return a file's content.

    Args:
        path: The file.
        most: How many bytes it may have.
        error: What is raised.
        larger: What is said of a file that has more, a clause.

    Raises:
        error: The file is not there, can't be read, or is larger.
    """
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as reason:
        raise error(f"{path} can't be read: {reason.strerror or reason}") from None
    if len(data) > most:
        raise error(f"{path} has more than {most} bytes: {larger}")
    return data
