"""The reference BM1: one cycle at a time, as the thesis describes it; every other kernel is checked against it."""

from collections.abc import Collection

import numpy as np
import numpy.typing as npt

from machines.bm1 import (
    BM1Machine,
    Start,
    StopReason,
    addressed_codes,
    check_one_machine,
    check_resume,
    check_start,
    joint_reason,
)
from machines.parameters import RngReset
from machines.rng import random_numbers


class ReferenceBM1:
    """A machine (`machines.bm1.BM1Kernel`) of any kind that runs cycle by cycle (thesis 2.1.2, figure 2.4).

    Raises:
        MachineError: It has replicas: those are `ReferenceReplicas`.
    """

    def __init__(self, machine: BM1Machine) -> None:
        check_one_machine(machine)
        self._machine = machine
        self._random_numbers = random_numbers(machine)
        self._codes = np.zeros((machine.parameters.lines, machine.parameters.columns), dtype=np.uint16)
        self._target_count = 1
        self._max_cycles = 1
        self.reset()

    @property
    def machine(self) -> BM1Machine:
        """The machine that this kernel runs."""
        return self._machine

    @property
    def counts(self) -> npt.NDArray[np.uint32]:
        """uint32[lines]: the counters as they stand, a copy."""
        return self._counts.copy()

    @property
    def cycles(self) -> int:
        """Cycles run in this frame."""
        return self._cycles

    @property
    def reason(self) -> StopReason:
        """Why the machine stands still."""
        return self._reason

    @property
    def replica_cycles(self) -> tuple[int, ...]:
        """The only one's."""
        return (self._cycles,)

    @property
    def replica_reasons(self) -> tuple[StopReason, ...]:
        """The only one's."""
        return (self._reason,)

    @property
    def rng_state(self) -> npt.NDArray[np.uint64]:
        """The generators' states, a copy: uint64[columns], or uint64[lines, columns] if unshared."""
        return self._states.copy()

    def prepare(self) -> None:
        """There is nothing that could be done beforehand."""
        self.reset()

    def reset(self) -> None:
        """Counters and cycles to 0, reason `NONE`, generators to the start of bank 0."""
        self._counts = np.zeros(self._machine.parameters.lines, dtype=np.uint32)
        self._cycles = 0
        self._reason = StopReason.NONE
        self._states = self._random_numbers.restart(0)

    def start(self, start: Start) -> StopReason:
        """Run a new frame to its end, or to the end of its first slice.

        Raises:
            StartError: The start asks for what the machine does not have; nothing has changed then.
        """
        check_start(self._machine, start)
        self._codes = addressed_codes(self._machine, start).T
        self._target_count = int(start.target_count)
        self._max_cycles = int(start.max_cycles)
        self._counts[:] = 0
        self._cycles = 0
        if self._machine.parameters.rng_reset is RngReset.BANK:
            self._states = self._random_numbers.restart(int(start.bank))
        if (self._codes == 0).any(axis=1).all():
            self._reason = StopReason.IMPOSSIBLE
        else:
            self._run(int(start.run_until))
        return self._reason

    def resume(self, run_until: int, halted: Collection[int] = ()) -> StopReason:
        """Run the next slice of the same frame, to cycle `run_until` at most; 0 for no further slices.

        Raises:
            StartError: The frame is over or there is none, or `run_until` is no later cycle; nothing has
                changed then.
        """
        check_resume(self._reason, self._cycles, run_until, halted)
        self._run(int(run_until))
        return self._reason

    def _run(self, run_until: int) -> None:
        """Cycle until a line overflows, or the frame's or the slice's last cycle was run."""
        while True:
            self._cycle()
            if (self._counts == self._target_count).any():
                self._reason = StopReason.OVERFLOW
            elif self._cycles == self._max_cycles:
                self._reason = StopReason.MAX_CYCLES
            elif self._cycles == run_until:
                self._reason = StopReason.SLICE
            else:
                continue
            return

    def _cycle(self) -> None:
        """Every cell makes its bit, every line ANDs its cells and counts, and every generator steps."""
        ones = self._machine.parameters.ones_code
        random = self._random_numbers.show(self._states)
        bits = (random < self._codes) | (self._codes == ones)
        self._counts += bits.all(axis=1)
        self._states = self._random_numbers.clock(self._states)
        self._cycles += 1


class ReferenceReplicas:
    """Replicas of a machine (`machines.bm1.BM1Kernel`) around one set of generators, cycle by cycle (thesis 4.4).

    In every cycle all of them see the same random numbers. Each compares these with its own codes, counts by itself and
    stops by itself; the generators step until the last one has stopped.
    """

    def __init__(self, machine: BM1Machine) -> None:
        parameters = machine.parameters
        self._machine = machine
        self._random_numbers = random_numbers(machine)
        self._codes = np.zeros((parameters.replicas, parameters.lines, parameters.columns), dtype=np.uint16)
        self._target_count = 1
        self._max_cycles = 1
        self.reset()

    @property
    def machine(self) -> BM1Machine:
        """The machine that this kernel runs."""
        return self._machine

    @property
    def counts(self) -> npt.NDArray[np.uint32]:
        """uint32[lines], or uint32[replicas, lines]: the counters as they stand, a copy."""
        return self._counts.reshape(self._machine.parameters.count_shape).copy()

    @property
    def cycles(self) -> int:
        """Cycles that the replica ran that ran longest."""
        return max(self._cycles)

    @property
    def reason(self) -> StopReason:
        """Why the board stands still."""
        return joint_reason(self._reasons, self._halted)

    @property
    def replica_cycles(self) -> tuple[int, ...]:
        """Cycles that each replica ran."""
        return tuple(self._cycles)

    @property
    def replica_reasons(self) -> tuple[StopReason, ...]:
        """Why each replica stands still."""
        return tuple(self._reasons)

    @property
    def rng_state(self) -> npt.NDArray[np.uint64]:
        """The generators' states, a copy: uint64[columns], or uint64[lines, columns] if unshared."""
        return self._states.copy()

    def prepare(self) -> None:
        """There is nothing that could be done beforehand."""
        self.reset()

    def reset(self) -> None:
        """Counters and cycles to 0, reasons `NONE`, generators to the start of bank 0."""
        parameters = self._machine.parameters
        self._counts = np.zeros((parameters.replicas, parameters.lines), dtype=np.uint32)
        self._cycles = [0] * parameters.replicas
        self._reasons = [StopReason.NONE] * parameters.replicas
        self._halted: set[int] = set()
        self._states = self._random_numbers.restart(0)

    def start(self, start: Start) -> StopReason:
        """Run a new frame to its end, or to the end of its first slice.

        Raises:
            StartError: The start asks for what the machine does not have; nothing has changed then.
        """
        check_start(self._machine, start)
        parameters = self._machine.parameters
        codes = addressed_codes(self._machine, start)
        self._codes = codes.reshape(parameters.replicas, *codes.shape[-2:]).transpose(0, 2, 1)
        self._target_count = int(start.target_count)
        self._max_cycles = int(start.max_cycles)
        self._counts[:] = 0
        self._cycles = [0] * parameters.replicas
        self._halted = set()
        if parameters.rng_reset is RngReset.BANK:
            self._states = self._random_numbers.restart(int(start.bank))
        impossible = (self._codes == 0).any(axis=2).all(axis=1)
        self._reasons = [StopReason.IMPOSSIBLE if never else StopReason.SLICE for never in impossible]
        self._run(int(start.run_until))
        return self.reason

    def resume(self, run_until: int, halted: Collection[int] = ()) -> StopReason:
        """Run the next slice of the same frame, to cycle `run_until` at most; 0 for no further slices.

        Raises:
            StartError: The frame is over or there is none, or `run_until` is no later cycle, or no replica is left
                that could go on; nothing has changed then.
        """
        halts = self._halted | set(halted)
        reason = joint_reason(self._reasons, halts)
        check_resume(reason, self.cycles, run_until, halted, len(self._reasons))
        self._halted = halts
        self._run(int(run_until))
        return self.reason

    def _run(self, run_until: int) -> None:
        """Cycle until every replica has stopped, or all that have not were run to the slice's last cycle."""
        running = [
            at
            for at, reason in enumerate(self._reasons)
            if reason is StopReason.SLICE and at not in self._halted
        ]
        while running:
            self._cycle(running)
            going = []
            for at in running:
                if (self._counts[at] == self._target_count).any():
                    self._reasons[at] = StopReason.OVERFLOW
                elif self._cycles[at] == self._max_cycles:
                    self._reasons[at] = StopReason.MAX_CYCLES
                elif self._cycles[at] != run_until:
                    going.append(at)
            running = going

    def _cycle(self, running: list[int]) -> None:
        """Every cell of the running replicas makes its bit, every line ANDs and counts, every generator steps."""
        ones = self._machine.parameters.ones_code
        random = self._random_numbers.show(self._states)
        codes = self._codes[running]
        bits = (random < codes) | (codes == ones)
        self._counts[running] += bits.all(axis=2)
        self._states = self._random_numbers.clock(self._states)
        for at in running:
            self._cycles[at] += 1
