"""Contiguous blocks of lines, the first M mod n one longer."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolchain.building.machine import partition_lines
from toolchain.errors import BuildError


@given(st.data())
def test_blocks_cover_all_lines_in_order(data):
    lines = data.draw(st.integers(1, 5000))
    count = data.draw(st.integers(1, min(lines, 50)))
    blocks = partition_lines(lines, count)
    assert [line for block in blocks for line in range(block.offset, block.end)] == list(range(lines))
    sizes = [block.lines for block in blocks]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes.count(lines // count + 1) == lines % count
    assert len(blocks) == count


@pytest.mark.parametrize("count", [0, -1, 5])
def test_what_cannot_be_split(count):
    with pytest.raises(BuildError, match="expected 1 to 4 partitions"):
        partition_lines(4, count)
