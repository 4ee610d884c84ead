"""Layouts shared by host and board: doorbell numbers, named blocks, and registers read or written in one burst."""

import struct
from collections.abc import Mapping
from typing import Final

from machines.kind import UsedRegisters
from pcie_shim import register_map as rm

ALL_ONES: Final = 0xFFFFFFFF
"""The word of all ones, which every read returns if no device answers."""

WORD: Final = struct.Struct("<I")
"""A register of 32 bits."""

SETTINGS: Final = struct.Struct("<IQII")
"""The registers TARGET_COUNT, MAX_CYCLES, BANK and PRIOR_SELECT; RUN_UNTIL and the doorbells come next in the map."""

DONE_BLOCK: Final = struct.Struct("<IIQQ")
"""The registers DONE, STATUS, CYCLES and COMPUTE_NS."""


def next_doorbell(number: int) -> int:
    """Return the doorbell number after `number`: one more, modulo 2^32, skipping 0, which has no effect."""
    return number % ALL_ONES + 1


def in_field(mask: int, value: int) -> int:
    """Return a word that has a value in the field with this mask, and zeros elsewhere."""
    return value * (mask & -mask)


def field_of(mask: int, word: int) -> int:
    """Return the value of a word's field with this mask."""
    return (word & mask) // (mask & -mask)


def register_values(fields: Mapping[str, int]) -> dict[int, int]:
    """Return register values by address from values by register (`CAP_LINES`) or by field (`CAP_MACHINE.RNG`)."""
    values: dict[int, int] = {}
    for name, value in fields.items():
        register, _, field = name.partition(".")
        shifted = in_field(getattr(rm, f"{register}_{field}_MASK"), value) if field else value
        address = rm.BLOCKS[register]
        values[address] = values.get(address, 0) | shifted
    return values


def interface_room(registers: UsedRegisters) -> tuple[int, int]:
    """Return how many words the map has for inputs (in the block `registers.inputs`), and how many for results."""
    return rm.BLOCKS[registers.inputs].words, rm.RESULTS.words
