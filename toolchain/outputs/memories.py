"""The memories of a machine on each board, with a MIF for each: priors, tiles, random numbers (thesis 3.2).

All tiles of a column have the same reading, so a column is one memory: its address is that of the reading,
and a word contains the codes of all lines of the board, with line 0 in the lowest bits. The prior elements
are also one memory. If each line has its own reading, each tile is a separate memory, with its bits of these words.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import BM1Machine
from machines.bm2 import BM2Machine
from machines.parameters import BM1Parameters, PriorMode, RngKind, SensorMode
from machines.rng import LFSR, POLYNOMIALS, generator_numbers, random_numbers
from pcie_shim.programming_file import Image
from toolchain.deployment import Deployment
from toolchain.outputs.mif import mif_lines

MEMORIES_FOLDER: Final = "bm_arch/Memory_MIFs"

_ROWS_AT_ONCE: Final = 64


@dataclass(frozen=True, slots=True)
class Memory:
    """A memory of a board, or a memory shared by all boards."""

    name: str
    """Its file name."""
    width: int
    """Bits of a word."""
    depth: int
    """The number of words."""
    words: Callable[[], Iterable[int]]
    """A function that returns every word, from address 0."""
    comments: tuple[str, ...]
    """Comment lines for the beginning of the file."""

    def lines(self) -> Iterator[str]:
        """Yield the MIF, in canonical form."""
        return mif_lines(self.width, self.depth, self.words(), self.comments)


def memories(deployment: Deployment, images: Sequence[Image]) -> tuple[Memory, ...]:
    """Return the memories of a deployment's machine, board by board and then the shared ones.

    Generators that exist only in emulation (`rng = ideal`) have no memories.
    """
    found: list[Memory] = []
    for board, image in enumerate(images):
        found += [_prior(deployment, board, image), *_columns(deployment, board, image)]
        if not image.machine.parameters.shared:
            found += _seeds(image.machine, f"board{board}_")
    if images[0].machine.parameters.shared:
        found += _seeds(images[0].machine, "")
    table = images[0].machine.rng_table
    if table is not None:
        found.append(rng_table_memory(table, images[0].machine.parameters.prob_bits))
    return tuple(found)


def column_name(board: int, column: int, sensors: int) -> str:
    """Return the file name of a board's column, 1 to `sensors`; all have the same length, for sorting."""
    return f"board{board}_column{column:0{len(str(sensors))}d}.mif"


def seed_words(machine: BM1Machine) -> NDArray[np.uint64]:
    """Return the start of every generator in every bank: uint64[banks, columns] or [banks, lines, columns]."""
    parameters = machine.parameters
    if parameters.rng in POLYNOMIALS:  # all banks at once: the numbers of bank b follow those of bank b - 1
        shape = generator_numbers(parameters, 0).shape
        every = np.arange(parameters.rng_banks * generators(parameters), dtype=np.uint64)
        return LFSR(parameters.rng).seeds(every.reshape(-1, *shape))
    numbers = random_numbers(machine)
    return np.stack([numbers.restart(bank) for bank in range(parameters.rng_banks)])


def seed_width(machine: BM1Machine | BM2Machine) -> int:
    """Return the bits of a seed: of an LFSR's state, or of an index into the table of random numbers."""
    if machine.rng_table is not None:
        return max(1, (machine.rng_table.size - 1).bit_length())
    return machine.parameters.rng.lfsr_bits or 64


def packed_words(codes: NDArray[np.uint16], prob_bits: int) -> Iterator[int]:
    """Yield a word per row of uint16[rows, lines]: the code of line 0 in the lowest bits, `prob_bits` each."""
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
                "prior elements, P(S), until the host writes another",
                f"address = the line of the board, from line {part.line_offset} of the model on",
            ),
        )
    what = "P(S)"
    if select is not None:
        what = (
            f"P(S | {select.name}): address = the value of {select.name}; the top one is the prior without it"
        )
    return _codes(name, f"prior elements, {what}", image, image.machine.prior)


def _columns(deployment: Deployment, board: int, image: Image) -> Iterator[Memory]:
    sensors = len(image.machine.tables)
    parameters = image.machine.parameters
    if not parameters.has_tables:
        return
    whose = "the line's own " if parameters.sensor_mode is SensorMode.CELL else "the "
    for column, (variable, table) in enumerate(
        zip(deployment.sensors, image.machine.tables, strict=True), start=1
    ):
        what = (
            f"column {column}, tiles, P({variable.name} | S): address = {whose}value of {variable.name}, {variable.values} "
            "are served; the top one is a missing reading"
        )
        yield _codes(column_name(board, column, sensors), what, image, table)


def _codes(name: str, what: str, image: Image, codes: NDArray[np.uint16]) -> Memory:
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
                f"a word is the codes, {bits} bits each, of lines {part.line_offset} to {part.line_offset + lines - 1}, "
                "the first in the lowest bits"
            ),
        ),
    )


def _seeds(machine: BM1Machine, prefix: str) -> list[Memory]:
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
                f"where the generators ({parameters.rng}) start",
                f"address = bank * {parameters.columns} + column"
                if parameters.shared
                else f"address = (bank * {parameters.lines} + line of the board) * {parameters.columns} + column",
            ),
        )
    ]


def generators(parameters: BM1Parameters) -> int:
    """Return the number of generators of a board: one per column, or one per cell."""
    return parameters.columns * (1 if parameters.shared else parameters.lines)


def rng_table_memory(table: NDArray[np.uint32], prob_bits: int) -> Memory:
    """Return the memory of random numbers, whose low bits are used."""
    mask = (1 << prob_bits) - 1
    return Memory(
        name="rng_table.mif",
        width=prob_bits,
        depth=table.size,
        words=lambda: (int(number) & mask for number in table),
        comments=("the random numbers that all generators play in a ring",),
    )
