"""The fast BM2 for LFSRs: one chain, or several in turns, with the same results as the reference, bit for bit.

A bit is written in the first cycle in which its CDEs agree. Until then the state, and so the codes, stay as they
are: each code is compared with the numbers of 32 cycles at a time, and the first agreement is found in the masks.

The numbers of a block of cycles are kept for each CDE. A generator's number in cycle t is the XOR of its numbers in
the cycles t - e, for the exponents e of its polynomial, since each bit of an LFSR's state shows the LFSR's sequence,
and every 2**k-th bit of that sequence is the same sequence at another phase (`steps_per_clock` is a power of two).
For the same reason it is the XOR of those in the cycles t - 32 * e, which makes 32 numbers at a time.
"""

from collections.abc import Callable, Iterable
from itertools import accumulate
from typing import Any, Final, NamedTuple, cast

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.core import cgutils as untyped_cgutils
from numba.extending import intrinsic

from machines.bm2 import BM2Machine, BM2Parameters, BM2Start, BM2StopReason, pack, unpack
from machines.bm2_kernel import BM2Kernel
from machines.errors import MachineError
from machines.fast_code import jit, jump
from machines.parameters import CYCLES_MAX, RngKind, RngReset, SampleEvery, Sequencer
from machines.rng import LFSR, POLYNOMIALS, Words, jump_tables, random_numbers

CHUNK: Final = 32
"""Number of cycles that are looked at together: the bits of a mask."""

STREAM_ROOM: Final = 4096
"""Number of samples for which a stream's buffer has room at first; it grows when it must."""

KEPT_MOVES: Final = 64
"""Maximum number of sets of known variables whose moves are kept."""

Integers = npt.NDArray[np.int64]
cgutils: Any = untyped_cgutils

# Fields of a lane's `control`. Its next cycle is ORIGIN + AT; the others of a cycle count from ORIGIN, too.
(AT, ORIGIN, END, BEGAN, PENDING, PLACE, BURN_IN, SAMPLES, UNUSED, STREAMED, ORDER, REASON, TIMED_OUT) = (
    range(13)
)
# Fields of `settings`, which all lanes share.
OPS_TIMEOUT, SAMPLES_DUE, LIMIT, PAUSE_AT, STREAM, RANDOM, EVERY_MOVE = range(7)
# Columns of `Wiring.bits`, `Wiring.entries` and `Moves.counted`.
VARIABLE, SHIFT, FIRST_ENTRY, LAST_ENTRY = range(4)
ROW, ADDRESS, BASE, BELOW, ABOVE, LOCAL = range(6)
FIRST_WORD, CARDINALITY = 1, 2

# Reasons of a lane to stop: those of a machine, and that its stream's buffer must grow.
DRAWN, OUT_OF_CYCLES, PAUSED = (
    int(r) for r in (BM2StopReason.SAMPLES, BM2StopReason.MAX_CYCLES, BM2StopReason.PAUSED)
)
OUT_OF_TIME, FULL, ROOM = int(BM2StopReason.OPS_TIMEOUT), int(BM2StopReason.FULL), 7


class Wiring(NamedTuple):
    """A machine's tables and wiring."""

    codes: npt.NDArray[np.uint16]  # the tables of all CDEs, then the code 2**(prob_bits - 1)
    bits: Words  # [state bits, 4]: its variable, its place in the variable's code, and its entries
    # [entries, 5]: a CDE that is compared for a bit, where its code is (BASE, and masks of the local bits below and
    # above the pointed one), and the pointed local bit; all masks are 0 for a CDE that is not concerned
    entries: Words
    exponents: Integers  # of the generators' polynomial
    clock: Words  # [1, bytes, 256]: a clock of the generators
    order_clock: Words  # [1, 2, 256]: a clock of the sequencer's LFSR16
    places: Words  # [variables, 2]: first word in the packed state, shift in that word
    searched: Words  # [searched variables, 2]: variable, its bits
    joint_word: np.uint64  # first result word of the joint; 0 for no joint


class Moves(NamedTuple):
    """The moves of a sweep, for an order and a set of known variables."""

    first: Words  # [moves + 1]: place of a move's first bit in `bits`
    bits: Words
    counted: Words  # [unknown variables, 3]: variable, first word of its histogram, cardinality


class Lanes(NamedTuple):
    """The chains that are run together. The first index of every array is the chain's."""

    control: Integers  # [lanes, 16]
    values: Words  # [lanes, variables]: codes of the state
    addresses: Words  # [lanes, CDEs]: local bits of the factor
    pending: Words  # [lanes, state bits]: bits of the move that are not yet written, in rising order
    numbers: npt.NDArray[
        np.uint16
    ]  # [lanes, CDEs, block + CHUNK]: from the cycle ORIGIN on; the last ones are unused
    results: Integers  # [lanes, result words]
    stream: npt.NDArray[np.uint32]  # [lanes, room, state words]


class FastBM2(BM2Kernel):
    """A kernel for a machine with LFSRs that looks at many cycles at a time (thesis 2.1.3).

    Raises:
        MachineError: The generators of the machine are not LFSRs.
    """

    def __init__(self, machine: BM2Machine) -> None:
        super().__init__(machine)
        self._engine = ChainEngine(machine)
        self._lanes = self._engine.lanes(1)
        self._settings = np.zeros(7, dtype=np.int64)
        self._moves = self._engine.moves(0, machine.parameters.sequencer)
        self._starts = np.zeros(machine.parameters.cdes, dtype=np.uint64)  # of the generators, in cycle 0
        self.reset()

    @property
    def state(self) -> int:
        """The packed state after the last cycle."""
        return self._engine.packed(self._lanes, 0)

    @property
    def results(self) -> npt.NDArray[np.uint32]:
        """A copy of the result words: uint32[result_words], histograms, then the joint."""
        return np.array(self._lanes.results[0], dtype=np.uint32)

    @property
    def rng_state(self) -> Words:
        """A copy of the generators' states: uint64[CDEs]."""
        # `start` sets the public number of cycles to 0 before free generators go on
        control = self._lanes.control[0]
        return self._engine.later(self._starts, int(control[ORIGIN] + control[AT]))

    @property
    def sequencer_state(self) -> int:
        """The state of the sequencer's own generator, which only moves in `random` order."""
        return int(self._lanes.control[0, ORDER])

    @property
    def stream(self) -> npt.NDArray[np.uint32]:
        """A copy of the stream's buffer: uint32[samples since the last start or resume, state_words]."""
        return self._lanes.stream[0, : self._lanes.control[0, STREAMED]].copy()

    def _reset(self) -> None:
        self._lanes.control[:] = 0
        self._restart(0)
        self._lanes.values[:] = 0
        self._lanes.results[:] = 0

    def _restart(self, bank: int) -> None:
        self._starts = self._engine.random_numbers.restart(bank)
        self._lanes.control[0, ORDER] = order_seed(self._machine.parameters, bank)

    def _load(self, start: BM2Start) -> None:
        if self._machine.parameters.rng_reset is RngReset.BANK:
            self._restart(start.bank)
        else:
            self._starts = self.rng_state
        self._moves = self._engine.moves(start.known, start.sequencer)
        self._settings[:] = self._engine.settings(start)
        self._engine.load(self._lanes, self._moves, 0, start, self._starts)

    def _empty_stream(self) -> None:
        self._lanes.control[0, STREAMED] = 0

    def _run(self, pause_at: int) -> None:
        self._settings[SAMPLES_DUE] = self._samples_due
        self._settings[PAUSE_AT] = pause_at or CYCLES_MAX
        self._lanes = self._engine.run(self._lanes, self._moves, self._settings, range(1))
        control = self._lanes.control[0]
        self.cycles = int(control[ORIGIN] + control[AT])
        self.samples, self.unused = int(control[SAMPLES]), int(control[UNUSED])
        self.reason = BM2StopReason(control[REASON])
        self.timed_out_bit = int(control[TIMED_OUT])


class ChainEngine:
    """The compiled code's view of a machine. Machines that differ only in their seeds can share it."""

    def __init__(self, machine: BM2Machine) -> None:
        parameters = machine.parameters
        if parameters.rng.lfsr_bits is None:
            raise MachineError(
                f"The fast kernel supports only LFSRs; this machine has rng = {parameters.rng}; use the reference kernel."
            )
        self._parameters = parameters
        self._jumps = jump_tables(parameters.rng, parameters.steps_per_clock).copy()
        self._kept_moves: dict[tuple[int, Sequencer], Moves] = {}
        self._local_bits = [parameters.factor_bits(cde) for cde in range(parameters.cdes)]
        self.random_numbers = random_numbers(machine)
        self.wiring = _wiring(machine, self._jumps)

    def lanes(self, count: int) -> Lanes:
        """Return chains whose state is 0."""
        parameters = self._parameters
        numbers = (int(self.wiring.exponents[0]) + 1) * CHUNK
        room = min(parameters.stream, STREAM_ROOM)
        return Lanes(
            control=np.zeros((count, 16), dtype=np.int64),
            values=np.zeros((count, len(parameters.cardinalities)), dtype=np.uint64),
            addresses=np.zeros((count, parameters.cdes + 1), dtype=np.uint64),
            pending=np.zeros((count, parameters.state_bits), dtype=np.uint64),
            numbers=np.zeros((count, parameters.cdes, numbers), dtype=np.uint16),
            results=np.zeros((count, parameters.result_words), dtype=np.int64),
            stream=np.zeros((count, room, parameters.state_words), dtype=np.uint32),
        )

    def moves(self, known: int, sequencer: Sequencer) -> Moves:
        """Return the moves of a sweep."""
        moves = self._kept_moves.get((known, sequencer))
        if moves is None:
            if len(self._kept_moves) == KEPT_MOVES:
                self._kept_moves.clear()
            moves = self._kept_moves[known, sequencer] = _moves(self._parameters, known, sequencer)
        return moves

    def settings(self, start: BM2Start) -> Integers:
        """Return the settings of a run, without a pause."""
        every_move = self._parameters.sample_every is SampleEvery.MOVE
        settings = (start.ops_timeout, start.samples, start.max_cycles, CYCLES_MAX, self._parameters.stream)
        return np.array([*settings, start.sequencer is Sequencer.RANDOM, every_move], dtype=np.int64)

    def load(self, lanes: Lanes, moves: Moves, lane: int, start: BM2Start, generators: Words) -> None:
        """Load a chain for a start, whose generators are in these states."""
        parameters = self._parameters
        control = lanes.control[lane]
        order = control[ORDER]
        control[:] = 0
        control[ORDER], control[BURN_IN], control[TIMED_OUT] = order, start.burn_in, -1
        lanes.values[lane] = unpack(parameters, start.state)
        for cde, local_bits in enumerate(self._local_bits):
            lanes.addresses[lane, cde] = sum(
                (start.state >> bit & 1) << j for j, bit in enumerate(local_bits)
            )
        lanes.results[lane] = 0
        random = start.sequencer is Sequencer.RANDOM
        move = int(order) * (len(moves.first) - 1) >> 16 if random else 0
        first, end = moves.first[move : move + 2].tolist()
        pending = moves.bits[first:end]
        control[PENDING] = len(pending)
        lanes.pending[lane, : len(pending)] = pending
        fill(self.wiring, lanes.numbers[lane], generators, parameters.ones_code)

    def run(self, lanes: Lanes, moves: Moves, settings: Integers, going: Iterable[int]) -> Lanes:
        """Run chains until each stops, and return all of them: with a larger buffer where the stream's was too small."""
        running = np.fromiter(going, dtype=np.uint64)
        while running.size:
            room = lanes.stream.shape[1]
            if room < self._parameters.stream and (lanes.control[running, STREAMED] == room).any():
                stream = np.zeros_like(
                    lanes.stream,
                    shape=(len(lanes.stream), min(2 * room, self._parameters.stream), lanes.stream.shape[2]),
                )
                stream[:, :room] = lanes.stream
                lanes = lanes._replace(stream=stream)
            run(self.wiring, moves, lanes, settings, running)
            running = running[lanes.control[running, REASON] == ROOM]
        return lanes

    def packed(self, lanes: Lanes, lane: int) -> int:
        """Return the packed state of a chain."""
        return pack(self._parameters, lanes.values[lane].tolist())

    def later(self, generators: Words, cycles: int) -> Words:
        """Return the generators' states after some cycles."""
        states = np.empty_like(generators)
        jump(self._jumps, generators, cycles % LFSR(self._parameters.rng).period, states)
        return states


def order_seed(parameters: BM2Parameters, bank: int) -> int:
    """Return the state of the sequencer's LFSR16 at the start of a bank."""
    number = np.array([parameters.seed_set(bank)], dtype=np.uint64)
    return int(LFSR(RngKind.LFSR16).seeds(number)[0])


def warm_up() -> None:
    """Compile the kernel, or load it from the cache."""
    parameters = BM2Parameters(cardinalities=(2,), factors=((0,),), stream=1)
    kernel = FastBM2(BM2Machine.from_factors(parameters, [[0.5, 0.5]]))
    kernel.start(BM2Start(state=0, known=0, samples=1, burn_in=0, ops_timeout=1000, max_cycles=1000))


def _wiring(machine: BM2Machine, jumps: Words) -> Wiring:
    parameters = machine.parameters
    tables = [*machine.tables, np.array([1 << (parameters.prob_bits - 1)], dtype=np.uint16)]
    bases = list(accumulate(map(len, tables), initial=0))
    # the CDEs whose factor has a bit, and the bit's place in that factor
    concerned: list[list[tuple[int, int]]] = [[] for _ in range(parameters.state_bits)]
    for cde in range(parameters.cdes):
        for j, bit in enumerate(parameters.factor_bits(cde)):
            concerned[bit].append((cde, j))
    exponents = POLYNOMIALS[parameters.rng]
    row = (exponents[0] + 1) * CHUNK
    bits: list[tuple[int, ...]] = []
    entries: list[tuple[int, ...]] = []
    for variable, (width, offset) in enumerate(zip(parameters.bits, parameters.offsets, strict=True)):
        for shift in range(width):
            first = len(entries)
            for cde, j in concerned[offset + shift]:
                half = len(tables[cde]) // len(parameters.factor_bits(cde))
                below = (1 << j) - 1
                entries.append((cde * row, cde, bases[cde] + j * half, below, half - 1 - below, j))
            if parameters.literal:
                others = set(range(parameters.cdes)) - {cde for cde, _ in concerned[offset + shift]}
                entries += [(cde * row, parameters.cdes, bases[-2], 0, 0, 0) for cde in sorted(others)]
            bits.append((variable, shift, first, len(entries)))
    return Wiring(
        codes=np.concatenate(tables),
        bits=np.array(bits, dtype=np.uint64),
        entries=np.array(entries, dtype=np.uint64),
        exponents=np.array(exponents, dtype=np.int64),
        clock=jumps[:1].copy(),
        order_clock=jump_tables(RngKind.LFSR16, 16)[:1].copy(),
        places=np.array([divmod(offset, 32) for offset in parameters.offsets], dtype=np.uint64),
        searched=np.array(
            [(variable, parameters.bits[variable]) for variable in parameters.searched], dtype=np.uint64
        ).reshape(-1, 2),
        joint_word=np.uint64(parameters.histogram_words if parameters.joint_words else 0),
    )


def _moves(parameters: BM2Parameters, known: int, sequencer: Sequencer) -> Moves:
    moves = parameters.moves(known, sequencer)
    first_words = accumulate((1 << bits for bits in parameters.bits), initial=0)
    counted = [
        (variable, word, cardinality)
        for variable, (word, cardinality, mask) in enumerate(
            zip(first_words, parameters.cardinalities, parameters.masks, strict=False)
        )
        if mask and not known & mask
    ]
    return Moves(
        first=np.array([0, *accumulate(map(len, moves))], dtype=np.uint64),
        bits=np.array([bit for move in moves for bit in move], dtype=np.uint64),
        counted=np.array(counted, dtype=np.uint64).reshape(-1, 3),
    )


# Everything below is compiled, once for all machines; see `machines.fast_code` for its types. Chunks of numbers are
# written in LLVM's terms, where they are one vector on any processor.

_0: Final = np.uint64(0)
_1: Final = np.uint64(1)
_8: Final = np.uint64(8)
_BYTE: Final = np.uint64(255)
_32: Final = np.uint64(32)
_LOW_WORD: Final = np.uint64(2**32 - 1)
_ALL: Final = np.uint64(2**CHUNK - 1)

_NUMBERS: Final = ir.VectorType(ir.IntType(16), CHUNK)


def _load_chunk(context: Any, builder: Any, signature: Any, array: Any, place: Any) -> tuple[Any, Any]:
    """Load a chunk of the numbers from a place on; return it and its address."""
    data = context.make_array(signature.args[0])(context, builder, array).data
    address = builder.bitcast(builder.gep(data, [place]), _NUMBERS.as_pointer())
    chunk = builder.load(address)
    chunk.align = 2  # arrays guarantee no more
    return chunk, address


def _less_code(_context: Any, numbers: Any, _place: Any, _code: Any) -> Any:
    """Compare a chunk with a code: bit i is 1 if number i is less."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        chunk, _ = _load_chunk(context, builder, signature, arguments[0], arguments[1])
        zero = ir.Constant(ir.IntType(32), 0)
        one = builder.insert_element(
            ir.Constant(_NUMBERS, ir.Undefined), builder.trunc(arguments[2], ir.IntType(16)), zero
        )
        mask = ir.Constant(ir.VectorType(ir.IntType(32), CHUNK), [0] * CHUNK)
        codes = builder.shuffle_vector(one, ir.Constant(_NUMBERS, ir.Undefined), mask)
        less = builder.icmp_unsigned("<", chunk, codes)
        return builder.zext(builder.bitcast(less, ir.IntType(CHUNK)), ir.IntType(64))

    return types.uint64(numbers, types.int64, types.int64), code


_less = cast("Callable[[npt.NDArray[np.uint16], int, int], np.uint64]", intrinsic(_less_code))


def _mix_code(_context: Any, numbers: Any, _place: Any, _first: Any, _second: Any, _third: Any) -> Any:
    """XOR three chunks into the first one."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        chunk, address = _load_chunk(context, builder, signature, arguments[0], arguments[1])
        for place in arguments[2:]:
            chunk = builder.xor(chunk, _load_chunk(context, builder, signature, arguments[0], place)[0])
        builder.store(chunk, address).align = 2
        return context.get_dummy_value()

    return types.void(numbers, *(types.int64,) * 4), code


_mix = cast("Callable[[npt.NDArray[np.uint16], int, int, int, int], None]", intrinsic(_mix_code))


def _first_code(_context: Any, _word: Any) -> Any:
    """Return the place of the lowest 1 of a word that is not 0."""

    def code(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), code


_first = cast("Callable[[np.uint64], np.uint64]", intrinsic(_first_code))


@jit
def _image(map_: Words, state: np.uint64) -> np.uint64:
    """Return the image of a state under a linear map."""
    image = np.uint64(0)
    for byte in range(map_.shape[1]):
        image ^= map_[0, byte, state & _BYTE]
        state >>= _8
    return image


@jit
def fill(wiring: Wiring, numbers: npt.NDArray[np.uint16], generators: Words, ones: int) -> None:
    """Compute the first block of a chain's numbers."""
    exponents = wiring.exponents
    for cde in range(generators.shape[0]):
        state = generators[cde]
        for t in range(exponents[0]):
            numbers[cde, t] = np.int64(state) & ones
            state = _image(wiring.clock, state)
        for t in range(exponents[0], exponents[0] * CHUNK):
            number = numbers[cde, t - exponents[0]]
            for i in range(1, 4):
                number ^= numbers[cde, t - exponents[i]]
            numbers[cde, t] = number


@jit
def _refill(exponents: Integers, numbers: npt.NDArray[np.uint16], first: int, rows: int) -> None:
    """Replace a chain's numbers by those of the next block, a chunk at a time."""
    top = exponents[0]
    for row in range(rows):
        base = first + row * (top + 1) * CHUNK
        for chunk in range(top):
            _mix(
                numbers,
                base + chunk * CHUNK,
                base + (chunk - exponents[1]) % top * CHUNK,
                base + (chunk - exponents[2]) % top * CHUNK,
                base + (chunk - exponents[3]) % top * CHUNK,
            )


@jit
def run(  # noqa: PLR0915 - a call of a function takes longer than a move
    wiring: Wiring, moves: Moves, lanes: Lanes, settings: Integers, going: Words
) -> None:
    """Run chains in turns, a move each, until each has a reason to stop.

    Turns hide the time that a move waits for the one before.
    """
    ops_timeout, samples_due, pause_at = settings[OPS_TIMEOUT], settings[SAMPLES_DUE], settings[PAUSE_AT]
    max_cycles, stream, room = settings[LIMIT], settings[STREAM], lanes.stream.shape[1]
    random, every_move = settings[RANDOM], settings[EVERY_MOVE]
    sweep_moves = moves.first.shape[0] - 1
    rows = lanes.numbers.shape[1]
    row_size = lanes.numbers.shape[2]
    block = row_size - CHUNK
    limit = min(max_cycles, pause_at)
    numbers = lanes.numbers.reshape(-1)
    entries, bits, codes, places = wiring.entries, wiring.bits, wiring.codes, wiring.places
    searched, joint_word = wiring.searched, wiring.joint_word
    order_clock, exponents = wiring.order_clock, wiring.exponents
    first, moved, counted = moves.first, moves.bits, moves.counted
    control, values, addresses, pending = lanes.control, lanes.values, lanes.addresses, lanes.pending
    results, streamed = lanes.results, lanes.stream
    for lane in going:
        control[lane, REASON] = 0
        control[lane, END] = min(block, limit - control[lane, ORIGIN])
    running = going.copy()
    count = running.shape[0]
    while count:
        left = 0
        for turn in range(count):
            lane = running[turn]
            base = np.int64(lane) * rows * row_size
            at = control[lane, AT]
            end = min(control[lane, END], control[lane, BEGAN] + ops_timeout)
            latest = at
            missing = _0
            for i in range(np.uint64(control[lane, PENDING])):
                bit = pending[lane, i]
                first_entry, last_entry = bits[bit, FIRST_ENTRY], bits[bit, LAST_ENTRY]
                start = at
                while True:
                    all_ones, some_ones = _ALL, _0
                    for entry in range(first_entry, last_entry):
                        address = addresses[lane, entries[entry, ADDRESS]]
                        others = (address & entries[entry, BELOW]) | ((address >> _1) & entries[entry, ABOVE])
                        code = codes[entries[entry, BASE] + others]
                        less = _less(numbers, base + np.int64(entries[entry, ROW]) + start, code)
                        all_ones &= less
                        some_ones |= less
                    agree = (all_ones | ~some_ones) & (_ALL >> np.uint64(CHUNK - min(end - start, CHUNK)))
                    start += CHUNK
                    if agree or start >= end:
                        break
                if not agree:
                    pending[lane, missing] = bit
                    missing += _1
                    continue
                nth = _first(agree)
                variable, shift = bits[bit, VARIABLE], bits[bit, SHIFT]
                flip = ((all_ones >> nth) ^ (values[lane, variable] >> shift)) & _1
                values[lane, variable] ^= flip << shift
                for entry in range(first_entry, last_entry):
                    addresses[lane, entries[entry, ADDRESS]] ^= flip << entries[entry, LOCAL]
                latest = max(latest, start + np.int64(nth) + 1 - CHUNK)
            reason = 0
            if missing:
                control[lane, PENDING] = missing
                at = end
                if at == control[lane, BEGAN] + ops_timeout:
                    reason = OUT_OF_TIME
                    control[lane, TIMED_OUT] = pending[lane, 0]
            else:
                at = latest
                place = control[lane, PLACE] + 1
                ends_sweep = place == sweep_moves
                sampled = control[lane, BURN_IN] == 0 and (ends_sweep or every_move != 0)
                if ends_sweep:
                    place = 0
                    control[lane, BURN_IN] -= control[lane, BURN_IN] > 0
                control[lane, PLACE] = place
                if random:
                    control[lane, ORDER] = np.int64(_image(order_clock, np.uint64(control[lane, ORDER])))
                    place = (control[lane, ORDER] * sweep_moves) >> 16
                first_bit = first[np.uint64(place)]
                count_of_bits = first[np.uint64(place + 1)] - first_bit
                for i in range(count_of_bits):
                    pending[lane, i] = moved[first_bit + i]
                control[lane, PENDING] = count_of_bits
                control[lane, BEGAN] = at
                if sampled:
                    control[lane, SAMPLES] += 1
                    if stream:
                        row = control[lane, STREAMED]
                        control[lane, STREAMED] += 1
                        streamed[lane, row] = 0
                        for i in range(values.shape[1]):
                            shifted, word = values[lane, i] << places[i, 1], places[i, 0]
                            streamed[lane, row, word] |= np.uint32(shifted & _LOW_WORD)
                            if shifted >> _32:
                                streamed[lane, row, word + _1] |= np.uint32(shifted >> _32)
                    unused = False
                    for i in range(counted.shape[0]):
                        unused |= values[lane, counted[i, VARIABLE]] >= counted[i, CARDINALITY]
                    if unused:
                        control[lane, UNUSED] += 1
                    else:
                        for i in range(counted.shape[0]):
                            results[lane, counted[i, FIRST_WORD] + values[lane, counted[i, VARIABLE]]] += 1
                        if joint_word:
                            joint = _0
                            for i in range(searched.shape[0]):
                                joint = (joint << searched[i, 1]) | values[lane, searched[i, 0]]
                            results[lane, joint_word + joint] += 1
                    if control[lane, SAMPLES] == samples_due:
                        reason = DRAWN
                    elif control[lane, STREAMED] == room and stream:
                        reason = FULL if room == stream else ROOM
            control[lane, AT] = at
            if reason or at == control[lane, END]:
                cycles = control[lane, ORIGIN] + at
                if reason not in (DRAWN, OUT_OF_TIME) and cycles == max_cycles:
                    reason = OUT_OF_CYCLES
                elif reason in (0, ROOM) and cycles == pause_at:
                    reason = PAUSED
                if reason == 0:
                    _refill(exponents, numbers, base, rows)
                    control[lane, ORIGIN] += block
                    control[lane, BEGAN] -= block
                    control[lane, AT] = 0
                    control[lane, END] = min(block, limit - control[lane, ORIGIN])
                control[lane, REASON] = reason
            if reason == 0:
                running[left] = lane
                left += 1
        count = left
