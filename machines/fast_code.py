"""The fast kernels' machine code, which makes and counts the words of a block of cycles, and the arrays it works on.

Both are here: numba compiles anew when this file changes, but not when one does that it imports from.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, Final, NamedTuple, TypeVar, cast

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils as untyped_cgutils
from numba.extending import intrinsic

from machines.parameters import BM1Parameters, RngKind
from machines.rng import LFSR, Words, apply_map, jump_tables

WORD_BITS: Final = 64
BLOCK_WORDS: Final = 8  # one register of AVX-512, two of AVX2, four of NEON
BLOCK_CYCLES: Final = WORD_BITS * BLOCK_WORDS
NO_ROW: Final = -1
LIVE, USED, CYCLES, OVERFLOWED = range(4)  # in a replica's outcome
# a plain 0 has a type of its own: numba would compile `run` twice
_NO_CYCLE: Final = cast("int", np.int64(0))

cgutils: Any = untyped_cgutils
_Function = TypeVar("_Function", bound=Callable[..., Any])


def _jit(function: _Function) -> _Function:
    """Machine code for a function, cached on disk where there is a place that can be written to."""
    try:
        return cast("_Function", njit(cache=True, nogil=True)(function))
    except RuntimeError:  # no such place: every process compiles for itself
        return cast("_Function", njit(nogil=True)(function))


class Generators(NamedTuple):
    """What the LFSRs of all columns do, as linear maps of a state."""

    jumps: Words  # [bits, bits / 8, 256]: 2**i clocks on
    bits: Words  # [prob_bits, bits / 4, 16, BLOCK_WORDS]: the next block of each bit shown


class _Store(NamedTuple):
    """The words, by slot (a block of cycles of a bank; the last one is scratch) and row (a column's code)."""

    words: Words  # [slots, rows * BLOCK_WORDS]
    filled: npt.NDArray[np.uint8]  # [slots, rows]: whether those words are there to stay
    row_column: npt.NDArray[np.int64]  # [rows]
    row_code: npt.NDArray[np.int64]  # [rows]
    row_of_code: npt.NDArray[np.int32]  # [columns, 2**prob_bits]; NO_ROW where a code has none
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
    inverted: Words  # [columns, prob_bits, BLOCK_WORDS]: working space
    mask: Words  # [BLOCK_WORDS]: the cycles of a block that are run


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
    inverted: Words  # [columns, prob_bits, BLOCK_WORDS]
    mask: Words  # [BLOCK_WORDS]
    outcome: npt.NDArray[np.int64]  # [replicas, 4]: live lines, rows used, cycles, whether one overflowed


def store_of_codes(occurring: npt.NDArray[np.bool_], slots: int) -> _Store:
    """The memory for words of all codes that may occur, none of them there yet."""
    row_of_code = np.full(occurring.shape, NO_ROW, dtype=np.int32)
    row_column, row_code = np.nonzero(occurring)
    row_of_code[occurring] = np.arange(len(row_code), dtype=np.int32)
    return _store(row_of_code, row_column, row_code, slots)


def store_of_frame(occurring: npt.NDArray[np.bool_], cells: int, slots: int) -> _Store:
    """The memory for words of the codes that a frame of so many cells uses: rows are given out as it begins."""
    none = np.zeros(min(int(occurring.sum()), cells), dtype=np.int64)
    return _store(np.full(occurring.shape, NO_ROW, dtype=np.int32), none, none, slots)


def _store(
    row_of_code: npt.NDArray[np.int32],
    row_column: npt.NDArray[np.int64],
    row_code: npt.NDArray[np.int64],
    slots: int,
) -> _Store:
    """The memory for words in so many slots, and one for scratch."""
    rows = len(row_code)
    return _Store(
        words=_aligned((slots + 1, rows * BLOCK_WORDS)),
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


def make_frame(parameters: BM1Parameters, rows: int) -> _Frame:
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
        inverted=np.zeros((columns, parameters.prob_bits, BLOCK_WORDS), dtype=np.uint64),
        mask=np.zeros(BLOCK_WORDS, dtype=np.uint64),
    )


def make_replicas(parameters: BM1Parameters, rows: int) -> _Replicas:
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
        inverted=np.zeros((columns, parameters.prob_bits, BLOCK_WORDS), dtype=np.uint64),
        mask=np.zeros(BLOCK_WORDS, dtype=np.uint64),
        outcome=np.zeros((replicas, 4), dtype=np.int64),
    )


def first_frame(replicas: _Replicas) -> _Frame:
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
def bit_tables(kind: RngKind, steps_per_clock: int, prob_bits: int) -> Words:
    """The map from a state to a block of each bit shown: uint64[prob_bits, bits / 4, 16, BLOCK_WORDS].

    Like `machines.rng.map_tables`, but with a table per 4 bits of the state, so that all of them stay in the
    processor's nearest caches.
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
_I64: Final = ir.IntType(WORD_BITS)
_BLOCK: Final = ir.VectorType(_I64, BLOCK_WORDS)


def _constant_block(word: int) -> ir.Constant:
    return ir.Constant(_BLOCK, [ir.Constant(_I64, word)] * BLOCK_WORDS)


def _block_pointer(builder: Any, data: Any, place: Any) -> Any:
    """The address of the block of words that begins at a place of an array."""
    return builder.bitcast(builder.gep(data, [place]), _BLOCK.as_pointer())


def _load_block(builder: Any, data: Any, place: Any) -> Any:
    block = builder.load(_block_pointer(builder, data, place))
    block.align = WORD_BITS // 8  # arrays promise no more
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
        ones = _call_on_block(builder, f"llvm.ctpop.v{BLOCK_WORDS}i64", _BLOCK, builder.load(anded))
        return _call_on_block(builder, f"llvm.vector.reduce.add.v{BLOCK_WORDS}i64", _I64, ones)

    return types.int64(words, places, types.int64, types.int64, mask), code


_count = cast("Callable[[Words, npt.NDArray[np.uint32], int, int, Words], int]", intrinsic(_count_code))


def _fill_code(_context: Any, _code: Any, inverted: Any, words: Any, _place: Any) -> Any:
    """Make a block of words of a code in a column: what the generator shows < code, from the low bit up."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        shown, into = (context.make_array(signature.args[i])(context, builder, arguments[i]) for i in (1, 2))
        less = cgutils.alloca_once_value(builder, _constant_block(0))
        with cgutils.for_range(builder, builder.extract_value(shown.shape, 0)) as loop:
            first = builder.mul(loop.index, ir.Constant(_I64, BLOCK_WORDS))
            zeros = _load_block(builder, shown.data, first)
            bit = builder.trunc(builder.lshr(arguments[0], loop.index), ir.IntType(1))
            # A 0 is less than the code's 1, and a 1 is more than the code's 0, whatever the lower bits said.
            before = builder.load(less)
            builder.store(builder.select(bit, builder.or_(before, zeros), builder.and_(before, zeros)), less)
        store = builder.store(builder.load(less), _block_pointer(builder, into.data, arguments[3]))
        store.align = WORD_BITS // 8
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
def jump(jumps: Words, states: Words, clocks: int, later: Words) -> None:
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
            if new_rows and row == NO_ROW:
                row = rows
                rows += 1
                store.row_of_code[column, code] = row
                store.row_column[row] = column
                store.row_code[row] = code
            if store.row_frame[row] != frame_number:
                store.row_frame[row] = frame_number
                frame.used[used] = row
                used += 1
            frame.places[live, width] = row * BLOCK_WORDS
            width += 1
        frame.widths[live] = width
        frame.lines[live] = line
        frame.counts[live] = 0
        live += 1
    return live, used, rows


@_jit
def _show(generators: Generators, frame: _Frame, clocks: int) -> None:
    """Make a block's words of all bits that the generators show, inverted, from so many clocks on."""
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


@_jit
def fill_blocks(
    generators: Generators, store: _Store, frame: _Frame, first_slot: int, blocks: int, period: int
) -> None:
    """Make the words of all codes for a bank's first blocks, from the states in `frame.starts`."""
    for block in range(blocks):
        words = store.words[first_slot + block]
        filled = store.filled[first_slot + block]
        _show(generators, frame, (block * BLOCK_CYCLES) % period)
        for row in range(filled.shape[0]):
            if not filled[row]:
                _fill(store.row_code[row], frame.inverted[store.row_column[row]], words, row * BLOCK_WORDS)
                filled[row] = True


@_jit
def _mask(first: int, end: int, mask: Words) -> None:
    """Mark a block's cycles `first` to `end` - 1."""
    for word in range(BLOCK_WORDS):
        start = word * WORD_BITS
        low = min(max(first - start, 0), WORD_BITS)
        high = min(max(end - start, 0), WORD_BITS)
        ones = _0
        if low < high:  # a shift by 64 is none
            ones = (_ALL >> np.uint64(WORD_BITS - (high - low))) << np.uint64(low)
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
    return word * WORD_BITS + _popcount(~made & (made - _1))


@_jit
def run(
    generators: Generators,
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
        block = cycles // BLOCK_CYCLES
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
                _show(generators, frame, (block * BLOCK_CYCLES) % period)
                shown = True
            _fill(store.row_code[row], frame.inverted[store.row_column[row]], words, row * BLOCK_WORDS)
            filled[row] = keep
        first = cycles - block * BLOCK_CYCLES
        end = min(limit - block * BLOCK_CYCLES, BLOCK_CYCLES)
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
        cycles = block * BLOCK_CYCLES + end
    return cycles, overflow


@_jit
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
) -> tuple[int, int, int, bool]:
    """Select a frame's lines and run its first cycles: what `_select` and `run` return, one after the other.

    A frame in which no line can count runs no cycle.
    """
    live, used, _ = _select(codes, ones, store, frame, frame_number, kept_blocks == 0, _NO_CYCLE)
    if live == 0:
        return live, used, _NO_CYCLE, False
    cycles, overflow = run(
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
def begin_replicas(
    codes: npt.NDArray[np.uint16],
    ones: int,
    generators: Generators,
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
        replicas.outcome[at, LIVE] = live
        replicas.outcome[at, USED] = used
        replicas.outcome[at, CYCLES] = _NO_CYCLE
        replicas.outcome[at, OVERFLOWED] = False
    for at in range(codes.shape[0]):
        if replicas.outcome[at, LIVE]:
            _run_replica(
                generators, store, replicas, at, limit, target_count, first_slot, kept_blocks, period
            )
    return rows


@_jit
def resume_replicas(
    generators: Generators,
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
    generators: Generators,
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
    cycles, overflow = run(
        generators,
        store,
        _frame_of(replicas, at),
        outcome[LIVE],
        outcome[USED],
        outcome[CYCLES],
        limit,
        target_count,
        first_slot,
        kept_blocks,
        period,
    )
    outcome[CYCLES] = cycles
    outcome[OVERFLOWED] = overflow


@_jit
def copy_counts(replicas: _Replicas, counts: npt.NDArray[np.uint32]) -> None:
    """Put the counters of the lines that can count where they belong."""
    for at in range(counts.shape[0]):
        for i in range(replicas.outcome[at, LIVE]):
            counts[at, replicas.lines[at, i]] = replicas.counts[at, i]
