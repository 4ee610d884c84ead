"""What a BM1 takes of an FPGA, from first principles: comparators, ANDs, counters, generators, readout, tables.

What the logic needs of a part is counted by its bits; how much of an FPGA's logic a bit becomes is calibrated on
yosys's synthesis of small machines (`scripts/verify resources`; docs/design-space.md). Tables are memories, one a cell
as in the thesis's tiles (figure 2.2), since a table's content may be exchanged without a new compilation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset, SensorMode
from pcie_shim.programming_file import interface_room, interface_words
from toolchain.errors import BuildError
from toolchain.outputs.rng_table import LENGTH
from toolchain.partition import partition_lines

if TYPE_CHECKING:
    from collections.abc import Callable

CYCLE_BITS: Final = 64
"""Width of the cycle counter, and of the two limits that it is compared with."""

WORD_BITS: Final = 32
"""A register of the interface holds this many bits, used or not (thesis 3.2: 20 inputs, 1200 results)."""

MLAB_ALMS: Final = 10
"""ALMs that a memory LAB is made of."""
MLAB_SHAPE: Final = (64, 10)
"""Its words and their bits, in the deeper of its two shapes."""
MLAB_SHARE: Final = 0.5
"""Every other LAB of a Stratix V can be a memory."""

BLOCK_SHAPES: Final = ((512, 40), (1024, 20), (2048, 10), (4096, 5), (8192, 2), (16384, 1))
"""Words and their bits that an M20K can be read as."""

SOFT_PCIE_ELEMENTS: Final = (8_000, 30_000)
"""Logic elements that a PCIe controller made of logic takes, by its configuration (thesis 2.3)."""

PLACE_BITS: Final = (LENGTH - 1).bit_length()
"""Bits of a place in a table of random numbers."""

ELEMENTS_PER_ALM: Final = 2.65
"""Logic elements that the vendor counts for an ALM."""


class Pcie(StrEnum):
    """What the PCIe controller is made of."""

    HARD = "hard"
    """A block of the device, as in the thesis: no logic."""
    SOFT = "soft"
    """Logic: 8,000 to 30,000 elements."""


class Tables(StrEnum):
    """How tables lie in memory blocks."""

    CELL = "cell"
    """Every cell has its own memory, as the thesis draws a tile."""
    COLUMN = "column"
    """A column's tables lie side by side in wide memories: possible where a column shares one address."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Device:
    """An FPGA, and the board it is on.

    Attributes:
        name: As `--device` takes it.
        title: As a person says it.
        alms: Adaptive logic modules.
        registers_per_alm: Registers in each of those.
        blocks: M20K memory blocks, 20,480 bits each.
        usable: Share of each that a design can take before it no longer places and routes.
        hard_pcie: Whether it has PCIe controllers of its own.
    """

    name: str
    title: str
    alms: int
    registers_per_alm: int
    blocks: int
    usable: float = 0.8
    hard_pcie: bool = True


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
"""The devices that `--device` knows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Alms:
    """Logic: look-up tables by their inputs, bits of carry chains, registers.

    Attributes:
        luts: Look-up tables of up to 4 inputs.
        luts5: Those of 5.
        luts6: Those of 6.
        sums: Bits of carry chains.
        registers: Flip-flops.
    """

    luts: float = 0.0
    luts5: float = 0.0
    luts6: float = 0.0
    sums: float = 0.0
    registers: float = 0.0

    @property
    def aluts(self) -> float:
        """Look-up tables of all kinds, carry chains among them."""
        return self.luts + self.luts5 + self.luts6 + self.sums

    @property
    def alms(self) -> float:
        """ALMs: one holds a 6-input table, or two of up to 4, or two bits of a carry chain; a 5-input one shares if it can."""
        return self.luts6 + 0.75 * self.luts5 + 0.5 * (self.luts + self.sums)


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """What one part of a machine takes."""

    name: str
    aluts: float
    alms: float
    registers: float


@dataclass(frozen=True, slots=True)
class Logic:
    """A machine's logic, tables left out."""

    parts: tuple[Part, ...]

    @property
    def aluts(self) -> float:
        """Look-up tables, carry chains among them."""
        return sum(part.aluts for part in self.parts)

    @property
    def alms(self) -> float:
        """ALMs that hold those."""
        return sum(part.alms for part in self.parts)

    @property
    def registers(self) -> float:
        """Flip-flops."""
        return sum(part.registers for part in self.parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Cost:
    """What a bit of a part becomes in an FPGA: look-up tables beside the carry chains, and ALMs of those."""

    luts: float
    alms: float


# Least squares over 26 synthesised machines (yosys 0.23, synth_intel_alm, Cyclone V: the same ALM as a Stratix V's), of
# 2 to 48 lines, 1 to 6 sensors, codes of 4 to 16 bits; relative errors up to 10 %, 17 % for 2 lines.
_CONTROL: Final = _Cost(luts=158.1, alms=104.4)  # the frame's sequence and the 64-bit limits
_CODE_BIT: Final = _Cost(luts=0.912, alms=0.589)  # of a cell: r < code, all ones, all zeros
_CELL: Final = _Cost(luts=0.240, alms=0.620)  # its AND, and its part in "no line can count"
_COUNTER_BIT: Final = _Cost(luts=0.916, alms=0.516)  # of a line: the counter against the target
_RESULT_BIT: Final = _Cost(luts=0.333, alms=0.333)  # of a result: a third of a 4-to-1 multiplexer
_LINE: Final = _Cost(luts=4.025, alms=1.663)  # enabling it, and its part in "any line overflows"
_STATE_BIT: Final = _Cost(luts=0.442, alms=0.112)  # of a generator
_STEP: Final = _Cost(luts=0.955, alms=0.881)  # of a generator: the parity of its taps
_SEED_BIT: Final = _Cost(luts=0.080, alms=0.052)  # of a generator, for every bank


def logic_of(parameters: BM1Parameters, *, interface_words: int, word_bits: int = WORD_BITS) -> Logic:
    """Return what a machine's logic takes, its tables left out.

    Args:
        parameters: The machine; of one board.
        interface_words: Result registers of the interface; as many as lines, or more.
        word_bits: Bits of each.

    Raises:
        BuildError: Generators that no FPGA has.
    """
    p = parameters
    if p.rng is RngKind.IDEAL:
        message = "rng = ideal exists emulated only: no FPGA has it; use an LFSR"
        raise BuildError(message)
    lines = p.replicas * p.lines
    cells = lines * p.columns
    generators = p.columns * (1 if p.shared else p.lines)  # replicas share them
    # Where a table is played, a generator is a place in it, which counts up.
    state = p.rng.lfsr_bits or PLACE_BITS
    steps = p.steps_per_clock if p.rng.lfsr_bits else 0
    places = 0 if p.rng.lfsr_bits else generators * state
    seeds = p.rng_banks if p.rng_banks > 1 and p.rng_reset is RngReset.BANK else 0
    bank_bits = max((p.rng_banks - 1).bit_length(), 1)
    per_column = 1 if p.sensor_mode is SensorMode.COLUMN else p.lines
    inputs = p.replicas * (max(p.prior_bits, 1) + per_column * sum(p.sensor_bits))
    written = lines * p.prob_bits if p.prior_mode is PriorMode.WRITTEN else 0
    counters, results = lines * p.counter_bits, interface_words * word_bits
    # a replica stops by itself: its cycles are kept, and whether it runs
    stops = (p.replicas - 1) * (CYCLE_BITS + 3)
    return Logic(
        (
            _part("cells", (cells * p.prob_bits, _CODE_BIT), (cells, _CELL), sums=cells * (p.prob_bits + 1)),
            _part("counters", (counters, _COUNTER_BIT), (lines, _LINE), sums=counters, registers=counters),
            _part(
                "generators",
                (generators * state, _STATE_BIT),
                (generators * steps, _STEP),
                (generators * state * seeds, _SEED_BIT),
                sums=places,
                registers=generators * state,
            ),
            _part("readout", (results, _RESULT_BIT), registers=results + word_bits),
            _part(
                "control",
                (1, _CONTROL),
                sums=CYCLE_BITS,
                registers=3 * CYCLE_BITS + p.counter_bits + bank_bits + 7 + inputs + written + stops,
            ),
        )
    )


def _part(name: str, *bits: tuple[float, _Cost], sums: float = 0.0, registers: float = 0.0) -> Part:
    return Part(
        name=name,
        aluts=sums + sum(count * cost.luts for count, cost in bits),
        alms=sums / 2 + sum(count * cost.alms for count, cost in bits),
        registers=registers,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """What a machine takes of a board's FPGA.

    Attributes:
        device: Which one.
        logic: Its logic, part by part.
        tables: How its tables lie in memory blocks.
        table_bits: Bits of all tables.
        blocks: M20Ks that hold tables, of random numbers too.
        logic_tables: Tables for which there was no block left, so that they lie in memory LABs.
        mlabs: Memory LABs that those take.
        table_alms: ALMs that those and their multiplexers take.
        pcie: What the PCIe controller is made of.
        pcie_alms: ALMs that it takes, at least and at most.
    """

    device: Device
    logic: Logic
    tables: Tables
    table_bits: int
    blocks: int
    logic_tables: int
    mlabs: int
    table_alms: float
    pcie: Pcie
    pcie_alms: tuple[float, float]

    @property
    def alms(self) -> float:
        """ALMs altogether: of the logic, the registers that have no place beside it, tables and PCIe at its largest."""
        logic = max(self.logic.alms, self.logic.registers / self.device.registers_per_alm)
        return logic + self.table_alms + self.pcie_alms[1]

    @property
    def alm_share(self) -> float:
        """Of the device's ALMs."""
        return self.alms / self.device.alms

    @property
    def block_share(self) -> float:
        """Of the device's memory blocks."""
        return self.blocks / self.device.blocks

    @property
    def mlab_share(self) -> float:
        """Of the memory LABs that the device has."""
        return self.mlabs * MLAB_ALMS / (self.device.alms * MLAB_SHARE)

    @property
    def fits(self) -> bool:
        """Whether it can be placed and routed."""
        return self.why_not == ""

    @property
    def why_not(self) -> str:
        """What there is too little of, as a clause; nothing where it fits."""
        usable = self.device.usable
        if self.blocks > usable * self.device.blocks:
            return f"it takes {self.blocks:,} memory blocks, and there are {self.device.blocks:,}"
        if self.alm_share > usable:
            return f"it takes {self.alms:,.0f} ALMs, and {usable * self.device.alms:,.0f} of {self.device.alms:,} can be used"
        if self.mlab_share > 1:
            mlabs = self.device.alms * MLAB_SHARE / MLAB_ALMS
            return f"its tables take {self.mlabs:,} memory LABs, and there are {mlabs:,.0f}"
        return ""


def estimate(
    parameters: BM1Parameters,
    device: Device,
    *,
    interface: tuple[int, int],
    pcie: Pcie = Pcie.HARD,
    tables: Tables = Tables.CELL,
) -> Estimate:
    """Return what a machine takes of a device.

    Args:
        parameters: The machine; of one board.
        device: The FPGA.
        interface: Inputs and results of the interface; each is a register of 32 bits.
        pcie: What the PCIe controller is made of.
        tables: How tables lie in memory blocks.

    Raises:
        BuildError: Generators that no FPGA has, or a controller that the device has not.
    """
    if pcie is Pcie.HARD and not device.hard_pcie:
        message = f"{device.title} has no hard PCIe controller: use --pcie soft"
        raise BuildError(message)
    inputs, results = interface
    logic = logic_of(parameters, interface_words=max(results, parameters.replicas * parameters.lines))
    words = Part(name="inputs", aluts=inputs, alms=inputs / 2, registers=inputs * WORD_BITS)
    blocks, logic_tables, mlabs, table_alms = _place(parameters, device, tables)
    soft = tuple(elements / ELEMENTS_PER_ALM for elements in SOFT_PCIE_ELEMENTS)
    return Estimate(
        device=device,
        logic=Logic((*logic.parts, words)),
        tables=tables,
        table_bits=sum(
            parameters.replicas * parameters.lines * parameters.prob_bits << bits
            for bits in _table_bits(parameters)
        ),
        blocks=blocks,
        logic_tables=logic_tables,
        mlabs=mlabs,
        table_alms=table_alms,
        pcie=pcie,
        pcie_alms=(0.0, 0.0) if pcie is Pcie.HARD else (soft[0], soft[1]),
    )


def _table_bits(parameters: BM1Parameters) -> list[int]:
    """The address bits of the columns that have tables: a prior of one row, or a written one, is registers."""
    sensors = parameters.sensor_bits if parameters.has_tables else ()
    return [bits for bits in (parameters.prior_bits, *sensors) if bits]


def _place(parameters: BM1Parameters, device: Device, tables: Tables) -> tuple[int, int, int, float]:
    """Put tables into memory blocks, the largest first, and the others into memory LABs."""
    width, room = parameters.prob_bits, math.floor(device.usable * device.blocks)
    logic_tables = mlabs = 0
    # Two generators read one copy of a table of random numbers, through a port each.
    copies = (
        0
        if parameters.rng.lfsr_bits
        else math.ceil(parameters.columns * (1 if parameters.shared else parameters.lines) / 2)
    )
    blocks = copies * _blocks(LENGTH, width)
    alms = 0.0
    for bits in sorted(_table_bits(parameters), reverse=True):
        if tables is Tables.COLUMN:
            # As many of a block's words as possible side by side: the whole column or none of it.
            wide, each = parameters.lines * width, parameters.replicas
            own = _blocks(1 << bits, wide)
            count = min(each, max(0, room - blocks) // own)
        else:
            # every replica looks at an address of its own, so it has tables of its own
            wide, each = width, parameters.replicas * parameters.lines
            own = _blocks(1 << bits, wide)
            count = min(each, max(0, room - blocks) // own)
        blocks += count * own
        left = each - count
        deep = math.ceil((1 << bits) / MLAB_SHAPE[0])
        own_mlabs = deep * math.ceil(wide / MLAB_SHAPE[1])
        logic_tables += left * (1 if tables is Tables.CELL else parameters.lines)
        mlabs += left * own_mlabs
        alms += left * (own_mlabs * MLAB_ALMS + (deep - 1) * wide / 3)  # a third of a 4-to-1 multiplexer
    return blocks, logic_tables, mlabs, alms


def _blocks(words: int, width: int) -> int:
    """M20Ks that hold so many words of so many bits, in the best of their shapes."""
    return min(math.ceil(words / deep) * math.ceil(width / wide) for deep, wide in BLOCK_SHAPES)


def device_named(name: str) -> Device:
    """Return a device by its name.

    Raises:
        BuildError: There is none of that name; lists those there are.
    """
    try:
        return DEVICES[name]
    except KeyError:
        message = f"--device {name}: expected one of {', '.join(DEVICES)}"
        raise BuildError(message) from None


def boards_needed(
    parameters: BM1Parameters,
    device: Device,
    *,
    interface: tuple[int, int] = (20, 1200),
    largest_lines: int = 4096,
    pcie: Pcie = Pcie.HARD,
) -> tuple[int, str]:
    """Return the fewest boards that hold a machine, and a sentence that says why.

    Args:
        parameters: The whole machine.
        device: What a board has.
        interface: Inputs and results of a board's registers, at least; a larger machine gets a larger one.
        largest_lines: Lines that the register map has room for on a board.
        pcie: What the PCIe controllers are made of.

    Raises:
        BuildError: Not even a line a board fits, or generators that no FPGA has.
    """

    def on(lines: int) -> Estimate:
        part = with_lines(parameters, lines)
        inputs, results = interface_words(part)
        grown = (max(interface[0], inputs), max(interface[1], results))
        return estimate(part, device, interface=grown, pcie=pcie)

    room = interface_room(parameters)
    largest_lines = min(largest_lines, room[1] // parameters.replicas)
    if parameters.sensor_mode is not SensorMode.COLUMN and parameters.sensors:
        largest_lines = min(largest_lines, room[0] // (parameters.replicas * parameters.sensors))
    most = _most_lines(lambda lines: on(lines).fits, min(parameters.lines, largest_lines))
    if most == 0 and largest_lines == 0:
        message = (
            f"not even one line of {parameters.replicas} replicas fits the register map: it has room for {room[0]} inputs "
            f"and {room[1]} results; use fewer --replicas"
        )
        raise BuildError(message)
    if most == 0:
        message = (
            f"not even one line fits a {device.title}: {on(1).why_not}; use narrower tables or another device"
        )
        raise BuildError(message)
    count = math.ceil(parameters.lines / most)
    largest = partition_lines(parameters.lines, count)[0].lines
    took = on(largest)
    share = f"{took.alms:,.0f} ALMs ({took.alm_share:.0%}) and {took.blocks:,} memory blocks ({took.block_share:.0%})"
    if count == 1:
        return 1, f"All {parameters.lines} lines fit one {device.title}: {share}."
    if largest_lines < parameters.lines and on(largest_lines).fits:
        reason = f"the register map has room for {largest_lines} lines a board"
    else:
        reason = f"on one {device.title} {on(parameters.lines).why_not}"
    boards = f"{count} boards" if count > 2 else "two boards"
    return count, (
        f"{parameters.lines} lines need {boards}: {reason}; {largest} lines a board take {share}. An estimate, not a "
        "compilation."
    )


def _most_lines(fits: Callable[[int], bool], highest: int) -> int:
    """The most lines that fit, 0 to `highest`: what fits with more fits with fewer."""
    low, high = 0, highest + 1
    while high - low > 1:
        middle = (low + high) // 2
        if fits(middle):
            low = middle
        else:
            high = middle
    return low


def with_lines(parameters: BM1Parameters, lines: int) -> BM1Parameters:
    """Return the same machine with another number of lines."""
    from dataclasses import replace

    return replace(parameters, lines=lines)
