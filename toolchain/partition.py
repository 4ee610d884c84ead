"""A model's lines split over boards in contiguous blocks, the first M mod n one longer (thesis 3.4, 4.2)."""

from dataclasses import dataclass

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
    """Return the blocks of `lines` lines on `count` boards, in order.

    Raises:
        BuildError: Fewer than 1 board, or more boards than lines.
    """
    if not 1 <= count <= lines:
        raise BuildError(
            f"{lines} lines can't be split over {count} boards: expected 1 to {lines} partitions"
        )
    shorter, longer = divmod(lines, count)
    sizes = [shorter + (board < longer) for board in range(count)]
    return tuple(Block(sum(sizes[:board]), size) for board, size in enumerate(sizes))
