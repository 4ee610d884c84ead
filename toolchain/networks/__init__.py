"""Readers of network files: BIF, XMLBIF, UAI and NET become joint distributions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from toolchain.errors import ModelError, NetworkFileError
from toolchain.files.bounded_file import read_bounded

if TYPE_CHECKING:
    from collections.abc import Callable

    from toolchain.models.joint import JointDistribution
    from toolchain.networks.builder import NetworkBuilder

MAX_BYTES: Final = 32 << 20
"""Maximum size of a file in bytes."""

SUFFIXES: Final = (".bif", ".xmlbif", ".bifxml", ".xml", ".uai", ".net")
"""Suffixes of network files."""


def is_network(path: Path) -> bool:
    """Return whether a path has the suffix of a network file."""
    return Path(path).suffix.lower() in SUFFIXES


def read_network(path: Path, *, on_missing: Literal["error", "missing"] = "error") -> JointDistribution:
    """Return the joint distribution of a file whose name ends in one of `SUFFIXES`.

    Raises:
        NetworkFileError: The file is missing, too large, or not a network; the sentence contains file and
            line.
    """
    from toolchain.networks.builder import NetworkBuilder

    path = Path(path)
    reader = _reader(path)
    data = read_bounded(path, MAX_BYTES, NetworkFileError)
    builder = NetworkBuilder(path, on_missing=on_missing)
    reader(data, builder)
    try:
        return builder.joint()
    except NetworkFileError:
        raise
    except ModelError as reason:
        raise NetworkFileError(str(reason), path=path) from None


def _reader(path: Path) -> Callable[[bytes, NetworkBuilder], None]:
    match path.suffix.lower():
        case ".bif":
            from toolchain.networks.bif import read_bif as reader
        case ".xmlbif" | ".bifxml" | ".xml":
            from toolchain.networks.xmlbif import read_xmlbif as reader
        case ".uai":
            from toolchain.networks.uai import read_uai as reader
        case ".net":
            from toolchain.networks.net import read_net as reader
        case _:
            raise NetworkFileError(f"expected a name that ends in {', '.join(SUFFIXES)}", path=path)
    return reader
