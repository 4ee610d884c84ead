"""The largest sizes of a model's parts, which are checked before anything is allocated."""

from typing import Final

from toolchain.errors import ModelError

MAX_LINES: Final = 2**24
"""Values of all searched dimensions together: 4,096 boards of as many lines as the register map has room for."""
MAX_VALUES: Final = 2**16 - 1
"""Values of a known variable: a column has at most 16 address bits, and its top address means a missing reading."""
MAX_ENTRIES: Final = 2**24
"""Entries of a factor of a joint distribution (128 MiB as float64)."""
MAX_TABLE_ENTRIES: Final = 2**26
"""Entries of a known variable's table (512 MiB as float64)."""
MAX_MODEL_ENTRIES: Final = 2**28
"""Entries of the tables that a question's known variables get together."""


def check_size(what: str, entries: int, most: int, advice: str = "") -> None:
    """Refuse, with a ModelError, a size above its limit."""
    if entries > most:
        raise ModelError(f"{what} would have {entries} entries; the most is {most}{advice}")
