"""Memories of a machine in an FPGA, as in the VHDL: memory blocks, then memory LABs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from machines.parameters import PriorMode, SensorMode
from pcie_shim.programming_file import interface_words
from toolchain.analysis.resources.logic import WORD_BITS, state_bits
from toolchain.outputs.memories import generators
from toolchain.outputs.mif import LENGTH

if TYPE_CHECKING:
    from machines.parameters import BM1Parameters
    from toolchain.analysis.resources.device import Device

MLAB_ALMS: Final = 10
"""Number of ALMs of a memory LAB."""
MLAB_SHAPE: Final = (64, 10)
"""Words and bits of a memory LAB, in the deeper of its two shapes."""
MLAB_SHARE: Final = 0.5
"""Share of the LABs of a Stratix V that can be memories."""

BLOCK_SHAPES: Final = ((512, 40), (1024, 20), (2048, 10), (4096, 5), (8192, 2), (16384, 1))
"""Words and bits of an M20K, in its possible shapes."""


@dataclass(frozen=True, slots=True, order=True)
class _Memory:
    words: int
    width: int
    count: int

    @property
    def blocks(self) -> int:
        """Minimum number of M20Ks for one of them."""
        return min(math.ceil(self.words / deep) * math.ceil(self.width / wide) for deep, wide in BLOCK_SHAPES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Memories:
    """The memories of a machine; `logic_tables` did not get a block and are in memory LABs."""

    table_bits: int
    blocks: int
    logic_tables: int
    mlabs: int
    alms: float


def _tables(p: BM1Parameters) -> list[_Memory]:
    """Return the tables: one per column with one address, otherwise one per cell; a one-row prior has none.

    Every replica has its own tables, because it uses its own addresses.
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
    """Place tables in the remaining memory blocks, the deepest first, and the rest in memory LABs."""
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
