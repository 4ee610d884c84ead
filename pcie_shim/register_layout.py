"""Layouts that host and board share: doorbell numbers, and registers that are read or written in one burst."""

from __future__ import annotations

import struct
from typing import Final

import numpy as np

ALL_ONES: Final = 0xFFFFFFFF
"""Highest word: all registers read it where no device answers."""

WORD: Final = struct.Struct("<I")
"""One register."""

SETTINGS: Final = struct.Struct("<IQII")
"""TARGET_COUNT, MAX_CYCLES, BANK and PRIOR_SELECT, which RUN_UNTIL and the doorbells follow."""

DONE_BLOCK: Final = struct.Struct("<IIQQ")
"""DONE, STATUS, CYCLES and COMPUTE_NS."""

REPLICA_OUTCOME: Final = np.dtype([("reason", "<u4"), ("zero", "<u4"), ("cycles", "<u8")])
"""One replica's part of OUTCOMES."""


def next_doorbell(number: int) -> int:
    """Return the doorbell number after `number`: one more, modulo 2^32, skipping 0 (which rings nothing)."""
    return number % ALL_ONES + 1
