"""Compiled functions of the fast kernel, and the arrays that they use.

The functions compute the bits of a block of cycles as words, and count the ones. All functions are in one file, because
numba recompiles a function if its own file changes, but not if an imported file changes.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, Final, NamedTuple, TypeVar, cast

import numpy as np
import numpy.typing as npt
from numba import njit

from machines.parameters import BM1Parameters, RngKind
from machines.rng import LFSR, Words, apply_map, jump_tables
from machines.vectors import aligned, load, ones_in, ones_in_word, splat, store

WORD_BITS: Final = 64
BLOCK_WORDS: Final = 8  # one register of AVX-512, two of AVX2, four of NEON
BLOCK_CYCLES: Final = WORD_BITS * BLOCK_WORDS
NO_ROW: Final = -1
LIVE, USED, CYCLES, OVERFLOWED = range(4)  # columns of a replica's outcome
# a literal 0 has its own type: numba would compile `_select` twice
_NO_ROWS: Final = cast("int", np.int64(0))

_Function = TypeVar("_Function", bound=Callable[..., Any])


def jit(function: _Function) -> _Function:
    """Compile a function at its first call, and cache it on disk if numba's cache folder is writable."""
    try:
        return cast("_Function", njit(cache=True, nogil=True)(function))
    except RuntimeError:  # no writable folder: every process compiles
        return cast("_Function", njit(nogil=True)(function))


class Generators(NamedTuple):
    """Linear maps that advance an LFSR. All columns use one set of maps, and each column has its own state."""

    jumps: Words  # [bits, bits / 8, 256]: the state 2**i clocks later
    bits: Words  # [prob_bits, bits / 4, 16, BLOCK_WORDS]: the next block of each output bit


class _Store(NamedTuple):
    """Cached words: the bits that cells make, one bit per cycle.

    A slot holds one block of cycles of a bank. The last slot is scratch memory. A row holds one code of one column.
    """

    words: Words  # [slots, rows * BLOCK_WORDS]
    filled: npt.NDArray[np.uint8]  # [slots, rows]: whether these words are cached
    row_column: npt.NDArray[np.int64]  # [rows]
    row_code: npt.NDArray[np.int64]  # [rows]
    row_of_code: npt.NDArray[np.int32]  # [columns, 2**prob_bits]; NO_ROW for a code without a row
    row_frame: npt.NDArray[np.int64]  # [rows]: the last frame that used the row


class _Frame(NamedTuple):
    """A frame of all replicas. Arrays by line have entries only for lines that can count."""

    lines: npt.NDArray[np.int64]  # [replicas, lines]: number of the line in the machine
    places: npt.NDArray[np.uint32]  # [replicas, lines, columns]: rows to AND
    widths: npt.NDArray[np.int64]  # [replicas, lines]: number of words to AND
    sums: npt.NDArray[np.int64]  # [replicas, lines]: the counters
    added: npt.NDArray[np.int64]  # [lines]: ones in a block
    used: npt.NDArray[np.int64]  # [replicas, rows]: rows used by the replica, each once
    starts: Words  # [columns]: states before the frame's first cycle
    states: Words  # [columns]: working space
    inverted: Words  # [columns, prob_bits, BLOCK_WORDS]: working space
    mask: Words  # [BLOCK_WORDS]: mask of the cycles of a block to run
    counts: npt.NDArray[
        np.uint32
    ]  # [replicas, all lines of the machine]: the counters, in the order of the machine
    outcome: npt.NDArray[np.int64]  # [replicas, 4]: live lines, rows used, cycles, whether one overflowed


def store_of_codes(occurring: npt.NDArray[np.bool_], slots: int) -> _Store:
    """Allocate a store with an empty row for each code that may occur."""
    row_of_code = np.full(occurring.shape, NO_ROW, dtype=np.int32)
    row_column, row_code = np.nonzero(occurring)
    row_of_code[occurring] = np.arange(len(row_code), dtype=np.int32)
    return _store(row_of_code, row_column, row_code, slots)


def store_of_frame(occurring: npt.NDArray[np.bool_], cells: int, slots: int) -> _Store:
    """Allocate a store whose rows get new codes in every frame: the codes that the frame uses.

    A row holds the words of one code of a column. `cells` is the number of cells of all replicas. A frame uses at most
    one code per cell, so the store needs at most `cells` rows. If fewer codes may occur, it has one row per such code.
    """
    none = np.zeros(min(int(occurring.sum()), cells), dtype=np.int64)
    return _store(np.full(occurring.shape, NO_ROW, dtype=np.int32), none, none, slots)


def _store(
    row_of_code: npt.NDArray[np.int32],
    row_column: npt.NDArray[np.int64],
    row_code: npt.NDArray[np.int64],
    slots: int,
) -> _Store:
    """Allocate the words of the given rows in `slots` slots, one per block of cycles, and in a scratch slot."""
    rows = len(row_code)
    return _Store(
        words=aligned((slots + 1, rows * BLOCK_WORDS), np.uint64),
        filled=np.zeros((slots + 1, rows), dtype=np.uint8),
        row_column=row_column.astype(np.int64),
        row_code=row_code.astype(np.int64),
        row_of_code=row_of_code,
        row_frame=np.zeros(rows, dtype=np.int64),
    )


def make_frame(parameters: BM1Parameters, rows: int) -> _Frame:
    """Allocate the arrays for a frame of all replicas. `rows` is the number of rows in the `_Store`."""
    replicas, lines, columns = parameters.replicas, parameters.lines, parameters.columns
    return _Frame(
        lines=np.zeros((replicas, lines), dtype=np.int64),
        places=np.zeros((replicas, lines, columns), dtype=np.uint32),
        widths=np.zeros((replicas, lines), dtype=np.int64),
        sums=np.zeros((replicas, lines), dtype=np.int64),
        added=np.zeros(lines, dtype=np.int64),
        used=np.zeros((replicas, min(rows, lines * columns)), dtype=np.int64),
        starts=np.zeros(columns, dtype=np.uint64),
        states=np.zeros(columns, dtype=np.uint64),
        inverted=aligned((columns, parameters.prob_bits, BLOCK_WORDS), np.uint64),
        mask=aligned((BLOCK_WORDS,), np.uint64),
        counts=np.zeros((replicas, lines), dtype=np.uint32),
        outcome=np.zeros((replicas, 4), dtype=np.int64),
    )


@cache
def bit_tables(kind: RngKind, steps_per_clock: int, prob_bits: int) -> Words:
    """Return tables that map an LFSR's state to its output bits in the next block of cycles.

    The shape is uint64[prob_bits, bits / 4, 16, BLOCK_WORDS]. Each table is for 4 bits of the state, so that all
    tables fit into the processor's first caches.
    """
    clock = jump_tables(kind, steps_per_clock)[0]
    bits = LFSR(kind).bits
    states = np.uint64(1) << np.arange(bits, dtype=np.uint64)
    shifts = np.arange(prob_bits, dtype=np.uint64)[:, np.newaxis]
    images = np.zeros((prob_bits, bits, BLOCK_WORDS), dtype=np.uint64)
    for cycle in range(BLOCK_CYCLES):
        word, place = divmod(cycle, WORD_BITS)
        images[:, :, word] |= ((states >> shifts) & np.uint64(1)) << np.uint64(place)
        states = apply_map(clock, states)
    tables = np.zeros((prob_bits, bits // 4, 16, BLOCK_WORDS), dtype=np.uint64)
    for j in range(bits):
        table, half = tables[:, j // 4], 1 << (j % 4)
        table[:, half : 2 * half] = table[:, :half] ^ images[:, j, np.newaxis]
    return tables


# Everything below is compiled. Types are the same for every machine (contiguous arrays, int64 and uint64), so
# it is compiled once and cached on disk. An operation on a uint64 and an int64 would give a float: words are
# combined only with uint64 constants, and counts are int64 throughout.

_0: Final = np.uint64(0)
_1: Final = np.uint64(1)
_4: Final = np.uint64(4)
_8: Final = np.uint64(8)
_DIGIT: Final = np.uint64(15)
_BYTE: Final = np.uint64(255)
_ALL: Final = np.uint64(2**64 - 1)


@jit
def image(maps: Words, which: int, state: np.uint64) -> np.uint64:
    """Apply the linear map number `which` to a state, and return the new state."""
    found = _0
    for byte in range(maps.shape[1]):
        found ^= maps[which, byte, state & _BYTE]
        state >>= _8
    return found


@jit
def jump(jumps: Words, states: Words, clocks: int, later: Words) -> None:
    """Advance each state by a number of clocks below 2**(state bits), and store the new states in `later`."""
    for column in range(states.shape[0]):
        state = states[column]
        for bit in range(jumps.shape[0]):
            if (clocks >> bit) & 1:
                state = image(jumps, bit, state)
        later[column] = state


@jit
def _select(
    codes: npt.NDArray[np.uint16],
    ones: int,
    store: _Store,
    frame: _Frame,
    replica: int,
    frame_number: int,
    new_rows: bool,
    rows: int,
) -> int:
    """Find a replica's lines that can count, and for each the rows of bits to AND; clear the lines' counters.

    With `new_rows`, each code without a row is assigned the next free row, from `rows` on. Returns the number of
    assigned rows.
    """
    columns, lines = codes.shape
    numbers, places, widths = frame.lines[replica], frame.places[replica], frame.widths[replica]
    sums, used_rows = frame.sums[replica], frame.used[replica]
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
            if new_rows and row == NO_ROW:
                row = rows
                rows += 1
                store.row_of_code[column, code] = row
                store.row_column[row] = column
                store.row_code[row] = code
            if store.row_frame[row] != frame_number:
                store.row_frame[row] = frame_number
                used_rows[used] = row
                used += 1
            places[live, width] = row
            width += 1
        widths[live] = width
        numbers[live] = line
        sums[live] = 0
        live += 1
    outcome = frame.outcome[replica]
    outcome[LIVE] = live
    outcome[USED] = used
    outcome[CYCLES] = 0
    outcome[OVERFLOWED] = 0
    return rows


@jit
def _show(generators: Generators, frame: _Frame, clocks: int) -> None:
    """Compute the inverted bits of the random numbers, as words, for the block that begins after `clocks` clocks."""
    jump(generators.jumps, frame.starts, clocks, frame.states)
    for column in range(frame.inverted.shape[0]):
        for bit in range(frame.inverted.shape[1]):
            state = frame.states[column]
            for word in range(BLOCK_WORDS):
                frame.inverted[column, bit, word] = _ALL
            for digit in range(generators.bits.shape[1]):
                value = state & _DIGIT
                for word in range(BLOCK_WORDS):
                    frame.inverted[column, bit, word] ^= generators.bits[bit, digit, value, word]
                state >>= _4


@jit
def _fill(code: int, inverted: Words, words: Words, row: int) -> None:
    """Compute a code's row in a block: a one in each cycle in which the random number is less than the code."""
    less = splat(_0)
    for bit in range(inverted.shape[0]):
        zeros = load(inverted, bit)
        # if this bit differs between number and code, it decides regardless of the lower bits
        less = less | zeros if (code >> bit) & 1 else less & zeros
    store(words, row, less)


@jit
def _count(words: Words, places: npt.NDArray[np.uint32], line: int, width: int, mask: Words) -> int:
    """Return a line's count in a block: the number of ones in the AND of the line's rows and `mask`."""
    made = load(mask, 0)
    for i in range(width):
        made = made & load(words, places[line, i])
    return int(ones_in(made))


@jit
def fill_blocks(
    generators: Generators, store: _Store, frame: _Frame, first_slot: int, blocks: int, period: int
) -> None:
    """Fill the cache for the first `blocks` blocks of cycles after a restart from a seed bank.

    Block i goes to slot `first_slot` + i. `frame.starts` has the states of the generators at the restart.
    """
    for block in range(blocks):
        words = store.words[first_slot + block]
        filled = store.filled[first_slot + block]
        _show(generators, frame, (block * BLOCK_CYCLES) % period)
        for row in range(filled.shape[0]):
            if not filled[row]:
                _fill(store.row_code[row], frame.inverted[store.row_column[row]], words, row)
                filled[row] = True


@jit
def _mask(first: int, end: int, mask: Words) -> None:
    """Set a block's `mask`, one bit per cycle, to ones from cycle `first` to `end` - 1, and to zeros elsewhere."""
    for word in range(BLOCK_WORDS):
        start = word * WORD_BITS
        low = min(max(first - start, 0), WORD_BITS)
        high = min(max(end - start, 0), WORD_BITS)
        ones = _0
        if low < high:  # a shift by 64 would have no effect
            ones = (_ALL >> np.uint64(WORD_BITS - (high - low))) << np.uint64(low)
        mask[word] = ones


@jit
def _cycle_of(
    words: Words, places: npt.NDArray[np.uint32], width: int, mask: Words, line: int, nth: int
) -> int:
    """Return the cycle of a block in which a line's masked bit is 1 for the `nth` time, which must be in the block."""
    word = 0
    while True:
        made = mask[word]
        for i in range(width):
            made &= words[np.int64(places[line, i]) * BLOCK_WORDS + word]
        ones = ones_in_word(made)
        if nth <= ones:
            break
        nth -= ones
        word += 1
    for _ in range(nth - 1):
        made &= made - _1  # clears the lowest one
    return int(word * WORD_BITS + ones_in_word(~made & (made - _1)))


@jit
def _run(
    generators: Generators,
    store: _Store,
    frame: _Frame,
    replica: int,
    limit: int,
    target_count: int,
    first_slot: int,
    kept_blocks: int,
    period: int,
) -> None:
    """Run a replica from its present cycle to `limit`, or until a counter reaches the target."""
    outcome, places, widths = frame.outcome[replica], frame.places[replica], frame.widths[replica]
    sums, used_rows, added, mask = frame.sums[replica], frame.used[replica], frame.added, frame.mask
    live, used, cycles = outcome[LIVE], outcome[USED], outcome[CYCLES]
    overflow = False
    while cycles < limit and not overflow:
        block = cycles // BLOCK_CYCLES
        keep = block < kept_blocks
        slot = first_slot + block if keep else store.words.shape[0] - 1
        words = store.words[slot]
        filled = store.filled[slot]
        shown = False
        for i in range(used):
            row = used_rows[i]
            if filled[row]:
                continue
            if not shown:
                _show(generators, frame, (block * BLOCK_CYCLES) % period)
                shown = True
            _fill(store.row_code[row], frame.inverted[store.row_column[row]], words, row)
            filled[row] = keep
        first = cycles - block * BLOCK_CYCLES
        end = min(limit - block * BLOCK_CYCLES, BLOCK_CYCLES)
        _mask(first, end, mask)
        for i in range(live):
            ones = _count(words, places, i, widths[i], mask)
            added[i] = ones
            overflow |= sums[i] + ones >= target_count
        if overflow:
            # The first line that reaches the target stops all lines after that cycle.
            for i in range(live):
                missing = target_count - sums[i]
                if added[i] >= missing:
                    end = min(end, _cycle_of(words, places, widths[i], mask, i, missing) + 1)
            _mask(first, end, mask)
            for i in range(live):
                added[i] = _count(words, places, i, widths[i], mask)
        for i in range(live):
            sums[i] += added[i]
        cycles = block * BLOCK_CYCLES + end
    outcome[CYCLES] = cycles
    outcome[OVERFLOWED] = overflow
    counts, lines = frame.counts[replica], frame.lines[replica]
    for i in range(live):
        counts[lines[i]] = sums[i]


@jit
def begin(
    codes: npt.NDArray[np.uint16],
    ones: int,
    generators: Generators,
    store: _Store,
    frame: _Frame,
    frame_number: int,
    limit: int,
    target_count: int,
    first_slot: int,
    kept_blocks: int,
    period: int,
    new_rows: bool,
) -> int:
    """Find the lines that can count in each replica, run the first slice of each replica, and fill in `frame.outcome`.

    With `new_rows`, each code that the frame uses gets a row of the store before the first block is run. All replicas
    use the same row for the same code of a column. A replica in which no line can count runs no cycle.

    Returns the number of rows that were assigned to codes, or 0 without `new_rows`.
    """
    rows = _NO_ROWS
    for replica in range(codes.shape[0]):
        rows = _select(codes[replica], ones, store, frame, replica, frame_number + replica, new_rows, rows)
    frame.counts[:] = 0
    for replica in range(codes.shape[0]):
        if frame.outcome[replica, LIVE]:
            _run(generators, store, frame, replica, limit, target_count, first_slot, kept_blocks, period)
    return rows


@jit
def resume(
    generators: Generators,
    store: _Store,
    frame: _Frame,
    going: npt.NDArray[np.int64],
    limit: int,
    target_count: int,
    first_slot: int,
    kept_blocks: int,
    period: int,
) -> None:
    """Run the next slice of the replicas whose numbers are in `going`. Write the results to `frame`."""
    for replica in going:
        _run(generators, store, frame, replica, limit, target_count, first_slot, kept_blocks, period)
