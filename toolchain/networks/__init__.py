"""Readers of Bayesian network files. A BIF, XMLBIF, UAI, NET or XDSL file (also .gz) becomes a joint distribution."""

from __future__ import annotations

import gzip
import io
import zlib
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from toolchain.bounded_files import read_bounded
from toolchain.errors import ModelError, NetworkFileError

if TYPE_CHECKING:
    from toolchain.models.joint import JointDistribution

MAX_BYTES: Final = 32 << 20
"""Maximum size of a network file in bytes. The limit holds before and after decompression."""

_READERS: Final = {
    ".bif": "text_formats.read_bif",
    ".xmlbif": "xml_formats.read_xmlbif",
    ".bifxml": "xml_formats.read_xmlbif",
    ".xml": "xml_formats.read_xmlbif",
    ".uai": "text_formats.read_uai",
    ".net": "text_formats.read_net",
    ".xdsl": "xml_formats.read_xdsl",
}
"""For each suffix, the module and the function that read the file. Modules are imported late: they need NumPy."""
SUFFIXES: Final = tuple(_READERS)
"""Suffixes of network files; `.gz` may follow."""


def is_network(path: Path) -> bool:
    """Return whether a path ends in one of `SUFFIXES`, with or without `.gz`."""
    return _suffix(Path(path)) in SUFFIXES


def read_network(path: Path, *, on_missing: Literal["error", "missing"] = "error") -> JointDistribution:
    """Return the joint distribution in a network file.

    The file's name ends in one of `SUFFIXES`, or in such a suffix and `.gz`.

    Raises:
        NetworkFileError: The file is missing, too large, or not a network. The error names file and line.
    """
    from toolchain.networks.builder import NetworkBuilder

    path = Path(path)
    if not is_network(path):
        raise NetworkFileError(
            f"expected a name that ends in {', '.join(SUFFIXES)}, with or without .gz", path=path
        )
    module, _, function = _READERS[_suffix(path)].partition(".")
    reader = getattr(import_module(f"{__name__}.{module}"), function)
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


def _suffix(path: Path) -> str:
    name = path.name.lower().removesuffix(".gz")
    return Path(name).suffix


def _unpacked(path: Path, data: bytes) -> bytes:
    """Return the content of a compressed file, or raise a NetworkFileError if the file is damaged or too large."""
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
