"""The fast BM1 for shared LFSRs: 64 cycles to a word, and the same results as the reference, to the bit.

A cell's bits of 64 cycles are one word, which depends only on its column's generator and on its code, so that
cells of a column with the same code share it. A line is the AND of its words, and it counts their ones. Lines
with a code 0 can't count and are left out. Cycles are run in blocks of 512; a block that takes a counter to the
target is rolled back: the exact cycle is looked up in the words of the lines concerned, and the block is
counted again, up to there.

Where frames restart from a bank, the words of a frame's first cycles are constants of the machine: those that
were needed once are kept, and a later frame from that bank finds them ready.
"""

from collections.abc import Collection
from typing import Final

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
from machines.errors import MachineError
from machines.fast_code import (
    BLOCK_CYCLES,
    BLOCK_WORDS,
    CYCLES,
    NO_ROW,
    WORD_BITS,
    Generators,
    begin,
    begin_replicas,
    bit_tables,
    copy_counts,
    fill_blocks,
    first_frame,
    jump,
    make_frame,
    make_replicas,
    resume_replicas,
    run,
    store_of_codes,
    store_of_frame,
)
from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset
from machines.rng import LFSR, LFSRNumbers, Words, jump_tables

KEPT_BYTES: Final = 64 * 2**20
"""Most memory for kept words, in bytes for each machine. It is taken as it is filled."""

KEPT_CYCLES: Final = 2**17
"""Words of later cycles than this are never kept."""

PREPARED_CYCLES: Final = 2**14
"""So many of a frame's first cycles can have their words made beforehand."""


class FastBM1:
    """A machine (`machines.bm1.BM1Kernel`) with shared LFSRs that runs many cycles at a time (thesis 2.1.2).

    Args:
        machine: What to run.
        kept_bytes: Most memory for kept words; 0 keeps none.

    Raises:
        MachineError: The machine's generators are no LFSRs, or are not shared, or it has replicas.
    """

    def __init__(self, machine: BM1Machine, *, kept_bytes: int = KEPT_BYTES) -> None:
        check_one_machine(machine)
        _check_generators(machine)
        parameters = machine.parameters
        self._machine = machine
        self._period = LFSR(parameters.rng).period
        self._random_numbers = LFSRNumbers(parameters)
        self._bank_starts: dict[int, Words] = {}
        self._generators = Generators(
            jumps=jump_tables(parameters.rng, parameters.steps_per_clock).copy(),
            bits=bit_tables(parameters.rng, parameters.steps_per_clock, parameters.prob_bits).copy(),
        )
        occurring = _occurring_codes(machine)
        self._kept_blocks = _kept_blocks(parameters, int(occurring.sum()), kept_bytes)
        if self._kept_blocks:
            self._store = store_of_codes(occurring, parameters.rng_banks * self._kept_blocks)
        else:
            self._store = store_of_frame(occurring, parameters.lines * parameters.columns, 0)
        self._frame = make_frame(parameters, len(self._store.row_code))
        self._frames = 0
        self._live = 0
        self._used = 0
        self._first_slot = 0
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
        counts = np.zeros(self._machine.parameters.lines, dtype=np.uint32)
        counts[self._frame.lines[: self._live]] = self._frame.counts[: self._live]
        return counts

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
        """uint64[columns]: the generators' states, a copy."""
        states = np.empty_like(self._frame.starts)
        jump(self._generators.jumps, self._frame.starts, self._cycles % self._period, states)
        return states

    @property
    def kept_cycles(self) -> int:
        """How many of a frame's first cycles, of every bank, have their words kept."""
        return self._kept_blocks * BLOCK_CYCLES

    def prepare(self) -> None:
        """Make the words of every bank's first `PREPARED_CYCLES` cycles that are kept: a tenth of a second at most."""
        blocks = min(self._kept_blocks, PREPARED_CYCLES // BLOCK_CYCLES)
        for bank in range(self._machine.parameters.rng_banks if blocks else 0):
            self._restart(bank)
            fill_blocks(self._generators, self._store, self._frame, self._first_slot, blocks, self._period)
        self.reset()

    def reset(self) -> None:
        """Counters and cycles to 0, reason `NONE`, generators to the start of bank 0."""
        self._live = 0
        self._cycles = 0
        self._reason = StopReason.NONE
        self._restart(0)

    def start(self, start: Start) -> StopReason:
        """Run a new frame to its end, or to the end of its first slice.

        Raises:
            StartError: The start asks for what the machine does not have; nothing has changed then.
        """
        check_start(self._machine, start)
        parameters = self._machine.parameters
        if parameters.rng_reset is RngReset.BANK:
            self._restart(int(start.bank))
        else:
            self._frame.starts[:] = self.rng_state
        self._target_count = int(start.target_count)
        self._max_cycles = int(start.max_cycles)
        self._cycles = 0
        self._frames += 1
        codes = addressed_codes(self._machine, start)
        if self._kept_blocks == 0:
            # There may be more codes than could have rows for good: rows are the frame's own.
            last_codes = self._store.row_column[: self._used], self._store.row_code[: self._used]
            self._store.row_of_code[last_codes] = NO_ROW
        # One call for both: passing a machine's arrays costs as much as a block of its cycles.
        self._live, self._used, self._cycles, overflow = begin(
            codes,
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
        )
        self._reason = StopReason.IMPOSSIBLE if self._live == 0 else self._why_stopped(overflow)
        return self._reason

    def resume(self, run_until: int, halted: Collection[int] = ()) -> StopReason:
        """Run the next slice of the same frame, to cycle `run_until` at most; 0 for no further slices.

        Raises:
            StartError: The frame is over or there is none, or `run_until` is no later cycle; nothing has
                changed then.
        """
        check_resume(self._reason, self._cycles, run_until, halted)
        self._cycles, overflow = run(
            self._generators,
            self._store,
            self._frame,
            self._live,
            self._used,
            self._cycles,
            self._limit(int(run_until)),
            self._target_count,
            self._first_slot,
            self._kept_blocks,
            self._period,
        )
        self._reason = self._why_stopped(overflow)
        return self._reason

    def _restart(self, bank: int) -> None:
        """Put the generators to the start of a bank."""
        starts = self._bank_starts.get(bank)
        if starts is None:
            starts = self._bank_starts[bank] = self._random_numbers.restart(bank)
        self._frame.starts[:] = starts
        self._first_slot = bank * self._kept_blocks

    def _limit(self, run_until: int) -> int:
        """The cycle at which a slice ends."""
        return min(run_until, self._max_cycles) if run_until else self._max_cycles

    def _why_stopped(self, overflow: bool) -> StopReason:
        if overflow:
            return StopReason.OVERFLOW
        return StopReason.MAX_CYCLES if self._cycles == self._max_cycles else StopReason.SLICE


class FastReplicas:
    """Replicas of a machine (`machines.bm1.BM1Kernel`) with shared LFSRs, many cycles at a time (thesis 4.4).

    A cell's bits depend on its column, its code and the cycle, not on the replica. So each replica is run to its own
    end, one after the other, and what one has needed of the streams the next ones find ready.

    Args:
        machine: What to run.
        kept_bytes: Most memory for kept words; 0 keeps none.

    Raises:
        MachineError: The machine's generators are no LFSRs, or are not shared.
    """

    def __init__(self, machine: BM1Machine, *, kept_bytes: int = KEPT_BYTES) -> None:
        _check_generators(machine)
        parameters = machine.parameters
        self._machine = machine
        self._period = LFSR(parameters.rng).period
        self._random_numbers = LFSRNumbers(parameters)
        self._bank_starts: dict[int, Words] = {}
        self._generators = Generators(
            jumps=jump_tables(parameters.rng, parameters.steps_per_clock).copy(),
            bits=bit_tables(parameters.rng, parameters.steps_per_clock, parameters.prob_bits).copy(),
        )
        occurring = _occurring_codes(machine)
        rows = int(occurring.sum())
        self._kept_blocks = _kept_blocks(parameters, rows, kept_bytes)
        # Where a bank's words cannot be kept from frame to frame, the replicas still share the frame's.
        self._of_frame = self._kept_blocks == 0
        if self._of_frame:
            cells = parameters.replicas * parameters.lines * parameters.columns
            self._kept_blocks = _blocks_in(kept_bytes, min(rows, cells))
            self._store = store_of_frame(occurring, cells, self._kept_blocks)
        else:
            self._store = store_of_codes(occurring, parameters.rng_banks * self._kept_blocks)
        self._replicas = make_replicas(parameters, len(self._store.row_code))
        self._frames = 0
        self._rows = 0
        self._first_slot = 0
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
        parameters = self._machine.parameters
        counts = np.zeros((parameters.replicas, parameters.lines), dtype=np.uint32)
        copy_counts(self._replicas, counts)
        return counts.reshape(parameters.count_shape)

    @property
    def cycles(self) -> int:
        """Cycles that the replica ran that ran longest."""
        return int(self._replicas.outcome[:, CYCLES].max())

    @property
    def reason(self) -> StopReason:
        """Why the board stands still."""
        return joint_reason(self._reasons, self._halted)

    @property
    def replica_cycles(self) -> tuple[int, ...]:
        """Cycles that each replica ran."""
        return tuple(self._replicas.outcome[:, CYCLES].tolist())

    @property
    def replica_reasons(self) -> tuple[StopReason, ...]:
        """Why each replica stands still."""
        return tuple(self._reasons)

    @property
    def rng_state(self) -> npt.NDArray[np.uint64]:
        """uint64[columns]: the generators' states, a copy."""
        states = np.empty_like(self._replicas.starts)
        jump(self._generators.jumps, self._replicas.starts, self.cycles % self._period, states)
        return states

    @property
    def kept_cycles(self) -> int:
        """How many of a frame's first cycles, of every bank, have their words kept for the frames that follow."""
        return 0 if self._of_frame else self._kept_blocks * BLOCK_CYCLES

    def prepare(self) -> None:
        """Make the words of every bank's first `PREPARED_CYCLES` cycles that are kept: a tenth of a second at most."""
        blocks = 0 if self._of_frame else min(self._kept_blocks, PREPARED_CYCLES // BLOCK_CYCLES)
        for bank in range(self._machine.parameters.rng_banks if blocks else 0):
            self._restart(bank)
            first = first_frame(self._replicas)
            fill_blocks(self._generators, self._store, first, self._first_slot, blocks, self._period)
        self.reset()

    def reset(self) -> None:
        """Counters and cycles to 0, reasons `NONE`, generators to the start of bank 0."""
        self._forget_words()
        self._replicas.outcome[:] = 0
        self._reasons = [StopReason.NONE] * self._machine.parameters.replicas
        self._halted: set[int] = set()
        self._restart(0)

    def start(self, start: Start) -> StopReason:
        """Run a new frame to its end, or to the end of its first slice.

        Raises:
            StartError: The start asks for what the machine does not have; nothing has changed then.
        """
        check_start(self._machine, start)
        parameters = self._machine.parameters
        states = self.rng_state if parameters.rng_reset is RngReset.FREE else None
        self._forget_words()
        if states is None:
            self._restart(int(start.bank))
        else:
            self._replicas.starts[:] = states
        self._target_count = int(start.target_count)
        self._max_cycles = int(start.max_cycles)
        codes = addressed_codes(self._machine, start)
        self._rows = begin_replicas(
            codes.reshape(parameters.replicas, parameters.columns, parameters.lines),
            parameters.ones_code,
            self._generators,
            self._store,
            self._replicas,
            self._frames + 1,
            self._limit(int(start.run_until)),
            self._target_count,
            self._first_slot,
            self._kept_blocks,
            self._period,
            self._of_frame,
        )
        self._frames += parameters.replicas
        self._halted = set()
        self._reasons = [self._why_stopped(*row) for row in self._replicas.outcome.tolist()]
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
        going = np.array(
            [at for at, reason in enumerate(self._reasons) if reason is StopReason.SLICE and at not in halts],
            dtype=np.int64,
        )
        resume_replicas(
            self._generators,
            self._store,
            self._replicas,
            going,
            self._limit(int(run_until)),
            self._target_count,
            self._first_slot,
            self._kept_blocks,
            self._period,
        )
        for at in going.tolist():
            self._reasons[at] = self._why_stopped(*self._replicas.outcome[at].tolist())
        return self.reason

    def _forget_words(self) -> None:
        """Take back the rows that the last frame was given; bank's words stay."""
        if not self._of_frame or not self._rows:
            return
        given = self._store.row_column[: self._rows], self._store.row_code[: self._rows]
        self._store.row_of_code[given] = NO_ROW
        blocks = min(-(-self.cycles // BLOCK_CYCLES), self._kept_blocks)
        self._store.filled[:blocks, : self._rows] = False
        self._rows = 0

    def _restart(self, bank: int) -> None:
        """Put the generators to the start of a bank."""
        starts = self._bank_starts.get(bank)
        if starts is None:
            starts = self._bank_starts[bank] = self._random_numbers.restart(bank)
        self._replicas.starts[:] = starts
        self._first_slot = 0 if self._of_frame else bank * self._kept_blocks

    def _limit(self, run_until: int) -> int:
        """The cycle at which a slice ends."""
        return min(run_until, self._max_cycles) if run_until else self._max_cycles

    def _why_stopped(self, live: int, _used: int, cycles: int, overflow: int) -> StopReason:
        if live == 0:
            return StopReason.IMPOSSIBLE
        if overflow:
            return StopReason.OVERFLOW
        return StopReason.MAX_CYCLES if cycles == self._max_cycles else StopReason.SLICE


def warm_up() -> None:
    """Compile, or load from the cache, all that runs in machine code: some 5 s the first time, then 0.2 s."""
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


def _check_generators(machine: BM1Machine) -> None:
    """Refuse generators that the fast kernels do not know."""
    parameters = machine.parameters
    if not parameters.shared or parameters.rng.lfsr_bits is None:
        raise MachineError(
            f"The fast kernel runs shared LFSRs only; this machine has rng = {parameters.rng}, "
            f"shared = {str(parameters.shared).lower()}: use the reference."
        )


def _kept_blocks(parameters: BM1Parameters, rows: int, kept_bytes: int) -> int:
    """How many blocks of every bank fit into the memory for kept words."""
    if parameters.rng_reset is RngReset.FREE:
        return 0  # a frame's states are not a bank's, and hardly ever come again
    return _blocks_in(kept_bytes, rows * parameters.rng_banks)


def _blocks_in(kept_bytes: int, rows: int) -> int:
    """How many blocks of so many rows fit into a memory."""
    block_bytes = max(rows, 1) * (BLOCK_WORDS * WORD_BITS // 8 + 1)
    return min(kept_bytes // block_bytes, KEPT_CYCLES // BLOCK_CYCLES)
