"""Layouts that host and board share: doorbell numbers, fields, and registers that one burst reads or writes."""

import struct
from collections.abc import Mapping
from typing import Final

from machines.kind import UsedRegisters
from pcie_shim import register_map as rm

ALL_ONES: Final = 0xFFFFFFFF
"""The word of all ones. Every read returns this word if no device answers."""

WORD: Final = struct.Struct("<I")
"""A register of 32 bits."""

SETTINGS: Final = struct.Struct("<IQII")
"""The registers TARGET_COUNT, MAX_CYCLES, BANK and PRIOR_SELECT.

In the register map, RUN_UNTIL and the doorbells follow these registers, so one burst can write all of them.
"""

DONE_BLOCK: Final = struct.Struct("<IIQQ")
"""The registers DONE, STATUS, CYCLES and COMPUTE_NS."""


def next_doorbell(number: int) -> int:
    """Return the doorbell number after `number`. After 2^32 - 1 comes 1, because a doorbell of 0 has no effect."""
    return number % ALL_ONES + 1


def in_field(mask: int, value: int) -> int:
    """Return a word with `value` in the field that `mask` selects, and zeros elsewhere."""
    return value * (mask & -mask)


def field_of(mask: int, word: int) -> int:
    """Return the value of the field that `mask` selects in `word`."""
    return (word & mask) // (mask & -mask)


def register_values(fields: Mapping[str, int]) -> dict[int, int]:
    """Return register values by address. Keys of `fields` are registers (`CAP_LINES`) or fields (`CAP_MACHINE.RNG`)."""
    values: dict[int, int] = {}
    for name, value in fields.items():
        register, _, field = name.partition(".")
        shifted = in_field(getattr(rm, f"{register}_{field}_MASK"), value) if field else value
        address = rm.BLOCKS[register]
        values[address] = values.get(address, 0) | shifted
    return values


def interface_room(registers: UsedRegisters) -> tuple[int, int]:
    """Return how many words the register map has for inputs (block `registers.inputs`) and for results."""
    return rm.BLOCKS[registers.inputs].words, rm.RESULTS.words
