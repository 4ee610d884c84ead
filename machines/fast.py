"""The fast BM1 for shared LFSRs: 64 cycles to a word, and the same results as the reference, to the bit.

A cell's bits of 64 cycles are one word, which depends only on its column's generator and on its code, so that
cells of a column with the same code share it. A line is the AND of its words, and it counts their ones.
Cycles are run in passes over all lines that can count at all; a pass that would take a counter past the target
is not committed: the exact cycle is looked up in the words of the lines concerned, and the pass runs again,
up to there.

Where frames restart from a bank, the words of a frame's first cycles are constants of the machine: those that
were needed once are kept, and a later frame from that bank finds them ready.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, Final, NamedTuple, TypeVar, cast

import numpy as np
import numpy.typing as npt
from numba import njit, types
from numba.extending import intrinsic

from machines.bm1 import BM1Machine, Start, StopReason, addressed_codes, check_resume, check_start
from machines.errors import MachineError
from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset
from machines.rng import LFSR, LFSRNumbers, Words, apply_map, jump_tables, map_tables

KEPT_BYTES: Final = 64 * 2**20
"""Most memory for kept words, in bytes for each machine. It is taken as it is filled."""

KEPT_CYCLES: Final = 2**17
"""Words of later cycles than this are never kept."""

_WORD_BITS: Final = 64
_WORD_JUMP: Final = 6  # 2**6 clocks are a word
_BLOCK_WORDS: Final = 64
_BLOCK_CYCLES: Final = _WORD_BITS * _BLOCK_WORDS
_FIRST_PASS: Final = 512
_GROUP: Final = 4  # a line's rows are ANDed four at a time

_Function = TypeVar("_Function", bound=Callable[..., Any])
_jit = cast("Callable[[_Function], _Function]", njit(cache=True, nogil=True))


class _Generators(NamedTuple):
    """What the LFSRs of all columns do, as linear maps of a state."""

    jumps: Words  # [bits, bits / 8, 256]: 2**i clocks on
    bits: Words  # [prob_bits, bits / 8, 256]: the next 64 cycles of bit b of what is shown, as a word


class _Store(NamedTuple):
    """The words, by slot (a block of cycles of a bank; the last one is scratch) and row (a column's code)."""

    words: Words  # [slots, rows * _BLOCK_WORDS]
    filled: npt.NDArray[np.uint8]  # [slots, rows]: whether those words are there
    inverted: Words  # [slots, columns, prob_bits, _BLOCK_WORDS]: the shown bits, inverted
    shown: npt.NDArray[np.uint8]  # [slots]: whether those are there
    row_column: npt.NDArray[np.uint32]  # [rows]
    row_code: npt.NDArray[np.uint32]  # [rows]
    row_of_code: npt.NDArray[np.uint32]  # [columns, 2**prob_bits]: 0 where a code has no row
    row_frame: npt.NDArray[np.int64]  # [rows]: the last frame that used the row


class _Frame(NamedTuple):
    """What a frame uses, of the lines that can count, in their order."""

    lines: npt.NDArray[np.int64]  # [lines]: which line of the machine it is
    places: Words  # [lines, columns up to a multiple of _GROUP]: where in the slot the rows to AND begin
    groups: npt.NDArray[np.int64]  # [lines]: how many groups of rows
    counts: npt.NDArray[np.int64]  # [lines]
    added: npt.NDArray[np.int64]  # [lines]: what a pass adds to the counts
    used: npt.NDArray[np.uint32]  # [rows]: all rows that the frame uses, once each
    starts: Words  # [columns]: states before the frame's first cycle
    states: Words  # [columns]: working space


class FastBM1:
    """A machine (`machines.bm1.BM1Kernel`) with shared LFSRs that runs many cycles at a time (thesis 2.1.2).

    Args:
        machine: What to run.
        kept_bytes: Most memory for kept words; 0 keeps none.

    Raises:
        MachineError: The machine's generators are no LFSRs, or are not shared.
    """

    def __init__(self, machine: BM1Machine, *, kept_bytes: int = KEPT_BYTES) -> None:
        parameters = machine.parameters
        if not parameters.shared or parameters.rng.lfsr_bits is None:
            raise MachineError(
                f"The fast kernel runs shared LFSRs only; this machine has rng = {parameters.rng}, "
                f"shared = {str(parameters.shared).lower()}: use the reference."
            )
        self._machine = machine
        self._period = LFSR(parameters.rng).period
        self._random_numbers = LFSRNumbers(parameters)
        self._bank_starts: dict[int, Words] = {}
        self._generators = _Generators(
            jumps=jump_tables(parameters.rng, parameters.steps_per_clock).copy(),
            bits=_bit_tables(parameters.rng, parameters.steps_per_clock, parameters.prob_bits).copy(),
        )
        occurring = _occurring_codes(machine)
        self._kept_blocks = _kept_blocks(parameters, int(occurring.sum()) + 1, kept_bytes)
        self._store = _store(parameters, occurring, self._kept_blocks)
        self._frame = _frame(parameters, len(self._store.row_code))
        self._frames = 0
        self._live = 0
        self._used = 0
        self._first_slot = 0
        self._scratch_block = -1
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
    def rng_state(self) -> npt.NDArray[np.uint64]:
        """uint64[columns]: the generators' states, a copy."""
        states = np.empty_like(self._frame.starts)
        _jump(self._generators.jumps, self._frame.starts, self._cycles % self._period, states)
        return states

    @property
    def kept_cycles(self) -> int:
        """How many of a frame's first cycles, of every bank, have their words kept."""
        return self._kept_blocks * _BLOCK_CYCLES

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
        self._scratch_block = -1
        self._frames += 1
        codes = addressed_codes(self._machine, start)
        if self._kept_blocks == 0:
            # There may be more codes than could have rows for good: rows are the frame's own.
            codes_of_rows = self._store.row_column[: self._used], self._store.row_code[: self._used]
            self._store.row_of_code[codes_of_rows] = 0
        self._live, self._used = _select(
            codes, parameters.ones_code, self._store, self._frame, self._frames, self._kept_blocks == 0
        )
        if self._live == 0:
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

    def _restart(self, bank: int) -> None:
        """Put the generators to the start of a bank."""
        starts = self._bank_starts.get(bank)
        if starts is None:
            starts = self._bank_starts[bank] = self._random_numbers.restart(bank)
        self._frame.starts[:] = starts
        self._first_slot = bank * self._kept_blocks

    def _run(self, run_until: int) -> None:
        limit = min(run_until, self._max_cycles) if run_until else self._max_cycles
        self._cycles, overflow, self._scratch_block = _run(
            self._generators,
            self._store,
            self._frame,
            self._live,
            self._used,
            self._cycles,
            limit,
            self._target_count,
            self._first_slot,
            self._kept_blocks,
            self._scratch_block,
            self._period,
        )
        if overflow:
            self._reason = StopReason.OVERFLOW
        elif self._cycles == self._max_cycles:
            self._reason = StopReason.MAX_CYCLES
        else:
            self._reason = StopReason.SLICE


def warm_up() -> None:
    """Compile, or load from the cache, all that runs in machine code: about 10 s the first time, then 0.1 s."""
    parameters = BM1Parameters(lines=1, sensor_bits=(), rng=RngKind.LFSR16)
    kernel = FastBM1(BM1Machine(parameters, np.full((1, 1), 128, dtype=np.uint16), ()))
    kernel.start(Start(addresses=(), target_count=1, max_cycles=1))
    _ = kernel.rng_state


def _occurring_codes(machine: BM1Machine) -> npt.NDArray[np.bool_]:
    """bool[columns, 2**prob_bits]: the codes that a frame may address, but for 0 and all-ones, which need no words."""
    parameters = machine.parameters
    occurring = np.zeros((parameters.columns, 1 << parameters.prob_bits), dtype=np.bool_)
    if parameters.prior_mode is PriorMode.WRITTEN:
        occurring[0] = True
    for column, table in enumerate((machine.prior, *machine.tables)):
        occurring[column, table.ravel()] = True
    occurring[:, [0, parameters.ones_code]] = False
    return occurring


def _kept_blocks(parameters: BM1Parameters, rows: int, kept_bytes: int) -> int:
    """How many blocks of every bank fit into the memory for kept words."""
    if parameters.rng_reset is RngReset.FREE:
        return 0  # a frame's states are not a bank's, and hardly ever come again
    row_bytes = _BLOCK_WORDS * np.dtype(np.uint64).itemsize
    block_bytes = (rows + parameters.columns * parameters.prob_bits) * row_bytes
    return min(kept_bytes // (block_bytes * parameters.rng_banks), KEPT_CYCLES // _BLOCK_CYCLES)


def _store(parameters: BM1Parameters, occurring: npt.NDArray[np.bool_], kept_blocks: int) -> _Store:
    """The memory for words, none of them there yet; row 0 is all ones."""
    columns = parameters.columns
    slots = parameters.rng_banks * kept_blocks + 1
    row_of_code = np.zeros(occurring.shape, dtype=np.uint32)
    if kept_blocks:
        column_of, code_of = np.nonzero(occurring)
        rows = len(code_of) + 1
        row_of_code[occurring] = np.arange(1, rows, dtype=np.uint32)
    else:
        rows = min(int(occurring.sum()), parameters.lines * columns) + 1
        column_of = code_of = np.zeros(rows - 1, dtype=np.int64)
    return _Store(
        words=np.empty((slots, rows * _BLOCK_WORDS), dtype=np.uint64),
        filled=np.zeros((slots, rows), dtype=np.uint8),
        inverted=np.empty((slots, columns, parameters.prob_bits, _BLOCK_WORDS), dtype=np.uint64),
        shown=np.zeros(slots, dtype=np.uint8),
        row_column=np.concatenate(([0], column_of)).astype(np.uint32),
        row_code=np.concatenate(([parameters.ones_code], code_of)).astype(np.uint32),
        row_of_code=row_of_code,
        row_frame=np.zeros(rows, dtype=np.int64),
    )


def _frame(parameters: BM1Parameters, rows: int) -> _Frame:
    """The memory for a frame."""
    lines, columns = parameters.lines, parameters.columns
    return _Frame(
        lines=np.zeros(lines, dtype=np.int64),
        places=np.zeros((lines, -(-columns // _GROUP) * _GROUP), dtype=np.uint64),
        groups=np.zeros(lines, dtype=np.int64),
        counts=np.zeros(lines, dtype=np.int64),
        added=np.zeros(lines, dtype=np.int64),
        used=np.zeros(rows, dtype=np.uint32),
        starts=np.zeros(columns, dtype=np.uint64),
        states=np.zeros(columns, dtype=np.uint64),
    )


@cache
def _bit_tables(kind: RngKind, steps_per_clock: int, prob_bits: int) -> Words:
    """The maps from a state to the next 64 cycles of each bit shown: uint64[prob_bits, bits / 8, 256]."""
    clock = jump_tables(kind, steps_per_clock)[0]
    states = np.uint64(1) << np.arange(LFSR(kind).bits, dtype=np.uint64)
    images = np.zeros((prob_bits, len(states)), dtype=np.uint64)
    shifts = np.arange(prob_bits, dtype=np.uint64)[:, np.newaxis]
    for cycle in range(_WORD_BITS):
        images |= ((states >> shifts) & np.uint64(1)) << np.uint64(cycle)
        states = apply_map(clock, states)
    return np.stack([map_tables(image) for image in images])


# What follows is machine code. Types are the same for every machine (contiguous arrays, int64 and uint64), so it
# is compiled once and cached on disk. A uint64 and an int64 in one operation would make a float: words only meet
# uint64 constants, and counts are int64 throughout.

_0: Final = np.uint64(0)
_1: Final = np.uint64(1)
_8: Final = np.uint64(8)
_BYTE: Final = np.uint64(255)
_ALL: Final = np.uint64(2**64 - 1)


def _ctpop(_context: Any, _word: Any) -> Any:
    """The processor's count of a word's ones."""

    def code(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.uint64), code


_popcount = cast("Callable[[np.uint64], int]", intrinsic(_ctpop))


@_jit
def _image(tables: Words, state: np.uint64) -> np.uint64:
    """The image of a state under a linear map."""
    image = np.uint64(0)
    for byte in range(tables.shape[0]):
        image ^= tables[byte, state & _BYTE]
        state >>= _8
    return image


@_jit
def _jump(jumps: Words, states: Words, clocks: int, later: Words) -> None:
    """Write the states `clocks` clocks on; `clocks` has at most as many bits as a state."""
    for column in range(states.shape[0]):
        state = states[column]
        for bit in range(jumps.shape[0]):
            if (clocks >> bit) & 1:
                state = _image(jumps[bit], state)
        later[column] = state


@_jit
def _select(
    codes: npt.NDArray[np.uint16], ones: int, store: _Store, frame: _Frame, frame_number: int, new_rows: bool
) -> tuple[int, int]:
    """Find the lines that can count and the rows that each ANDs, and put their counters to 0.

    Returns the numbers of such lines and of rows in use. `new_rows` gives codes rows as they come.
    """
    columns, lines = codes.shape
    live = 0
    used = 1  # row 0, in case a line has nothing but all-ones codes
    frame.used[0] = 0
    for line in range(lines):
        dead = False
        for column in range(columns):
            dead |= codes[column, line] == 0
        if dead:
            continue
        n = 0
        for column in range(columns):
            code = codes[column, line]
            if code == ones:
                continue
            row = store.row_of_code[column, code]
            if new_rows and row == 0:
                row = np.uint32(used)
                store.row_of_code[column, code] = row
                store.row_column[row] = column
                store.row_code[row] = code
            if store.row_frame[row] != frame_number:
                store.row_frame[row] = frame_number
                frame.used[used] = row
                used += 1
            frame.places[live, n] = row * _BLOCK_WORDS
            n += 1
        if n == 0:
            frame.places[live, 0] = 0
            n = 1
        # A row twice changes no AND, so the last group is filled up with it.
        while n % _GROUP:
            frame.places[live, n] = frame.places[live, n - 1]
            n += 1
        frame.groups[live] = n // _GROUP
        frame.lines[live] = line
        frame.counts[live] = 0
        live += 1
    return live, used


@_jit
def _show(generators: _Generators, frame: _Frame, first_cycle: int, inverted: Words) -> None:
    """Make a block of what all generators show, from the cycle on, inverted."""
    _jump(generators.jumps, frame.starts, first_cycle, frame.states)
    for column in range(inverted.shape[0]):
        state = frame.states[column]
        for word in range(_BLOCK_WORDS):
            for bit in range(inverted.shape[1]):
                inverted[column, bit, word] = ~_image(generators.bits[bit], state)
            state = _image(generators.jumps[_WORD_JUMP], state)


@_jit
def _fill(code: int, ones: int, inverted: Words, words: Words) -> None:
    """Make the words of a code in a column: shown < code, by a comparison from the low bit up."""
    if code == ones:
        words[:] = _ALL
        return
    words[:] = _0
    for bit in range(inverted.shape[0]):
        # A 0 in the shown number is less than the code's 1, and a 1 is more than its 0, whatever the lower bits are.
        if (code >> bit) & 1:
            for word in range(_BLOCK_WORDS):
                words[word] |= inverted[bit, word]
        else:
            for word in range(_BLOCK_WORDS):
                words[word] &= inverted[bit, word]


@_jit
def _word(words: Words, places: Words, line: int, groups: int, word: int) -> np.uint64:
    """One word of a line: the AND of its rows."""
    made = _ALL
    for i in range(groups * _GROUP):
        made &= words[places[line, i] + np.uint64(word)]
    return made


@_jit
def _ones(words: Words, places: Words, line: int, groups: int, first: int, end: int) -> int:
    """How many ones a line makes in a block's cycles `first` to `end` - 1."""
    word, end_word = first // _WORD_BITS, end // _WORD_BITS
    before, after = first % _WORD_BITS, end % _WORD_BITS
    ones = 0
    if before:
        made = _word(words, places, line, groups, word) >> np.uint64(before)
        if word == end_word:
            return _popcount(made & ((_1 << np.uint64(after - before)) - _1))
        ones += _popcount(made)
        word += 1
    if after:
        ones += _popcount(_word(words, places, line, groups, end_word) & ((_1 << np.uint64(after)) - _1))
    # Whole words, one loop for each number of groups that is common: nothing is written, so that it is fast.
    whole = np.uint64(max(end_word - word, 0))
    skip = np.uint64(word)
    a = places[line, 0] + skip
    b = places[line, 1] + skip
    c = places[line, 2] + skip
    d = places[line, 3] + skip
    if groups == 1:
        for i in range(whole):
            ones += _popcount(words[a + i] & words[b + i] & words[c + i] & words[d + i])
        return ones
    e = places[line, 4] + skip
    f = places[line, 5] + skip
    g = places[line, 6] + skip
    h = places[line, 7] + skip
    if groups == 2:
        for i in range(whole):
            ones += _popcount(
                words[a + i] & words[b + i] & words[c + i] & words[d + i]
                & words[e + i] & words[f + i] & words[g + i] & words[h + i]
            )
        return ones
    for i in range(end_word-word):
        ones += _popcount(_word(words, places, line, groups, word + i))
    return ones


@_jit
def _cycle_of(words: Words, places: Words, line: int, groups: int, first: int, nth: int) -> int:
    """The block's cycle, from `first` on, in which a line makes its `nth` one (from 1), which must be there."""
    word = first // _WORD_BITS
    made = _word(words, places, line, groups, word) & (_ALL << np.uint64(first % _WORD_BITS))
    ones = _popcount(made)
    while ones < nth:
        nth -= ones
        word += 1
        made = _word(words, places, line, groups, word)
        ones = _popcount(made)
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
    scratch_block: int,
    period: int,
) -> tuple[int, bool, int]:
    """Run from `cycles` to `limit`, or to the cycle in which a counter reaches the target.

    Returns the cycles run in the frame, whether a counter overflowed, and the block that the scratch slot holds.
    """
    ones_code = store.row_of_code.shape[1] - 1
    block, slot = -1, 0
    overflow = False
    while cycles < limit and not overflow:
        if cycles // _BLOCK_CYCLES != block:
            block = cycles // _BLOCK_CYCLES
            if block < kept_blocks:
                slot = first_slot + block
            else:
                slot = store.shown.shape[0] - 1
                if block != scratch_block:
                    scratch_block = block
                    store.shown[slot] = 0
                    store.filled[slot, :] = 0
            for i in range(used):
                row = frame.used[i]
                if store.filled[slot, row] == 0:
                    if store.shown[slot] == 0:
                        _show(generators, frame, (block * _BLOCK_CYCLES) % period, store.inverted[slot])
                        store.shown[slot] = 1
                    inverted = store.inverted[slot, store.row_column[row]]
                    _fill(store.row_code[row], ones_code, inverted, store.words[slot, row * _BLOCK_WORDS : (row + 1) * _BLOCK_WORDS])
                    store.filled[slot, row] = 1
        words = store.words[slot]
        # Passes double in length, so that what a rolled back pass costs is no more than what was run before it.
        block_start = block * _BLOCK_CYCLES
        first = cycles - block_start
        end = min(limit - block_start, _BLOCK_CYCLES, max(_FIRST_PASS, 2 * first))
        for i in range(live):
            added = _ones(words, frame.places, i, frame.groups[i], first, end)
            frame.added[i] = added
            overflow |= frame.counts[i] + added >= target_count
        if overflow:
            # The first line to get there stops all of them, after that cycle.
            for i in range(live):
                missing = target_count - frame.counts[i]
                if frame.added[i] >= missing:
                    end = min(end, _cycle_of(words, frame.places, i, frame.groups[i], first, missing) + 1)
            for i in range(live):
                frame.added[i] = _ones(words, frame.places, i, frame.groups[i], first, end)
        for i in range(live):
            frame.counts[i] += frame.added[i]
        cycles = block_start + end
    return cycles, overflow, scratch_block
