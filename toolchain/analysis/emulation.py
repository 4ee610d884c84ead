"""Emulation of a deployment's boards in this process, with the host's stop rule."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from machines import make_kernel
from machines.bm1 import BM1Machine, Start, StopReason, addressed_codes, first_slice
from machines.encode import decode_code
from machines.parameters import COUNTER_BITS_MAX, CYCLES_MAX, BM1Parameters
from machines.posterior import joint_posterior
from toolchain.deployment import Stop
from toolchain.errors import BuildError

Inputs: TypeAlias = "tuple[int, ...] | NDArray[np.int64]"
"""Inputs of a frame: one address per sensor column, or int64[sensors, lines of all boards] if each line has its own
readings."""
WrittenPrior: TypeAlias = "NDArray[np.uint16] | None"
"""Codes of a prior that the host writes for a frame, uint16[lines of all boards]. None selects the machines' prior."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameRun:
    """The counts (uint32[lines]), the cycles and the stop reason of each board in one frame."""

    counts: tuple[NDArray[np.uint32], ...]
    cycles: tuple[int, ...]
    reasons: tuple[StopReason, ...]

    @property
    def length(self) -> int:
        """Cycles of the longest-running board."""
        return max(self.cycles)

    @property
    def posterior(self) -> NDArray[np.float64] | None:
        """The posterior, float64[lines of all boards] with the sum 1, or None if all counts are 0."""
        return joint_posterior(self.counts, self.cycles)


class EmulatedBoards:
    """Boards among which the lines of one machine are divided. Raises a BuildError if a limit is out of range."""

    def __init__(
        self, machines: Sequence[BM1Machine], *, target_count: int, max_cycles: int, stop: Stop
    ) -> None:
        highest = machines[0].parameters.target_count_max
        if not 1 <= target_count <= highest:
            bits = machines[0].parameters.counter_bits
            raise BuildError(
                f"counters of {bits} bits do not hold a target of {target_count}: expected 1 to {highest}"
            )
        if not 1 <= max_cycles <= CYCLES_MAX:
            raise BuildError(f"max_cycles is {max_cycles}, expected 1 to {CYCLES_MAX}")
        self.machines = tuple(machines)
        self.target_count = target_count
        self.max_cycles = max_cycles
        self.stop = stop
        self._ends = np.cumsum([machine.parameters.lines for machine in machines])[:-1]
        # Counters so wide that they never stop `run_for`. They do not change frames, which the target stops
        # earlier.
        self._kernels = [
            make_kernel(
                replace(machine, parameters=replace(machine.parameters, counter_bits=COUNTER_BITS_MAX)),
                boards=len(machines),
            )
            for machine in machines
        ]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the machines without their kernels, since each process makes its own."""
        make = partial(
            EmulatedBoards, target_count=self.target_count, max_cycles=self.max_cycles, stop=self.stop
        )
        return make, (self.machines,)

    @property
    def parameters(self) -> BM1Parameters:
        """Parameters of the first board. The other boards differ only in the number of lines."""
        return self.machines[0].parameters

    def parts(self, inputs: Inputs, prior: WrittenPrior) -> Iterator[tuple[Inputs, WrittenPrior]]:
        """Return a pair for each board: its inputs of a frame, and its part of the written prior or None.

        If each line has its own readings, the inputs are split among the boards. Otherwise each board gets all inputs.
        """
        count, ends = len(self.machines), self._ends
        of_boards = [inputs] * count if isinstance(inputs, tuple) else np.split(inputs, ends, axis=1)
        return zip(of_boards, [None] * count if prior is None else np.split(prior, ends), strict=True)

    def run(self, addresses: Inputs, prior_address: int, bank: int, prior: WrittenPrior = None) -> FrameRun:
        """Run a frame as the host does, with the stop rule of the boards.

        With `Stop.SLICES`, all boards run to a common last cycle. This last cycle is doubled until a counter reaches
        the target. With `Stop.OWN`, each board runs to its own end.
        """
        end = first_slice(self.target_count) if self.stop is Stop.SLICES else 0
        if end >= self.max_cycles:
            end = 0
        start = Start(
            addresses=(),
            prior_address=prior_address,
            target_count=self.target_count,
            max_cycles=self.max_cycles,
            bank=bank,
            run_until=end,
        )
        reasons = self._start(start, addresses, prior)
        while StopReason.SLICE in reasons and StopReason.OVERFLOW not in reasons:
            end = 2 * end if 2 * end < self.max_cycles else 0
            reasons = [
                kernel.resume(end) if reason is StopReason.SLICE else reason
                for kernel, reason in zip(self._kernels, reasons, strict=True)
            ]
        return self._shown()

    def run_for(
        self, addresses: Inputs, prior_address: int, bank: int, cycles: int, prior: WrittenPrior = None
    ) -> FrameRun:
        """Run each board for `cycles` cycles, without a target count.

        If every line of a board has a code 0 for the readings, no line can count, and the board does not run.
        """
        start = Start(
            addresses=(),
            prior_address=prior_address,
            target_count=2**COUNTER_BITS_MAX - 1,
            max_cycles=cycles,
            bank=bank,
        )
        self._start(start, addresses, prior)
        return self._shown()

    def _start(self, start: Start, addresses: Inputs, prior: WrittenPrior) -> list[StopReason]:
        parts = zip(self._kernels, self.parts(addresses, prior), strict=True)
        return [
            kernel.start(replace(start, addresses=own, prior_codes=codes)) for kernel, (own, codes) in parts
        ]

    def _shown(self) -> FrameRun:
        return FrameRun(
            tuple(kernel.counts for kernel in self._kernels),
            tuple(kernel.cycles for kernel in self._kernels),
            tuple(kernel.reason for kernel in self._kernels),
        )


def addressed_chances(
    machine: BM1Machine, addresses: Inputs, prior_address: int, prior: WrittenPrior = None
) -> NDArray[np.float64]:
    """Return the probability of a 1 in a cycle for each column and line: float64[columns, lines], the prior first."""
    frame = Start(
        addresses=addresses, prior_address=prior_address, prior_codes=prior, target_count=1, max_cycles=1
    )
    return decode_code(addressed_codes(machine, frame), machine.parameters.prob_bits)


def one_replica(machine: BM1Machine) -> BM1Machine:
    """Return a copy of `machine` that has only one replica."""
    return replace(machine, parameters=replace(machine.parameters, replicas=1))


def joined(machines: Sequence[BM1Machine]) -> BM1Machine:
    """Join the machines of all boards, and return the machine with all their lines."""
    first = machines[0]
    return BM1Machine(
        replace(first.parameters, lines=sum(machine.parameters.lines for machine in machines)),
        np.hstack([machine.prior for machine in machines]),
        tuple(
            np.hstack([machine.tables[column] for machine in machines]) for column in range(len(first.tables))
        ),
        first.rng_table,
    )
