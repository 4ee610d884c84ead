"""Layouts shared by host and board: doorbell numbers, and registers read or written in one burst."""

import struct
from typing import Final

import numpy as np

ALL_ONES: Final = 0xFFFFFFFF
"""The all-ones word, which all registers read as if no device answers."""

WORD: Final = struct.Struct("<I")
"""One register."""

SETTINGS: Final = struct.Struct("<IQII")
"""TARGET_COUNT, MAX_CYCLES, BANK and PRIOR_SELECT, followed by RUN_UNTIL and the doorbells."""

DONE_BLOCK: Final = struct.Struct("<IIQQ")
"""DONE, STATUS, CYCLES and COMPUTE_NS."""

REPLICA_OUTCOME: Final = np.dtype([("reason", "<u4"), ("zero", "<u4"), ("cycles", "<u8")])
"""The part of OUTCOMES for one replica."""


def next_doorbell(number: int) -> int:
    """Return the doorbell number after `number`: one more, modulo 2^32, skipping 0, which has no effect."""
    return number % ALL_ONES + 1
