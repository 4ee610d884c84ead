"""A machine's logic from first principles: comparators, ANDs, counters, generators, inputs, readout, in bits.

A part's logic is counted by its bits; the FPGA's logic for a bit is calibrated on yosys's synthesis of small machines
(`scripts/verify resources --calibrate`; docs/how-to/design-space.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset, SensorMode
from toolchain.errors import BuildError
from toolchain.outputs.rng_table import LENGTH

if TYPE_CHECKING:
    from collections.abc import Mapping

CYCLE_BITS: Final = 64
"""Width of the cycle counter, and of the two limits that it is compared with."""

WORD_BITS: Final = 32
"""A register of the interface holds this many bits, used or not (thesis 3.2: 20 inputs, 1200 results)."""

_CONTROL_BITS: Final = 4
"""Of the frame's sequence, and whether it has just begun."""
_REASON_BITS: Final = 3
_FLAG_BITS: Final = 3
"""Of a replica: whether it runs, whether it was halted, whether it is to be."""


class Of(StrEnum):
    """Units that logic is counted by; each costs look-up tables beside the carry chains, and ALMs for those."""

    CONTROL = "control"
    """A machine: the frame's sequence and the 64-bit limits."""
    CODE_BIT = "code bit"
    """A bit of a cell's code: r < code, all ones, all zeros."""
    CELL = "cell"
    """A cell's AND, and its part in "no line can count"."""
    COUNTER_BIT = "counter bit"
    """A bit of a line's counter against the target."""
    LINE = "line"
    """Enabling a line, and its part in "any line overflows"."""
    STATE_BIT = "state bit"
    """A bit of a generator."""
    STEP = "step"
    """A step of a generator: the parity of its taps."""
    SEED_BIT = "seed bit"
    """A bit of a generator, for every bank."""
    INPUT = "input"
    """A word that the host writes: its address."""
    RESULT_BIT = "result bit"
    """A bit that the host reads: a third of a 4-to-1 multiplexer."""
    REPLICA = "replica"
    """A machine of several: when it stops, why, and whether it goes on."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Logic of an FPGA for one unit: look-up tables beside the carry chains, and ALMs of those."""

    luts: float
    alms: float


# Least squares over 47 synthesised machines (yosys 0.23, synth_intel_alm, Cyclone V: the same ALM as a Stratix V's), of 1
# to 48 lines, 1 to 6 sensors, codes of 4 to 16 bits, up to 32 replicas, inputs of all kinds: relative errors up to 9 %.
# Negative costs are set to 0; the cost of a cell's AND can't be separated from its comparator's.
COSTS: Final[Mapping[Of, Cost]] = {
    Of.CONTROL: Cost(178.5, 110.3),
    Of.CODE_BIT: Cost(0.891, 0.579),
    Of.CELL: Cost(0.0, 0.0),
    Of.COUNTER_BIT: Cost(0.751, 0.349),
    Of.LINE: Cost(3.936, 3.637),
    Of.STATE_BIT: Cost(0.711, 0.345),
    Of.STEP: Cost(0.442, 0.214),
    Of.SEED_BIT: Cost(0.078, 0.058),
    Of.INPUT: Cost(2.502, 1.590),
    Of.RESULT_BIT: Cost(1 / 3, 1 / 3),  # not fitted: 6 inputs make a 4-to-1 multiplexer
    Of.REPLICA: Cost(35.76, 13.66),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of a machine: its name, units of look-up tables, bits of carry chains, and flip-flops."""

    name: str
    counts: Mapping[Of, float] = field(default_factory=dict)
    sums: float = 0.0
    registers: float = 0.0

    @property
    def aluts(self) -> float:
        """Look-up tables of all kinds, carry chains among them."""
        return self.sums + sum(count * COSTS[of].luts for of, count in self.counts.items())

    @property
    def alms(self) -> float:
        """ALMs that hold those."""
        return self.sums / 2 + sum(count * COSTS[of].alms for of, count in self.counts.items())


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


def logic_of(
    parameters: BM1Parameters,
    *,
    inputs: int = 0,
    results: int = 0,
    whole_words: bool = True,
    table_length: int = LENGTH,
) -> Logic:
    """Return a machine's logic, its tables left out.

    Args:
        parameters: The machine; of one board.
        inputs: Input registers of the interface, as many as the machine's at least.
        results: Result registers of the interface, as many as the machine's at least.
        whole_words: Whether those have 32 bits each, or as many as the machine uses.
        table_length: Numbers in the table of random numbers, where one is played.

    Raises:
        BuildError: Generators that no FPGA has.
    """
    p = parameters
    if p.rng is RngKind.IDEAL:
        raise BuildError("rng = ideal exists emulated only: no FPGA has it; use an LFSR")
    lines = p.replicas * p.lines
    cells = lines * p.columns
    generators = p.columns * (1 if p.shared else p.lines)  # replicas share them
    # Where a table is played, a generator is a place in it, which counts up.
    state = p.rng.lfsr_bits or max(1, (table_length - 1).bit_length())
    steps = p.steps_per_clock if p.rng.lfsr_bits else 0
    places = 0 if p.rng.lfsr_bits else generators * state
    seeds = p.rng_banks if p.rng_banks > 1 and p.rng_reset is RngReset.BANK else 0
    bank_bits = (seeds - 1).bit_length() if seeds else 0
    counters = lines * p.counter_bits
    return Logic(
        (
            Part(
                name="cells",
                counts={Of.CODE_BIT: cells * p.prob_bits, Of.CELL: cells},
                sums=cells * (p.prob_bits + 1),
            ),
            Part(
                name="counters",
                counts={Of.COUNTER_BIT: counters, Of.LINE: lines},
                sums=counters,
                registers=counters,
            ),
            Part(
                name="generators",
                counts={
                    Of.STATE_BIT: generators * state,
                    Of.STEP: generators * steps,
                    Of.SEED_BIT: generators * state * seeds,
                },
                sums=places,
                registers=generators * state,
            ),
            _inputs(p, inputs, whole_words),
            _readout(p, results, whole_words),
            Part(
                name="control",
                counts={Of.CONTROL: 1, Of.REPLICA: p.replicas if p.replicas > 1 else 0},
                sums=CYCLE_BITS,
                registers=3 * CYCLE_BITS + p.counter_bits + bank_bits + _CONTROL_BITS + _stops(p),
            ),
        )
    )


def _stops(p: BM1Parameters) -> int:
    """Return the registers of the stop reason; of replicas also each one's cycles and flags."""
    return _REASON_BITS if p.replicas == 1 else p.replicas * (CYCLE_BITS + _REASON_BITS + _FLAG_BITS)


def _inputs(p: BM1Parameters, words: int, whole_words: bool) -> Part:
    """Return the registers that the host writes for a frame: readings, prior address or codes, replicas to halt."""
    per_column = 1 if p.sensor_mode is SensorMode.COLUMN else p.lines
    own = p.replicas * p.sensors * per_column
    bits = p.replicas * per_column * sum(p.sensor_bits)
    if whole_words:
        own = max(own, words)
        bits = own * WORD_BITS
    written = p.replicas * p.lines if p.prior_mode is PriorMode.WRITTEN else 0
    selects = 0 if p.prior_mode is PriorMode.WRITTEN else p.replicas
    halts = math.ceil(p.replicas / WORD_BITS) if p.replicas > 1 else 0
    return Part(
        name="inputs",
        counts={Of.INPUT: own + selects + written + halts},
        registers=bits + written * p.prob_bits + selects * max(p.prior_bits, 1),
    )


def _readout(p: BM1Parameters, words: int, whole_words: bool) -> Part:
    """Return the registers that the host reads: every line's final count, and each replica's outcome."""
    results = max(words, p.replicas * p.lines) if whole_words else p.replicas * p.lines
    width = WORD_BITS if whole_words else p.counter_bits
    outcomes = p.replicas * (CYCLE_BITS + _REASON_BITS) if p.replicas > 1 else 0
    return Part(
        name="readout",
        counts={Of.RESULT_BIT: results * width + outcomes},
        registers=results * width + (WORD_BITS if p.replicas > 1 else width),
    )
