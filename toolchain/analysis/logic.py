"""Logic and memories of a machine in an FPGA, as the sum over the units of its VHDL (see `Of`).

`scripts/verify resources --calibrate` synthesises small machines with GHDL and yosys, and fits the cost of each unit
(docs/how-to/design-space.md). Registers are counted from the VHDL. Tables go into memory blocks (M20K). If all memory
blocks are full, the other tables go into memory LABs, which are made of logic.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from machines.bm1_kind import BM1
from machines.bm2 import BM2Parameters
from machines.parameters import BM1Parameters, PriorMode, RngKind, SensorMode
from toolchain.errors import BuildError
from toolchain.outputs.memories import generators
from toolchain.outputs.mif import LENGTH


@dataclass(frozen=True, slots=True, kw_only=True)
class Device:
    """An FPGA on a board.

    A design that needs more than the share `usable` of the FPGA's resources cannot be placed and routed.
    """

    name: str
    title: str
    alms: int
    registers_per_alm: int
    blocks: int
    usable: float = 0.8


DEVICES: Final = {
    device.name: device
    for device in (
        Device(
            name="proce-v-d8",
            title="Gidel Proce V D8 (Stratix V GS D8)",
            alms=262_400,
            registers_per_alm=4,
            blocks=2_567,
        ),
    )
}
"""The devices for `--device`."""


def device_named(name: str) -> Device:
    """Return a device by its name, or raise a BuildError."""
    try:
        return DEVICES[name]
    except KeyError:
        raise BuildError(f"--device {name}: expected one of {', '.join(DEVICES)}") from None


CYCLE_BITS: Final = 64
"""Width of a cycle counter."""

WORD_BITS: Final = 32
"""Width of a word that the host writes or reads."""

_BOARD_REGISTERS: Final = 1032
"""Registers of bm1_axi, bm_register_block, bm1_registers and bm1_control, except those for target and replicas."""
_REPLICA_BITS: Final = 5
"""Number of flip-flops of bm1_control for each replica: its stop reason, whether it runs and whether it is halted."""
_FEW_WORDS: Final = 8
"""A memory of at most this many words is built from memory LABs; unlike memory blocks, they need output registers."""


class Of(StrEnum):
    """The kinds of units that make up a machine's logic. The docstring of a kind names the unit's VHDL entities."""

    BOARD = "board"
    """The units that every board has once: bm1_axi, bm_register_block, bm1_guard, and bm1_control.

    bm1_control is counted here as on a board without replicas. `REPLICA` counts the logic that replicas add.
    """
    CODE_BIT = "code bit"
    """A bit of a cell's code, in bm1_stochastic_bitstream_generator.

    The logic of the bit compares the random number with the code, and tests the code for all ones and all zeros. It
    also includes this bit's share of the AND in bm1_tile_element."""
    COUNTER_BIT = "counter bit"
    """A bit of a counter, in bm1_counter, bm1_readout and bm1_matrix.

    The logic of the bit increments the counter, compares the count with the target, and selects the bit for the host.
    """
    STATE_BIT = "state bit"
    """A bit of an LFSR's state, in bm1_lfsr. Its logic loads the seed, or the state after the steps of a cycle."""
    STEP = "step"
    """A step of an LFSR in a cycle, in bm1_lfsr. Its logic computes the parity of the taps."""
    PLACE_BIT = "place bit"
    """A bit of the index in bm1_table_player. The index is the place of the current random number in the table.

    The logic of the bit loads the seed, or the bit of the index after the steps of a cycle.
    """
    WORD = "word"
    """A word that the host writes for a frame, in bm1_words. Its logic decodes the address and checks the value."""
    MEMORY = "memory"
    """A memory of the words that the host writes, in bm1_words.

    The logic of the memory writes the initial words after a reset, and reads words for the host.
    """
    REPLICA = "replica"
    """A replica on a board with several replicas.

    The logic of the replica is in bm1_control and bm1_readout. It stops and resumes the replica, and selects the
    replica's outcome for the host. A board with one replica does not need this logic.
    """


WORST_ERROR: Final = 0.06
"""Maximum relative error of estimated ALUTs and ALMs that `scripts/verify resources` accepts."""


@dataclass(frozen=True, slots=True)
class Cost:
    """FPGA logic of one unit: the look-up tables (ALUTs), including carry chains, and the ALMs that hold them."""

    aluts: float
    alms: float


# Least squares of the relative errors of 37 boards (GHDL 2.0, yosys 0.70, synth_intel_alm, Cyclone V: the same ALM as
# a Stratix V's), 2 to 100 lines, up to 32 replicas. Their ALMs deviate by 1.0 % in the median, and by 4.0 % at most.
COSTS: Final[Mapping[Of, Cost]] = {
    Of.BOARD: Cost(1674, 946.2),
    Of.CODE_BIT: Cost(1.775, 0.969),
    Of.COUNTER_BIT: Cost(2.216, 1.413),
    Of.STATE_BIT: Cost(1.243, 0.648),
    Of.STEP: Cost(0.254, 0.371),
    Of.PLACE_BIT: Cost(2.678, 1.359),
    Of.WORD: Cost(1.460, 1.172),
    Of.MEMORY: Cost(125.3, 68.83),
    Of.REPLICA: Cost(55.47, 36.87),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LogicPart:
    """A part of a machine: its name, its number of units of each kind, and its flip-flops."""

    name: str
    counts: Mapping[Of, float] = field(default_factory=dict)
    registers: int = 0

    @property
    def aluts(self) -> float:
        """Number of look-up tables, including carry chains."""
        return sum(count * COSTS[of].aluts for of, count in self.counts.items())

    @property
    def alms(self) -> float:
        """Number of ALMs that hold the look-up tables."""
        return sum(count * COSTS[of].alms for of, count in self.counts.items())


@dataclass(frozen=True, slots=True)
class Logic:
    """The logic of a machine, without memories."""

    parts: tuple[LogicPart, ...]

    @property
    def aluts(self) -> float:
        """Number of look-up tables, including carry chains."""
        return sum(part.aluts for part in self.parts)

    @property
    def alms(self) -> float:
        """Number of ALMs that hold the look-up tables."""
        return sum(part.alms for part in self.parts)

    @property
    def registers(self) -> int:
        """Number of flip-flops."""
        return sum(part.registers for part in self.parts)


def state_bits(p: BM1Parameters | BM2Parameters, table_length: int) -> int:
    """Return the number of bits in a generator's state: an LFSR, or an index in the table of random numbers."""
    return p.rng.lfsr_bits or _index_bits(table_length)


def logic_of(parameters: BM1Parameters, *, table_length: int = LENGTH, inputs: int = 0) -> Logic:
    """Return the logic of a machine on a board, without memories. Raises a BuildError for ideal generators.

    `inputs` is the number of input words that the board's registers have. If `inputs` is smaller than the number of
    input words that the machine needs, the needed number is used.
    """
    p = parameters
    if p.rng is RngKind.IDEAL:
        raise BuildError("rng = ideal exists only in emulation; use an LFSR")
    lines = p.replicas * p.lines
    cells = lines * p.columns
    counters = lines * p.counter_bits
    # codes that the host writes are held for the frame; the others are held by the memories' outputs
    held = lines * ((p.prior_mode is PriorMode.WRITTEN) + (0 if p.has_tables else p.sensors))
    several = p.replicas if p.replicas > 1 else 0
    # the target, and what bm1_readout has selected: a count and, with several replicas, a word of their outcomes
    control = _BOARD_REGISTERS + 2 * p.counter_bits + (WORD_BITS + several * CYCLE_BITS if several else 0)
    return Logic(
        (
            LogicPart(name="cells", counts={Of.CODE_BIT: cells * p.prob_bits}, registers=held * p.prob_bits),
            LogicPart(name="counters", counts={Of.COUNTER_BIT: counters}, registers=counters),
            _generators(p, table_length),
            _inputs(p, inputs),
            LogicPart(
                name="control",
                counts={Of.BOARD: 1, Of.REPLICA: several},
                registers=control + p.replicas * _REPLICA_BITS,
            ),
        )
    )


def _generators(p: BM1Parameters, table_length: int) -> LogicPart:
    """Return the logic of the generators, and the logic that loads their seeds (bm1_generators)."""
    count, width = generators(p), state_bits(p, table_length)
    lfsrs = {Of.STATE_BIT: count * width, Of.STEP: count * p.steps_per_clock}
    counts = lfsrs if p.rng.lfsr_bits else {Of.PLACE_BIT: count * width}
    loading = _index_bits(p.rng_banks * count) + _index_bits(count + 1) + 2
    return LogicPart(name="generators", counts=counts, registers=count * width + loading)


def _inputs(p: BM1Parameters, inputs: int) -> LogicPart:
    """Return the logic of the words that a host writes for a frame (bm1_words): readings, prior addresses, codes."""
    used = BM1.registers(p)
    sensor_bits = sum(p.sensor_bits) * used.input_words // max(p.sensors, 1)
    # used words, their used bits, and the depth of the memory
    blocks = [(used.input_words, sensor_bits, max(inputs, used.input_words))]
    if p.replicas > 1:
        blocks.append((p.replicas, p.replicas * p.prior_bits, p.replicas))
    place_bits = 0
    if p.prior_mode is PriorMode.WRITTEN:
        blocks.append((used.result_words, used.result_words * p.prob_bits, used.result_words))
        place_bits = _index_bits(p.lines)  # in the memory of their initial codes
    # a used word has a flag that says that it is too large; a block has two indices, each with a flag, and an output
    registers = sum(
        words + bits + 2 * _index_bits(depth) + 2 + (WORD_BITS if depth <= _FEW_WORDS else 0)
        for words, bits, depth in blocks
    )
    return LogicPart(
        name="inputs",
        counts={Of.WORD: sum(words for words, _, _ in blocks), Of.MEMORY: len(blocks)},
        registers=registers + place_bits,
    )


def _index_bits(count: int) -> int:
    """Return how many bits hold a number below `count`, at least one."""
    return max(1, (count - 1).bit_length())


MLAB_ALMS: Final = 10
"""Number of ALMs of a memory LAB."""
MLAB_SHAPE: Final = (64, 10)
"""Number of words and bits per word of a memory LAB. Of its two shapes, this is the deeper one."""
MLAB_SHARE: Final = 0.5
"""Share of the LABs in a Stratix V that can be used as memories."""

BLOCK_SHAPES: Final = ((512, 40), (1024, 20), (2048, 10), (4096, 5), (8192, 2), (16384, 1))
"""The possible shapes of an M20K: number of words, and bits per word."""


def blocks_of(words: int, width: int) -> int:
    """Return the minimum number of M20Ks for a table of the given size."""
    return min(math.ceil(words / deep) * math.ceil(width / wide) for deep, wide in BLOCK_SHAPES)


@dataclass(frozen=True, slots=True, order=True)
class EqualMemories:
    """Several memories with the same number of words and the same width."""

    words: int
    width: int
    count: int

    @property
    def blocks(self) -> int:
        """Minimum number of M20Ks for one memory."""
        return blocks_of(self.words, self.width)


@dataclass(frozen=True, slots=True, kw_only=True)
class Memories:
    """The memories of a machine.

    Attributes:
        logic_tables: Number of tables in memory LABs. A table of a BM1 is in memory LABs if no M20K block is left for
            it. A table of a BM2 is in memory LABs if it is small.
    """

    table_bits: int
    blocks: int
    logic_tables: int
    mlabs: int
    alms: float


def tables_of(p: BM1Parameters) -> list[EqualMemories]:
    """Return the tables of codes. A column has one table if its cells share an address, otherwise one table per cell.

    Every replica has its own tables, because it uses its own addresses. A prior of one row, whose MIF has one word, is
    not a memory but a constant.
    """
    column, cell = (p.lines * p.prob_bits, p.replicas), (p.prob_bits, p.replicas * p.lines)
    tables = [EqualMemories(1 << p.prior_bits, *column)] if p.prior_bits else []
    if p.has_tables:
        shape = column if p.sensor_mode is SensorMode.COLUMN else cell
        tables += [EqualMemories(1 << bits, *shape) for bits in p.sensor_bits]
    return tables


def random_memories_of(p: BM1Parameters | BM2Parameters, table_length: int) -> list[EqualMemories]:
    """Return the memory of seeds and, for `rng = table`, each generator's copy of the table of random numbers."""
    seeds = EqualMemories(p.rng_banks * generators(p), state_bits(p, table_length), 1)
    table = EqualMemories(table_length, p.prob_bits, generators(p))
    return [seeds, table] if p.rng is RngKind.TABLE else [seeds]


def word_memories_of(p: BM1Parameters, inputs: int = 0) -> list[EqualMemories]:
    """Return the memories of the words that the host writes (bm1_words).

    If the host writes the prior, another memory holds the initial prior, which a reset copies into the words.
    """
    used = BM1.registers(p)
    depths = [max(inputs, used.input_words, 1)]
    initial = []
    if p.replicas > 1:
        depths.append(p.replicas)
    if p.prior_mode is PriorMode.WRITTEN:
        depths.append(used.result_words)
        initial.append(EqualMemories(p.lines, p.prob_bits, 1))
    # a power of two, because the index is an address of the bus
    return [EqualMemories(1 << _index_bits(depth), WORD_BITS, 1) for depth in depths] + initial


def place_memories(
    parameters: BM1Parameters, device: Device, table_length: int = LENGTH, inputs: int = 0
) -> Memories:
    """Place the memories of a BM1 in M20Ks and memory LABs.

    The memories of random numbers and of the words that the host writes are always in M20Ks. The remaining
    usable M20Ks take tables, the deepest tables first. The tables that do not fit there are in memory LABs.
    """
    tables = tables_of(parameters)
    room = math.floor(device.usable * device.blocks)
    others = random_memories_of(parameters, table_length) + word_memories_of(parameters, inputs)
    blocks = sum(each.count * each.blocks for each in others)
    logic_tables = mlabs = 0
    alms = 0.0
    for table in sorted(tables, reverse=True):
        count = min(table.count, max(0, room - blocks) // table.blocks)
        blocks += count * table.blocks
        left = table.count - count
        deep = math.ceil(table.words / MLAB_SHAPE[0])
        own_mlabs = deep * math.ceil(table.width / MLAB_SHAPE[1])
        logic_tables += left
        mlabs += left * own_mlabs
        # a third of a 4-to-1 multiplexer for a bit
        alms += left * (own_mlabs * MLAB_ALMS + (deep - 1) * table.width / 3)
    return Memories(
        table_bits=sum(each.words * each.width * each.count for each in tables),
        blocks=blocks,
        logic_tables=logic_tables,
        mlabs=mlabs,
        alms=alms,
    )
