"""Partition of the lines of a machine into contiguous blocks, one per board (thesis 3.4, 4.2)."""

from dataclasses import dataclass, replace

import numpy as np

from machines.bm1 import BM1Machine
from toolchain.errors import BuildError


@dataclass(frozen=True, slots=True)
class Block:
    """The lines of one board: `lines` of them from `offset` on."""

    offset: int
    lines: int

    @property
    def end(self) -> int:
        """The line after the last one."""
        return self.offset + self.lines


def partition_lines(lines: int, count: int) -> tuple[Block, ...]:
    """Return the blocks of `lines` lines on `count` boards, in order; the first `lines` mod `count` are one longer."""
    if not 1 <= count <= lines:
        raise BuildError(
            f"{lines} lines cannot be divided among {count} boards: expected 1 to {lines} partitions"
        )
    shorter, longer = divmod(lines, count)
    return tuple(
        Block(board * shorter + min(board, longer), shorter + (board < longer)) for board in range(count)
    )


def split(machine: BM1Machine, count: int) -> tuple[BM1Machine, ...]:
    """Return the machine of each board of a whole machine; a BuildError as for the lines."""
    return tuple(
        BM1Machine(
            replace(machine.parameters, lines=block.lines),
            np.ascontiguousarray(machine.prior[:, block.offset : block.end]),
            tuple(np.ascontiguousarray(table[:, block.offset : block.end]) for table in machine.tables),
            machine.rng_table,
        )
        for block in partition_lines(machine.parameters.lines, count)
    )
