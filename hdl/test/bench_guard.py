"""Bench of the guard alone: doorbell numbers, cycles and masks that a machine never reaches in a simulation.

    access, state, settings --> bm1_guard     --> verdict
                            --> EmulatedBoard --> the same?

This is a cocotb module for the entity `bm1_guard`, built for 3 replicas.
"""

from __future__ import annotations

from typing import Any, Final

import cocotb
import numpy as np
from cocotb.triggers import Timer

from hdl.test.guard_generics import REPLICAS
from hdl.test.project import ErrorCode, next_doorbell
from hdl.test.project import register_map as rm

_GOOD: Final = {
    "write_i": 1,
    "address_i": rm.START,
    "strobe_i": 0xF,
    "data_i": 1,
    "running_i": 0,
    "can_resume_i": 1,
    "ready_i": 0b111,
    "done_i": 0,
    "cycles_i": 100,
    "target_i": 10,
    "max_cycles_i": 1000,
    "run_until_i": 0,
    "bank_i": 0,
    "prior_i": 0,
    "halt_i": 0,
    "bad_input_i": 0,
}
"""The guard's inputs, for an access and a state in which both a start and a resume are allowed."""


async def verdict_on(dut: Any, **others: int) -> tuple[ErrorCode, bool]:
    """Return the verdict on the access `_GOOD` with some values changed, and whether the doorbell rings."""
    for name, value in (_GOOD | others).items():
        getattr(dut, name).value = value
    await Timer(1, "ns")
    return ErrorCode(int(dut.error_o.value)), dut.ring_o.value == 1


@cocotb.test()
async def doorbells_are_numbers_that_go_round(dut: Any) -> None:
    """Ring the doorbell with the expected number (1 after 2^32 - 1), and with the numbers next to it."""
    for done in (0, 1, 2, 0x7FFFFFFF, 0xFFFFFFFE, 0xFFFFFFFF):
        due = next_doorbell(done)
        for number in {done, due, (due + 1) % 2**32, 1, 0xFFFFFFFF} - {0}:
            for doorbell in (rm.START, rm.RESUME):
                expected = ErrorCode.NONE if number == due else ErrorCode.DOORBELL
                found = await verdict_on(dut, done_i=done, data_i=number, address_i=doorbell)
                assert found == (expected, number == due), f"{number} after {done}"
        for doorbell in (rm.START, rm.RESUME):
            assert await verdict_on(dut, done_i=done, data_i=0, address_i=doorbell) == (ErrorCode.NONE, False)


@cocotb.test()
async def values_at_their_limits(dut: Any) -> None:
    """Start and resume with each value at its limit and one beyond it."""
    bad = (ErrorCode.BAD_VALUE, False)
    good = (ErrorCode.NONE, True)
    top = 2**63
    for name, value, allowed in (
        ("target_i", 0, False),
        ("target_i", 1, True),
        ("target_i", 255, True),
        ("target_i", 256, False),
        ("target_i", 2**31, False),
        ("max_cycles_i", 0, False),
        ("max_cycles_i", 1, True),
        ("max_cycles_i", top - 1, True),
        ("max_cycles_i", top, False),
        ("max_cycles_i", 2**64 - 1, False),
        ("run_until_i", 1, True),
        ("run_until_i", top - 1, True),
        ("run_until_i", top, False),
        ("bank_i", 4, True),
        ("bank_i", 5, False),
        ("bank_i", 2**31, False),
        ("bad_input_i", 1, False),
        ("prior_i", 2**31, True),  # each replica has its own selects
        ("halt_i", 2**256 - 1, True),  # a start does not halt replicas
        ("can_resume_i", 0, True),
    ):
        assert await verdict_on(dut, **{name: value}) == (good if allowed else bad), f"start, {name} {value}"
    for others, verdict in (
        ({"can_resume_i": 0}, (ErrorCode.DOORBELL, False)),
        ({"run_until_i": 100}, bad),
        ({"run_until_i": 101}, good),
        ({"run_until_i": 2**40, "cycles_i": 2**40}, bad),
        ({"run_until_i": 2**40, "cycles_i": 2**40 - 1}, good),
        ({"run_until_i": top}, bad),
        ({"run_until_i": top, "can_resume_i": 0}, bad),
        ({"halt_i": 0b110}, good),
        ({"halt_i": 0b111}, bad),
        ({"halt_i": 0b001, "ready_i": 0b001}, bad),
        ({"halt_i": 0b001, "ready_i": 0b011}, good),
        ({"halt_i": 0b1000}, bad),
        ({"halt_i": 2**255}, bad),
        ({"target_i": 0, "bad_input_i": 1, "max_cycles_i": 0, "bank_i": 9}, good),  # a frame keeps its target
    ):
        assert await verdict_on(dut, address_i=rm.RESUME, **others) == verdict, f"resume, {others}"


@cocotb.test()
async def every_address(dut: Any) -> None:
    """Read and write every word of the map, and bytes between words, while the machine is idle and while it runs."""
    implemented = {"INPUTS": 9, "PRIOR_SELECTS": REPLICAS, "OUTCOMES": 4 * REPLICAS, "RESULTS": 12}
    kind: dict[int, bool] = {}
    for name, block in rm.BLOCKS.items():
        # the other blocks of data are those of other images
        words = block.words if block < rm.SENSORS else implemented.get(name, 0)
        for word in range(words):
            kind[block + 4 * word] = block.writable
    random = np.random.default_rng(3)
    near = {address + step for address in kind for step in (-4, 0, 4)}
    near |= {int(word) * 4 for word in random.integers(rm.BAR_SIZE // 4, size=400)}
    for address in sorted(near & set(range(rm.BAR_SIZE))):
        expected = ErrorCode.NONE if address in kind else ErrorCode.OUTSIDE
        assert await verdict_on(dut, address_i=address, write_i=0, strobe_i=0, running_i=1) == (
            expected,
            False,
        )
        if address in {rm.START, rm.RESUME}:
            continue
        if address in kind and not kind[address]:
            expected = ErrorCode.READ_ONLY
        assert await verdict_on(dut, address_i=address) == (expected, False), f"write of {address:#x}"
        if expected == ErrorCode.NONE:
            resets = address == rm.CONTROL
            busy = ErrorCode.NONE if resets else ErrorCode.BUSY
            assert await verdict_on(dut, address_i=address, running_i=1) == (busy, False), f"{address:#x}"
            assert await verdict_on(dut, address_i=address, running_i=1, data_i=2) == (ErrorCode.BUSY, False)
        for odd in (1, 2, 3):
            found = await verdict_on(dut, address_i=address + odd, write_i=0)
            assert found == (ErrorCode.MISALIGNED, False)
    for doorbell in (rm.START, rm.RESUME):
        for number in (0, 1):
            found = await verdict_on(dut, address_i=doorbell, data_i=number, running_i=1)
            assert found == (ErrorCode.BUSY, False)
    for strobe in range(15):
        assert await verdict_on(dut, strobe_i=strobe) == (ErrorCode.MISALIGNED, False)
