"""Maximum sizes of the parts of a model, checked before anything is allocated."""

from typing import Final

from toolchain.errors import ModelError

MAX_LINES: Final = 2**24
"""Values of all searched dimensions together: 4,096 boards with the maximum number of lines in the register
map.
"""
MAX_VALUES: Final = 2**16 - 1
"""Values of a known variable: a column has at most 16 address bits, and the top address means a missing
reading.
"""
MAX_ENTRIES: Final = 2**24
"""Entries of a factor of a joint distribution (128 MiB as float64)."""
MAX_TABLE_ENTRIES: Final = 2**26
"""Entries of a known variable's table (512 MiB as float64)."""
MAX_MODEL_ENTRIES: Final = 2**28
"""Entries of the tables of all known variables of a question together."""


def check_size(what: str, entries: int, most: int, advice: str = "") -> None:
    """Raise a ModelError for a size above its limit."""
    if entries > most:
        raise ModelError(f"{what} would have {entries} entries; the maximum is {most}{advice}")
