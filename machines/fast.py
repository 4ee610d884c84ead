"""The fast BM1 for shared LFSRs: 64 cycles to a word, and the same results as the reference, to the bit.

A cell's bits of 64 cycles are one word, which depends only on its column's generator and on its code, so that
cells of a column with the same code share it, in all replicas. A line is the AND of its words, and it counts their
ones. Lines with a code 0 can't count and are left out. Cycles are run in blocks of 512. If a block takes a counter
to the target, the exact cycle is looked up in the words of the lines concerned, and the block is counted again, up
to there. Each replica is run to its own end, one after the other.

Where frames restart from a bank, the words of a frame's first cycles are constants of the machine: a frame keeps
the words that it made, and later frames from that bank use them.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from machines.bm1 import BM1Machine, Start, StopReason, addressed_codes
from machines.errors import MachineError
from machines.fast_code import (
    BLOCK_CYCLES,
    BLOCK_WORDS,
    NO_ROW,
    WORD_BITS,
    Generators,
    begin,
    bit_tables,
    fill_blocks,
    jump,
    make_frame,
    resume,
    store_of_codes,
    store_of_frame,
)
from machines.kernel import BM1Kernel
from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset
from machines.rng import LFSR, LFSRNumbers, Words, jump_tables

KEPT_BYTES: Final = 64 * 2**20
"""Most memory for kept words, in bytes for each machine; untouched memory is not allocated."""

KEPT_CYCLES: Final = 2**17
"""Cycle from which on no words are kept."""

PREPARED_CYCLES: Final = 2**14
"""Number of a frame's first cycles whose words `prepare` makes."""


class FastBM1(BM1Kernel):
    """A machine with shared LFSRs that runs many cycles at a time (thesis 2.1.2 and 4.4).

    Args:
        machine: The machine to run.
        kept_bytes: Most memory for kept words; 0 keeps none.

    Raises:
        MachineError: The machine's generators are not LFSRs, or are not shared.
    """

    def __init__(self, machine: BM1Machine, *, kept_bytes: int = KEPT_BYTES) -> None:
        super().__init__(machine)
        parameters = machine.parameters
        if not parameters.shared or parameters.rng.lfsr_bits is None:
            raise MachineError(
                f"The fast kernel runs shared LFSRs only; this machine has rng = {parameters.rng}, "
                f"shared = {str(parameters.shared).lower()}: use the reference."
            )
        self._period = LFSR(parameters.rng).period
        self._random_numbers = LFSRNumbers(parameters)
        self._bank_starts: dict[int, Words] = {}
        self._generators = Generators(
            jumps=jump_tables(parameters.rng, parameters.steps_per_clock).copy(),
            bits=bit_tables(parameters.rng, parameters.steps_per_clock, parameters.prob_bits).copy(),
        )
        occurring = _occurring_codes(machine)
        rows = int(occurring.sum())
        # the states of free generators are not a bank's, and hardly ever come again
        banks = parameters.rng_banks if parameters.rng_reset is RngReset.BANK else 0
        self._kept_blocks = _blocks_in(kept_bytes, rows * banks) if banks else 0
        # Where a bank's words cannot be kept from frame to frame, several replicas still share the frame's.
        self._of_frame = self._kept_blocks == 0
        if self._of_frame:
            cells = parameters.replicas * parameters.lines * parameters.columns
            if parameters.replicas > 1:
                self._kept_blocks = _blocks_in(kept_bytes, min(rows, cells))
            self._store = store_of_frame(occurring, cells, self._kept_blocks)
        else:
            self._store = store_of_codes(occurring, banks * self._kept_blocks)
        self._frame = make_frame(parameters, len(self._store.row_code))
        self._frames = 1  # a row that was never used has 0
        self._rows = 0
        self._first_slot = 0
        self.reset()

    @property
    def counts(self) -> npt.NDArray[np.uint32]:
        """The counters, a copy: uint32[lines], with several replicas uint32[replicas, lines]."""
        return self._frame.counts.reshape(self._machine.parameters.count_shape).copy()

    @property
    def rng_state(self) -> npt.NDArray[np.uint64]:
        """uint64[columns]: the generators' states, a copy."""
        states = np.empty_like(self._frame.starts)
        jump(self._generators.jumps, self._frame.starts, self.cycles % self._period, states)
        return states

    @property
    def kept_cycles(self) -> int:
        """Number of a frame's first cycles, in every bank, whose words are kept for later frames."""
        return 0 if self._of_frame else self._kept_blocks * BLOCK_CYCLES

    def prepare(self) -> None:
        """Make the words of every bank's first `PREPARED_CYCLES` cycles that are kept: a tenth of a second at most."""
        blocks = min(self.kept_cycles, PREPARED_CYCLES) // BLOCK_CYCLES
        for bank in range(self._machine.parameters.rng_banks if blocks else 0):
            self._restart(bank)
            fill_blocks(self._generators, self._store, self._frame, self._first_slot, blocks, self._period)
        self.reset()

    def _reset(self) -> None:
        self._free_rows()
        self._frame.counts[:] = 0
        self._restart(0)

    def _start(self, start: Start) -> None:
        parameters = self._machine.parameters
        if parameters.rng_reset is RngReset.BANK:
            self._restart(int(start.bank))
        else:
            self._frame.starts[:] = self.rng_state
        self._free_rows()
        codes = addressed_codes(self._machine, start)
        # One call for all: passing a machine's arrays costs as much as a block of its cycles.
        self._rows = begin(
            codes.reshape(-1, parameters.columns, parameters.lines),
            parameters.ones_code,
            self._generators,
            self._store,
            self._frame,
            self._frames,
            self._limit(int(start.run_until)),
            self._target_count,
            self._first_slot,
            self._kept_blocks,
            self._period,
            self._of_frame,
        )
        self._frames += parameters.replicas
        self._take_outcome()

    def _resume(self, going: list[int], run_until: int) -> None:
        resume(
            self._generators,
            self._store,
            self._frame,
            np.array(going, dtype=np.int64),
            self._limit(run_until),
            self._target_count,
            self._first_slot,
            self._kept_blocks,
            self._period,
        )
        self._take_outcome()

    def _take_outcome(self) -> None:
        """Set cycles and reasons from the frame's outcome; a halted replica keeps its own."""
        for replica, (live, _, cycles, overflow) in enumerate(self._frame.outcome.tolist()):
            self._cycles[replica] = cycles
            if live == 0:
                self._reasons[replica] = StopReason.IMPOSSIBLE
            elif overflow:
                self._reasons[replica] = StopReason.OVERFLOW
            elif cycles == self._max_cycles:
                self._reasons[replica] = StopReason.MAX_CYCLES
            else:
                self._reasons[replica] = StopReason.SLICE

    def _free_rows(self) -> None:
        """Take back the rows that the last frame assigned, and their words; the rows of banks stay."""
        if not self._rows:
            return
        assigned = self._store.row_column[: self._rows], self._store.row_code[: self._rows]
        self._store.row_of_code[assigned] = NO_ROW
        blocks = min(-(-self.cycles // BLOCK_CYCLES), self._kept_blocks)
        self._store.filled[:blocks, : self._rows] = False
        self._rows = 0

    def _restart(self, bank: int) -> None:
        """Set the generators to the start of a bank."""
        starts = self._bank_starts.get(bank)
        if starts is None:
            starts = self._bank_starts[bank] = self._random_numbers.restart(bank)
        self._frame.starts[:] = starts
        self._first_slot = 0 if self._of_frame else bank * self._kept_blocks

    def _limit(self, run_until: int) -> int:
        """Return the cycle at which a slice ends."""
        return min(run_until, self._max_cycles) if run_until else self._max_cycles


def warm_up() -> None:
    """Compile everything, or load it from the cache: some 5 s the first time, then 0.2 s."""
    parameters = BM1Parameters(lines=1, sensor_bits=(), rng=RngKind.LFSR16)
    kernel = FastBM1(BM1Machine(parameters, np.full((1, 1), 128, dtype=np.uint16), ()))
    kernel.start(Start(addresses=(), target_count=2, max_cycles=2, run_until=1))
    kernel.resume(0)
    kernel.prepare()
    _ = kernel.rng_state


def _occurring_codes(machine: BM1Machine) -> npt.NDArray[np.bool_]:
    """bool[columns, 2**prob_bits]: the codes that a frame may address, but for 0 and all-ones, which need no words."""
    parameters = machine.parameters
    occurring = np.zeros((parameters.columns, 1 << parameters.prob_bits), dtype=np.bool_)
    if parameters.prior_mode is PriorMode.WRITTEN:
        occurring[0] = True
    if not parameters.has_tables:
        occurring[1:] = True
    for column, table in enumerate((machine.prior, *machine.tables)):
        occurring[column, table.ravel()] = True
    occurring[:, [0, parameters.ones_code]] = False
    return occurring


def _blocks_in(kept_bytes: int, rows: int) -> int:
    """Return the number of blocks of this many rows that fit into a memory."""
    block_bytes = max(rows, 1) * (BLOCK_WORDS * WORD_BITS // 8 + 1)
    return min(kept_bytes // block_bytes, KEPT_CYCLES // BLOCK_CYCLES)
