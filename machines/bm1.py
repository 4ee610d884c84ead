"""The data of a BM1: its tables, the inputs of a frame, and the reasons why it stops."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import chain
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from machines.errors import ParameterError
from machines.parameters import BM1Parameters, RngKind, SensorMode

_Scalar = TypeVar("_Scalar", bound=np.generic)


class MachineContents:
    """Parameters and tables of a machine. Objects with equal parameters and tables are equal."""

    __slots__: tuple[str, ...] = ()
    parameters: Any

    @property
    def arrays(self) -> tuple[npt.NDArray[Any], ...]:
        """All arrays of the machine, in the order of the programming file."""
        contents = [getattr(self, name) for name in self.__slots__ if name != "parameters"]
        every = chain.from_iterable(each if isinstance(each, tuple) else (each,) for each in contents)
        return tuple(array for array in every if array is not None)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, MachineContents):
            return NotImplemented
        same_parameters: bool = self.parameters == other.parameters
        return same_parameters and all(map(np.array_equal, self.arrays, other.arrays))

    def __hash__(self) -> int:
        # equal machines have equal parameters
        return hash(self.parameters)


@dataclass(frozen=True, eq=False, slots=True)
class BM1Machine(MachineContents):
    """A complete machine: parameters and the codes of every cell. Arrays are stored as read-only copies.

    Attributes:
        parameters: Sizes, widths and generators.
        prior: uint16[2**prior_bits, lines], the codes of the prior. If `prior_mode` is `written`, row 0 applies
            until the host writes a prior.
        tables: One uint16[2**sensor_bits, lines] per sensor column. The top row stands for a missing reading, and
            its codes are all ones. Empty if `sensor_mode` is `threshold`.
        rng_table: uint32[length], the random numbers for all columns, or None if `rng` is not `table`.

    Raises:
        ParameterError: The arrays do not match the parameters.
    """

    parameters: BM1Parameters
    prior: npt.NDArray[np.uint16] = field(repr=False)
    tables: tuple[npt.NDArray[np.uint16], ...] = field(repr=False)
    rng_table: npt.NDArray[np.uint32] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Check shapes and codes, and store read-only copies."""
        parameters = self.parameters
        if not parameters.has_tables and self.tables:
            raise ParameterError(
                f"There are {len(self.tables)} sensor tables; with sensor_mode = threshold there must be none."
            )
        if parameters.has_tables and len(self.tables) != parameters.sensors:
            raise ParameterError(
                f"There are {len(self.tables)} sensor tables; "
                f"these parameters have {parameters.sensors} sensor columns."
            )
        prior = checked_codes(
            "The prior's table",
            self.prior,
            (parameters.prior_addresses, parameters.lines),
            parameters.prob_bits,
        )
        tables = []
        for column, (table, bits) in enumerate(
            zip(self.tables, parameters.sensor_bits, strict=parameters.has_tables), start=1
        ):
            name = f"The table of column {column}"
            codes = checked_codes(name, table, (1 << bits, parameters.lines), parameters.prob_bits)
            if not (codes[-1] == parameters.ones_code).all():
                raise ParameterError(
                    f"{name} has other codes than all-ones ({parameters.ones_code}) "
                    f"at its top address {(1 << bits) - 1}, which stands for a missing reading."
                )
            tables.append(codes)
        object.__setattr__(self, "prior", prior)
        object.__setattr__(self, "tables", tuple(tables))
        object.__setattr__(self, "rng_table", checked_rng_table(self.rng_table, parameters.rng))


SHORTEST_SLICE: Final = 256
"""Minimum length of the first slice, in cycles. Each later slice ends at twice the end of the previous slice."""


def first_slice(target_count: int) -> int:
    """Return the cycle at which a frame's first slice ends: the smallest 256 * 2^k that is at least twice the target.

    A line needs at least `target_count` cycles to reach the target, and twice as many if it counts in every other
    cycle. A shorter slice would cost each board a useless doorbell and answer.
    """
    end = SHORTEST_SLICE
    while end < 2 * target_count:
        end *= 2
    return end


class StopReason(IntEnum):
    """The reason why a machine stopped. The numbers are those of the status register."""

    NONE = 0
    """The machine has not run since the reset."""
    OVERFLOW = 1
    """A counter reached the target count."""
    MAX_CYCLES = 2
    """The machine ran to the frame's last cycle without an overflow."""
    SLICE = 3
    """The machine ran to the slice's last cycle (`run_until`). The frame can continue."""
    IMPOSSIBLE = 4
    """The machine did not run: each line has a code 0 at the given addresses, so no line can count."""


_JOINT_ORDER: Final = (StopReason.OVERFLOW, StopReason.MAX_CYCLES, StopReason.IMPOSSIBLE)
_SLICE: Final = StopReason.SLICE


def joint_reason(reasons: Sequence[StopReason], halted: Collection[int] = ()) -> StopReason:
    """Return one stop reason for several replicas.

    If a replica that is not in `halted` can continue, the reason is `SLICE`. Otherwise it is the first of `OVERFLOW`,
    `MAX_CYCLES` and `IMPOSSIBLE` that any replica has.
    """
    if _SLICE in reasons and any(
        reason is _SLICE and replica not in halted for replica, reason in enumerate(reasons)
    ):
        return _SLICE
    for reason in _JOINT_ORDER:
        if reason in reasons:
            return reason
    return StopReason.NONE


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """The registers that the host writes to start a frame.

    Attributes:
        addresses: One address per sensor column, columns 1..N. A missing reading has the column's top address.
            If the machine has inputs per cell or several replicas, `addresses` is an array of integers of the shape
            `parameters.input_shape`. The array contains addresses, or codes if `sensor_mode` is `threshold`. A
            missing reading has the top value on all lines.
        prior_address: Row of the prior's table. If the machine has replicas, an integer is the row of all replicas,
            and a tuple has one row for each replica.
        prior_codes: uint16[lines], a written prior, for a machine with `prior_mode` = `written`. An array
            uint16[replicas, lines] has one prior for each replica. If None, the machine uses the row of the table.
        target_count: The count at which a line stops the machine, 1 to 2**counter_bits - 1.
        max_cycles: The frame's last cycle, 1 or more.
        bank: Set of seeds from which the generators restart. Generators with `rng_reset` = `free` ignore it.
        run_until: Cycle at which the first slice ends, or 0 for a frame without slices.
    """

    addresses: tuple[int, ...] | npt.NDArray[np.integer]
    prior_address: int | tuple[int, ...] = 0
    prior_codes: npt.NDArray[np.uint16] | None = None
    target_count: int
    max_cycles: int
    bank: int = 0
    run_until: int = 0


def addressed_codes(machine: BM1Machine, start: Start) -> npt.NDArray[np.uint16]:
    """Return the codes selected by the inputs of a valid start.

    Returns:
        uint16[columns, lines], or uint16[replicas, columns, lines] for several replicas. Column 0 is the prior.
    """
    parameters = machine.parameters
    codes = np.empty((parameters.replicas, parameters.columns, parameters.lines), dtype=np.uint16)
    by_column = codes.swapaxes(0, 1)
    if start.prior_codes is not None:
        by_column[0] = start.prior_codes
    else:
        row = start.prior_address
        by_column[0] = machine.prior[list(row) if isinstance(row, tuple) else row]
    if parameters.sensor_mode is SensorMode.COLUMN:
        rows = start.addresses if parameters.replicas == 1 else np.asarray(start.addresses).T
        for column, table in enumerate(machine.tables):
            by_column[column + 1] = table[rows[column]]
    elif parameters.sensors:
        inputs = np.asarray(start.addresses).reshape(-1, parameters.sensors, parameters.lines).swapaxes(0, 1)
        if not parameters.has_tables:
            by_column[1:] = inputs
        for column, table in enumerate(machine.tables):
            by_column[column + 1] = table[inputs[column], np.arange(parameters.lines)]
    return codes if parameters.replicas > 1 else codes[0]


def checked_codes(
    name: str, given: npt.NDArray[np.uint16], shape: tuple[int, ...], prob_bits: int, lowest: int = 0
) -> npt.NDArray[np.uint16]:
    """Return `given` as a read-only uint16 array, or raise a ParameterError if its shape or a code is wrong."""
    array = np.asarray(given)
    if array.shape != shape:
        raise ParameterError(f"{name} has the shape {array.shape}; it must be {shape}.")
    if array.dtype.kind not in "ui":
        raise ParameterError(f"{name} holds {array.dtype}; codes are integers.")
    if array.size and not lowest <= int(array.min()) <= int(array.max()) < 1 << prob_bits:
        raise ParameterError(
            f"{name} holds codes from {array.min()} to {array.max()}; with "
            f"prob_bits = {prob_bits} they must be from {lowest} to {(1 << prob_bits) - 1}."
        )
    return frozen(array.astype(np.uint16, copy=False))


def checked_rng_table(given: npt.NDArray[np.uint32] | None, rng: RngKind) -> npt.NDArray[np.uint32] | None:
    """Return `given` as a read-only uint32 array, or None. Raises a ParameterError if `given` does not suit `rng`."""
    if rng is not RngKind.TABLE:
        if given is not None:
            raise ParameterError(f"There is a table of random numbers, but rng = {rng} does not use one.")
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
            "The table of random numbers holds values that are not integers from 0 to 2**32 - 1."
        )
    return frozen(array.astype(np.uint32, copy=False))


def frozen(array: npt.NDArray[_Scalar]) -> npt.NDArray[_Scalar]:
    """Return a read-only C-contiguous array: `array` itself if possible, otherwise a copy."""
    if array.flags.c_contiguous and array.flags.owndata and not array.flags.writeable:
        return array
    copy = array.copy(order="C")
    copy.flags.writeable = False
    return copy
