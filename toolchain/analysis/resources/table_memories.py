"""Memories of a machine in an FPGA, as the VHDL has them: memory blocks, and memory LABs where those are all taken."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from machines.parameters import PriorMode, SensorMode
from pcie_shim.programming_file import interface_words
from toolchain.analysis.resources.logic import WORD_BITS, state_bits
from toolchain.outputs.memories import generators
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


@dataclass(frozen=True, slots=True, order=True)
class _Memory:
    words: int
    width: int
    count: int

    @property
    def blocks(self) -> int:
        """The fewest M20Ks that hold one of them."""
        return min(math.ceil(self.words / deep) * math.ceil(self.width / wide) for deep, wide in BLOCK_SHAPES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Memories:
    """The memories that a machine takes; `logic_tables` found no block, and lie in memory LABs."""

    table_bits: int
    blocks: int
    logic_tables: int
    mlabs: int
    alms: float


def _tables(p: BM1Parameters) -> list[_Memory]:
    """Return the tables: one for a column that has one address, else one for each cell; a prior of one row has none.

    Every replica looks at addresses of its own, so it has tables of its own.
    """
    column, cell = (p.lines * p.prob_bits, p.replicas), (p.prob_bits, p.replicas * p.lines)
    tables = [_Memory(1 << p.prior_bits, *column)] if p.prior_bits else []
    if p.has_tables:
        shape = column if p.sensor_mode is SensorMode.COLUMN else cell
        tables += [_Memory(1 << bits, *shape) for bits in p.sensor_bits]
    return tables


def _other_memories(p: BM1Parameters, table_length: int) -> list[_Memory]:
    """Return the seeds, the table of random numbers (one for each generator), and the words that the host writes."""
    inputs, results = interface_words(p)
    memories = [
        _Memory(p.rng_banks * generators(p), state_bits(p, table_length), 1),
        _Memory(max(inputs, 1), WORD_BITS, 1),
    ]
    if p.rng.lfsr_bits is None:
        memories.append(_Memory(table_length, p.prob_bits, generators(p)))
    if p.replicas > 1:
        memories.append(_Memory(p.replicas, WORD_BITS, 1))
    if p.prior_mode is PriorMode.WRITTEN:
        memories += [_Memory(results, WORD_BITS, 1), _Memory(p.lines, p.prob_bits, 1)]
    return memories


def place_memories(parameters: BM1Parameters, device: Device, table_length: int = LENGTH) -> Memories:
    """Put tables into the memory blocks that other memories leave, the deepest first, and the rest into memory LABs."""
    tables = _tables(parameters)
    room = math.floor(device.usable * device.blocks)
    blocks = sum(each.count * each.blocks for each in _other_memories(parameters, table_length))
    logic_tables = mlabs = 0
    alms = 0.0
    for table in sorted(tables, reverse=True):
        count = min(table.count, max(0, room - blocks) // table.blocks)
        blocks += count * table.blocks
        left = table.count - count
        deep = math.ceil(table.words / MLAB_SHAPE[0])
        own_mlabs = deep * math.ceil(table.width / MLAB_SHAPE[1])
        logic_tables += left
        mlabs += left * own_mlabs
        # a third of a 4-to-1 multiplexer for a bit
        alms += left * (own_mlabs * MLAB_ALMS + (deep - 1) * table.width / 3)
    return Memories(
        table_bits=sum(each.words * each.width * each.count for each in tables),
        blocks=blocks,
        logic_tables=logic_tables,
        mlabs=mlabs,
        alms=alms,
    )
