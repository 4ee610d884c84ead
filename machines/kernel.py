"""The base class of all BM1 kernels, and the checks of the values that start or resume a frame."""

from abc import ABC, abstractmethod
from collections.abc import Collection

import numpy as np
import numpy.typing as npt

from machines.bm1 import BM1Machine, Start, StopReason, checked_codes, joint_reason
from machines.errors import ParameterError, StartError
from machines.parameters import CYCLES_MAX, BM1Parameters, PriorMode, SensorMode, check_parameter


class BM1Kernel(ABC):
    """A running machine with `replicas` replicas around one set of generators (thesis 2.1.2 and 4.4).

    Each replica counts and stops by itself. The generators step until the last replica has stopped. All kernels give
    equal counts, cycles, stop reasons and generator states, bit for bit.
    """

    def __init__(self, machine: BM1Machine) -> None:
        self.machine = machine
        self._cycles = [0] * machine.parameters.replicas
        self._reasons = [StopReason.NONE] * machine.parameters.replicas
        self._halted: set[int] = set()
        self._target_count = 1
        self._max_cycles = 1

    @property
    def cycles(self) -> int:
        """Number of cycles that the generators have run in this frame: the maximum of `replica_cycles`."""
        return max(self._cycles)

    @property
    def reason(self) -> StopReason:
        """The reason why the machine stopped. `joint_reason` computes it from the reasons of the replicas."""
        return joint_reason(self._reasons, self._halted)

    @property
    def replica_cycles(self) -> tuple[int, ...]:
        """Number of cycles that each replica has run in this frame."""
        return tuple(self._cycles)

    @property
    def replica_reasons(self) -> tuple[StopReason, ...]:
        """The reason why each replica stopped."""
        return tuple(self._reasons)

    @property
    @abstractmethod
    def counts(self) -> npt.NDArray[np.uint32]:
        """A copy of the counters: uint32[lines], or uint32[replicas, lines] with several replicas."""

    @property
    @abstractmethod
    def rng_state(self) -> npt.NDArray[np.uint64]:
        """A copy of the generators' states: uint64[columns], or uint64[lines, columns] with a generator per cell."""

    def reset(self) -> None:
        """Set all counters and cycles to 0 and all stop reasons to `NONE`. Restart the generators from bank 0."""
        self._reset()
        self._cycles = [0] * len(self._cycles)
        self._reasons = [StopReason.NONE] * len(self._reasons)
        self._halted = set()

    def prepare(self) -> None:
        """Do the work that would otherwise slow down the first frames, and reset the machine."""
        self.reset()

    def start(self, start: Start) -> StopReason:
        """Run a new frame to its end, or to the end of its first slice.

        All counters start at 0. If `rng_reset` is `bank`, the generators restart from the bank of `start`. If
        `rng_reset` is `free`, the generators continue.

        Raises:
            StartError: The start does not fit the machine. The machine is then unchanged.
        """
        check_start(self.machine.parameters, start)
        self._target_count = int(start.target_count)
        self._max_cycles = int(start.max_cycles)
        self._halted = set()
        self._start(start)
        return self.reason

    def resume(self, run_until: int, halted: Collection[int] = ()) -> StopReason:
        """Run the next slice of the current frame, up to cycle `run_until`. If `run_until` is 0, run to the end.

        The replicas with the indices `halted` do not continue in this frame. They keep the reason `SLICE`.

        Raises:
            StartError: No frame can be continued, or `run_until` is not a later cycle. The machine is unchanged.
        """
        halts = self._halted | set(halted)
        self._check_resume(run_until, halted, halts)
        self._halted = halts
        going = [
            replica
            for replica, reason in enumerate(self._reasons)
            if reason is StopReason.SLICE and replica not in halts
        ]
        self._resume(going, int(run_until))
        return self.reason

    @abstractmethod
    def _reset(self) -> None:
        """Set the counters to 0 and restart the generators from bank 0."""

    @abstractmethod
    def _start(self, start: Start) -> None:
        """Run the first slice of a checked start. Set the cycles and stop reasons of the replicas."""

    @abstractmethod
    def _resume(self, going: list[int], run_until: int) -> None:
        """Run the next slice of the replicas with the indices `going`. Set their cycles and stop reasons."""

    def _check_resume(self, run_until: int, halted: Collection[int], halts: Collection[int]) -> None:
        replicas = len(self._reasons)
        if not all(0 <= replica < replicas for replica in halted):
            raise StartError(
                f"Replicas {', '.join(map(str, sorted(halted)))} cannot be halted; this machine has replicas 0 to {replicas - 1}."
            )
        reason = joint_reason(self._reasons, halts)
        if reason is not StopReason.SLICE:
            raise StartError(
                "There is no slice to resume: every replica has stopped or is halted."
                if halted
                else f"There is no slice to resume: the machine has stopped with reason {reason.name.lower()}."
            )
        if run_until != 0:
            check_start_value("run_until", run_until, self.cycles + 1, CYCLES_MAX)


def check_start(parameters: BM1Parameters, start: Start) -> None:
    """Raise a StartError if a start does not fit the machine. The error names the wrong value and the valid range."""
    if not _are_plain_addresses(parameters, start.addresses):
        _check_inputs(parameters, start.addresses)
    if isinstance(start.prior_address, tuple):
        if parameters.replicas == 1 or len(start.prior_address) != parameters.replicas:
            raise StartError(
                f"There are {len(start.prior_address)} prior addresses; this machine needs one for all or "
                f"one for each of its replicas, of which it has {parameters.replicas}."
            )
        for replica, address in enumerate(start.prior_address):
            check_start_value(
                f"prior_address of replica {replica}", address, 0, parameters.prior_addresses - 1
            )
    else:
        check_start_value("prior_address", start.prior_address, 0, parameters.prior_addresses - 1)
    check_start_value("target_count", start.target_count, 1, parameters.target_count_max)
    check_start_value("max_cycles", start.max_cycles, 1, CYCLES_MAX)
    check_start_value("bank", start.bank, 0, parameters.rng_banks - 1)
    check_start_value("run_until", start.run_until, 0, CYCLES_MAX)
    if start.prior_codes is not None:
        if parameters.prior_mode is not PriorMode.WRITTEN:
            raise StartError(
                "The start has prior codes, but this machine's prior is a table (prior_mode = table)."
            )
        own = parameters.replicas > 1 and np.shape(start.prior_codes) == parameters.count_shape
        shape = parameters.count_shape if own else (parameters.lines,)
        try:
            checked_codes("The written prior", start.prior_codes, shape, parameters.prob_bits)
        except ParameterError as error:
            raise StartError(str(error)) from None


def _are_plain_addresses(parameters: BM1Parameters, given: object) -> bool:
    """Return whether the inputs are one integer per column, all in range: a fast check, enough for most frames."""
    if type(given) is not tuple or parameters.input_shape != (len(given),):
        return False
    for address, bits in zip(given, parameters.sensor_bits, strict=True):  # noqa: SIM110 - all() of a generator would slow every frame
        if type(address) is not int or not 0 <= address < 1 << bits:
            return False
    return True


def _check_inputs(parameters: BM1Parameters, given: object) -> None:
    """Refuse inputs of another shape than the machine's, and values outside the range of their column."""
    inputs, shape = np.asarray(given), parameters.input_shape
    if inputs.size == 0 and not parameters.sensors:
        return
    if inputs.shape != shape or inputs.dtype.kind not in "ui":
        raise StartError(
            f"The inputs have the shape {inputs.shape} and are {inputs.dtype}; this machine takes integers of the "
            f"shape {shape}."
        )
    by_column = inputs.reshape(parameters.replicas, parameters.sensors, -1)
    tops = (1 << np.array(parameters.sensor_bits, dtype=np.int64)) - 1
    wrong = np.argwhere((by_column < 0) | (by_column > tops[:, np.newaxis]))
    if len(wrong):
        replica, column, line = (int(at) for at in wrong[0])
        name = "The address" if parameters.has_tables else "The code"
        where = f" at line {line}" if parameters.sensor_mode is not SensorMode.COLUMN else ""
        where += f" of replica {replica}" if parameters.replicas > 1 else ""
        check_start_value(
            f"{name} of column {column + 1}{where}", by_column[replica, column, line], 0, int(tops[column])
        )


def check_start_value(name: str, value: object, lowest: int, highest: int) -> None:
    """Raise a StartError unless `value` is an integer from `lowest` to `highest`."""
    value = int(value) if isinstance(value, np.integer) else value
    check_parameter(name, value, lowest, highest, StartError)
