"""Atomic writing of files, so that readers never see a partial file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from toolchain.errors import ToolchainError


@contextmanager
def whole_file(path: Path, error: type[ToolchainError]) -> Iterator[Path]:
    """Yield the path of a partial file, which replaces the file at the end of the block.

    If the partial file is removed in the block, the file does not change.
    """
    partial = path.with_name(path.name + ".part")
    try:
        yield partial
        if partial.exists():
            partial.replace(path)
    except OSError as reason:
        raise error(f"{path} cannot be written: {reason.strerror or reason}") from None
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
