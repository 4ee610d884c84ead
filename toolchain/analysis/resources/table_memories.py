"""Memories of a machine's tables in an FPGA: memory blocks, and memory LABs where those are all taken."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from toolchain.outputs.rng_table import LENGTH

if TYPE_CHECKING:
    from machines.parameters import BM1Parameters
    from toolchain.analysis.resources.device import Device

MLAB_ALMS: Final = 10
"""ALMs that a memory LAB is made of."""
MLAB_SHAPE: Final = (64, 10)
"""Its words and their bits, in the deeper of its two shapes."""
MLAB_SHARE: Final = 0.5
"""Every other LAB of a Stratix V can be a memory."""

BLOCK_SHAPES: Final = ((512, 40), (1024, 20), (2048, 10), (4096, 5), (8192, 2), (16384, 1))
"""Words and their bits that an M20K can be read as."""


class Tables(StrEnum):
    """The layout of tables in memory blocks."""

    CELL = "cell"
    """Every cell has its own memory, as in the thesis's tile."""
    COLUMN = "column"
    """A column's tables lie side by side in wide memories: possible where a column shares one address."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Memories:
    """The memories that a machine's tables take; `logic_tables` found no block, and lie in memory LABs."""

    tables: Tables
    table_bits: int
    blocks: int
    logic_tables: int
    mlabs: int
    alms: float


def _table_bits(parameters: BM1Parameters) -> list[int]:
    """Return the address bits of the columns with tables; a prior of one row, or a written one, is in registers."""
    sensors = parameters.sensor_bits if parameters.has_tables else ()
    return [bits for bits in (parameters.prior_bits, *sensors) if bits]


def place_tables(
    parameters: BM1Parameters, device: Device, tables: Tables, table_length: int = LENGTH
) -> Memories:
    """Put tables into memory blocks, the largest first, and the others into memory LABs."""
    width, room = parameters.prob_bits, math.floor(device.usable * device.blocks)
    logic_tables = mlabs = 0
    # Two generators read one copy of a table of random numbers, through a port each.
    copies = (
        0
        if parameters.rng.lfsr_bits
        else math.ceil(parameters.columns * (1 if parameters.shared else parameters.lines) / 2)
    )
    blocks = copies * _blocks(table_length, width)
    alms = 0.0
    for bits in sorted(_table_bits(parameters), reverse=True):
        if tables is Tables.COLUMN:
            # As many of a block's words as possible side by side: the whole column or none of it.
            wide, each = parameters.lines * width, parameters.replicas
            own = _blocks(1 << bits, wide)
            count = min(each, max(0, room - blocks) // own)
        else:
            # every replica looks at an address of its own, so it has tables of its own
            wide, each = width, parameters.replicas * parameters.lines
            own = _blocks(1 << bits, wide)
            count = min(each, max(0, room - blocks) // own)
        blocks += count * own
        left = each - count
        deep = math.ceil((1 << bits) / MLAB_SHAPE[0])
        own_mlabs = deep * math.ceil(wide / MLAB_SHAPE[1])
        logic_tables += left * (1 if tables is Tables.CELL else parameters.lines)
        mlabs += left * own_mlabs
        alms += left * (own_mlabs * MLAB_ALMS + (deep - 1) * wide / 3)  # a third of a 4-to-1 multiplexer
    return Memories(
        tables=tables,
        table_bits=sum(
            parameters.replicas * parameters.lines * width << bits for bits in _table_bits(parameters)
        ),
        blocks=blocks,
        logic_tables=logic_tables,
        mlabs=mlabs,
        alms=alms,
    )


def _blocks(words: int, width: int) -> int:
    """Return the fewest M20Ks that hold so many words of so many bits."""
    return min(math.ceil(words / deep) * math.ceil(width / wide) for deep, wide in BLOCK_SHAPES)
