"""Many chains of a BM2 at a time, each with the same results as a kernel of its own, bit for bit.

Chains of a small network are sliced: bit i of a vector belongs to chain i, and a cycle is a list of logical
operations on vectors. Each CDE makes a bit in every context (values of the other bits of its factor), and a chain
takes that of its own state; a bit is written in the chains that point at it. Other chains run one by one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import accumulate
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types

from machines import make_bm2_kernel
from machines.bm2 import BM2Machine, BM2Parameters, BM2Start, BM2StopReason, unpack
from machines.bm2_fast import VECTOR, Integers, aligned, in_llvm, load, splat, store
from machines.bm2_kernel import BM2Kernel, check_bm2_start
from machines.errors import ParameterError, StartError
from machines.fast_code import jit
from machines.parameters import RngReset, SampleEvery, Sequencer
from machines.rng import LFSR, POLYNOMIALS, Words, generator_numbers

SLICE: Final = 512
"""Number of chains in a vector."""

SLICED_MIN: Final = 32
"""Minimum number of chains to be sliced; fewer are faster one by one."""

CONTEXTS_MAX: Final = 128
"""Maximum number of contexts, over all CDEs, of sliced chains."""

COUNTERS_MAX: Final = 64
"""Maximum number of counters of sliced chains."""

STEPS_MAX: Final = 32
"""Maximum of `steps_per_clock` of sliced chains, whose generators make every step."""

CYCLES: Final = 8
"""Number of cycles of sliced chains whose random bits are made together."""

LOW_PLANES: Final = 3
"""Number of a counter's lowest bits; they overflow at most once in `CYCLES` cycles."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ChainResult:
    """The results and the state of a chain after its stop; the attributes are those of `BM2Kernel`."""

    reason: BM2StopReason
    cycles: int
    samples: int
    unused: int
    timed_out_bit: int
    state: int
    results: npt.NDArray[np.uint32]
    rng_state: Words


class Chains:
    """Chains of one model: machines that differ only in `chain` and `chains`.

    Raises:
        ParameterError: The machines differ in something else.
    """

    def __init__(self, machines: Sequence[BM2Machine]) -> None:
        self._machines = tuple(machines)
        self._parameters = machines[0].parameters
        for machine in machines:
            parameters = replace(
                machine.parameters, chain=self._parameters.chain, chains=self._parameters.chains
            )
            if parameters != self._parameters or not all(
                map(np.array_equal, machine.tables, machines[0].tables)
            ):
                raise ParameterError(
                    "The machines of the chains differ; all must have the same model and parameters."
                )
        # Kernels of chains that run one by one; free generators go on in them.
        self._kernels: list[BM2Kernel] = []

    def run(self, starts: Sequence[BM2Start]) -> tuple[ChainResult, ...]:
        """Run a frame of every chain to its stop; starts that differ only in `state` and `bank` are fast.

        Raises:
            StartError: There is not one start for each chain, or one does not fit; no chain has run.
        """
        if len(starts) != len(self._machines):
            raise StartError(f"There are {len(starts)} starts for {len(self._machines)} chains.")
        for start in starts:
            check_bm2_start(self._parameters, start)
        results = self._run_sliced(starts)
        if results is None:
            self._kernels = self._kernels or [make_bm2_kernel(machine) for machine in self._machines]
            for kernel, start in zip(self._kernels, starts, strict=True):
                kernel.start(start)
            names = [field.name for field in fields(ChainResult)]
            results = [
                ChainResult(**{name: getattr(kernel, name) for name in names}) for kernel in self._kernels
            ]
        return tuple(results)

    def _run_sliced(self, starts: Sequence[BM2Start]) -> list[ChainResult] | None:
        """Run the chains sliced; None if they do not suit that, or if one of them may have timed out."""
        parameters, first = self._parameters, starts[0]
        if (
            len(starts) < SLICED_MIN
            or any(replace(start, state=first.state, bank=first.bank) != first for start in starts)
            or not first.samples
            or first.ops_timeout < 4 * CYCLES
            or first.sequencer is not Sequencer.LINEAR
            or parameters.sample_every is SampleEvery.MOVE
            or parameters.rng.lfsr_bits is None
            or parameters.rng_reset is RngReset.FREE
            or parameters.steps_per_clock > STEPS_MAX
            or parameters.stream
        ):
            return None
        circuit = _circuit(self._machines[0], first.known, {start.state for start in starts})
        if circuit is None:
            return None
        numbers = [
            generator_numbers(machine.parameters, start.bank)
            for machine, start in zip(self._machines, starts, strict=True)
        ]
        seeds = LFSR(parameters.rng).seeds(np.stack(numbers))
        results: list[ChainResult] = []
        for at in range(0, len(starts), SLICE):
            states = [start.state for start in starts[at : at + SLICE]]
            part = _run_slice(parameters, first, circuit, states, seeds[at : at + SLICE])
            if part is None:
                return None
            results += part
        return results


class _Circuit(NamedTuple):
    """The operations of a cycle of sliced chains. A place is that of a bit in `bits`."""

    bits: list[
        int
    ]  # the state bits that have a vector: the unknown ones, then those in which the starts differ
    unknown: int  # number of the unknown ones
    cdes: Integers  # [groups of four contexts]
    masks: Words  # [groups, prob_bits, 4]: the bits of the contexts' codes, each as a word of 64
    # [entries, 3 + n]: place of an unknown bit, first context of a CDE that is compared for it, and number and places
    # of the bits whose values are the contexts
    entries: Integers
    # [unused codes and events, 1 + 2 * n]: number of bits, and their places and values
    conditions: Integers
    # the events that have a counter, as mask and value of state bits, and its number; counter 0 counts all samples
    events: dict[tuple[int, int], int]


def _circuit(machine: BM2Machine, known: int, states: set[int]) -> _Circuit | None:
    """Return the operations for a mask of known bits and these start states; None if there are too many."""
    parameters = machine.parameters
    state = min(states)
    differing = 0
    for other in states:
        differing |= (other ^ state) & known
    unknown = [bit for bit in range(parameters.state_bits) if not known >> bit & 1]
    bits = unknown + [bit for bit in range(parameters.state_bits) if differing >> bit & 1]
    codes: list[int] = []
    cdes: list[int] = []
    entries: list[list[int]] = []
    for cde, table in enumerate(machine.tables):
        local_bits = parameters.factor_bits(cde)
        for place, bit in enumerate(unknown):
            others = [other for other in local_bits if other != bit]
            chosen = [other for other in others if other in bits] if bit in local_bits else []
            if len(codes) + (1 << len(chosen)) > CONTEXTS_MAX:
                return None
            if bit in local_bits:
                entries.append([place, len(codes), len(chosen), *map(bits.index, chosen)])
                for context in range(1 << len(chosen)):
                    address = local_bits.index(bit) << len(others)
                    for i, other in enumerate(others):
                        value = context >> chosen.index(other) if other in chosen else state >> other
                        address |= (value & 1) << i
                    codes.append(int(table[address]))
            elif parameters.literal:
                entries.append([place, len(codes), 0])
                codes.append(1 << (parameters.prob_bits - 1))
        codes += [0] * (-len(codes) % 4)
        cdes += [cde] * (len(codes) // 4 - len(cdes))

    unused = [
        (mask, code << offset)
        for mask, offset, cardinality in zip(
            parameters.masks, parameters.offsets, parameters.cardinalities, strict=True
        )
        for code in range(cardinality, (mask >> offset) + 1)
        if not mask & known
    ]
    counted = [
        (0, 0),
        *((mask, value) for mask, _, _ in _counted(parameters, known) for value in _values_of(mask)),
    ]
    events = {event: 1 + at for at, event in enumerate(dict.fromkeys(counted))}
    if len(events) > COUNTERS_MAX:
        return None
    conditions = [
        [
            mask.bit_count(),
            *(n for place, bit in enumerate(bits) if mask >> bit & 1 for n in (place, value >> bit & 1)),
        ]
        for mask, value in (*unused, *events)
    ]
    code_bits = (
        np.array(codes, dtype=np.uint64).reshape(-1, 1, 4)
        >> np.arange(parameters.prob_bits, dtype=np.uint64)[:, np.newaxis]
    )
    return _Circuit(
        bits=bits,
        unknown=len(unknown),
        cdes=np.array(cdes, dtype=np.int64),
        masks=-(code_bits & np.uint64(1)),
        entries=_rows(sorted(entries)),
        conditions=_rows(conditions),
        events=events,
    )


def _counted(parameters: BM2Parameters, known: int) -> list[tuple[int, int, tuple[int, ...]]]:
    """Return what is counted: unknown bits, the first word for their values, and their variables and known ones."""
    first_words = accumulate((1 << bits for bits in parameters.bits), initial=0)
    counted: list[tuple[int, int, tuple[int, ...]]] = [
        (mask, word, (variable,))
        for variable, (mask, word) in enumerate(zip(parameters.masks, first_words, strict=False))
        if mask & ~known
    ]
    if parameters.joint_words:
        searched = sum(parameters.masks[variable] for variable in parameters.searched)
        counted.append((searched & ~known, parameters.histogram_words, parameters.searched))
    return counted


def _values_of(mask: int) -> list[int]:
    """Return all values of the bits in a mask but 0, which the other samples have."""
    values = [mask]
    while values[-1]:
        values.append((values[-1] - 1) & mask)
    return values[:-1]


def _rows(rows: list[list[int]]) -> Integers:
    """Return rows of different lengths as one array."""
    array = np.zeros((len(rows), max(map(len, rows))), dtype=np.int64)
    for at, row in enumerate(rows):
        array[at, : len(row)] = row
    return array


def _vectors(bits: npt.NDArray[Any]) -> Words:
    """Return the vectors of the bits [..., chains]: uint64[..., 8]."""
    padded = np.zeros((*bits.shape[:-1], SLICE), dtype=np.bool_)
    padded[..., : bits.shape[-1]] = bits
    return np.packbits(padded, axis=-1, bitorder="little").view(np.uint64)


def _bits_of(vectors: Words, count: int) -> Integers:
    """Return the bits of the first chains of vectors: int64[..., count]."""
    return np.unpackbits(vectors.view(np.uint8), axis=-1, bitorder="little")[..., :count].astype(np.int64)


def _run_slice(
    parameters: BM2Parameters, start: BM2Start, circuit: _Circuit, states: list[int], seeds: Words
) -> list[ChainResult] | None:
    """Run up to 512 chains; None if one of them may have timed out."""
    count, lfsr, steps = len(states), LFSR(parameters.rng), parameters.steps_per_clock
    # counters have their lowest bit first
    depth = max(start.samples.bit_length(), start.burn_in.bit_length(), LOW_PLANES + 2)
    numbers = aligned((parameters.cdes, lfsr.bits + CYCLES * steps, 8), np.uint64)
    values = aligned((len(circuit.bits), 8), np.uint64)
    pointed = aligned((circuit.unknown, 8), np.uint64)
    running = aligned((3, 8), np.uint64)
    left = aligned((depth, 8), np.uint64)
    counts = aligned((1 + len(circuit.events), depth, 8), np.uint64)
    room = aligned((4 * len(circuit.cdes) + len(counts), 8), np.uint64)
    ends = np.full(SLICE, start.max_cycles, dtype=np.int64)
    # the bits that each generator shifted in before the first cycle, the last one last
    shifts = np.arange(lfsr.bits, dtype=np.uint64)[::-1, np.newaxis]
    numbers[:, : lfsr.bits] = _vectors((seeds.T[:, np.newaxis] >> shifts) & np.uint64(1))
    values[:] = _vectors(np.array([[state >> bit & 1 for state in states] for bit in circuit.bits]))
    pointed[0] = running[0] = _vectors(np.ones(count))
    running[1] = 0 if start.burn_in else running[0]
    sweeps = start.burn_in or start.samples
    left[[plane for plane in range(depth) if sweeps >> plane & 1]] = ~np.uint64(0)
    if not run_sliced(
        np.array(POLYNOMIALS[parameters.rng], dtype=np.int64),
        steps,
        circuit.masks,
        circuit.cdes,
        circuit.entries,
        circuit.conditions,
        numbers,
        values,
        pointed,
        running,
        left,
        counts,
        room,
        ends,
        start.samples,
        start.max_cycles,
        start.ops_timeout // 2 - CYCLES,
    ):
        return None

    drawn = (_bits_of(counts, count) << np.arange(depth)[:, np.newaxis]).sum(axis=1)
    results = np.zeros((count, parameters.result_words), dtype=np.uint32)
    evidence = [state & start.known for state in states]
    for known in set(evidence):
        same = np.flatnonzero([each == known for each in evidence])
        for mask, first, variables in _counted(parameters, start.known):
            rest = drawn[circuit.events[0, 0], same]
            for value in (*_values_of(mask), 0):
                samples = drawn[circuit.events[mask, value], same] if value else rest
                rest = rest - samples
                codes = unpack(parameters, known | value)
                word = 0
                for variable in variables:
                    word = word << parameters.bits[variable] | codes[variable]
                results[same, first + word] = samples
    going = _bits_of(running[0], count)
    ended = _bits_of(values[: circuit.unknown], count).T.tolist()
    cycles = ends[:count]
    made = (cycles % lfsr.period * steps).astype(np.uint64)
    generators = lfsr.jump(seeds, np.repeat(made[:, np.newaxis], parameters.cdes, axis=1))
    return [
        ChainResult(
            reason=BM2StopReason.MAX_CYCLES if going[chain] else BM2StopReason.SAMPLES,
            cycles=int(cycles[chain]),
            samples=int(drawn[0, chain]),
            unused=int(drawn[0, chain] - drawn[circuit.events[0, 0], chain]),
            timed_out_bit=-1,
            state=known | sum(value << bit for bit, value in zip(circuit.bits, ended[chain], strict=False)),
            results=results[chain],
            rng_state=generators[chain],
        )
        for chain, known in enumerate(evidence)
    ]


# Everything below is compiled, as in `machines.bm2_fast`.

_0: Final = np.uint64(0)
_1: Final = np.uint64(1)
_63: Final = np.uint64(63)


@in_llvm(types.boolean, VECTOR)
def _some(builder: Any, vector: Any) -> Any:
    """Return whether a vector has a 1."""
    whole = builder.bitcast(vector, ir.IntType(SLICE))
    return builder.icmp_unsigned("!=", whole, ir.Constant(ir.IntType(SLICE), 0))


@jit
def run_sliced(  # noqa: PLR0915 - vectors are not passed to functions
    exponents: Integers,
    steps: int,
    masks: Words,
    cdes: Integers,
    entries: Integers,
    conditions: Integers,
    numbers: Words,
    values: Words,
    pointed: Words,
    running: Words,
    left: Words,
    counts: Words,
    room: Words,
    ends: Integers,
    samples: int,
    max_cycles: int,
    window: int,
) -> bool:
    """Run sliced chains to their ends, and set `ends`; return False if one wrote no bit for `window` cycles.

    The vectors of `running` are the chains that have not stopped, those whose burn-in has ended, and room for one.
    `left` counts the sweeps up to the end of the burn-in or of the chain. `room` is for the contexts' bits, and for
    carries of the counters in `counts`.
    """
    zero = splat(_0)
    going, counting, moved = load(running, 0), load(running, 1), zero
    unknown, depth, rows = pointed.shape[0], left.shape[0], numbers.shape[1]
    carries, width = room.shape[0] - counts.shape[0], masks.shape[1]
    unused = conditions.shape[0] - counts.shape[0] + 1
    bits = exponents[0]
    cycle = 0
    unwatched = 0
    while cycle < max_cycles and _some(going):
        for first in range(bits, bits + numbers.shape[0] * rows, rows):
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
        high = zero
        for plane in range(LOW_PLANES + 1, depth):
            high = high | load(left, plane)
        careful = _some(going & ~high)
        borrows = zero
        for counter in range(counts.shape[0]):
            store(room, carries + counter, zero)
        cycles = min(CYCLES, max_cycles - cycle)
        for now in range(cycles):
            # the bits of all contexts: number < code, from the low bit up, as the majority of what the lower bits
            # say, the inverted number and the code
            for group in range(cdes.shape[0]):
                low_bit = cdes[group] * rows + bits + now * steps - 1
                less0, less1, less2, less3 = zero, zero, zero, zero
                for i in range(width):
                    zeros = ~load(numbers, low_bit - i)
                    code0, code1 = splat(masks[group, i, 0]), splat(masks[group, i, 1])
                    code2, code3 = splat(masks[group, i, 2]), splat(masks[group, i, 3])
                    less0 = (less0 & zeros) | (code0 & (less0 | zeros))
                    less1 = (less1 & zeros) | (code1 & (less1 | zeros))
                    less2 = (less2 & zeros) | (code2 & (less2 | zeros))
                    less3 = (less3 & zeros) | (code3 & (less3 | zeros))
                store(room, 4 * group, less0)
                store(room, 4 * group + 1, less1)
                store(room, 4 * group + 2, less2)
                store(room, 4 * group + 3, less3)
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
            # `before` is now the chains that have ended a sweep; a sample with an unused code has no other events
            sampled = before & counting
            for step in range(unused + counts.shape[0]):
                event = sampled
                if step:
                    condition = step - 1
                    for i in range(1, 1 + 2 * conditions[condition, 0], 2):
                        value_bit = load(values, conditions[condition, i])
                        event = event & (value_bit if conditions[condition, i + 1] else ~value_bit)
                if 0 < step <= unused:
                    sampled = sampled & ~event
                    continue
                counter = max(step - unused, 0)
                for plane in range(counter * depth, counter * depth + LOW_PLANES):
                    digit = load(counts, plane)
                    store(counts, plane, digit ^ event)
                    event = event & digit
                store(room, carries + counter, load(room, carries + counter) | event)
            borrow = before
            for plane in range(depth if careful else LOW_PLANES):
                digit = load(left, plane)
                store(left, plane, digit ^ borrow)
                borrow = borrow & ~digit
            if not careful:
                borrows = borrows | borrow
                continue
            high = zero
            for plane in range(depth):
                high = high | load(left, plane)
            through = before & ~high
            if _some(through):
                going = going & ~(through & counting)
                store(running, 2, through & counting)
                begun = through & ~counting
                counting = counting | begun
                for plane in range(depth):
                    if (samples >> plane) & 1:
                        store(left, plane, load(left, plane) | begun)
                for lane in range(ends.shape[0]):
                    if (running[2, lane >> 6] >> (np.uint64(lane) & _63)) & _1:
                        ends[lane] = cycle + now + 1
        for counter in range(counts.shape[0]):
            carry = load(room, carries + counter)
            plane = counter * depth + LOW_PLANES
            while plane < (counter + 1) * depth and _some(carry):
                digit = load(counts, plane)
                store(counts, plane, digit ^ carry)
                carry = carry & digit
                plane += 1
        plane = LOW_PLANES
        while plane < depth and _some(borrows):
            digit = load(left, plane)
            store(left, plane, digit ^ borrows)
            borrows = borrows & ~digit
            plane += 1
        cycle += cycles
        for first in range(0, numbers.shape[0] * rows, rows):
            for at in range(first, first + bits):
                store(numbers, at, load(numbers, at + CYCLES * steps))
        unwatched += cycles
        if unwatched >= window:
            if _some(going & ~moved):
                return False
            moved, unwatched = zero, 0
    store(running, 0, going)
    return True
