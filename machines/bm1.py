"""A BM1 as data: its tables, what a frame starts with, why it stopped, and what every kernel can do."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from machines.errors import ParameterError, StartError
from machines.parameters import BM1Parameters, PriorMode, RngKind

CYCLES_MAX: Final = 2**63 - 1
"""Highest `max_cycles` and `run_until`: both are 64-bit registers that a signed number must hold."""

_Scalar = TypeVar("_Scalar", bound=np.generic)


@dataclass(frozen=True, eq=False, slots=True)
class BM1Machine:
    """A machine that can run: parameters and the codes of every cell. Arrays are kept as read-only copies.

    Attributes:
        parameters: What the machine is built with.
        prior: uint16[2**prior_bits, lines], the prior's codes; its row 0 is also what a written prior is
            until the host writes one.
        tables: One uint16[2**sensor_bits, lines] per sensor column; the top row is all-ones codes (a
            missing reading).
        rng_table: uint32[length], the numbers that all columns play where `rng` is `table`; else None.

    Raises:
        ParameterError: The arrays are not those of such a machine.
    """

    parameters: BM1Parameters
    prior: npt.NDArray[np.uint16]
    tables: tuple[npt.NDArray[np.uint16], ...]
    rng_table: npt.NDArray[np.uint32] | None = None

    def __post_init__(self) -> None:
        """Check shapes and codes, and keep copies that nobody can write to."""
        parameters = self.parameters
        if len(self.tables) != parameters.sensors:
            raise ParameterError(
                f"There are {len(self.tables)} sensor tables; "
                f"these parameters have {parameters.sensors} sensor columns."
            )
        prior = _codes(
            "The prior's table", self.prior, (parameters.prior_addresses, parameters.lines), parameters
        )
        tables = []
        for column, (table, bits) in enumerate(
            zip(self.tables, parameters.sensor_bits, strict=True), start=1
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
        prior_address: Row of the prior's table.
        prior_codes: uint16[lines], a written prior (`prior_mode` = `written` only); None leaves the
            table's row.
        target_count: The count at which a line stops the machine, 1 to 2**counter_bits - 1.
        max_cycles: The frame's last cycle, 1 or more.
        bank: Set of seeds that the generators restart from (`rng_reset` = `bank`); without effect where
            they are free.
        run_until: Cycle at which the first slice ends; 0 for no slices.
    """

    addresses: tuple[int, ...]
    prior_address: int = 0
    prior_codes: npt.NDArray[np.uint16] | None = None
    target_count: int
    max_cycles: int
    bank: int = 0
    run_until: int = 0


class BM1Kernel(Protocol):
    """A machine that runs: the same to the bit, whichever kernel it is."""

    @property
    def machine(self) -> BM1Machine:
        """The machine that this kernel runs."""

    @property
    def counts(self) -> npt.NDArray[np.uint32]:
        """uint32[lines]: the counters as they stand, a copy."""

    @property
    def cycles(self) -> int:
        """Cycles run in this frame."""

    @property
    def reason(self) -> StopReason:
        """Why the machine stands still."""

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

    def resume(self, run_until: int) -> StopReason:
        """Run the next slice of the same frame, to cycle `run_until` at most; 0 for no further slices.

        Raises:
            StartError: The frame is over or there is none, or `run_until` is no later cycle; nothing has
                changed then.
        """

    def prepare(self) -> None:
        """Do beforehand what else the first frames would take time for; changes no result. Resets the machine."""

    def reset(self) -> None:
        """Counters and cycles to 0, reason `NONE`, generators to the start of bank 0."""


def check_start(machine: BM1Machine, start: Start) -> None:
    """Refuse a start that asks for what the machine does not have.

    Raises:
        StartError: Says which part, and what it may be.
    """
    parameters = machine.parameters
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
        try:
            _codes("The written prior", start.prior_codes, (parameters.lines,), parameters)
        except ParameterError as error:
            raise StartError(str(error)) from None


def check_resume(reason: StopReason, cycles: int, run_until: int) -> None:
    """Refuse a resume of a frame that is over (or is not there), or one that ends at no later cycle.

    Raises:
        StartError: Says which.
    """
    if reason is not StopReason.SLICE:
        raise StartError(
            f"There is no slice to resume: the machine stands still with reason {reason.name.lower()}."
        )
    if run_until != 0:
        _check("run_until", run_until, cycles + 1, CYCLES_MAX)


def addressed_codes(machine: BM1Machine, start: Start) -> npt.NDArray[np.uint16]:
    """The codes that a valid start's addresses select: uint16[columns, lines], row 0 the prior's."""
    codes = np.empty((machine.parameters.columns, machine.parameters.lines), dtype=np.uint16)
    codes[0] = machine.prior[start.prior_address] if start.prior_codes is None else start.prior_codes
    for column, (table, address) in enumerate(zip(machine.tables, start.addresses, strict=True), start=1):
        codes[column] = table[address]
    return codes


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
