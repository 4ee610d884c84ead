"""The fast BM1 for shared LFSRs: 64 cycles to a word, and the same results as the reference, to the bit.

A cell's bits of 64 cycles are one word, which depends only on its column's generator and on its code, so that
cells of a column with the same code share it. A line is the AND of its words, and it counts their ones. Lines
with a code 0 can't count and are left out. Cycles are run in blocks of 512; a block that takes a counter to the
target is rolled back: the exact cycle is looked up in the words of the lines concerned, and the block is
counted again, up to there.

Where frames restart from a bank, the words of a frame's first cycles are constants of the machine: those that
were needed once are kept, and a later frame from that bank finds them ready.
"""

from collections.abc import Callable, Collection
from functools import cache
from typing import Any, Final, NamedTuple, TypeVar, cast

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils as untyped_cgutils
from numba.extending import intrinsic

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
from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset
from machines.rng import LFSR, LFSRNumbers, Words, apply_map, jump_tables

KEPT_BYTES: Final = 64 * 2**20
"""Most memory for kept words, in bytes for each machine. It is taken as it is filled."""

KEPT_CYCLES: Final = 2**17
"""Words of later cycles than this are never kept."""

PREPARED_CYCLES: Final = 2**14
"""So many of a frame's first cycles can have their words made beforehand."""

_WORD_BITS: Final = 64
_BLOCK_WORDS: Final = 8  # one register of AVX-512, two of AVX2, four of NEON
_BLOCK_CYCLES: Final = _WORD_BITS * _BLOCK_WORDS
_NO_ROW: Final = -1
_LIVE, _USED, _CYCLES, _OVERFLOWED = range(4)  # in a replica's outcome
_NO_CYCLE: Final = cast(
    "int", np.int64(0)
)  # a plain 0 is a type of its own to numba: it would compile `_run` twice

cgutils: Any = untyped_cgutils
_Function = TypeVar("_Function", bound=Callable[..., Any])


def _jit(function: _Function) -> _Function:
    """Machine code for a function, cached on disk where there is a place that can be written to."""
    try:
        return cast("_Function", njit(cache=True, nogil=True)(function))
    except RuntimeError:  # no such place: every process compiles for itself
        return cast("_Function", njit(nogil=True)(function))


class _Generators(NamedTuple):
    """What the LFSRs of all columns do, as linear maps of a state."""

    jumps: Words  # [bits, bits / 8, 256]: 2**i clocks on
    bits: Words  # [prob_bits, bits / 4, 16, _BLOCK_WORDS]: the next block of each bit shown


class _Store(NamedTuple):
    """The words, by slot (a block of cycles of a bank; the last one is scratch) and row (a column's code)."""

    words: Words  # [slots, rows * _BLOCK_WORDS]
    filled: npt.NDArray[np.uint8]  # [slots, rows]: whether those words are there to stay
    row_column: npt.NDArray[np.int64]  # [rows]
    row_code: npt.NDArray[np.int64]  # [rows]
    row_of_code: npt.NDArray[np.int32]  # [columns, 2**prob_bits]; _NO_ROW where a code has none
    row_frame: npt.NDArray[np.int64]  # [rows]: the last frame that used the row


class _Frame(NamedTuple):
    """What a frame uses. Arrays by line hold the lines that can count, without gaps."""

    lines: npt.NDArray[np.int64]  # [lines]: which line of the machine it is
    places: npt.NDArray[np.uint32]  # [lines, columns]: where in a slot the words to AND begin
    widths: npt.NDArray[np.int64]  # [lines]: how many of those there are
    counts: npt.NDArray[np.int64]  # [lines]
    added: npt.NDArray[np.int64]  # [lines]: what a block adds to the counts
    used: npt.NDArray[np.int64]  # [rows]: the rows that the frame uses, once each
    starts: Words  # [columns]: states before the frame's first cycle
    states: Words  # [columns]: working space
    inverted: Words  # [columns, prob_bits, _BLOCK_WORDS]: working space
    mask: Words  # [_BLOCK_WORDS]: the cycles of a block that are run


class _Replicas(NamedTuple):
    """What the frames of all replicas use: `_Frame`'s arrays, one for each replica but for the working space."""

    lines: npt.NDArray[np.int64]  # [replicas, lines]
    places: npt.NDArray[np.uint32]  # [replicas, lines, columns]
    widths: npt.NDArray[np.int64]  # [replicas, lines]
    counts: npt.NDArray[np.int64]  # [replicas, lines]
    added: npt.NDArray[np.int64]  # [lines]
    used: npt.NDArray[np.int64]  # [replicas, rows]
    starts: Words  # [columns]
    states: Words  # [columns]
    inverted: Words  # [columns, prob_bits, _BLOCK_WORDS]
    mask: Words  # [_BLOCK_WORDS]
    outcome: npt.NDArray[np.int64]  # [replicas, 4]: live lines, rows used, cycles, whether one overflowed


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
        self._generators = _Generators(
            jumps=jump_tables(parameters.rng, parameters.steps_per_clock).copy(),
            bits=_bit_tables(parameters.rng, parameters.steps_per_clock, parameters.prob_bits).copy(),
        )
        occurring = _occurring_codes(machine)
        self._kept_blocks = _kept_blocks(parameters, int(occurring.sum()), kept_bytes)
        if self._kept_blocks:
            self._store = _store_of_codes(occurring, parameters.rng_banks * self._kept_blocks)
        else:
            self._store = _store_of_frame(occurring, parameters.lines * parameters.columns, 0)
        self._frame = _frame(parameters, len(self._store.row_code))
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
        _jump(self._generators.jumps, self._frame.starts, self._cycles % self._period, states)
        return states

    @property
    def kept_cycles(self) -> int:
        """How many of a frame's first cycles, of every bank, have their words kept."""
        return self._kept_blocks * _BLOCK_CYCLES

    def prepare(self) -> None:
        """Make the words of every bank's first `PREPARED_CYCLES` cycles that are kept: a tenth of a second at most."""
        blocks = min(self._kept_blocks, PREPARED_CYCLES // _BLOCK_CYCLES)
        for bank in range(self._machine.parameters.rng_banks if blocks else 0):
            self._restart(bank)
            _fill_blocks(self._generators, self._store, self._frame, self._first_slot, blocks, self._period)
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
            self._store.row_of_code[last_codes] = _NO_ROW
        # One call for both: passing a machine's arrays costs as much as a block of its cycles.
        self._live, self._used, self._cycles, overflow = _begin(
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
        self._cycles, overflow = _run(
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
        self._generators = _Generators(
            jumps=jump_tables(parameters.rng, parameters.steps_per_clock).copy(),
            bits=_bit_tables(parameters.rng, parameters.steps_per_clock, parameters.prob_bits).copy(),
        )
        occurring = _occurring_codes(machine)
        rows = int(occurring.sum())
        self._kept_blocks = _kept_blocks(parameters, rows, kept_bytes)
        # Where a bank's words cannot be kept from frame to frame, the replicas still share the frame's.
        self._of_frame = self._kept_blocks == 0
        if self._of_frame:
            cells = parameters.replicas * parameters.lines * parameters.columns
            self._kept_blocks = _blocks_in(kept_bytes, min(rows, cells))
            self._store = _store_of_frame(occurring, cells, self._kept_blocks)
        else:
            self._store = _store_of_codes(occurring, parameters.rng_banks * self._kept_blocks)
        self._replicas = _replicas(parameters, len(self._store.row_code))
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
        _copy_counts(self._replicas, counts)
        return counts.reshape(parameters.count_shape)

    @property
    def cycles(self) -> int:
        """Cycles that the replica ran that ran longest."""
        return int(self._replicas.outcome[:, _CYCLES].max())

    @property
    def reason(self) -> StopReason:
        """Why the board stands still."""
        return joint_reason(self._reasons, self._halted)

    @property
    def replica_cycles(self) -> tuple[int, ...]:
        """Cycles that each replica ran."""
        return tuple(self._replicas.outcome[:, _CYCLES].tolist())

    @property
    def replica_reasons(self) -> tuple[StopReason, ...]:
        """Why each replica stands still."""
        return tuple(self._reasons)

    @property
    def rng_state(self) -> npt.NDArray[np.uint64]:
        """uint64[columns]: the generators' states, a copy."""
        states = np.empty_like(self._replicas.starts)
        _jump(self._generators.jumps, self._replicas.starts, self.cycles % self._period, states)
        return states

    @property
    def kept_cycles(self) -> int:
        """How many of a frame's first cycles, of every bank, have their words kept for the frames that follow."""
        return 0 if self._of_frame else self._kept_blocks * _BLOCK_CYCLES

    def prepare(self) -> None:
        """Make the words of every bank's first `PREPARED_CYCLES` cycles that are kept: a tenth of a second at most."""
        blocks = 0 if self._of_frame else min(self._kept_blocks, PREPARED_CYCLES // _BLOCK_CYCLES)
        for bank in range(self._machine.parameters.rng_banks if blocks else 0):
            self._restart(bank)
            first = _first_frame(self._replicas)
            _fill_blocks(self._generators, self._store, first, self._first_slot, blocks, self._period)
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
        self._rows = _begin_replicas(
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
        _resume_replicas(
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
        self._store.row_of_code[given] = _NO_ROW
        blocks = min(-(-self.cycles // _BLOCK_CYCLES), self._kept_blocks)
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
    block_bytes = max(rows, 1) * (_BLOCK_WORDS * _WORD_BITS // 8 + 1)
    return min(kept_bytes // block_bytes, KEPT_CYCLES // _BLOCK_CYCLES)


def _store_of_codes(occurring: npt.NDArray[np.bool_], slots: int) -> _Store:
    """The memory for words of all codes that may occur, none of them there yet."""
    row_of_code = np.full(occurring.shape, _NO_ROW, dtype=np.int32)
    row_column, row_code = np.nonzero(occurring)
    row_of_code[occurring] = np.arange(len(row_code), dtype=np.int32)
    return _store(row_of_code, row_column, row_code, slots)


def _store_of_frame(occurring: npt.NDArray[np.bool_], cells: int, slots: int) -> _Store:
    """The memory for words of the codes that a frame of so many cells uses: rows are given out as it begins."""
    none = np.zeros(min(int(occurring.sum()), cells), dtype=np.int64)
    return _store(np.full(occurring.shape, _NO_ROW, dtype=np.int32), none, none, slots)


def _store(
    row_of_code: npt.NDArray[np.int32],
    row_column: npt.NDArray[np.int64],
    row_code: npt.NDArray[np.int64],
    slots: int,
) -> _Store:
    """The memory for words in so many slots, and one for scratch."""
    rows = len(row_code)
    return _Store(
        words=_aligned((slots + 1, rows * _BLOCK_WORDS)),
        filled=np.zeros((slots + 1, rows), dtype=np.uint8),
        row_column=row_column.astype(np.int64),
        row_code=row_code.astype(np.int64),
        row_of_code=row_of_code,
        row_frame=np.zeros(rows, dtype=np.int64),
    )


def _aligned(shape: tuple[int, int]) -> Words:
    """Words that are not set yet, beginning at a cache line, or else every block would lie in two."""
    count = shape[0] * shape[1]
    line = 64 // np.dtype(np.uint64).itemsize
    words = np.empty(count + line, dtype=np.uint64)
    skip = -words.ctypes.data // words.itemsize % line
    return words[skip : skip + count].reshape(shape)


def _frame(parameters: BM1Parameters, rows: int) -> _Frame:
    """The memory for a frame."""
    lines, columns = parameters.lines, parameters.columns
    return _Frame(
        lines=np.zeros(lines, dtype=np.int64),
        places=np.zeros((lines, columns), dtype=np.uint32),
        widths=np.zeros(lines, dtype=np.int64),
        counts=np.zeros(lines, dtype=np.int64),
        added=np.zeros(lines, dtype=np.int64),
        used=np.zeros(rows, dtype=np.int64),
        starts=np.zeros(columns, dtype=np.uint64),
        states=np.zeros(columns, dtype=np.uint64),
        inverted=np.zeros((columns, parameters.prob_bits, _BLOCK_WORDS), dtype=np.uint64),
        mask=np.zeros(_BLOCK_WORDS, dtype=np.uint64),
    )


def _replicas(parameters: BM1Parameters, rows: int) -> _Replicas:
    """The memory for the frames of all replicas."""
    replicas, lines, columns = parameters.replicas, parameters.lines, parameters.columns
    return _Replicas(
        lines=np.zeros((replicas, lines), dtype=np.int64),
        places=np.zeros((replicas, lines, columns), dtype=np.uint32),
        widths=np.zeros((replicas, lines), dtype=np.int64),
        counts=np.zeros((replicas, lines), dtype=np.int64),
        added=np.zeros(lines, dtype=np.int64),
        used=np.zeros((replicas, min(rows, lines * columns)), dtype=np.int64),
        starts=np.zeros(columns, dtype=np.uint64),
        states=np.zeros(columns, dtype=np.uint64),
        inverted=np.zeros((columns, parameters.prob_bits, _BLOCK_WORDS), dtype=np.uint64),
        mask=np.zeros(_BLOCK_WORDS, dtype=np.uint64),
        outcome=np.zeros((replicas, 4), dtype=np.int64),
    )


def _first_frame(replicas: _Replicas) -> _Frame:
    """The first replica's frame, for what needs any."""
    return _Frame(
        lines=replicas.lines[0],
        places=replicas.places[0],
        widths=replicas.widths[0],
        counts=replicas.counts[0],
        added=replicas.added,
        used=replicas.used[0],
        starts=replicas.starts,
        states=replicas.states,
        inverted=replicas.inverted,
        mask=replicas.mask,
    )


@cache
def _bit_tables(kind: RngKind, steps_per_clock: int, prob_bits: int) -> Words:
    """The map from a state to a block of each bit shown: uint64[prob_bits, bits / 4, 16, _BLOCK_WORDS].

    Like `machines.rng.map_tables`, but with a table per 4 bits of the state, so that all of them stay in the
    processor's nearest caches.
    """
    clock = jump_tables(kind, steps_per_clock)[0]
    bits = LFSR(kind).bits
    states = np.uint64(1) << np.arange(bits, dtype=np.uint64)
    shifts = np.arange(prob_bits, dtype=np.uint64)[:, np.newaxis]
    images = np.zeros((prob_bits, bits, _BLOCK_WORDS), dtype=np.uint64)
    for cycle in range(_BLOCK_CYCLES):
        word, place = divmod(cycle, _WORD_BITS)
        images[:, :, word] |= ((states >> shifts) & np.uint64(1)) << np.uint64(place)
        states = apply_map(clock, states)
    tables = np.zeros((prob_bits, bits // 4, 16, _BLOCK_WORDS), dtype=np.uint64)
    for j in range(bits):
        table, half = tables[:, j // 4], 1 << (j % 4)
        table[:, half : 2 * half] = table[:, :half] ^ images[:, j, np.newaxis]
    return tables


# What follows is machine code. Types are the same for every machine (contiguous arrays, int64 and uint64), so it
# is compiled once and cached on disk. A uint64 and an int64 in one operation would make a float: words meet only
# uint64 constants, and counts are int64 throughout.

_0: Final = np.uint64(0)
_1: Final = np.uint64(1)
_4: Final = np.uint64(4)
_8: Final = np.uint64(8)
_DIGIT: Final = np.uint64(15)
_BYTE: Final = np.uint64(255)
_ALL: Final = np.uint64(2**64 - 1)

# numba makes no vector of so short a loop as a block's 8 words (it was 2.5 times slower), so the two loops that
# all the time goes to are written in LLVM's terms, where a block's words are one vector of any processor's.
_I64: Final = ir.IntType(_WORD_BITS)
_BLOCK: Final = ir.VectorType(_I64, _BLOCK_WORDS)


def _constant_block(word: int) -> ir.Constant:
    return ir.Constant(_BLOCK, [ir.Constant(_I64, word)] * _BLOCK_WORDS)


def _block_pointer(builder: Any, data: Any, place: Any) -> Any:
    """The address of the block of words that begins at a place of an array."""
    return builder.bitcast(builder.gep(data, [place]), _BLOCK.as_pointer())


def _load_block(builder: Any, data: Any, place: Any) -> Any:
    block = builder.load(_block_pointer(builder, data, place))
    block.align = _WORD_BITS // 8  # arrays promise no more
    return block


def _call_on_block(builder: Any, name: str, result: Any, block: Any) -> Any:
    """A call of one of LLVM's own functions with a block of words."""
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(result, [_BLOCK]), name)
    return builder.call(function, [block])


def _count_code(_context: Any, words: Any, places: Any, _line: Any, _width: Any, mask: Any) -> Any:
    """How many ones a line makes in a block: in the AND of its rows and the mask."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data, where, masks = (
            context.make_array(signature.args[i])(context, builder, arguments[i]) for i in (0, 1, 4)
        )
        anded = cgutils.alloca_once_value(builder, _load_block(builder, masks.data, ir.Constant(_I64, 0)))
        first = builder.mul(arguments[2], builder.extract_value(where.shape, 1))
        with cgutils.for_range(builder, arguments[3]) as loop:
            place = builder.load(builder.gep(where.data, [builder.add(first, loop.index)]))
            row = _load_block(builder, data.data, builder.zext(place, _I64))
            builder.store(builder.and_(builder.load(anded), row), anded)
        ones = _call_on_block(builder, f"llvm.ctpop.v{_BLOCK_WORDS}i64", _BLOCK, builder.load(anded))
        return _call_on_block(builder, f"llvm.vector.reduce.add.v{_BLOCK_WORDS}i64", _I64, ones)

    return types.int64(words, places, types.int64, types.int64, mask), code


_count = cast("Callable[[Words, npt.NDArray[np.uint32], int, int, Words], int]", intrinsic(_count_code))


def _fill_code(_context: Any, _code: Any, inverted: Any, words: Any, _place: Any) -> Any:
    """Make a block of words of a code in a column: what the generator shows < code, from the low bit up."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        shown, into = (context.make_array(signature.args[i])(context, builder, arguments[i]) for i in (1, 2))
        less = cgutils.alloca_once_value(builder, _constant_block(0))
        with cgutils.for_range(builder, builder.extract_value(shown.shape, 0)) as loop:
            first = builder.mul(loop.index, ir.Constant(_I64, _BLOCK_WORDS))
            zeros = _load_block(builder, shown.data, first)
            bit = builder.trunc(builder.lshr(arguments[0], loop.index), ir.IntType(1))
            # A 0 is less than the code's 1, and a 1 is more than the code's 0, whatever the lower bits said.
            before = builder.load(less)
            builder.store(builder.select(bit, builder.or_(before, zeros), builder.and_(before, zeros)), less)
        store = builder.store(builder.load(less), _block_pointer(builder, into.data, arguments[3]))
        store.align = _WORD_BITS // 8
        return context.get_dummy_value()

    return types.void(types.int64, inverted, words, types.int64), make


_fill = cast("Callable[[int, Words, Words, int], None]", intrinsic(_fill_code))


def _popcount_code(_context: Any, _word: Any) -> Any:
    """A word's ones."""

    def code(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.uint64), code


_popcount = cast("Callable[[np.uint64], int]", intrinsic(_popcount_code))


@_jit
def _image(maps: Words, which: int, state: np.uint64) -> np.uint64:
    """The image of a state under one of some linear maps."""
    image = _0
    for byte in range(maps.shape[1]):
        image ^= maps[which, byte, state & _BYTE]
        state >>= _8
    return image


@_jit
def _jump(jumps: Words, states: Words, clocks: int, later: Words) -> None:
    """Write the states `clocks` clocks on; `clocks` has at most as many bits as a state."""
    for column in range(states.shape[0]):
        state = states[column]
        for bit in range(jumps.shape[0]):
            if (clocks >> bit) & 1:
                state = _image(jumps, bit, state)
        later[column] = state


@_jit
def _select(
    codes: npt.NDArray[np.uint16],
    ones: int,
    store: _Store,
    frame: _Frame,
    frame_number: int,
    new_rows: bool,
    rows: int,
) -> tuple[int, int, int]:
    """Find the lines that can count and the rows that each ANDs, and put their counters to 0.

    Returns the numbers of such lines, of rows in use and of rows given out. `new_rows` gives codes rows as they come,
    from `rows` on.
    """
    columns, lines = codes.shape
    live = 0
    used = 0
    for line in range(lines):
        dead = False
        for column in range(columns):
            dead |= codes[column, line] == 0
        if dead:
            continue
        width = 0
        for column in range(columns):
            code = codes[column, line]
            if code == ones:
                continue
            row = int(store.row_of_code[column, code])
            if new_rows and row == _NO_ROW:
                row = rows
                rows += 1
                store.row_of_code[column, code] = row
                store.row_column[row] = column
                store.row_code[row] = code
            if store.row_frame[row] != frame_number:
                store.row_frame[row] = frame_number
                frame.used[used] = row
                used += 1
            frame.places[live, width] = row * _BLOCK_WORDS
            width += 1
        frame.widths[live] = width
        frame.lines[live] = line
        frame.counts[live] = 0
        live += 1
    return live, used, rows


@_jit
def _show(generators: _Generators, frame: _Frame, clocks: int) -> None:
    """Make a block's words of all bits that the generators show, inverted, from so many clocks on."""
    _jump(generators.jumps, frame.starts, clocks, frame.states)
    for column in range(frame.inverted.shape[0]):
        for bit in range(frame.inverted.shape[1]):
            state = frame.states[column]
            for word in range(_BLOCK_WORDS):
                frame.inverted[column, bit, word] = _ALL
            for digit in range(generators.bits.shape[1]):
                value = state & _DIGIT
                for word in range(_BLOCK_WORDS):
                    frame.inverted[column, bit, word] ^= generators.bits[bit, digit, value, word]
                state >>= _4


@_jit
def _fill_blocks(
    generators: _Generators, store: _Store, frame: _Frame, first_slot: int, blocks: int, period: int
) -> None:
    """Make the words of all codes for a bank's first blocks, from the states in `frame.starts`."""
    for block in range(blocks):
        words = store.words[first_slot + block]
        filled = store.filled[first_slot + block]
        _show(generators, frame, (block * _BLOCK_CYCLES) % period)
        for row in range(filled.shape[0]):
            if not filled[row]:
                _fill(store.row_code[row], frame.inverted[store.row_column[row]], words, row * _BLOCK_WORDS)
                filled[row] = True


@_jit
def _mask(first: int, end: int, mask: Words) -> None:
    """Mark a block's cycles `first` to `end` - 1."""
    for word in range(_BLOCK_WORDS):
        start = word * _WORD_BITS
        low = min(max(first - start, 0), _WORD_BITS)
        high = min(max(end - start, 0), _WORD_BITS)
        ones = _0
        if low < high:  # a shift by 64 is none
            ones = (_ALL >> np.uint64(_WORD_BITS - (high - low))) << np.uint64(low)
        mask[word] = ones


@_jit
def _cycle_of(words: Words, frame: _Frame, line: int, nth: int) -> int:
    """The block's cycle in which a line makes its `nth` one (from 1) under the mask, which must be there."""
    word = 0
    while True:
        made = frame.mask[word]
        for i in range(frame.widths[line]):
            made &= words[frame.places[line, i] + word]
        ones = _popcount(made)
        if nth <= ones:
            break
        nth -= ones
        word += 1
    for _ in range(nth - 1):
        made &= made - _1  # takes the lowest one away
    return word * _WORD_BITS + _popcount(~made & (made - _1))


@_jit
def _run(
    generators: _Generators,
    store: _Store,
    frame: _Frame,
    live: int,
    used: int,
    cycles: int,
    limit: int,
    target_count: int,
    first_slot: int,
    kept_blocks: int,
    period: int,
) -> tuple[int, bool]:
    """Run from `cycles` to `limit`, or to the cycle in which a counter reaches the target.

    Returns the cycles run in the frame, and whether a counter overflowed.
    """
    overflow = False
    while cycles < limit and not overflow:
        block = cycles // _BLOCK_CYCLES
        keep = block < kept_blocks
        slot = first_slot + block if keep else store.words.shape[0] - 1
        words = store.words[slot]
        filled = store.filled[slot]
        shown = False
        for i in range(used):
            row = frame.used[i]
            if filled[row]:
                continue
            if not shown:
                _show(generators, frame, (block * _BLOCK_CYCLES) % period)
                shown = True
            _fill(store.row_code[row], frame.inverted[store.row_column[row]], words, row * _BLOCK_WORDS)
            filled[row] = keep
        first = cycles - block * _BLOCK_CYCLES
        end = min(limit - block * _BLOCK_CYCLES, _BLOCK_CYCLES)
        _mask(first, end, frame.mask)
        for i in range(live):
            added = _count(words, frame.places, i, frame.widths[i], frame.mask)
            frame.added[i] = added
            overflow |= frame.counts[i] + added >= target_count
        if overflow:
            # The first line to get there stops all of them, after that cycle.
            for i in range(live):
                missing = target_count - frame.counts[i]
                if frame.added[i] >= missing:
                    end = min(end, _cycle_of(words, frame, i, missing) + 1)
            _mask(first, end, frame.mask)
            for i in range(live):
                frame.added[i] = _count(words, frame.places, i, frame.widths[i], frame.mask)
        for i in range(live):
            frame.counts[i] += frame.added[i]
        cycles = block * _BLOCK_CYCLES + end
    return cycles, overflow


@_jit
def _begin(
    codes: npt.NDArray[np.uint16],
    ones: int,
    generators: _Generators,
    store: _Store,
    frame: _Frame,
    frame_number: int,
    limit: int,
    target_count: int,
    first_slot: int,
    kept_blocks: int,
    period: int,
) -> tuple[int, int, int, bool]:
    """Select a frame's lines and run its first cycles: what `_select` and `_run` return, one after the other.

    A frame in which no line can count runs no cycle.
    """
    live, used, _ = _select(codes, ones, store, frame, frame_number, kept_blocks == 0, _NO_CYCLE)
    if live == 0:
        return live, used, _NO_CYCLE, False
    cycles, overflow = _run(
        generators, store, frame, live, used, _NO_CYCLE, limit, target_count, first_slot, kept_blocks, period
    )
    return live, used, cycles, overflow


@_jit
def _frame_of(replicas: _Replicas, at: int) -> _Frame:
    """A replica's frame."""
    return _Frame(
        replicas.lines[at],
        replicas.places[at],
        replicas.widths[at],
        replicas.counts[at],
        replicas.added,
        replicas.used[at],
        replicas.starts,
        replicas.states,
        replicas.inverted,
        replicas.mask,
    )


@_jit
def _begin_replicas(
    codes: npt.NDArray[np.uint16],
    ones: int,
    generators: _Generators,
    store: _Store,
    replicas: _Replicas,
    frame_number: int,
    limit: int,
    target_count: int,
    first_slot: int,
    kept_blocks: int,
    period: int,
    new_rows: bool,
) -> int:
    """Select every replica's lines and run its first cycles; what became of it is in `outcome`.

    Returns the number of rows given out. All rows are given out before the first block is run: a slot has the words of
    one and the same row from the first replica to the last.
    """
    rows = _NO_CYCLE
    for at in range(codes.shape[0]):
        frame = _frame_of(replicas, at)
        live, used, rows = _select(codes[at], ones, store, frame, frame_number + at, new_rows, rows)
        replicas.outcome[at, _LIVE] = live
        replicas.outcome[at, _USED] = used
        replicas.outcome[at, _CYCLES] = _NO_CYCLE
        replicas.outcome[at, _OVERFLOWED] = False
    for at in range(codes.shape[0]):
        if replicas.outcome[at, _LIVE]:
            _run_replica(
                generators, store, replicas, at, limit, target_count, first_slot, kept_blocks, period
            )
    return rows


@_jit
def _resume_replicas(
    generators: _Generators,
    store: _Store,
    replicas: _Replicas,
    going: npt.NDArray[np.int64],
    limit: int,
    target_count: int,
    first_slot: int,
    kept_blocks: int,
    period: int,
) -> None:
    """Run the replicas that go on, each from where it stands."""
    for at in going:
        _run_replica(generators, store, replicas, at, limit, target_count, first_slot, kept_blocks, period)


@_jit
def _run_replica(
    generators: _Generators,
    store: _Store,
    replicas: _Replicas,
    at: int,
    limit: int,
    target_count: int,
    first_slot: int,
    kept_blocks: int,
    period: int,
) -> None:
    """Run a replica from its cycle to `limit`, or to its own overflow."""
    outcome = replicas.outcome[at]
    cycles, overflow = _run(
        generators,
        store,
        _frame_of(replicas, at),
        outcome[_LIVE],
        outcome[_USED],
        outcome[_CYCLES],
        limit,
        target_count,
        first_slot,
        kept_blocks,
        period,
    )
    outcome[_CYCLES] = cycles
    outcome[_OVERFLOWED] = overflow


@_jit
def _copy_counts(replicas: _Replicas, counts: npt.NDArray[np.uint32]) -> None:
    """Put the counters of the lines that can count where they belong."""
    for at in range(counts.shape[0]):
        for i in range(replicas.outcome[at, _LIVE]):
            counts[at, replicas.lines[at, i]] = replicas.counts[at, i]
