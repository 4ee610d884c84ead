"""Readers of network files: BIF, XMLBIF, UAI, NET and XDSL, also compressed (.gz), become joint distributions."""

from __future__ import annotations

import gzip
import io
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from toolchain.bounded_files import read_bounded
from toolchain.errors import ModelError, NetworkFileError

if TYPE_CHECKING:
    from collections.abc import Callable

    from toolchain.models.joint import JointDistribution
    from toolchain.networks.builder import NetworkBuilder

MAX_BYTES: Final = 32 << 20
"""Maximum size of a file in bytes, compressed or not."""

SUFFIXES: Final = (".bif", ".xmlbif", ".bifxml", ".xml", ".uai", ".net", ".xdsl")
"""Suffixes of network files; `.gz` may follow."""


def is_network(path: Path) -> bool:
    """Return whether a path has the suffix of a network file."""
    return _suffix(Path(path)) in SUFFIXES


def read_network(path: Path, *, on_missing: Literal["error", "missing"] = "error") -> JointDistribution:
    """Return the joint distribution in a network file; its name ends in one of `SUFFIXES`, and `.gz` may follow.

    Raises:
        NetworkFileError: The file is missing, too large, or not a network; the sentence contains file and
            line.
    """
    from toolchain.networks.builder import NetworkBuilder

    path = Path(path)
    reader = _reader(path)
    data = read_bounded(path, MAX_BYTES, NetworkFileError)
    if path.suffix.lower() == ".gz":
        data = _unpacked(path, data)
    builder = NetworkBuilder(path, on_missing=on_missing)
    reader(data, builder)
    try:
        return builder.joint()
    except NetworkFileError:
        raise
    except ModelError as reason:
        raise NetworkFileError(str(reason), path=path) from None


def _reader(path: Path) -> Callable[[bytes, NetworkBuilder], None]:
    match _suffix(path):
        case ".bif":
            from toolchain.networks.text_formats import read_bif as reader
        case ".xmlbif" | ".bifxml" | ".xml":
            from toolchain.networks.xml_formats import read_xmlbif as reader
        case ".uai":
            from toolchain.networks.text_formats import read_uai as reader
        case ".net":
            from toolchain.networks.text_formats import read_net as reader
        case ".xdsl":
            from toolchain.networks.xml_formats import read_xdsl as reader
        case _:
            raise NetworkFileError(
                f"expected a name that ends in {', '.join(SUFFIXES)}, with or without .gz", path=path
            )
    return reader


def _suffix(path: Path) -> str:
    name = path.name.lower().removesuffix(".gz")
    return Path(name).suffix


def _unpacked(path: Path, data: bytes) -> bytes:
    """Return the content of a compressed file, of bounded size."""
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            content = file.read(MAX_BYTES + 1)
    except (OSError, EOFError, zlib.error) as reason:
        raise NetworkFileError(f"not a gzip file, or damaged: {reason}", path=path) from None
    if len(content) > MAX_BYTES:
        raise NetworkFileError(
            f"it has more than {MAX_BYTES} bytes, unpacked; this is the maximum", path=path
        )
    return content
