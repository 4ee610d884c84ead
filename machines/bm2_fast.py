"""The fast BM2 for LFSRs, with the same results as the reference, bit for bit.

The machine writes a bit of the state in the first cycle in which the CDEs of this bit agree. Until then, neither the
state nor the codes change. So the kernel compares each code with the random numbers of 32 cycles at a time. Each
comparison gives a mask of 32 bits. The masks of a bit's CDEs show the first cycle in which these CDEs agree.

The random numbers of a block of cycles are stored for each CDE. A generator's number in cycle t is the XOR of its
numbers in the cycles t - e, for the exponents e of its polynomial. This recurrence holds because each bit of an LFSR's
state goes through the LFSR's sequence. Every 2**k-th bit of the sequence gives the same sequence at another phase. So
the recurrence also holds for `steps_per_clock` > 1, because `steps_per_clock` is a power of two. As 32 is a power of
two, the number in cycle t is also the XOR of the numbers in the cycles t - 32 * e. So 32 numbers are computed at once.
"""

from functools import lru_cache, partial
from itertools import accumulate
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types

from machines.bm2 import BM2Machine, BM2Parameters, BM2Start, BM2StopReason, pack, unpack
from machines.bm2_kernel import BM2Kernel
from machines.errors import MachineError
from machines.fast_code import image, jit, jump
from machines.parameters import CYCLES_MAX, RngKind, SampleEvery, Sequencer
from machines.rng import LFSR, POLYNOMIALS, Words, jump_tables
from machines.vectors import aligned, first_one, in_llvm, load, repeated, store

CHUNK: Final = 32
"""Number of cycles that are examined together. A mask has a bit for each of the cycles."""

STREAM_ROOM: Final = 4096
"""Initial capacity of a stream's buffer, in samples. A full buffer is enlarged."""

Integers = npt.NDArray[np.int64]

# Fields of `Chain.control`. The next cycle is ORIGIN + AT; END and BEGAN (of the move) count from ORIGIN, too.
AT, ORIGIN, END, BEGAN, PENDING, PLACE, BURN_IN, SAMPLES, UNUSED, STREAMED, ORDER, REASON, TIMED_OUT = range(
    13
)
# Fields of the settings of a run.
OPS_TIMEOUT, SAMPLES_DUE, LIMIT, PAUSE_AT, STREAM, RANDOM, EVERY_MOVE = range(7)
# Columns of `Wiring.bits`, `Wiring.entries` and `Moves.counted`.
VARIABLE, SHIFT, FIRST_ENTRY, LAST_ENTRY = range(4)
ROW, ADDRESS, BASE, LOCAL = range(4)
FIRST_WORD, CARDINALITY = 1, 2

# Reasons to stop: those of a machine, and that the stream's buffer must grow.
DRAWN, OUT_OF_CYCLES = int(BM2StopReason.SAMPLES), int(BM2StopReason.MAX_CYCLES)
PAUSED, OUT_OF_TIME = int(BM2StopReason.PAUSED), int(BM2StopReason.OPS_TIMEOUT)
FULL, ROOM = int(BM2StopReason.FULL), 7


class Wiring(NamedTuple):
    """A machine's tables and wiring."""

    codes: npt.NDArray[np.uint16]  # of each entry, by the factor's bits; first, twice 2**(prob_bits - 1)
    bits: Words  # [state bits, 4]: its variable, its place in the variable's code, and its entries
    # [entries, 4]: a CDE that is compared for a bit: its first random number, its place in `Chain.addresses` (the
    # unused one if its factor does not have the bit), its first code, and the place of the bit in the factor
    entries: Words
    exponents: Integers  # of the generators' polynomial
    clock: Words  # [1, bytes, 256]: a clock of the generators
    order_clock: Words  # [1, 2, 256]: a clock of the sequencer's LFSR16
    places: Words  # [variables, 2]: first word in the packed state, shift in that word
    searched: Words  # [searched variables, 2]: variable, its bits
    joint_word: np.uint64  # first result word of the joint; 0 for no joint


class Moves(NamedTuple):
    """The moves of a Gibbs sweep. They depend on the order of the sequencer and on the set of known variables."""

    first: Words  # [moves + 1]: place of a move's first bit in `bits`
    bits: Words
    counted: Words  # [unknown variables, 3]: variable, first word of its histogram, cardinality


class Chain(NamedTuple):
    """The state of a Markov chain between two clock cycles."""

    control: Integers  # [13]
    values: Words  # [variables]: codes of the state
    addresses: Words  # [CDEs + 1]: values of each factor's bits; the last one is unused
    pending: Words  # [state bits]: bits of the move that are not yet written, in rising order
    numbers: npt.NDArray[
        np.uint16
    ]  # [CDEs, block + CHUNK]: random numbers of the cycles from ORIGIN on; the last are unused
    results: Integers  # [result words]
    stream: npt.NDArray[np.uint32]  # [room, state words]


class FastBM2(BM2Kernel):
    """A kernel that runs many cycles at a time (thesis 2.1.3).

    The constructor raises a MachineError if the generators are not LFSRs.
    """

    def __init__(self, machine: BM2Machine) -> None:
        super().__init__(machine)
        parameters = machine.parameters
        if parameters.rng.lfsr_bits is None:
            raise MachineError(
                f"The fast kernel supports only LFSRs; this machine has rng = {parameters.rng}; use the reference kernel."
            )
        self._jumps = jump_tables(parameters.rng, parameters.steps_per_clock).copy()
        self._wiring = wiring_of(machine)
        self._moves_of = lru_cache(64)(partial(moves_of, parameters))  # by known bits and order
        self._settings = np.zeros(7, dtype=np.int64)
        self._chain = Chain(
            control=np.zeros(13, dtype=np.int64),
            values=np.zeros(len(parameters.cardinalities), dtype=np.uint64),
            addresses=np.zeros(parameters.cdes + 1, dtype=np.uint64),
            pending=np.zeros(parameters.state_bits, dtype=np.uint64),
            numbers=aligned((parameters.cdes, row_size(parameters)), np.uint16),
            results=self._results,
            stream=np.zeros((min(parameters.stream, STREAM_ROOM), parameters.state_words), dtype=np.uint32),
        )
        self.reset()

    @property
    def state(self) -> int:
        """The packed state after the last cycle."""
        return pack(self._parameters, self._chain.values.tolist())

    @property
    def rng_state(self) -> Words:
        """A copy of the generators' states: uint64[CDEs]."""
        # `start` sets the public number of cycles to 0 before free generators go on
        cycles = int(self._chain.control[ORIGIN] + self._chain.control[AT])
        # `_states` are the states in cycle 0 of the frame
        states = np.empty_like(self._states)
        jump(self._jumps, self._states, cycles % LFSR(self._parameters.rng).period, states)
        return states

    @property
    def stream(self) -> npt.NDArray[np.uint32]:
        """A copy of the samples since the last start or resume: uint32[samples, state_words]."""
        return self._chain.stream[: self._chain.control[STREAMED]].copy()

    def _load(self, start: BM2Start) -> None:
        parameters, chain = self._parameters, self._chain
        control = chain.control
        control[:] = 0
        control[ORDER] = self.sequencer_state
        control[BURN_IN], control[TIMED_OUT] = start.burn_in, -1
        load_state(parameters, start.state, chain.values, chain.addresses)
        fill(self._wiring, chain.numbers, self._states, parameters.ones_code)

        moves = self._moves = self._moves_of(start.known, start.sequencer)
        random = start.sequencer is Sequencer.RANDOM
        move = int(control[ORDER]) * (len(moves.first) - 1) >> 16 if random else 0
        pending = moves.bits[slice(*moves.first[move : move + 2].tolist())]
        control[PENDING] = len(pending)
        chain.pending[: len(pending)] = pending

        every_move = parameters.sample_every is SampleEvery.MOVE
        self._settings[[OPS_TIMEOUT, LIMIT]] = start.ops_timeout, start.max_cycles
        self._settings[STREAM:] = parameters.stream, random, every_move

    def _empty_stream(self) -> None:
        self._chain.control[STREAMED] = 0

    def _run(self, pause_at: int) -> None:
        control = self._chain.control
        self._settings[SAMPLES_DUE] = self._samples_due
        self._settings[PAUSE_AT] = pause_at or CYCLES_MAX
        control[REASON] = ROOM
        while control[REASON] == ROOM:
            stream, size = self._chain.stream, self._parameters.stream
            if control[STREAMED] == len(stream) < size:
                larger = np.zeros_like(stream, shape=(min(2 * len(stream), size), stream.shape[1]))
                larger[: len(stream)] = stream
                self._chain = self._chain._replace(stream=larger)
            run_chain(self._wiring, self._moves, self._chain, self._settings)
        self.cycles = int(control[ORIGIN] + control[AT])
        self.sequencer_state = int(control[ORDER])
        self.samples, self.unused = int(control[SAMPLES]), int(control[UNUSED])
        self.reason = BM2StopReason(control[REASON])
        self.timed_out_bit = int(control[TIMED_OUT])


def warm_up() -> None:
    """Compile the kernel, or load it from numba's cache on disk."""
    parameters = BM2Parameters(cardinalities=(2,), factors=((0,),), stream=1)
    kernel = FastBM2(BM2Machine.from_factors(parameters, [[0.5, 0.5]]))
    kernel.start(BM2Start(state=0, known=0, samples=1, burn_in=0, ops_timeout=1000, max_cycles=1000))


def row_size(parameters: BM2Parameters) -> int:
    """Return how many random numbers are stored for each CDE: `CHUNK` * (number of LFSR bits + 1)."""
    return (POLYNOMIALS[parameters.rng][0] + 1) * CHUNK


def load_state(parameters: BM2Parameters, state: int, values: Words, addresses: Words) -> None:
    """Unpack `state`: write the variables' codes to `values`, and the table address of each factor to `addresses`."""
    values[:] = unpack(parameters, state)
    bits = parameters.bits
    for cde, factor in enumerate(parameters.factors):
        address = offset = 0
        for variable in factor:
            address |= int(values[variable]) << offset
            offset += bits[variable]
        addresses[cde] = address


def wiring_of(machine: BM2Machine) -> Wiring:
    """Return the wiring of a machine with LFSRs. The wiring does not depend on the seeds."""
    parameters = machine.parameters
    # the CDEs whose factor has a bit, and the bit's place in that factor
    concerned: list[list[tuple[int, int]]] = [[] for _ in range(parameters.state_bits)]
    for cde in range(parameters.cdes):
        for j, bit in enumerate(parameters.factor_bits(cde)):
            concerned[bit].append((cde, j))
    exponents = POLYNOMIALS[parameters.rng]
    row = row_size(parameters)
    codes = [np.full(2, 1 << (parameters.prob_bits - 1), dtype=np.uint16)]
    base = len(codes[0])
    bits: list[tuple[int, ...]] = []
    entries: list[tuple[int, ...]] = []
    for variable, (width, offset) in enumerate(zip(parameters.bits, parameters.offsets, strict=True)):
        for shift in range(width):
            first = len(entries)
            for cde, j in concerned[offset + shift]:
                table = machine.tables[cde].reshape(len(parameters.factor_bits(cde)), -1, 1, 1 << j)[j]
                codes.append(np.repeat(table, 2, axis=1).ravel())  # the pointed bit does not matter
                entries.append((cde * row, cde, base, j))
                base += len(codes[-1])
            if parameters.literal:
                others = set(range(parameters.cdes)) - {cde for cde, _ in concerned[offset + shift]}
                entries += [(cde * row, parameters.cdes, 0, 0) for cde in sorted(others)]
            bits.append((variable, shift, first, len(entries)))
    return Wiring(
        codes=np.concatenate(codes),
        bits=np.array(bits, dtype=np.uint64),
        entries=np.array(entries, dtype=np.uint64),
        exponents=np.array(exponents, dtype=np.int64),
        clock=jump_tables(parameters.rng, parameters.steps_per_clock)[:1].copy(),
        order_clock=jump_tables(RngKind.LFSR16, 16)[:1].copy(),
        # a variable without bits may be beyond the last word
        places=np.array(
            [
                divmod(offset, 32) if mask else (0, 0)
                for offset, mask in zip(parameters.offsets, parameters.masks, strict=True)
            ],
            dtype=np.uint64,
        ),
        searched=np.array(
            [(variable, parameters.bits[variable]) for variable in parameters.searched], dtype=np.uint64
        ).reshape(-1, 2),
        joint_word=np.uint64(parameters.histogram_words if parameters.joint_words else 0),
    )


def moves_of(parameters: BM2Parameters, known: int, sequencer: Sequencer) -> Moves:
    """Return the moves of a sweep."""
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


# Everything below is compiled, once for all machines; see `machines.fast_code` for its types. What is done
# with vectors is written in LLVM's terms, where they are values on any processor.

_0: Final = np.uint64(0)
_1: Final = np.uint64(1)
_32: Final = np.uint64(32)
_LOW_WORD: Final = np.uint64(2**32 - 1)
_ALL: Final = np.uint64(2**CHUNK - 1)

_NUMBERS: Final = ir.VectorType(ir.IntType(16), CHUNK)


def compared(builder: Any, numbers: Any, place: Any, code: Any) -> Any:
    """Build the LLVM instructions that compare `CHUNK` random numbers with a probability code.

    Bit i of the result is 1 if `numbers[place + i] < code`.
    """
    chunk = builder.load(builder.bitcast(builder.gep(numbers, [place]), _NUMBERS.as_pointer()))
    chunk.align = 2
    less = builder.icmp_unsigned("<", chunk, repeated(builder, code, _NUMBERS))
    return builder.zext(builder.bitcast(less, ir.IntType(CHUNK)), ir.IntType(64))


less_in_chunk: Final = in_llvm(types.uint64, None, types.int64, types.uint16)(compared)


@jit
def fill(wiring: Wiring, numbers: npt.NDArray[np.uint16], generators: Words, ones: int) -> None:
    """Write the first block of a chain's random numbers to `numbers`."""
    exponents = wiring.exponents
    for cde in range(generators.shape[0]):
        state = generators[cde]
        for t in range(exponents[0]):
            numbers[cde, t] = np.int64(state) & ones
            state = image(wiring.clock, 0, state)
        for t in range(exponents[0], exponents[0] * CHUNK):
            number = numbers[cde, t - exponents[0]]
            for i in range(1, 4):
                number ^= numbers[cde, t - exponents[i]]
            numbers[cde, t] = number


@jit
def refill(exponents: Integers, numbers: npt.NDArray[np.uint16], first: int, rows: int) -> None:
    """Replace the random numbers of `rows` CDEs, stored one after the other in `numbers`, by those of the next block.

    `first` says where the numbers of the first CDE begin, counted in vectors of `CHUNK` numbers.
    """
    top, near = exponents[0], exponents[2] == 2  # then the exponents are 32, 22, 2 and 1
    for row in range(first, first + rows * (top + 1), top + 1):
        last, older = load(numbers, row + top - 1), load(numbers, row + top - 2)
        for chunk in range(top):
            second = chunk - exponents[1]
            made = load(numbers, row + chunk) ^ load(numbers, row + second + top * (second < 0))
            if not near:
                third, fourth = chunk - exponents[2], chunk - exponents[3]
                older = load(numbers, row + third + top * (third < 0))
                last = load(numbers, row + fourth + top * (fourth < 0))
            made = made ^ older ^ last
            store(numbers, row + chunk, made)
            older = last
            last = made


@jit
def run_chain(  # noqa: PLR0915 - a call of a function takes longer than a move
    wiring: Wiring, moves: Moves, chain: Chain, settings: Integers
) -> None:
    """Run a chain until it stops. The reason is in `chain.control`."""
    ops_timeout, samples_due, pause_at = settings[OPS_TIMEOUT], settings[SAMPLES_DUE], settings[PAUSE_AT]
    max_cycles, stream, room = settings[LIMIT], settings[STREAM], chain.stream.shape[0]
    random, every_move = settings[RANDOM], settings[EVERY_MOVE]
    sweep_moves = moves.first.shape[0] - 1
    rows = chain.numbers.shape[0]
    block = chain.numbers.shape[1] - CHUNK
    limit = min(max_cycles, pause_at)
    numbers = chain.numbers.reshape(-1)
    entries, bits, codes, places = wiring.entries, wiring.bits, wiring.codes, wiring.places
    searched, joint_word = wiring.searched, wiring.joint_word
    order_clock, exponents = wiring.order_clock, wiring.exponents
    first, moved, counted = moves.first, moves.bits, moves.counted
    control, values, addresses, pending = chain.control, chain.values, chain.addresses, chain.pending
    results, streamed = chain.results, chain.stream
    reason = 0
    control[END] = min(block, limit - control[ORIGIN])
    while reason == 0:
        at = control[AT]
        end = min(control[END], control[BEGAN] + ops_timeout)
        latest = at
        missing = _0
        for i in range(np.uint64(control[PENDING])):
            bit = pending[i]
            first_entry, last_entry = bits[bit, FIRST_ENTRY], bits[bit, LAST_ENTRY]
            start = at
            while True:
                all_ones, some_ones = _ALL, _0
                for entry in range(first_entry, last_entry):
                    code = codes[entries[entry, BASE] + addresses[entries[entry, ADDRESS]]]
                    less = less_in_chunk(numbers, np.int64(entries[entry, ROW]) + start, code)
                    all_ones &= less
                    some_ones |= less
                agree = (all_ones | ~some_ones) & (_ALL >> np.uint64(CHUNK - min(end - start, CHUNK)))
                start += CHUNK
                if agree or start >= end:
                    break
            if not agree:
                pending[missing] = bit
                missing += _1
                continue
            nth = first_one(agree)
            variable, shift = bits[bit, VARIABLE], bits[bit, SHIFT]
            flip = ((all_ones >> nth) ^ (values[variable] >> shift)) & _1
            values[variable] ^= flip << shift
            for entry in range(first_entry, last_entry):
                addresses[entries[entry, ADDRESS]] ^= flip << entries[entry, LOCAL]
            latest = max(latest, start + np.int64(nth) + 1 - CHUNK)
        if missing:
            control[PENDING] = missing
            at = end
            if at == control[BEGAN] + ops_timeout:
                reason = OUT_OF_TIME
                control[TIMED_OUT] = pending[0]
        else:
            at = latest
            place = control[PLACE] + 1
            ends_sweep = place == sweep_moves
            sampled = control[BURN_IN] == 0 and (ends_sweep or every_move != 0)
            if ends_sweep:
                place = 0
                control[BURN_IN] -= control[BURN_IN] > 0
            control[PLACE] = place
            if random:
                control[ORDER] = np.int64(image(order_clock, 0, np.uint64(control[ORDER])))
                place = (control[ORDER] * sweep_moves) >> 16
            first_bit = first[np.uint64(place)]
            count_of_bits = first[np.uint64(place + 1)] - first_bit
            for i in range(count_of_bits):
                pending[i] = moved[first_bit + i]
            control[PENDING] = count_of_bits
            control[BEGAN] = at
            if sampled:
                control[SAMPLES] += 1
                if stream:
                    row = control[STREAMED]
                    control[STREAMED] += 1
                    streamed[row] = 0
                    for i in range(values.shape[0]):
                        shifted, word = values[i] << places[i, 1], places[i, 0]
                        streamed[row, word] |= np.uint32(shifted & _LOW_WORD)
                        if shifted >> _32:
                            streamed[row, word + _1] |= np.uint32(shifted >> _32)
                unused = False
                for i in range(counted.shape[0]):
                    unused |= values[counted[i, VARIABLE]] >= counted[i, CARDINALITY]
                if unused:
                    control[UNUSED] += 1
                else:
                    for i in range(counted.shape[0]):
                        results[counted[i, FIRST_WORD] + values[counted[i, VARIABLE]]] += 1
                    if joint_word:
                        joint = _0
                        for i in range(searched.shape[0]):
                            joint = (joint << searched[i, 1]) | values[searched[i, 0]]
                        results[joint_word + joint] += 1
                if control[SAMPLES] == samples_due:
                    reason = DRAWN
                elif control[STREAMED] == room and stream:
                    reason = FULL if room == stream else ROOM
        control[AT] = at
        if reason or at == control[END]:
            cycles = control[ORIGIN] + at
            if reason not in (DRAWN, OUT_OF_TIME) and cycles == max_cycles:
                reason = OUT_OF_CYCLES
            elif reason in (0, ROOM) and cycles == pause_at:
                reason = PAUSED
            if reason == 0:
                refill(exponents, numbers, 0, rows)
                control[ORIGIN] += block
                control[BEGAN] -= block
                control[AT] = 0
                control[END] = min(block, limit - control[ORIGIN])
    control[REASON] = reason
