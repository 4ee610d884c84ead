"""The fast BM1 for shared LFSRs: 64 cycles per word, with the same results as the reference, bit for bit.

The bits of a cell in 64 cycles form one word. The word depends only on the cell's code and on the generator of the
cell's column. So all cells of a column with equal codes share one word, in all replicas. The kernel ANDs the words of
a line's cells, and counts the ones. A line with a code 0 cannot count, and is omitted.

Cycles are run in blocks of 512. If a counter reaches the target in a block, the words of the counter's line show the
exact cycle. The kernel then counts the block again up to this cycle. Replicas are run one after the other.

If frames restart the generators from a bank, the words of the first cycles are equal in all frames with this bank. The
kernel caches these words.
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
"""Maximum size in bytes of a machine's cache of random bits. The operating system allocates only the used part."""

KEPT_CYCLES: Final = 2**17
"""The random bits of at most this many cycles, counted from the start of a frame, are cached."""

PREPARED_CYCLES: Final = 2**14
"""`prepare` computes the random bits of at most this many cycles, counted from the start of a frame."""


class FastBM1(BM1Kernel):
    """A kernel for shared LFSRs that runs many cycles at a time (thesis 2.1.2 and 4.4).

    If each frame restarts the generators from a bank of seeds, all frames with this bank begin with the same random
    bits. A cache of at most `kept_bytes` bytes keeps these bits between frames. If frames do not restart the
    generators, or if the cache cannot hold one block of cycles for every bank, each frame computes its own bits.

    Raises:
        MachineError: The generators of the machine are not LFSRs, or are not shared.
    """

    def __init__(self, machine: BM1Machine, *, kept_bytes: int = KEPT_BYTES) -> None:
        super().__init__(machine)
        parameters = machine.parameters
        if not parameters.shared or parameters.rng.lfsr_bits is None:
            raise MachineError(
                f"The fast kernel supports only shared LFSRs; this machine has rng = {parameters.rng}, "
                f"shared = {str(parameters.shared).lower()}; use the reference kernel."
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
        # free generators do not start from a bank, and their states hardly ever recur
        banks = parameters.rng_banks if parameters.rng_reset is RngReset.BANK else 0
        self._kept_blocks = _blocks_in(kept_bytes, rows * banks) if banks else 0
        # Even without a cache between frames, several replicas share the words of a frame.
        self._of_frame = self._kept_blocks == 0
        if self._of_frame:
            cells = parameters.replicas * parameters.lines * parameters.columns
            if parameters.replicas > 1:
                self._kept_blocks = _blocks_in(kept_bytes, min(rows, cells))
            self._store = store_of_frame(occurring, cells, self._kept_blocks)
        else:
            self._store = store_of_codes(occurring, banks * self._kept_blocks)
        self._frame = make_frame(parameters, len(self._store.row_code))
        self._frames = 1  # 0 for a row that was never used
        self._rows = 0
        self._first_slot = 0
        self.reset()

    @property
    def counts(self) -> npt.NDArray[np.uint32]:
        """A copy of the counters: uint32[lines], or uint32[replicas, lines] if there are several replicas."""
        return self._frame.counts.reshape(self.machine.parameters.count_shape).copy()

    @property
    def rng_state(self) -> npt.NDArray[np.uint64]:
        """A copy of the generators' states: uint64[columns]."""
        states = np.empty_like(self._frame.starts)
        jump(self._generators.jumps, self._frame.starts, self.cycles % self._period, states)
        return states

    @property
    def kept_cycles(self) -> int:
        """Number of cycles for which the cache can keep random bits between frames, for each bank of seeds.

        The bits are those of the first cycles of a frame. 0 means that no bits are kept between frames.
        """
        return 0 if self._of_frame else self._kept_blocks * BLOCK_CYCLES

    def prepare(self) -> None:
        """Cache the bits of the first `PREPARED_CYCLES` cycles of every bank, or fewer if the cache is smaller."""
        blocks = min(self.kept_cycles, PREPARED_CYCLES) // BLOCK_CYCLES
        for bank in range(self.machine.parameters.rng_banks if blocks else 0):
            self._restart(bank)
            fill_blocks(self._generators, self._store, self._frame, self._first_slot, blocks, self._period)
        self.reset()

    def _reset(self) -> None:
        self._free_rows()
        self._frame.counts[:] = 0
        self._restart(0)

    def _start(self, start: Start) -> None:
        parameters = self.machine.parameters
        if parameters.rng_reset is RngReset.BANK:
            self._restart(int(start.bank))
        else:
            self._frame.starts[:] = self.rng_state
        self._free_rows()
        codes = addressed_codes(self.machine, start)
        # One call for all replicas, because passing a machine's arrays costs as much as a block of its
        # cycles.
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
        """Set the cycles and the stop reasons of the replicas from the frame's outcome.

        A halted replica keeps the cycles and the stop reason from before it was halted.
        """
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
        """Free the rows of words that were assigned for the last frame only; cached rows remain."""
        if not self._rows:
            return
        assigned = self._store.row_column[: self._rows], self._store.row_code[: self._rows]
        self._store.row_of_code[assigned] = NO_ROW
        blocks = min(-(-self.cycles // BLOCK_CYCLES), self._kept_blocks)
        self._store.filled[:blocks, : self._rows] = False
        self._rows = 0

    def _restart(self, bank: int) -> None:
        """Restart the generators from a bank."""
        starts = self._bank_starts.get(bank)
        if starts is None:
            starts = self._bank_starts[bank] = self._random_numbers.restart(bank)
        self._frame.starts[:] = starts
        self._first_slot = 0 if self._of_frame else bank * self._kept_blocks

    def _limit(self, run_until: int) -> int:
        """Return the cycle at which a slice ends."""
        return min(run_until, self._max_cycles) if run_until else self._max_cycles


def warm_up() -> None:
    """Compile the kernel (about 5 s), or load it from numba's cache on disk (about 0.2 s)."""
    # with the generator that a build chooses by default, because its tables are then cached, too
    parameters = BM1Parameters(lines=1, sensor_bits=(), rng=RngKind.LFSR32)
    kernel = FastBM1(BM1Machine(parameters, np.full((1, 1), 128, dtype=np.uint16), ()))
    kernel.start(Start(addresses=(), target_count=2, max_cycles=2, run_until=1))
    kernel.resume(0)
    kernel.prepare()
    _ = kernel.rng_state


def _occurring_codes(machine: BM1Machine) -> npt.NDArray[np.bool_]:
    """Return the codes that a frame may use, except 0 and all-ones, as bool[columns, 2**prob_bits]."""
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
    """Return how many blocks of `rows` rows fit into `kept_bytes` bytes."""
    block_bytes = max(rows, 1) * (BLOCK_WORDS * WORD_BITS // 8 + 1)
    return min(kept_bytes // block_bytes, KEPT_CYCLES // BLOCK_CYCLES)
