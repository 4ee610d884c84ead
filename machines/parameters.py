"""The parameters of a BM1 (thesis 2.1.2), and enumerations and checks for both the BM1 and the BM2."""

from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar, Final

from machines.errors import MachineError, ParameterError

PROB_BITS_MAX: Final = 16
"""Maximum number of bits in a code. Tables store codes as uint16."""

ADDRESS_BITS_MAX: Final = 16
"""Maximum number of address bits of a sensor or prior table: 65,536 rows. A row has one code per line."""

COUNTER_BITS_MAX: Final = 32
"""Maximum number of bits in a counter: the width of a result register."""

STEPS_PER_CLOCK_MAX: Final = 256
"""Maximum number of steps per clock. Hardware unrolls the steps, and the reference kernel makes them one by one."""

RNG_BANKS_MAX: Final = 65536
"""Maximum number of seed sets."""

REPLICAS_MAX: Final = 256
"""Maximum number of replicas on a board. The register map has room for the outcomes of 256 replicas."""

CYCLES_MAX: Final = 2**63 - 1
"""Maximum of `max_cycles` and `run_until`. Their registers have 64 bits, but the values must fit into an int64."""


class RngKind(StrEnum):
    """Kinds of random number generators; `machines.rng` implements them."""

    LFSR8 = "lfsr8"
    LFSR16 = "lfsr16"
    LFSR24 = "lfsr24"
    LFSR32 = "lfsr32"
    TABLE = "table"
    IDEAL = "ideal"

    @property
    def lfsr_bits(self) -> int | None:
        """Width of an LFSR's state in bits, or None if the generator is no LFSR."""
        return _LFSR_BITS.get(self)


_LFSR_BITS: Final = {RngKind.LFSR8: 8, RngKind.LFSR16: 16, RngKind.LFSR24: 24, RngKind.LFSR32: 32}


class RngReset(StrEnum):
    """Start of the generators in a frame: the seeds of a bank (`bank`), or the end of the last frame (`free`)."""

    BANK = "bank"
    FREE = "free"


class PriorMode(StrEnum):
    """Source of the prior's codes: a row of a table (`table`), or the host (`written`), with one code per line."""

    TABLE = "table"
    WRITTEN = "written"


class SensorMode(StrEnum):
    """Input of a sensor column (thesis 4.4): an address, an address per cell, or (`threshold`) a code per cell."""

    COLUMN = "column"
    CELL = "cell"
    THRESHOLD = "threshold"


class Sequencer(StrEnum):
    """Order in which a BM2 draws unknown bits.

    With `coloured`, each variable has a colour, and variables in a common factor have different colours. A BM2 then
    draws several bits at once: one bit of every unknown variable of one colour.
    """

    LINEAR = "linear"
    RANDOM = "random"
    COLOURED = "coloured"


class SampleEvery(StrEnum):
    """The step after which a BM2 takes a sample: a sweep, or a single move."""

    SWEEP = "sweep"
    MOVE = "move"


@dataclass(frozen=True, slots=True, kw_only=True)
class BM1Parameters:
    """Parameters of a BM1, a matrix of `lines` lines and `sensors` + 1 columns. Column 0 is the prior.

    Attributes:
        lines: Number of lines, one per value of the searched variable (M in the thesis).
        sensor_bits: Address bits of the table of each sensor column, for columns 1..N. The top address of a column
            means a missing reading, so a column of b bits supports 2**b - 1 values.
        prob_bits: Bits of a probability code (W), 1 to 16.
        prior_bits: Address bits of the prior's table. A table with a single row has 0.
        prior_mode: `table` or `written`. With `written`, the host writes the prior's codes with the start. Until then,
            the single row of the prior's table applies.
        counter_bits: Bits of a line's counter, 1 to 32.
        rng: Kind of random number generators. An LFSR must be wider than a code. Otherwise the low bits of the LFSR
            would never all be 0, and code 1 would never make a one.
        shared: Whether each column has one generator for all its lines. If False, each cell has its own generator.
        steps_per_clock: Steps of a generator per cycle. 0 selects the default. For an LFSR, the default is the smallest
            power of two that is at least `prob_bits`, so every cycle uses fresh bits. For `table` and `ideal`, it is 1.
        rng_banks: Number of seed sets. A start selects one set.
        rng_reset: Whether a start restarts the generators.
        ideal_seed: Seed of the `ideal` generator, 64 bits.
        sensor_mode: `column`, `cell` or `threshold`. With `column`, each sensor column has one address. With `cell`,
            each cell has its own address. With `threshold`, each cell has a code as its input, without a table. The
            `sensor_bits` of each column then equal `prob_bits`.
        replicas: Number of machines that share the generators. Each machine has its own inputs, counters, stop reason
            and number of cycles.

    Raises:
        ParameterError: A machine with these parameters cannot be built.
    """

    lines: int
    sensor_bits: tuple[int, ...]
    prob_bits: int = 8
    prior_bits: int = 0
    prior_mode: PriorMode = PriorMode.TABLE
    counter_bits: int = 8
    rng: RngKind = RngKind.LFSR32
    shared: bool = True
    steps_per_clock: int = 0
    rng_banks: int = 16
    rng_reset: RngReset = RngReset.BANK
    ideal_seed: int = 0
    sensor_mode: SensorMode = SensorMode.COLUMN
    replicas: int = 1
    # all boards have the seeds of board 0
    chain: ClassVar = 0
    chains: ClassVar = 1

    def __post_init__(self) -> None:
        """Check every parameter, convert strings to enum members, and set the default of `steps_per_clock`."""
        set_choices(self, prior_mode=PriorMode, rng=RngKind, rng_reset=RngReset, sensor_mode=SensorMode)
        object.__setattr__(self, "sensor_bits", tuple(self.sensor_bits))
        check_parameter("lines", self.lines, 1, 2**32 - 1)
        for column, bits in enumerate(self.sensor_bits, start=1):
            check_parameter(f"sensor_bits of column {column}", bits, 1, ADDRESS_BITS_MAX)
        check_parameter("prob_bits", self.prob_bits, 1, PROB_BITS_MAX)
        check_parameter("prior_bits", self.prior_bits, 0, ADDRESS_BITS_MAX)
        check_parameter("counter_bits", self.counter_bits, 1, COUNTER_BITS_MAX)
        check_parameter("steps_per_clock", self.steps_per_clock, 0, STEPS_PER_CLOCK_MAX)
        check_parameter("rng_banks", self.rng_banks, 1, RNG_BANKS_MAX)
        check_parameter("ideal_seed", self.ideal_seed, 0, 2**64 - 1)
        check_parameter("replicas", self.replicas, 1, REPLICAS_MAX)
        if self.sensor_mode is SensorMode.THRESHOLD:
            for column, bits in enumerate(self.sensor_bits, start=1):
                if bits != self.prob_bits:
                    raise ParameterError(
                        f"sensor_bits of column {column} is {bits}; with sensor_mode = threshold it must be "
                        f"prob_bits = {self.prob_bits}, since a cell's input is its code."
                    )
        if self.prior_mode is PriorMode.WRITTEN and self.prior_bits != 0:
            raise ParameterError(f"prior_bits is {self.prior_bits}; with prior_mode = written it must be 0.")
        width = self.rng.lfsr_bits
        if width is not None and width <= self.prob_bits:
            raise ParameterError(
                f"{self.rng} is too narrow for prob_bits = {self.prob_bits}; "
                f"use a wider generator, or at most {width - 1} bits."
            )
        if self.steps_per_clock == 0:
            steps = 1 if width is None else 1 << (self.prob_bits - 1).bit_length()
            object.__setattr__(self, "steps_per_clock", steps)

    @property
    def sensors(self) -> int:
        """Number of sensor columns (N)."""
        return len(self.sensor_bits)

    @property
    def columns(self) -> int:
        """Number of columns: the prior's column and N sensor columns."""
        return len(self.sensor_bits) + 1

    @property
    def generator_shape(self) -> tuple[int, ...]:
        """Shape of the generators' states: [columns], or [lines, columns] if each cell has its own generator."""
        return (self.columns,) if self.shared else (self.lines, self.columns)

    @property
    def has_tables(self) -> bool:
        """True if sensor columns have tables. In `threshold` mode, they have none, because their inputs are codes."""
        return self.sensor_mode is not SensorMode.THRESHOLD

    @property
    def input_shape(self) -> tuple[int, ...]:
        """Shape of a frame's inputs: [sensors], or [sensors, lines] if each cell has its own input.

        Several replicas add a first axis.
        """
        shape = (self.sensors,) if self.sensor_mode is SensorMode.COLUMN else (self.sensors, self.lines)
        return shape if self.replicas == 1 else (self.replicas, *shape)

    @property
    def count_shape(self) -> tuple[int, ...]:
        """Shape of a frame's counts: [lines], or [replicas, lines] with several replicas."""
        return (self.lines,) if self.replicas == 1 else (self.replicas, self.lines)

    @property
    def prior_addresses(self) -> int:
        """Number of rows of the prior's table."""
        return 1 << self.prior_bits

    @property
    def ones_code(self) -> int:
        """The code with all bits 1. A cell with this code makes a 1 in every cycle."""
        return (1 << self.prob_bits) - 1

    @property
    def target_count_max(self) -> int:
        """Maximum target count."""
        return (1 << self.counter_bits) - 1

    def missing_address(self, column: int) -> int:
        """Return the address that means a missing reading in column `column` (1..N), or raise a ParameterError."""
        if not 1 <= column <= self.sensors:
            raise ParameterError(f"There is no sensor column {column}: this machine has 1 to {self.sensors}.")
        return (1 << self.sensor_bits[column - 1]) - 1


def set_choices(parameters: object, **kinds: type[StrEnum]) -> None:
    """Convert each attribute named in `kinds` to its enumeration, in place, or raise a ParameterError."""
    for name, kind in kinds.items():
        given = getattr(parameters, name)
        try:
            object.__setattr__(parameters, name, kind(given))
        except ValueError:
            raise ParameterError(f"{name} is {given!r}; it must be one of {', '.join(kind)}.") from None


def check_parameter(
    name: str, value: object, lowest: int, highest: int, error: type[MachineError] = ParameterError
) -> None:
    """Raise `error` unless `value` is an integer from `lowest` to `highest`."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise error(f"{name} is {value!r}; it must be an integer.")
    if not lowest <= value <= highest:
        raise error(f"{name} is {value}; it must be from {lowest} to {highest}.")
