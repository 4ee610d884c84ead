"""Bench of the register block alone: 64-bit values that a machine never reaches in a simulation.

    reads and writes --> bm_register_block --> words read
    64-bit counters  -->

This is a cocotb module for the entity `bm_register_block`.
"""

from __future__ import annotations

from typing import Any, Final

import cocotb
import numpy as np
from cocotb.clock import Clock
from cocotb.triggers import FallingEdge

from hdl.test.project import register_map as rm

ROUNDS: Final = 40


class Block:
    """The block, accessed one word at a time."""

    def __init__(self, dut: Any) -> None:
        self.dut = dut

    async def start(self) -> None:
        """Start the clock and reset the block."""
        Clock(self.dut.clk_i, 10, "ns").start(start_high=False)
        for name in dir(self.dut):
            if name.endswith("_i") and name != "clk_i":
                getattr(self.dut, name).value = 0
        self.dut.rst_i.value = 1
        await FallingEdge(self.dut.clk_i)
        await FallingEdge(self.dut.clk_i)
        self.dut.rst_i.value = 0

    async def read(self, address: int) -> int:
        """Read a word."""
        self.dut.word_i.value = address // 4
        self.dut.read_i.value = 1
        await FallingEdge(self.dut.clk_i)
        self.dut.read_i.value = 0
        return int(self.dut.data_o.value)

    async def write(self, address: int, value: int) -> None:
        """Write a word."""
        self.dut.word_i.value = address // 4
        self.dut.data_i.value = value
        self.dut.write_i.value = 1
        await FallingEdge(self.dut.clk_i)
        self.dut.write_i.value = 0


@cocotb.test()
async def the_low_word_holds_the_high_one(dut: Any) -> None:
    """Read both words of a counter that changes between the reads: the pair is the value at the first read."""
    block = Block(dut)
    await block.start()
    random = np.random.default_rng(1)
    for port, address in ((dut.cycles_i, rm.CYCLES), (dut.compute_ns_i, rm.COMPUTE_NS)):
        for _ in range(ROUNDS):
            first, second, third = (int(value) for value in random.integers(2**63, size=3))
            port.value = first
            low = await block.read(address)
            port.value = second
            await block.read(rm.STATUS)
            high = await block.read(address + 4)
            assert high << 32 | low == first
            # the high word is held for one read only; without a read of the low word it is the current one
            assert await block.read(address + 4) == second >> 32
            port.value = third
            assert await block.read(address + 4) == third >> 32


@cocotb.test()
async def words_of_a_long_register_are_written_one_by_one(dut: Any) -> None:
    """Write either word of a 64-bit setting: the other word does not change."""
    block = Block(dut)
    await block.start()
    random = np.random.default_rng(2)
    for port, address in ((dut.max_cycles_o, rm.MAX_CYCLES), (dut.run_until_o, rm.RUN_UNTIL)):
        words = [0, 0]
        for _ in range(ROUNDS):
            at, value = int(random.integers(2)), int(random.integers(2**32))
            words[at] = value
            await block.write(address + 4 * at, value)
            assert int(port.value) == words[1] << 32 | words[0]
            assert [await block.read(address), await block.read(address + 4)] == words


@cocotb.test()
async def a_reset_is_a_pulse(dut: Any) -> None:
    """Check that a write to CONTROL sets the reset bit for one clock, and that the interrupt bit remains set.

    The reset bit always reads as 0.
    """
    block = Block(dut)
    await block.start()
    await block.write(rm.CONTROL, rm.CONTROL_RESET_MASK | rm.CONTROL_INTERRUPT_ENABLE_MASK)
    assert int(dut.control_o.value) == rm.CONTROL_RESET_MASK | rm.CONTROL_INTERRUPT_ENABLE_MASK
    assert await block.read(rm.CONTROL) == rm.CONTROL_INTERRUPT_ENABLE_MASK
    assert int(dut.control_o.value) == rm.CONTROL_INTERRUPT_ENABLE_MASK
