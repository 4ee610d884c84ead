"""The reference BM1: one cycle at a time, as the thesis describes it; every other kernel is checked against it."""

import numpy as np
import numpy.typing as npt

from machines.bm1 import BM1Machine, Start, StopReason, addressed_codes, check_resume, check_start
from machines.parameters import RngReset
from machines.rng import random_numbers


class ReferenceBM1:
    """A machine (`machines.bm1.BM1Kernel`) of any kind that runs cycle by cycle (thesis 2.1.2, figure 2.4)."""

    def __init__(self, machine: BM1Machine) -> None:
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

    def resume(self, run_until: int) -> StopReason:
        """Run the next slice of the same frame, to cycle `run_until` at most; 0 for no further slices.

        Raises:
            StartError: The frame is over or there is none, or `run_until` is no later cycle; nothing has
                changed then.
        """
        check_resume(self._reason, self._cycles, run_until)
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
