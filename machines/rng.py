"""The random number generators of a machine: seeds, steps and outputs.

A BM1 has one generator for each column, or one for each cell if generators are not shared. A BM2 has one for each CDE.
The serial number of a generator determines its seed. In seed set 0, the serial number is the number of the column or
CDE, or line * columns + column for a cell. Seed set s adds s times the number of generators. The state of a generator
is one uint64. A cell or CDE compares its code with the low `prob_bits` bits of the generator's output.
"""

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Final, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from machines.bm1 import BM1Machine
from machines.bm2 import BM2Machine, BM2Parameters
from machines.parameters import BM1Parameters, RngKind

Words: TypeAlias = npt.NDArray[np.uint64]
RngParameters: TypeAlias = BM1Parameters | BM2Parameters

GOLDEN: Final = 0x9E3779B97F4A7C15
"""2**64 divided by the golden ratio, rounded to an odd number. Its multiples modulo 2**64 are evenly spread."""

BASE_STATE: Final = 0x2545F4914F6CDD1D
"""The base state of an LFSR is the low bits of this number. `LFSR.seeds` derives all seeds from the base state."""

POLYNOMIALS: Final = {
    RngKind.LFSR8: (8, 6, 5, 4),
    RngKind.LFSR16: (16, 15, 13, 4),
    RngKind.LFSR24: (24, 23, 22, 17),
    RngKind.LFSR32: (32, 22, 2, 1),
}
"""For each LFSR, the non-zero exponents of its maximal-length polynomial, in descending order."""


class RandomNumbers(Protocol):
    """All generators of a machine. An array of states has one element per generator."""

    def restart(self, bank: int) -> Words:
        """Return the initial state of each generator for a seed bank: uint64[`generator_shape`]."""

    def show(self, states: Words) -> Words:
        """Return the random numbers that generators in these states output, with `prob_bits` bits each."""

    def clock(self, states: Words) -> Words:
        """Return the states after one clock. In one clock, each generator makes `steps_per_clock` steps."""


def random_numbers(machine: BM1Machine | BM2Machine) -> RandomNumbers:
    """Return the generators of a machine."""
    parameters = machine.parameters
    if parameters.rng in POLYNOMIALS:
        return LFSRNumbers(parameters)
    if machine.rng_table is not None:
        return TableNumbers(parameters, machine.rng_table)
    return IdealNumbers(parameters)


def seed_set(parameters: RngParameters, bank: int) -> int:
    """Return the index of the seed set that a board uses for a bank. The boards of a BM2 use different seed sets."""
    return bank * parameters.chains + parameters.chain


def generator_numbers(parameters: RngParameters, bank: int) -> Words:
    """Return the serial number of each generator in a bank: uint64[`generator_shape`]."""
    count = math.prod(parameters.generator_shape)
    first = seed_set(parameters, bank) * count
    return np.arange(first, first + count, dtype=np.uint64).reshape(parameters.generator_shape)


@dataclass(frozen=True, slots=True)
class LFSR:
    """A Fibonacci linear feedback shift register of `bits` bits, at most 32.

    A step shifts the state left by one bit. Each exponent e >= 1 of the polynomial selects bit e - 1 of the state
    before the step. The new lowest bit is the parity of the selected bits. The period is 2**bits - 1: the register runs
    through every state but 0.
    """

    kind: RngKind

    @property
    def bits(self) -> int:
        """Width of the state in bits."""
        return POLYNOMIALS[self.kind][0]

    @property
    def period(self) -> int:
        """Number of steps after which the states repeat."""
        return (1 << self.bits) - 1

    @property
    def taps(self) -> int:
        """Mask of the tapped state bits. A step shifts the parity of these bits into the state."""
        return sum(1 << (exponent - 1) for exponent in POLYNOMIALS[self.kind])

    def step(self, states: Words) -> Words:
        """Return the states after one step."""
        parity: Words = (np.bitwise_count(states & np.uint64(self.taps)) & np.uint8(1)).astype(np.uint64)
        return ((states << np.uint64(1)) & np.uint64(self.period)) | parity

    def jump(self, states: Words, steps: Words) -> Words:
        """Advance `states[i]` by `steps[i]` steps, for every i, with a few table look-ups instead of single steps."""
        steps = steps % np.uint64(self.period)
        for bit, tables in enumerate(jump_tables(self.kind, 1)):
            taken = (steps >> np.uint64(bit)) & np.uint64(1) == 1
            states = np.where(taken, apply_map(tables, states), states)
        return states

    def seeds(self, numbers: Words) -> Words:
        """Return the initial states of the generators with these serial numbers.

        An initial state is a base state after some number of steps, the distance. Distances are scattered
        and not evenly spaced. With evenly spaced distances, the states of 3, 5 or 17 columns would XOR to 0,
        because 3, 5 and 17 divide 2**32 - 1. If states XOR to 0, the AND of their columns is wrong, however
        many cycles are run.
        """
        base = BASE_STATE & self.period or 1
        distances = ((numbers + np.uint64(1)) * np.uint64(GOLDEN)) >> np.uint64(32)
        return self.jump(np.full(numbers.shape, base, dtype=np.uint64), distances)


def sequencer_seed(parameters: BM2Parameters, bank: int) -> int:
    """Return a bank's seed for the LFSR16 in a BM2's sequencer. A `random` sequencer chooses bits with this LFSR."""
    return int(LFSR(RngKind.LFSR16).seeds(np.array([seed_set(parameters, bank)], dtype=np.uint64))[0])


@lru_cache(1 << 12)  # 2 ms each, and the same for all boards of a deployment and most of a design space
def _seeds(kind: RngKind, first: int, count: int) -> Words:
    return LFSR(kind).seeds(np.arange(first, first + count, dtype=np.uint64))


@dataclass(frozen=True, slots=True)
class LFSRNumbers:
    """LFSRs as generators. The output of an LFSR is the low bits of its state."""

    parameters: RngParameters

    def restart(self, bank: int) -> Words:
        """Return the seeds of the bank's generators."""
        numbers = generator_numbers(self.parameters, bank)
        return _seeds(self.parameters.rng, int(numbers.flat[0]), numbers.size).reshape(numbers.shape).copy()

    def show(self, states: Words) -> Words:
        """Return the low `prob_bits` bits of the states."""
        return states & np.uint64(self.parameters.ones_code)

    def clock(self, states: Words) -> Words:
        """Make `steps_per_clock` steps, one by one."""
        lfsr = LFSR(self.parameters.rng)
        for _ in range(self.parameters.steps_per_clock):
            states = lfsr.step(states)
        return states


@dataclass(frozen=True, slots=True)
class TableNumbers:
    """Generators that repeat one table of recorded numbers. A state is an index into the table.

    In seed set 0, generator n of `count` starts at index floor(n * length / count). Seed set s of `sets` shifts every
    start by the fraction s / sets of the distance to the next generator's start.
    """

    parameters: RngParameters
    table: npt.NDArray[np.uint32]

    def restart(self, bank: int) -> Words:
        """Return the indices into the table from which the generators start for a bank: uint64[`generator_shape`]."""
        shape, sets = self.parameters.generator_shape, self.parameters.rng_banks * self.parameters.chains
        count, own = math.prod(shape), seed_set(self.parameters, bank)
        # Python integers, because the products may exceed 64 bits
        starts = [(n * sets + own) * len(self.table) // (count * sets) for n in range(count)]
        return np.array(starts, dtype=np.uint64).reshape(shape)

    def show(self, states: Words) -> Words:
        """Return the low `prob_bits` bits of the table's numbers at these indices."""
        return self.table[states] & np.uint64(self.parameters.ones_code)

    def clock(self, states: Words) -> Words:
        """Advance the indices by `steps_per_clock`."""
        return (states + np.uint64(self.parameters.steps_per_clock)) % np.uint64(len(self.table))


@dataclass(frozen=True, slots=True)
class IdealNumbers:
    """Nearly ideal generators (splitmix64), for comparison with LFSRs.

    The state of the generator with serial number n starts at mix(mix(`ideal_seed`) + (n + 1) * GOLDEN). A step adds
    GOLDEN to the state. The output is mix(state). All sums are modulo 2**64.
    """

    parameters: RngParameters

    def restart(self, bank: int) -> Words:
        """Return the initial states."""
        seed = mix(np.array([self.parameters.ideal_seed], dtype=np.uint64))
        numbers = generator_numbers(self.parameters, bank)
        return mix(seed + (numbers + np.uint64(1)) * np.uint64(GOLDEN))

    def show(self, states: Words) -> Words:
        """Return the low `prob_bits` bits of mix(state) for each state."""
        return mix(states) & np.uint64(self.parameters.ones_code)

    def clock(self, states: Words) -> Words:
        """Make `steps_per_clock` steps in one addition."""
        return states + np.uint64(self.parameters.steps_per_clock * GOLDEN % 2**64)


def mix(words: Words) -> Words:
    """Apply splitmix64's finaliser (Steele, Lea and Flood 2014): every output bit depends on every input bit."""
    words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return words ^ (words >> np.uint64(31))


# A step of an LFSR is linear over GF(2), and so is any number of steps. A linear map of a state is stored as
# one table of 256 words per byte of the state: the image is the XOR of one word from each table.


def map_tables(images: Words) -> Words:
    """Return the look-up tables of a linear map over GF(2), one for each byte of the state: uint64[bits / 8, 256].

    `images[j]` is the result for the state in which only bit j is 1.
    """
    tables = np.zeros((len(images) // 8, 256), dtype=np.uint64)
    for j, image in enumerate(images):
        table, half = tables[j // 8], 1 << (j % 8)
        table[half : 2 * half] = table[:half] ^ image
    return tables


def apply_map(tables: Words, states: Words) -> Words:
    """Return the images of states under the linear map with these look-up tables."""
    images = np.zeros_like(states)
    for byte, table in enumerate(tables):
        images ^= table[(states >> np.uint64(8 * byte)) & np.uint64(255)]
    return images


@cache
def jump_tables(kind: RngKind, stride: int) -> Words:
    """Return, for each i < bits, the tables of the map that makes stride * 2**i steps: uint64[bits, bits / 8, 256]."""
    lfsr = LFSR(kind)
    basis = np.uint64(1) << np.arange(lfsr.bits, dtype=np.uint64)
    images = basis
    for _ in range(stride):
        images = lfsr.step(images)
    tables = []
    for _ in range(lfsr.bits):
        tables.append(map_tables(images))
        images = apply_map(tables[-1], images)
    stacked = np.stack(tables)
    stacked.flags.writeable = False
    return stacked
