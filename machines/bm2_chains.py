"""Many chains of a BM2 at a time. Each chain has, bit for bit, the results of a `BM2Kernel` of its own.

Chains of a small network are bit-sliced: bit i of every vector belongs to chain i. A cycle is a list of logical
operations on vectors. A context is one choice of values for the other bits of a factor. Each CDE makes a bit for every
context, and each chain takes the bit for its own context. Each chain has a pointer to the bit that its sequencer
draws now. A new value of a bit is written only in the chains whose pointer is at this bit.

Chains of a large network go in step: all chains make a move together, but each chain takes its own number of cycles.
Vector operations search 8 chains at a time for the first cycle in which the CDEs agree.

Chains that can neither be sliced nor go in step run one by one, for example fewer than 16 chains.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types

from machines import bm2_fast as fast
from machines import make_bm2_kernel
from machines.bm2 import BM2Machine, BM2Start, BM2StopReason, pack, unpack
from machines.bm2_fast import CHUNK, Integers, Moves, Wiring
from machines.bm2_kernel import BM2Kernel, check_bm2_start
from machines.errors import ParameterError, StartError
from machines.fast_code import jit
from machines.parameters import RngReset, SampleEvery, Sequencer
from machines.rng import LFSR, POLYNOMIALS, Words, generator_numbers
from machines.vectors import VECTOR, aligned, below, first_one, first_ones, in_llvm, load, some, splat, store

SLICE: Final = 512  # chains in a vector
SLICED_MIN: Final = 64  # chains to be sliced; fewer are faster in step
UNKNOWN_MAX: Final = 5  # unknown bits of chains to be sliced; each of their joint values but 0 has a counter
CYCLES: Final = 8  # cycles of sliced chains whose random bits are made together
LOW_PLANES: Final = 3  # lowest bits of a counter; together they overflow at most once in `CYCLES` cycles
LANES: Final = 8  # chains in step that share a vector, a word each
PARTS: Final = 2  # such vectors; the random numbers of more chains would not fit into a core's cache
IN_STEP: Final = PARTS * LANES


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ChainResult:
    """The results and the state of a chain after its stop. See `BM2Kernel` for the attributes."""

    reason: BM2StopReason
    cycles: int
    samples: int
    unused: int
    timed_out_bit: int
    state: int
    results: npt.NDArray[np.uint32]
    rng_state: Words


class _Circuit(NamedTuple):
    """The operations of a cycle of sliced chains."""

    unknown: Integers  # the unknown bits of the state; a bit's place is its index in this array
    cdes: Integers  # [pairs of contexts]: the CDE of each
    masks: Words  # [pairs, prob_bits, 2]: the bits of the contexts' codes, each as a word of 64
    # [entries, 3 + n]: a bit's place, a CDE's first context, and number and places of the context bits
    entries: Integers


# Cycles, states and results of some chains; the results' last row counts the samples with an unused code.
_Ran = tuple[Integers, list[int], npt.NDArray[Any]]


class Chains:
    """The chains of one model. The parameters of their machines may differ only in `chain` and `chains`.

    Raises:
        ParameterError: The machines differ in something else.
    """

    def __init__(self, machines: Sequence[BM2Machine]) -> None:
        self._machines = tuple(machines)
        self._parameters = first = machines[0].parameters
        for machine in machines:
            parameters = replace(machine.parameters, chain=first.chain, chains=first.chains)
            if parameters != first or not all(map(np.array_equal, machine.tables, machines[0].tables)):
                raise ParameterError(
                    "The machines of the chains differ; all must have the same model and parameters."
                )
        # Kernels of chains that run one by one; free generators go on in them.
        self._kernels: list[BM2Kernel] = []

    def run(self, starts: Sequence[BM2Start]) -> tuple[ChainResult, ...]:
        """Run a frame of every chain to its stop.

        If the starts differ in more than `state` and `bank`, the chains run one by one, which is slower.

        Raises:
            StartError: The numbers of starts and chains differ, or a start does not fit. In this case, no chain has
                run.
        """
        if len(starts) != len(self._machines):
            raise StartError(f"There are {len(starts)} starts for {len(self._machines)} chains.")
        for start in starts:
            check_bm2_start(self._parameters, start)
        results = self._run_together(starts)
        if results is None:
            self._kernels = self._kernels or [make_bm2_kernel(machine) for machine in self._machines]
            for kernel, start in zip(self._kernels, starts, strict=True):
                kernel.start(start)
            names = [field.name for field in fields(ChainResult)]
            results = [
                ChainResult(**{name: getattr(kernel, name) for name in names}) for kernel in self._kernels
            ]
        return tuple(results)

    def _run_together(self, starts: Sequence[BM2Start]) -> list[ChainResult] | None:
        """Run the chains together, sliced or in step. Return the results, or None if the chains must run one by one.

        The chains must run one by one if the machine allows neither way, or if a chain may not draw all samples.
        """
        parameters, first, count = self._parameters, starts[0], len(starts)
        if (
            count < IN_STEP
            or any(replace(start, state=first.state, bank=first.bank) != first for start in starts)
            or not first.samples
            or first.ops_timeout < CHUNK
            or first.sequencer is not Sequencer.LINEAR
            or parameters.sample_every is SampleEvery.MOVE
            or parameters.rng.lfsr_bits is None
            or parameters.rng_reset is RngReset.FREE
            or parameters.stream
        ):
            return None
        lfsr = LFSR(parameters.rng)
        banks = [start.bank for start in starts]
        numbers = map(generator_numbers, (machine.parameters for machine in self._machines), banks)
        seeds = lfsr.seeds(np.stack(list(numbers)))
        circuit = self._circuit(starts)
        moves = fast.moves_of(parameters, first.known, first.sequencer)
        parts: list[_Ran] = []
        size = SLICE if circuit else IN_STEP
        for at in range(0, count, size):
            # copies of the last chain fill the rest of the last part
            lanes = [min(at + lane, count - 1) for lane in range(size)]
            given = moves, first, [starts[lane].state for lane in lanes], seeds[lanes]
            part = self._run_slice(circuit, *given) if circuit else self._run_in_step(*given)
            if part is None:
                return None
            parts.append(part)
        cycles = np.concatenate([part[0] for part in parts])[:count]
        results = np.concatenate([part[2] for part in parts], axis=1).T[:count]
        if cycles.max() > first.max_cycles:
            return None
        made = (cycles % lfsr.period * parameters.steps_per_clock).astype(np.uint64)
        generators = lfsr.jump(seeds, np.repeat(made[:, np.newaxis], parameters.cdes, axis=1))
        return [
            ChainResult(
                reason=BM2StopReason.SAMPLES,
                cycles=int(cycles[chain]),
                samples=first.samples,
                unused=int(results[chain, -1]),
                timed_out_bit=-1,
                state=parts[chain // size][1][chain % size],
                results=results[chain, :-1].astype(np.uint32),
                rng_state=generators[chain],
            )
            for chain in range(count)
        ]

    def _circuit(self, starts: Sequence[BM2Start]) -> _Circuit | None:
        """Return the operations for these starts; None if `run_sliced` cannot run them."""
        parameters, known, state = self._parameters, starts[0].known, starts[0].state
        unknown = [bit for bit in range(parameters.state_bits) if not known >> bit & 1]
        if (
            len(starts) < SLICED_MIN
            or len(unknown) > UNKNOWN_MAX
            or parameters.literal
            or any((start.state ^ state) & known for start in starts)
        ):
            return None
        codes: list[int] = []
        cdes: list[int] = []
        entries: list[list[int]] = []
        for cde, table in enumerate(self._machines[0].tables):
            bits = parameters.factor_bits(cde)
            for bit in filter(bits.__contains__, unknown):
                near = [other for other in bits if other != bit]
                chosen = [place for place, other in enumerate(unknown) if other in near]
                row = [unknown.index(bit), len(codes), len(chosen), *chosen, *unknown]
                entries.append(row[: 3 + len(unknown)])
                for context in range(1 << len(chosen)):
                    values = state & known | _spread(context, [unknown[place] for place in chosen])
                    local = sum((values >> other & 1) << i for i, other in enumerate(near))
                    codes.append(int(table[bits.index(bit) << len(near) | local]))
            codes += [0] * (-len(codes) % 2)
            cdes += [cde] * (len(codes) // 2 - len(cdes))
        planes = np.arange(parameters.prob_bits, dtype=np.uint64)[:, np.newaxis]
        masks = -(np.array(codes, dtype=np.uint64).reshape(-1, 1, 2) >> planes & np.uint64(1))
        return _Circuit(np.array(unknown), np.array(cdes), masks, np.array(sorted(entries)))

    def _run_slice(
        self, circuit: _Circuit, moves: Moves, start: BM2Start, states: list[int], seeds: Words
    ) -> _Ran | None:
        """Run up to 512 chains bit-sliced.

        Return None if a chain may stop before it has drawn all its samples.
        """
        parameters, unknown = self._parameters, circuit.unknown.tolist()
        lfsr, steps = LFSR(parameters.rng), parameters.steps_per_clock
        events = 1 << len(unknown)
        # counters have their lowest bit first
        depth = max(start.samples.bit_length(), start.burn_in.bit_length(), LOW_PLANES + 2)
        numbers = aligned((parameters.cdes, lfsr.bits + CYCLES * steps, 8), np.uint64)
        # the bits that each generator shifted in before the first cycle, the last one last
        shifts = np.arange(lfsr.bits, dtype=np.uint64)[::-1, np.newaxis]
        numbers[:, : lfsr.bits] = _vectors(seeds.T[:, np.newaxis] >> shifts & np.uint64(1))
        values, pointed, counts, room = (
            aligned((count, 8), np.uint64)
            for count in (len(unknown), len(unknown), events * depth, 2 * len(circuit.cdes) + 2 * events)
        )
        values[:] = _vectors(np.array([[state >> bit & 1 for state in states] for bit in unknown]))
        pointed[0] = ~np.uint64(0)
        sweeps = start.burn_in or start.samples
        counts[[plane for plane in range(depth) if -sweeps >> plane & 1]] = ~np.uint64(0)
        ends = np.zeros(SLICE, dtype=np.int64)
        vectors = numbers.reshape(-1, 8), values, pointed, counts, room
        window = start.ops_timeout // (2 * CYCLES) * CYCLES - CYCLES
        limits = start.burn_in, start.samples, start.max_cycles, window, steps
        if not run_sliced(circuit, np.array(POLYNOMIALS[parameters.rng]), vectors, ends, limits):
            return None

        counted = _bits_of(counts).reshape(-1, depth, SLICE) << np.arange(depth)[:, np.newaxis]
        drawn = counted.sum(axis=1)[1:]
        results = np.zeros((parameters.result_words + 1, SLICE), dtype=np.int64)
        known = states[0] & start.known
        for value, samples in enumerate([start.samples - drawn.sum(axis=0), *drawn]):
            codes = unpack(parameters, known | _spread(value, unknown))
            words = [first + codes[variable] for variable, first, _ in moves.counted.tolist()]
            if parameters.joint_words:
                joint = 0
                for variable in parameters.searched:
                    joint = joint << parameters.bits[variable] | codes[variable]
                words.append(parameters.histogram_words + joint)
            unused = any(codes[variable] >= size for variable, _, size in moves.counted.tolist())
            results[-1 if unused else words] += samples
        ended = _bits_of(values).T.tolist()
        return ends, [known | sum(map(int.__lshift__, own, unknown)) for own in ended], results

    @cached_property
    def _wiring(self) -> Wiring:
        return fast.wiring_of(self._machines[0])

    def _run_in_step(self, moves: Moves, start: BM2Start, states: list[int], seeds: Words) -> _Ran | None:
        """Run `IN_STEP` chains in step, or return None if a limit may stop a chain before its last sample."""
        parameters, cdes, row = self._parameters, self._parameters.cdes, fast.row_size(self._parameters)
        numbers = aligned((IN_STEP, cdes, row), np.uint16)
        values, addresses, results, clock = (
            aligned((count, IN_STEP), np.uint64)
            for count in (len(parameters.bits), cdes + 1, parameters.result_words + 1, 3)
        )
        clock[0] = np.arange(IN_STEP) * cdes * row
        clock[1] = clock[0] + np.uint64(row - CHUNK)
        firsts = clock[0].copy()
        for lane, state in enumerate(states):
            fast.load_state(parameters, state, values[:, lane], addresses[:, lane])
            fast.fill(self._wiring, numbers[lane], seeds[lane], parameters.ones_code)
        vectors = values, addresses, results, clock, aligned((3, LANES), np.uint64)
        limits = start.burn_in, start.samples, start.max_cycles, start.ops_timeout
        if not run_in_step(self._wiring, moves, numbers.reshape(-1), vectors, limits):
            return None
        cycles = (clock[2] + clock[0] - firsts).astype(np.int64)
        return cycles, [pack(parameters, own) for own in values.T.tolist()], results


def _spread(value: int, bits: Sequence[int]) -> int:
    """Return the state in which bit `bits[i]` is bit i of a value, and all others are 0."""
    return sum((value >> i & 1) << bit for i, bit in enumerate(bits))


def _vectors(bits: npt.NDArray[Any]) -> Words:
    """Pack bits [..., chains] into vectors: uint64[..., 8]."""
    return np.packbits(bits.astype(np.bool_), axis=-1, bitorder="little").view(np.uint64)


def _bits_of(vectors: Words) -> Integers:
    """Unpack vectors into bits: int64[..., chains]."""
    return np.unpackbits(vectors.view(np.uint8), axis=-1, bitorder="little").astype(np.int64)


# Everything below is compiled, as in `machines.bm2_fast`.

_0: Final = np.uint64(0)
_1: Final = np.uint64(1)
_ALL: Final = np.uint64(2**CHUNK - 1)


@jit
def run_sliced(  # noqa: PLR0915 - vectors are not passed to functions
    circuit: _Circuit,
    exponents: Integers,
    vectors: tuple[Words, ...],
    ends: Integers,
    limits: tuple[int, ...],
) -> bool:
    """Run bit-sliced chains until each has drawn its samples, and store the number of cycles of each chain in `ends`.

    Return True if all chains have finished. Return False as soon as `max_cycles` or the timeout of the OPS may stop a
    chain. The counts are then incomplete.

    `vectors` contains five arrays of vectors: `numbers`, `values`, `pointed`, `counts` and `room`. Bit i of a vector
    belongs to chain i. `numbers` has the bits from the generator of each CDE. `values` has the values of the unknown
    bits. `pointed` has a vector for each unknown bit, with a 1 for each chain whose sequencer draws the bit now.

    `counts` has a counter for each joint value of the unknown bits. From i = 1 on, counter i counts the samples with
    the joint value i. Counter 0 counts sweeps: first from -burn_in up to 0, and then from -samples up to 0. Each sweep
    after the burn-in gives a sample, so the number of samples with the joint value 0 is `samples` minus the sum of the
    other counters.

    `room` is working space. It holds carries, the bits that the CDEs make for each context, and for each counter the
    chains that increment the counter in this cycle.
    """
    numbers, values, pointed, counts, room = vectors
    burn_in, samples, max_cycles, window, steps = limits
    cdes, masks, entries = circuit.cdes, circuit.masks, circuit.entries
    zero = splat(_0)
    going, counting, moved = ~zero, zero if burn_in else ~zero, zero
    bits, unknown, counters, cycle = exponents[0], pointed.shape[0], 1 << pointed.shape[0], 0
    rows, depth, carries = bits + CYCLES * steps, counts.shape[0] // counters, room.shape[0] - counters
    while some(going):
        if cycle >= max_cycles:
            return False
        for first in range(bits, bits + numbers.shape[0], rows):
            last, older = load(numbers, first - 1), load(numbers, first - 2)
            for at in range(first, first + CYCLES * steps):
                made = load(numbers, at - bits) ^ load(numbers, at - exponents[1])
                if exponents[2] != 2:  # otherwise the exponents are 32, 22, 2 and 1
                    older, last = load(numbers, at - exponents[2]), load(numbers, at - exponents[3])
                made = made ^ older ^ last
                store(numbers, at, made)
                older = last
                last = made
        # Only if a chain has fewer than 16 sweeps left, the end of its sweeps is looked for in each cycle.
        near = going
        for plane in range(LOW_PLANES + 1, depth):
            near = near & load(counts, plane)
        careful = some(near)
        for counter in range(counters):
            store(room, carries + counter, zero)
        for now in range(CYCLES):
            # number < code for all contexts, from the low bit up: the majority of less so far, ~number and code
            for pair in range(cdes.shape[0]):
                low_bit = cdes[pair] * rows + bits + now * steps - 1
                less0, less1 = zero, zero
                for i in range(masks.shape[1]):
                    zeros = ~load(numbers, low_bit - i)
                    code0, code1 = splat(masks[pair, i, 0]), splat(masks[pair, i, 1])
                    less0 = (less0 & zeros) | (code0 & (less0 | zeros))
                    less1 = (less1 & zeros) | (code1 & (less1 | zeros))
                store(room, 2 * pair, less0)
                store(room, 2 * pair + 1, less1)
            entry = 0
            before = zero
            for bit in range(unknown):
                all_ones, some_ones = ~zero, zero
                while entry < entries.shape[0] and entries[entry, 0] == bit:
                    context, chosen = entries[entry, 1], entries[entry, 2]
                    for i in range(chosen):
                        chosen_bit = load(values, entries[entry, 3 + i])
                        for pair in range(1 << (chosen - 1 - i)):
                            if_0, if_1 = load(room, context + 2 * pair), load(room, context + 2 * pair + 1)
                            store(room, context + pair, (if_0 & ~chosen_bit) | (if_1 & chosen_bit))
                    made = load(room, context)
                    all_ones = all_ones & made
                    some_ones = some_ones | made
                    entry += 1
                here, value_bit = load(pointed, bit), load(values, bit)
                written = (all_ones | ~some_ones) & here & going
                store(values, bit, (value_bit & ~written) | (all_ones & written))
                store(pointed, bit, (here & ~written) | before)
                before = written
                moved = moved | written
            store(pointed, 0, load(pointed, 0) | before)
            # `before` is now the chains that have ended a sweep; each unknown bit splits the events in two
            store(room, 0, before & counting)
            for bit in range(unknown):
                value_bit = load(values, bit)
                for event in range(1 << bit):
                    whole = load(room, event)
                    store(room, event + (1 << bit), whole & value_bit)
                    store(room, event, whole & ~value_bit)
            store(room, 0, before)
            carry = zero
            for counter in range(counters - 1, -1, -1):
                carry = load(room, counter)
                planes = LOW_PLANES if counter or not careful else depth
                for plane in range(counter * depth, counter * depth + planes):
                    digit = load(counts, plane)
                    store(counts, plane, digit ^ carry)
                    carry = carry & digit
                if planes == LOW_PLANES:
                    store(room, carries + counter, load(room, carries + counter) | carry)
            if careful and some(carry):
                going = going & ~(carry & counting)
                store(room, 0, carry & counting)
                begun = carry & ~counting
                counting = counting | begun
                for plane in range(depth):
                    if (-samples >> plane) & 1:
                        store(counts, plane, load(counts, plane) | begun)
                for lane in range(ends.shape[0]):
                    if (room[0, lane >> 6] >> (np.uint64(lane) & np.uint64(63))) & _1:
                        ends[lane] = cycle + now + 1
        for counter in range(counters):
            carry = load(room, carries + counter)
            plane = counter * depth + LOW_PLANES
            while plane < (counter + 1) * depth and some(carry):
                digit = load(counts, plane)
                store(counts, plane, digit ^ carry)
                carry = carry & digit
                plane += 1
        cycle += CYCLES
        for first in range(0, numbers.shape[0], rows):
            for at in range(first, first + bits):
                store(numbers, at, load(numbers, at + CYCLES * steps))
        if cycle % window == 0:
            if some(going & ~moved):
                return False
            moved = zero
    return True


@in_llvm(VECTOR, None, types.int64, None, types.int64, None, types.int64, None, types.int64)
def _less_in_lanes(
    builder: Any, numbers: Any, row: Any, places: Any, lane: Any, codes: Any, base: Any, own: Any, first: Any
) -> Any:
    """Compare as `less_in_chunk`, for 8 chains, each with its own code and its own place in `numbers`."""
    masks = ir.Constant(ir.VectorType(lane.type, LANES), ir.Undefined)
    numbers, codes = builder.gep(numbers, [row]), builder.gep(codes, [base])
    for i in range(LANES):
        word = ir.Constant(lane.type, i)
        place = builder.load(builder.gep(places, [builder.add(lane, word)]))
        code = builder.load(builder.gep(codes, [builder.load(builder.gep(own, [builder.add(first, word)]))]))
        masks = builder.insert_element(masks, fast.compared(builder, numbers, place, code), word)
    return masks


@jit
def run_in_step(  # noqa: PLR0915 - vectors are not passed to functions
    wiring: Wiring,
    moves: Moves,
    numbers: npt.NDArray[np.uint16],
    vectors: tuple[Words, ...],
    limits: tuple[int, ...],
) -> bool:
    """Run chains in step until each chain has drawn its samples, and return True.

    Return False as soon as `max_cycles` or `ops_timeout` may stop a chain. The results are then incomplete.

    `numbers` is the flattened array [chains, CDEs, cycles] of random numbers. It contains a block of consecutive cycles
    for each chain. `clock` is the fourth of `vectors`. Each row of `clock` has one value per chain. Row 0 is the index
    in `numbers` of the first CDE's next number. Row 1 is the index at which the first CDE's numbers end. Row 2 is the
    number of the block's first cycle.
    """
    values, addresses, results, clock, room = vectors
    burn_in, samples, max_cycles, ops_timeout = limits
    zero, one = splat(_0), splat(_1)
    rows, block = addresses.shape[0] - 1, np.int64(clock[1, 0] - clock[0, 0])
    bits, entries, codes = wiring.bits, wiring.entries.view(np.int64), wiring.codes
    counted, searched = moves.counted.view(np.int64), wiring.searched.view(np.int64)
    for sweep in range(burn_in + samples):
        for move in range(moves.bits.shape[0]):
            bit = moves.bits[move]
            variable, shift = np.int64(bits[bit, fast.VARIABLE]) * PARTS, splat(bits[bit, fast.SHIFT])
            first_entry, last_entry = bits[bit, fast.FIRST_ENTRY], bits[bit, fast.LAST_ENTRY]
            for part in range(PARTS):
                all_ones, some_ones = ~zero, zero
                for entry in range(first_entry, last_entry):
                    row, base = entries[entry, fast.ROW], entries[entry, fast.BASE]
                    address = (entries[entry, fast.ADDRESS] * PARTS + part) * LANES
                    less = _less_in_lanes(numbers, row, clock, part * LANES, codes, base, addresses, address)
                    all_ones = all_ones & less
                    some_ones = some_ones | less
                nth = first_ones(~(all_ones ^ some_ones) | splat(_ALL + _1))
                before, value = load(clock, part), load(values, variable + part)
                after = before + nth + one
                made = (all_ones >> nth) & one
                late = below(load(clock, PARTS + part), after) | below(splat(np.uint64(CHUNK - 1)), nth)
                store(clock, part, after)
                if some(late):
                    store(room, 0, late)
                    store(room, 1, before)
                    store(room, 2, made)
                    for lane in range(LANES):
                        chain = part * LANES + lane
                        at: Any = np.int64(room[1, lane])
                        end, taken = np.int64(clock[1, chain]), 0
                        while room[0, lane]:
                            ones, any_ones = _ALL, _0
                            for entry in range(first_entry, last_entry):
                                own = addresses[entries[entry, fast.ADDRESS], chain]
                                code = codes[entries[entry, fast.BASE] + np.int64(own)]
                                mask = fast.less_in_chunk(numbers, entries[entry, fast.ROW] + at, code)
                                ones &= mask
                                any_ones |= mask
                            cycles = min(end - at, CHUNK)
                            agree = (ones | ~any_ones) & (_ALL >> np.uint64(CHUNK - cycles))
                            if agree:
                                cycles = np.int64(first_one(agree)) + 1
                                room[0, lane] = _0
                                room[2, lane] = (ones >> np.uint64(cycles - 1)) & _1
                            at += cycles
                            taken += cycles
                            if taken > ops_timeout or np.int64(clock[2, chain]) > max_cycles:
                                return False
                            if at == end and not agree:
                                fast.refill(wiring.exponents, numbers, int(end - block) // CHUNK, rows)
                                clock[2, chain] += np.uint64(block)
                                at -= block
                            clock[0, chain] = np.uint64(at)
                    made = load(room, 2)
                flip = made ^ ((value >> shift) & one)
                store(values, variable + part, value ^ (flip << shift))
                for entry in range(first_entry, last_entry):
                    place, local = entries[entry, fast.ADDRESS] * PARTS + part, entries[entry, fast.LOCAL]
                    store(addresses, place, load(addresses, place) ^ (flip << splat(np.uint64(local))))
        if sweep < burn_in:
            continue
        for part in range(PARTS):
            good = one
            for i in range(counted.shape[0]):
                value = load(values, counted[i, fast.VARIABLE] * PARTS + part)
                good = good & below(value, splat(np.uint64(counted[i, fast.CARDINALITY])))
            place = (results.shape[0] - 1) * PARTS + part
            store(results, place, load(results, place) + (good ^ one))
            for i in range(counted.shape[0]):
                value = load(values, counted[i, fast.VARIABLE] * PARTS + part)
                for code in range(counted[i, fast.CARDINALITY]):
                    place = (counted[i, fast.FIRST_WORD] + code) * PARTS + part
                    is_code = below(value ^ splat(np.uint64(code)), good)
                    store(results, place, load(results, place) + (is_code & one))
            if wiring.joint_word:
                joint = zero
                for i in range(searched.shape[0]):
                    own_code = load(values, searched[i, 0] * PARTS + part)
                    joint = (joint << splat(np.uint64(searched[i, 1]))) | own_code
                store(room, 0, joint + splat(wiring.joint_word))
                store(room, 1, good)
                for lane in range(LANES):
                    results[room[0, lane], part * LANES + lane] += room[1, lane]
    return True
