"""The reference kernel of a BM1.

It runs one cycle at a time, as in the thesis. Tests compare the other kernels with it.
"""

import numpy as np
import numpy.typing as npt

from machines.bm1 import BM1Machine, Start, StopReason, addressed_codes
from machines.kernel import BM1Kernel
from machines.parameters import RngReset
from machines.rng import random_numbers


class ReferenceBM1(BM1Kernel):
    """A kernel that computes any BM1 cycle by cycle (thesis 2.1.2, figure 2.4).

    In every cycle, all replicas use the same random numbers. Each replica has its own codes and counters, and
    stops independently of other replicas. The generators step until the last replica has stopped.
    """

    def __init__(self, machine: BM1Machine) -> None:
        super().__init__(machine)
        parameters = machine.parameters
        self._random_numbers = random_numbers(machine)
        self._codes = np.zeros((parameters.replicas, parameters.lines, parameters.columns), dtype=np.uint16)
        self._counts = np.zeros((parameters.replicas, parameters.lines), dtype=np.uint32)
        self.reset()

    @property
    def counts(self) -> npt.NDArray[np.uint32]:
        """A copy of the counters: uint32[lines], or uint32[replicas, lines] with several replicas."""
        return self._counts.reshape(self.machine.parameters.count_shape).copy()

    @property
    def rng_state(self) -> npt.NDArray[np.uint64]:
        """A copy of the generators' states: uint64[columns], or uint64[lines, columns] with a generator per cell."""
        return self._states.copy()

    def _reset(self) -> None:
        self._counts[:] = 0
        self._states = self._random_numbers.restart(0)

    def _start(self, start: Start) -> None:
        parameters = self.machine.parameters
        by_column = addressed_codes(self.machine, start).reshape(
            parameters.replicas, parameters.columns, parameters.lines
        )
        self._codes = by_column.swapaxes(1, 2)
        self._counts[:] = 0
        self._cycles = [0] * parameters.replicas
        if parameters.rng_reset is RngReset.BANK:
            self._states = self._random_numbers.restart(int(start.bank))
        impossible = (self._codes == 0).any(axis=2).all(axis=1)
        self._reasons = [StopReason.IMPOSSIBLE if never else StopReason.SLICE for never in impossible]
        going = [replica for replica, never in enumerate(impossible) if not never]
        self._resume(going, int(start.run_until))

    def _resume(self, going: list[int], run_until: int) -> None:
        """Run until each replica has overflowed or has reached the last cycle of the frame or slice."""
        running = going
        while running:
            self._cycle(running)
            going = []
            for replica in running:
                if (self._counts[replica] == self._target_count).any():
                    self._reasons[replica] = StopReason.OVERFLOW
                elif self._cycles[replica] == self._max_cycles:
                    self._reasons[replica] = StopReason.MAX_CYCLES
                elif self._cycles[replica] != run_until:
                    going.append(replica)
            running = going

    def _cycle(self, running: list[int]) -> None:
        """Compute the bits of all cells, count the lines of the running replicas, and step all generators."""
        ones = self.machine.parameters.ones_code
        random = self._random_numbers.show(self._states)
        bits = (random < self._codes) | (self._codes == ones)
        counting = bits.all(axis=2)
        self._states = self._random_numbers.clock(self._states)
        for replica in running:
            self._counts[replica] += counting[replica]
            self._cycles[replica] += 1
