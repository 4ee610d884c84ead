"""A BM1 as data: its tables, what a frame starts with, why it stopped, and what every kernel can do."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from machines.errors import MachineError, ParameterError, StartError
from machines.parameters import CYCLES_MAX, BM1Parameters, PriorMode, RngKind, SensorMode

_COLUMN: Final = SensorMode.COLUMN  # looked up in an enumeration it would cost every frame
_Scalar = TypeVar("_Scalar", bound=np.generic)


@dataclass(frozen=True, eq=False, slots=True)
class BM1Machine:
    """A machine that can run: parameters and the codes of every cell. Arrays are kept as read-only copies.

    Attributes:
        parameters: What the machine is built with.
        prior: uint16[2**prior_bits, lines], the prior's codes; its row 0 is also what a written prior is
            until the host writes one.
        tables: One uint16[2**sensor_bits, lines] per sensor column; the top row is all-ones codes (a
            missing reading). None of them where `sensor_mode` is `threshold`.
        rng_table: uint32[length], the numbers that all columns play where `rng` is `table`; else None.

    Raises:
        ParameterError: The arrays are not those of such a machine.
    """

    parameters: BM1Parameters
    prior: npt.NDArray[np.uint16] = field(repr=False)
    tables: tuple[npt.NDArray[np.uint16], ...] = field(repr=False)
    rng_table: npt.NDArray[np.uint32] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Check shapes and codes, and keep copies that nobody can write to."""
        parameters = self.parameters
        if not parameters.has_tables and self.tables:
            raise ParameterError(
                f"There are {len(self.tables)} sensor tables; with sensor_mode = threshold cells are given codes, "
                "so there must be none."
            )
        if parameters.has_tables and len(self.tables) != parameters.sensors:
            raise ParameterError(
                f"There are {len(self.tables)} sensor tables; "
                f"these parameters have {parameters.sensors} sensor columns."
            )
        prior = _codes(
            "The prior's table", self.prior, (parameters.prior_addresses, parameters.lines), parameters
        )
        tables = []
        for column, (table, bits) in enumerate(
            zip(self.tables, parameters.sensor_bits, strict=parameters.has_tables), start=1
        ):
            name = f"The table of column {column}"
            codes = _codes(name, table, (1 << bits, parameters.lines), parameters)
            if not (codes[-1] == parameters.ones_code).all():
                raise ParameterError(
                    f"{name} has other codes than all-ones ({parameters.ones_code}) "
                    f"at its top address {(1 << bits) - 1}, which stands for a missing reading."
                )
            tables.append(codes)
        object.__setattr__(self, "prior", prior)
        object.__setattr__(self, "tables", tuple(tables))
        object.__setattr__(self, "rng_table", _rng_table(self.rng_table, parameters))

    def __eq__(self, other: object) -> bool:
        """Whether the other machine is built alike and holds the same codes."""
        if not isinstance(other, BM1Machine):
            return NotImplemented
        return (
            self.parameters == other.parameters
            and np.array_equal(self.prior, other.prior)
            and all(map(np.array_equal, self.tables, other.tables))
            and (self.rng_table is None or np.array_equal(self.rng_table, np.asarray(other.rng_table)))
        )

    def __hash__(self) -> int:
        """A hash of the parameters: equal machines have equal ones."""
        return hash(self.parameters)


SHORTEST_SLICE: Final = 256
"""Cycle at which the first slice ends at the earliest; the next ones end at twice the last one's end."""


def first_slice(target_count: int) -> int:
    """The cycle at which the first of a frame's slices ends: 256 * 2^k, the first that is twice the target or more.

    No counter can reach the target earlier than in as many cycles, and even a line whose every other cycle counts takes
    twice as many: a slice that ended before would cost every board a doorbell and an answer for nothing.
    """
    end = SHORTEST_SLICE
    while end < 2 * target_count:
        end *= 2
    return end


class StopReason(IntEnum):
    """Why a machine stands still. The numbers are those of the status register."""

    NONE = 0
    """Reset, and nothing run since."""
    OVERFLOW = 1
    """A counter reached the target count."""
    MAX_CYCLES = 2
    """The frame's last cycle was run without an overflow."""
    SLICE = 3
    """The slice's last cycle (`run_until`) was run; the frame can go on."""
    IMPOSSIBLE = 4
    """No line can count for these addresses (each has a code 0), so nothing was run."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """What a frame starts with: the registers that the host writes.

    Attributes:
        addresses: One address per sensor column, columns 1..N; a missing reading is the column's top address.
            Where cells have inputs of their own, or there are replicas: an array of integers of the shape
            `parameters.input_shape`, addresses or (`threshold`) codes; all lines of a missing reading have the
            top value.
        prior_address: Row of the prior's table; with replicas one row for all, or a tuple of one each.
        prior_codes: uint16[lines], a written prior (`prior_mode` = `written` only); with replicas the same for all,
            or uint16[replicas, lines]. None leaves the table's row.
        target_count: The count at which a line stops the machine, 1 to 2**counter_bits - 1.
        max_cycles: The frame's last cycle, 1 or more.
        bank: Set of seeds that the generators restart from (`rng_reset` = `bank`); without effect where
            they are free.
        run_until: Cycle at which the first slice ends; 0 for no slices.
    """

    addresses: tuple[int, ...] | npt.NDArray[np.integer]
    prior_address: int | tuple[int, ...] = 0
    prior_codes: npt.NDArray[np.uint16] | None = None
    target_count: int
    max_cycles: int
    bank: int = 0
    run_until: int = 0


class BM1Kernel(Protocol):
    """A machine, or replicas of one that share their generators: the same to the bit, whichever kernel runs them."""

    @property
    def machine(self) -> BM1Machine:
        """The machine that this kernel runs."""

    @property
    def counts(self) -> npt.NDArray[np.uint32]:
        """uint32[lines], with replicas uint32[replicas, lines]: the counters as they stand, a copy."""

    @property
    def cycles(self) -> int:
        """Cycles run in this frame; with replicas those of the one that ran longest, which the generators stepped."""

    @property
    def reason(self) -> StopReason:
        """Why the machine stands still; with replicas what `joint_reason` makes of theirs."""

    @property
    def replica_cycles(self) -> tuple[int, ...]:
        """Cycles that each replica ran in this frame; one machine is one replica."""

    @property
    def replica_reasons(self) -> tuple[StopReason, ...]:
        """Why each replica stands still."""

    @property
    def rng_state(self) -> npt.NDArray[np.uint64]:
        """The generators' states, a copy: uint64[columns], or uint64[lines, columns] if unshared."""

    def start(self, start: Start) -> StopReason:
        """Run a new frame to its end, or to the end of its first slice.

        Counters start at 0; generators restart from the start's bank (`rng_reset` = `bank`) or go on
        (`free`).

        Raises:
            StartError: The start asks for what the machine does not have; nothing has changed then.
        """

    def resume(self, run_until: int, halted: Collection[int] = ()) -> StopReason:
        """Run the next slice of the same frame, to cycle `run_until` at most; 0 for no further slices.

        Args:
            run_until: Where the slice ends.
            halted: Numbers of replicas that are left where they stand, for the rest of the frame: they keep the
                reason `SLICE`.

        Raises:
            StartError: The frame is over or there is none, or `run_until` is no later cycle, or no replica is left
                that could go on; nothing has changed then.
        """

    def prepare(self) -> None:
        """Do beforehand what else the first frames would take time for; changes no result. Resets the machine."""

    def reset(self) -> None:
        """Counters and cycles to 0, reason `NONE`, generators to the start of bank 0."""


def check_one_machine(machine: BM1Machine) -> None:
    """Refuse replicas where a kernel runs one machine.

    Raises:
        MachineError: Says how many there are, and which kernel to use.
    """
    if machine.parameters.replicas != 1:
        raise MachineError(
            f"This kernel runs one machine; there are {machine.parameters.replicas} replicas: use make_kernel."
        )


def joint_reason(reasons: Sequence[StopReason], halted: Collection[int] = ()) -> StopReason:
    """Why several replicas stand still together.

    It is `SLICE` while one of them can go on, which a halted one can't; else the first of `OVERFLOW`, `MAX_CYCLES` and
    `IMPOSSIBLE` that one of them has.
    """
    if any(reason is StopReason.SLICE and at not in halted for at, reason in enumerate(reasons)):
        return StopReason.SLICE
    order = (StopReason.OVERFLOW, StopReason.MAX_CYCLES, StopReason.IMPOSSIBLE)
    return next((reason for reason in order if reason in reasons), StopReason.NONE)


def check_start(machine: BM1Machine, start: Start) -> None:
    """Refuse a start that asks for what the machine does not have.

    Raises:
        StartError: Says which part, and what it may be.
    """
    parameters = machine.parameters
    if parameters.replicas > 1 or parameters.sensor_mode is not _COLUMN:
        _check_inputs(parameters, start.addresses)
    else:
        if len(start.addresses) != parameters.sensors:
            raise StartError(
                f"There are {len(start.addresses)} addresses; "
                f"this machine has {parameters.sensors} sensor columns."
            )
        for column, (address, bits) in enumerate(
            zip(start.addresses, parameters.sensor_bits, strict=True), start=1
        ):
            # said in full only of what is refused: this is done for every frame
            if type(address) is not int or not 0 <= address < 1 << bits:
                _check(f"The address of column {column}", address, 0, (1 << bits) - 1)
    if isinstance(start.prior_address, tuple):
        if parameters.replicas == 1 or len(start.prior_address) != parameters.replicas:
            raise StartError(
                f"There are {len(start.prior_address)} prior addresses; this machine takes one"
                + (
                    "."
                    if parameters.replicas == 1
                    else f", or one for each of its {parameters.replicas} replicas."
                )
            )
        for replica, address in enumerate(start.prior_address):
            _check(f"prior_address of replica {replica}", address, 0, parameters.prior_addresses - 1)
    else:
        _check("prior_address", start.prior_address, 0, parameters.prior_addresses - 1)
    _check("target_count", start.target_count, 1, parameters.target_count_max)
    _check("max_cycles", start.max_cycles, 1, CYCLES_MAX)
    _check("bank", start.bank, 0, parameters.rng_banks - 1)
    _check("run_until", start.run_until, 0, CYCLES_MAX)
    if start.prior_codes is not None:
        if parameters.prior_mode is not PriorMode.WRITTEN:
            raise StartError(
                "The start brings prior codes, but this machine's prior is a table (prior_mode = table)."
            )
        shape = np.shape(start.prior_codes) if parameters.replicas > 1 else ()
        shape = shape if shape == parameters.count_shape else (parameters.lines,)
        try:
            _codes("The written prior", start.prior_codes, shape, parameters)
        except ParameterError as error:
            raise StartError(str(error)) from None


def check_resume(
    reason: StopReason, cycles: int, run_until: int, halted: Collection[int] = (), replicas: int = 1
) -> None:
    """Refuse a resume of a frame that is over (or is not there), or one that ends at no later cycle.

    Raises:
        StartError: Says which.
    """
    if halted and (replicas == 1 or not all(0 <= at < replicas for at in halted)):
        raise StartError(
            f"Replicas {', '.join(map(str, sorted(halted)))} are to be halted; "
            + (f"this machine's are 0 to {replicas - 1}." if replicas > 1 else "this machine has only one.")
        )
    if reason is not StopReason.SLICE:
        if halted:
            raise StartError("There is no slice to resume: no replica is left that could go on.")
        raise StartError(
            f"There is no slice to resume: the machine stands still with reason {reason.name.lower()}."
        )
    if run_until != 0:
        _check("run_until", run_until, cycles + 1, CYCLES_MAX)


def addressed_codes(machine: BM1Machine, start: Start) -> npt.NDArray[np.uint16]:
    """The codes that a valid start's inputs select: uint16[columns, lines], row 0 the prior's; replicas before these."""
    if machine.parameters.replicas > 1 or machine.parameters.sensor_mode is not _COLUMN:
        return _codes_of_inputs(machine, start)
    codes = np.empty((machine.parameters.columns, machine.parameters.lines), dtype=np.uint16)
    codes[0] = machine.prior[start.prior_address] if start.prior_codes is None else start.prior_codes
    for column, (table, address) in enumerate(zip(machine.tables, start.addresses, strict=True), start=1):
        codes[column] = table[address]
    return codes


def missing_inputs(parameters: BM1Parameters) -> tuple[int, ...] | npt.NDArray[np.int64]:
    """The inputs of a frame whose readings are all missing, as `Start.addresses` takes them."""
    tops = tuple((1 << bits) - 1 for bits in parameters.sensor_bits)
    shape = parameters.input_shape
    if shape == (parameters.sensors,):
        return tops
    by_column = np.array(tops, dtype=np.int64)
    if parameters.sensor_mode is not SensorMode.COLUMN:
        by_column = by_column[:, np.newaxis]
    return np.broadcast_to(by_column, shape).copy()


def _codes_of_inputs(machine: BM1Machine, start: Start) -> npt.NDArray[np.uint16]:
    """The codes that are selected where an input is not simply a column's: as `addressed_codes`."""
    parameters = machine.parameters
    codes = np.empty((parameters.replicas, parameters.columns, parameters.lines), dtype=np.uint16)
    if start.prior_codes is None:
        rows = np.broadcast_to(np.asarray(start.prior_address), (parameters.replicas,))
        codes[:, 0] = machine.prior[rows]
    else:
        codes[:, 0] = start.prior_codes
    if not parameters.sensors:
        return codes if parameters.replicas > 1 else codes[0]
    inputs = np.asarray(start.addresses).reshape(parameters.replicas, parameters.sensors, -1)
    if not parameters.has_tables:
        codes[:, 1:] = inputs
    lines = np.arange(parameters.lines)
    for column, table in enumerate(machine.tables):
        codes[:, column + 1] = (
            table[inputs[:, column, 0]]
            if parameters.sensor_mode is SensorMode.COLUMN
            else table[inputs[:, column], lines]
        )
    return codes if parameters.replicas > 1 else codes[0]


def _check_inputs(parameters: BM1Parameters, given: tuple[int, ...] | npt.NDArray[np.integer]) -> None:
    """Refuse inputs of another shape than the machine's, and values that its columns do not have."""
    inputs, shape = np.asarray(given), parameters.input_shape
    if inputs.size == 0 and not parameters.sensors:
        return
    if inputs.shape != shape:
        raise StartError(f"The inputs have the shape {inputs.shape}; this machine takes {shape}.")
    if inputs.dtype.kind not in "ui":
        raise StartError(f"The inputs are {inputs.dtype}; they must be integers.")
    by_column = inputs.reshape(parameters.replicas, parameters.sensors, -1)
    tops = (1 << np.array(parameters.sensor_bits, dtype=np.int64)) - 1
    wrong = np.argwhere((by_column < 0) | (by_column > tops[:, np.newaxis]))
    if len(wrong):
        replica, column, line = (int(at) for at in wrong[0])
        name = "The code" if not parameters.has_tables else "The address"
        where = f" at line {line}" if parameters.sensor_mode is not SensorMode.COLUMN else ""
        where += f" of replica {replica}" if parameters.replicas > 1 else ""
        _check(
            f"{name} of column {column + 1}{where}", by_column[replica, column, line], 0, int(tops[column])
        )


def _codes(
    name: str, given: npt.NDArray[np.uint16], shape: tuple[int, ...], parameters: BM1Parameters
) -> npt.NDArray[np.uint16]:
    """`given` as a read-only uint16 array, once it has this shape and only codes of `prob_bits` bits."""
    array = np.asarray(given)
    if array.shape != shape:
        raise ParameterError(f"{name} has the shape {array.shape}; it must be {shape}.")
    if array.dtype.kind not in "ui":
        raise ParameterError(f"{name} holds {array.dtype}; codes are integers.")
    if array.size and not 0 <= int(array.min()) <= int(array.max()) <= parameters.ones_code:
        raise ParameterError(
            f"{name} holds codes from {array.min()} to {array.max()}; with "
            f"prob_bits = {parameters.prob_bits} they must be from 0 to {parameters.ones_code}."
        )
    return _frozen(array.astype(np.uint16, copy=False))


def _rng_table(
    given: npt.NDArray[np.uint32] | None, parameters: BM1Parameters
) -> npt.NDArray[np.uint32] | None:
    """`given` as a read-only uint32 array, once it is there exactly where the generator plays a table."""
    if parameters.rng is not RngKind.TABLE:
        if given is not None:
            raise ParameterError(
                f"There is a table of random numbers, but rng = {parameters.rng} plays none."
            )
        return None
    if given is None:
        raise ParameterError("rng = table needs a table of random numbers (rng_table), and there is none.")
    array = np.asarray(given)
    if array.ndim != 1 or not array.size:
        raise ParameterError(
            f"The table of random numbers has the shape {array.shape}; it must be one row of 1 or more."
        )
    if array.dtype.kind not in "ui" or not 0 <= int(array.min()) <= int(array.max()) < 2**32:
        raise ParameterError(
            "The table of random numbers holds something else than integers from 0 to 2**32 - 1."
        )
    return _frozen(array.astype(np.uint32, copy=False))


def _frozen(array: npt.NDArray[_Scalar]) -> npt.NDArray[_Scalar]:
    """The array, C-contiguous and read-only: a copy, unless its owner has already frozen it."""
    if array.flags.c_contiguous and array.flags.owndata and not array.flags.writeable:
        return array
    copy = array.copy(order="C")
    copy.flags.writeable = False
    return copy


def _check(name: str, value: object, lowest: int, highest: int) -> None:
    """Refuse a value that is no integer from `lowest` to `highest`; `name` says whose it is."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool):
        raise StartError(f"{name} is {value!r}; it must be an integer.")
    if not lowest <= value <= highest:
        raise StartError(f"{name} is {value}; it must be from {lowest} to {highest}.")
