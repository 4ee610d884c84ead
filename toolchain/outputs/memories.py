"""The memories of a machine on each board, with a MIF for each: priors, tiles, CDEs, random numbers (thesis 3.2).

All tiles of a column have the same reading, so a column is one memory. The reading gives the memory's address. A word
contains the codes of all lines of the board, with line 0 in the lowest bits. The prior elements are also one memory.
If each line has its own reading, each tile is a memory of its own, which contains only the codes of the tile's line.

A BM2 has a memory for each CDE (conditional distribution encoder, thesis 2.1.3). All boards have equal memories.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import BM1Machine
from machines.bm2 import BM2Machine, BM2Parameters
from machines.parameters import BM1Parameters, PriorMode, RngKind, SensorMode
from machines.rng import LFSR, POLYNOMIALS, generator_numbers, random_numbers, seed_set
from pcie_shim.programming_file import Image
from toolchain.deployment import Deployment
from toolchain.outputs.mif import mif_lines

MEMORIES_FOLDER: Final = "bm_arch/Memory_MIFs"

_ROWS_AT_ONCE: Final = 64


@dataclass(frozen=True, slots=True)
class Memory:
    """A memory of one board, or a memory that is equal on all boards."""

    name: str
    """The name of its MIF."""
    width: int
    """Bits of a word."""
    depth: int
    """The number of words."""
    words: Callable[[], Iterable[int]]
    """A function that returns all words in the order of their addresses."""
    comments: tuple[str, ...]
    """Comment lines at the beginning of the MIF."""
    board: int | None = None
    """Number of the board that has this memory, or None if the memory is equal on all boards."""
    section: str = ""
    """The section of the programming file that contains the memory's codes.

    A memory of seeds has an empty `section`, because the seeds follow from the machine's parameters.
    """

    def lines(self) -> Iterator[str]:
        """Yield the MIF, in canonical form."""
        return mif_lines(self.width, self.depth, self.words(), self.comments)


def memories(deployment: Deployment, images: Sequence[Image]) -> tuple[Memory, ...]:
    """Return the memories of all boards. A memory that is equal on all boards, such as a CDE, is returned only once.

    Generators that exist only in emulation (`rng = ideal`) have no memories.
    """
    first = images[0].machine
    found: list[Memory] = []
    if isinstance(first, BM2Machine):
        found += _cdes(first)
        for board, image in enumerate(images):
            found += _chain_seeds(image.machine, f"board{board}_")
    else:
        parameters = first.parameters
        for board, image in enumerate(images):
            found += [_prior(deployment, board, image), *_columns(deployment, board, image)]
            if not parameters.shared:
                line = f"(bank * {image.machine.parameters.lines} + line of the board)"
                found += _seeds(image.machine, f"board{board}_", f"{line} * {parameters.columns} + column")
        if parameters.shared:
            found += _seeds(first, "", f"bank * {parameters.columns} + column")
    if first.rng_table is not None:
        found.append(_rng_table(first.rng_table, first.parameters.prob_bits))
    return tuple(found)


def column_name(board: int, column: int, sensors: int) -> str:
    """Return the file name of a column's MIF. `column` counts from 1, and is padded to as many digits as `sensors`."""
    return f"board{board}_column{column:0{len(str(sensors))}d}.mif"


def seed_words(machine: BM1Machine | BM2Machine) -> NDArray[np.uint64]:
    """Return the seeds of all generators in all banks: uint64[banks, *machine.parameters.generator_shape]."""
    parameters = machine.parameters
    if parameters.rng in POLYNOMIALS:  # all banks at once
        every = np.stack([generator_numbers(parameters, bank) for bank in range(parameters.rng_banks)])
        return LFSR(parameters.rng).seeds(every)
    numbers = random_numbers(machine)
    return np.stack([numbers.restart(bank) for bank in range(parameters.rng_banks)])


def seed_width(machine: BM1Machine | BM2Machine) -> int:
    """Return the number of bits in a seed. A seed is an LFSR's state, or an index into the table of random numbers."""
    if machine.rng_table is not None:
        return max(1, (machine.rng_table.size - 1).bit_length())
    return machine.parameters.rng.lfsr_bits or 64


def packed_words(codes: NDArray[np.uint16], prob_bits: int) -> Iterator[int]:
    """Yield one word per row of `codes`, uint16[rows, lines]. The code of line 0 is in the lowest `prob_bits` bits."""
    weights = np.arange(prob_bits - 1, -1, -1, dtype=np.uint16)
    for start in range(0, len(codes), _ROWS_AT_ONCE):
        rows = codes[start : start + _ROWS_AT_ONCE, ::-1]
        if prob_bits == 8:
            packed = rows.astype(np.uint8)
        elif prob_bits == 16:
            packed = rows.astype(">u2").view(np.uint8)
        else:
            bits = ((rows[:, :, np.newaxis] >> weights) & np.uint16(1)).astype(np.uint8)
            bits = bits.reshape(len(rows), -1)
            packed = np.packbits(np.pad(bits, ((0, 0), (-bits.shape[1] % 8, 0))), axis=1)
        for row in packed:
            yield int.from_bytes(row.tobytes(), "big")


def unpacked_codes(words: Sequence[int], prob_bits: int, count: int) -> NDArray[np.uint32]:
    """Unpack `count` codes from each word to uint32[words, count]. This is the inverse of `packed_words`."""
    size = -(-count * prob_bits // 8)
    data = np.frombuffer(b"".join(word.to_bytes(size, "little") for word in words), np.uint8)
    found = np.empty((len(words), count), np.uint32)
    weights = np.uint32(1) << np.arange(prob_bits, dtype=np.uint32)
    for start in range(0, len(words), _ROWS_AT_ONCE):
        rows = data.reshape(len(words), size)[start : start + _ROWS_AT_ONCE]
        bits = np.unpackbits(rows, axis=1, count=count * prob_bits, bitorder="little")
        found[start : start + _ROWS_AT_ONCE] = bits.reshape(len(rows), count, prob_bits) @ weights
    return found


def _prior(deployment: Deployment, board: int, image: Image) -> Memory:
    name, part, select = f"board{board}_prior.mif", image.partition, deployment.prior_select
    parameters = image.machine.parameters
    if (
        parameters.prior_mode is PriorMode.WRITTEN
    ):  # the initial contents of the words that the host may write
        return Memory(
            name=name,
            width=parameters.prob_bits,
            depth=parameters.lines,
            words=lambda: (int(code) for code in image.machine.prior[0]),
            comments=(
                "prior elements, P(S), until the host writes another prior",
                f"address = the line of the board; line 0 of the board is line {part.line_offset} of the model",
            ),
            board=board,
            section="prior",
        )
    what = "P(S)"
    if select is not None:
        what = f"P(S | {select.name}): address = the reading of {select.name}; the top address is a missing reading"
    return _codes(name, f"prior elements, {what}", image, image.machine.prior, "prior")


def _columns(deployment: Deployment, board: int, image: Image) -> Iterator[Memory]:
    sensors = len(image.machine.tables)
    parameters = image.machine.parameters
    if not parameters.has_tables:
        return
    whose = "each line's own " if parameters.sensor_mode is SensorMode.CELL else "the "
    for column, (variable, table) in enumerate(
        zip(deployment.sensors, image.machine.tables, strict=True), start=1
    ):
        what = (
            f"column {column}, tiles, P({variable.name} | S): address = {whose}reading of {variable.name}, one of "
            f"{variable.values} values; the top address is a missing reading"
        )
        yield _codes(column_name(board, column, sensors), what, image, table, f"column {column}")


def _codes(name: str, what: str, image: Image, codes: NDArray[np.uint16], section: str) -> Memory:
    bits, part = image.machine.parameters.prob_bits, image.partition
    lines = codes.shape[1]
    return Memory(
        name=name,
        width=lines * bits,
        depth=len(codes),
        words=lambda: packed_words(codes, bits),
        comments=(
            what,
            (
                f"a word has the codes, {bits} bits each, of lines {part.line_offset} to {part.line_offset + lines - 1}, "
                f"line {part.line_offset} in the lowest bits"
            ),
        ),
        board=part.index,
        section=section,
    )


def _seeds(machine: BM1Machine | BM2Machine, prefix: str, address: str) -> list[Memory]:
    parameters = machine.parameters
    if parameters.rng is RngKind.IDEAL:
        return []
    return [
        Memory(
            name=f"{prefix}rng_seeds.mif",
            width=seed_width(machine),
            depth=parameters.rng_banks * generators(parameters),
            words=lambda: (int(word) for word in seed_words(machine).ravel()),
            comments=(
                f"start states of the random number generators ({parameters.rng})",
                f"address = {address}",
            ),
        )
    ]


def generators(parameters: BM1Parameters | BM2Parameters) -> int:
    """Return a board's number of generators: one per column or per cell of a BM1, one per CDE of a BM2."""
    return math.prod(parameters.generator_shape)


def _cdes(machine: BM2Machine) -> Iterator[Memory]:
    parameters, digits = machine.parameters, len(str(machine.parameters.cdes - 1))
    for at, (factor, table) in enumerate(zip(parameters.factors, machine.tables, strict=True)):
        bits = parameters.factor_bits(at)
        if not bits:  # all of its variables have one value
            continue
        yield Memory(
            name=f"cde{at:0{digits}d}.mif",
            width=parameters.prob_bits,
            depth=table.size,
            words=partial(map, int, table),
            comments=(
                f"CDE {at}, for the factor of variables {_listed(factor)}, which are the bits {_listed(bits)} of the state",
                f"address = j * {1 << len(bits) - 1} + the other bits, if the sequencer points to bit number j of these",
            ),
            section=f"cde {at}",
        )


def _listed(numbers: Iterable[int]) -> str:
    return ", ".join(map(str, numbers))


def _chain_seeds(machine: BM2Machine, prefix: str) -> Iterator[Memory]:
    parameters = machine.parameters
    if parameters.rng is RngKind.IDEAL:
        return
    yield from _seeds(machine, prefix, f"bank * {parameters.cdes} + CDE")
    sets = np.array([seed_set(parameters, bank) for bank in range(parameters.rng_banks)], dtype=np.uint64)
    yield Memory(
        name=f"{prefix}sequencer_seeds.mif",
        width=16,
        depth=parameters.rng_banks,
        words=lambda: map(int, LFSR(RngKind.LFSR16).seeds(sets)),
        comments=("start states of the random sequencer's generator (lfsr16)", "address = bank"),
    )


def _rng_table(table: NDArray[np.uint32], prob_bits: int) -> Memory:
    mask = (1 << prob_bits) - 1
    return Memory(
        name="rng_table.mif",
        width=prob_bits,
        depth=table.size,
        words=lambda: (int(number) & mask for number in table),
        comments=(
            "random numbers; every generator reads them in this order, and starts again after the last",
        ),
        section="rng",
    )
