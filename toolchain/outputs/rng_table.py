"""The table of random numbers for `rng = table` (thesis 3.2): generated, or read from a user's MIF."""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import BM1Machine
from machines.rng import GOLDEN, mix
from toolchain.errors import BuildError
from toolchain.outputs.mif import read_mif

LENGTH: Final = 1 << 16
"""Length of a generated table: a multiple of every number of codes."""


def table_length(machine: BM1Machine) -> int:
    """Return the length of a machine's table of random numbers, or of a generated one if it has none."""
    return LENGTH if machine.rng_table is None else machine.rng_table.size


def random_table(prob_bits: int) -> NDArray[np.uint32]:
    """Return numbers of `prob_bits` bits in a random order, uint32[65536], all equally frequent.

    The probability of every code is therefore exact over the whole table. The order is always the same, from
    splitmix64.
    """
    keys = mix(np.arange(1, LENGTH + 1, dtype=np.uint64) * np.uint64(GOLDEN))
    numbers: NDArray[np.uint32] = (np.argsort(keys, kind="stable") % (1 << prob_bits)).astype(np.uint32)
    return numbers


def read_table(path: Path) -> NDArray[np.uint32]:
    """Return the random numbers in a user's MIF, uint32[length], or raise a MifError or BuildError."""
    mif = read_mif(path)
    if mif.width > 32:
        raise BuildError(
            f"{path} has words of {mif.width} bits; expected random numbers of at most 32, the codes' or more"
        )
    return np.array(mif.words, dtype=np.uint32)
