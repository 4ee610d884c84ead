"""Findings about a BM2: clipped factors and their error, states that are not connected, wide factors, random numbers.

Zeros of a factor are clipped to the smallest chance that a code can express, so that the chain can cross them, but
rarely. What that costs is computed exactly where the states are few; elsewhere the finding says that it was not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Final

import numpy as np

from machines.bm2 import BM2Machine, unpack
from machines.parameters import RngReset, Sequencer
from machines.rng import LFSR
from toolchain.analysis.chain import agreement, chain_error
from toolchain.analysis.logic import BLOCK_SHAPES, device_named
from toolchain.checks.findings import Check, Finding, Severity, error, note, reading, warning
from toolchain.checks.generators import relations

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from toolchain.analysis.chain import ChainError
    from toolchain.deployment import Variable
    from toolchain.models.network import NetworkModel

_LARGE_ERROR: Final = 0.01
"""Total variation from which an error is a warning."""
_MOST_LISTED: Final = 5
_MOST_STATES: Final = 2**20
_MOST_PATTERN_STATES: Final = 2**24
"""Maximum number of states over all patterns of missing readings."""
_BLANKET_BITS: Final = 16
"""Maximum number of bits that share a factor with a pointed bit, whose values are tried for clips."""
_TIMEOUT_RISK: Final = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class CheckedChain:
    """A BM2 to check, as one of its boards has it."""

    machine: BM2Machine
    names: tuple[str, ...]
    """The names of the machine's variables."""
    titles: tuple[str, ...]
    """The names of its factors."""
    labels: tuple[tuple[str, ...], ...]
    """The values of each variable in words."""
    known: tuple[Variable, ...]
    """The known variables."""
    boards: int
    samples: int
    max_cycles: int
    model: NetworkModel | None
    """The probabilities, if known."""

    def state(self, values: Sequence[int], variables: Sequence[int]) -> str:
        """Return values of some variables in words: `rain = yes, grass = wet`."""
        return ", ".join(f"{self.names[each]} = {self.labels[each][values[each]]}" for each in variables)


def chain_findings(chain: CheckedChain) -> Iterator[Finding]:
    """Find everything about a BM2 that can make its results wrong, slow, or impossible to build."""
    yield from _clips(chain)
    yield from _opposite_clips(chain)
    yield from _connections(chain)
    yield from _memories(chain)
    found = None
    if chain.model is not None:
        burn_in = chain.machine.parameters.burn_in
        found = chain_error(
            chain.machine, chain.model, burn_in=burn_in, samples=chain.samples, boards=chain.boards
        )
        yield from _error(chain, found)
    yield from _numbers(chain, found)


def clipped(factor: NDArray[np.float64], prob_bits: int) -> tuple[int, int, int]:
    """Return how many odds of a factor are clipped, how many of these by zeros, and the number of all odds.

    A CDE compares two values of a variable whose codes differ in one bit, the other variables being equal.
    """
    least = 0.5 / 2**prob_bits
    clips = zeros = count = 0
    for axis, size in enumerate(factor.shape):
        for bit in range((size - 1).bit_length()):
            low = np.array(
                [code for code in range(size) if not code >> bit & 1 and code | 1 << bit < size],
                dtype=np.intp,
            )
            zero, one = np.take(factor, low, axis), np.take(factor, low | 1 << bit, axis)
            both = zero + one
            possible = both > 0
            share = np.divide(np.minimum(zero, one), both, out=np.ones_like(both), where=possible)
            clips += int((share < least).sum())
            zeros += int((share == 0).sum())
            count += both.size
    return clips, zeros, count


def _clips(chain: CheckedChain) -> Iterator[Finding]:
    """Name every clipped factor; without the model, those that are clipped because of zeros."""
    width = chain.machine.parameters.prob_bits
    tables = (
        [support.astype(np.float64) for support in chain.machine.supports]
        if chain.model is None
        else [term.table for term in chain.model.factors]
    )
    for title, table in zip(chain.titles, tables, strict=True):
        clips, zeros, count = clipped(table, width)
        if clips:
            yield note(
                Check.CLIPPED,
                title,
                (
                    f"{clips} of its {count} odds are clipped to 1 in {2**width}"
                    + (f", {zeros} of them because of zeros" if zeros else "")
                ),
                "more --prob-bits make crossing a zero rarer, and the samples less independent"
                if zeros
                else "use more --prob-bits",
            )


def _error(chain: CheckedChain, found: ChainError | None) -> Iterator[Finding]:
    """Find what the codes, the start state and the samples cost."""
    machine = chain.machine
    if found is None:
        yield note(
            Check.CODES_ERROR,
            "the codes",
            "the error that they cause was not computed, because the machine has too many unknown bits",
            "use 'toolchain inspect' with --model, which runs it",
        )
        return
    about = "" if found.share > 0.9995 else f" ({found.readings} readings, {found.share:.0%} of all)"
    where = ", ".join(
        reading(variable, address) if not variable.name else f"{variable.name} = {reading(variable, address)}"
        for variable, address in zip(chain.known, found.worst_reading, strict=True)
    )
    large = max(found.quantising, found.worst) > _LARGE_ERROR
    if large or not all(support.all() for support in machine.supports):
        yield Finding(
            Severity.WARNING if large else Severity.NOTE,
            Check.CODES_ERROR,
            "the codes",
            (
                f"quantising and clipping change the posterior by a total variation of {found.quantising:.2g} in the "
                f"mean{about}" + (f", {found.worst:.2g} at worst ({where})" if where else "")
            ),
            "use more --prob-bits" if large else "",
        )
    slow = found.start + found.sampling
    if slow > _LARGE_ERROR:
        burn_in, samples = machine.parameters.burn_in, chain.samples * chain.boards
        yield Finding(
            Severity.WARNING if found.start > _LARGE_ERROR or slow > 5 * _LARGE_ERROR else Severity.NOTE,
            Check.MIXING,
            "the samples",
            (
                f"{samples} of them are worth {max(1.0, samples * found.effective):.0f} independent ones at worst, so a "
                f"total variation of {found.sampling:.2g} is left in the mean"
                + (
                    f", and the start state adds {found.start:.2g} in spite of {burn_in} sweeps of burn-in"
                    if found.start > _LARGE_ERROR / 10
                    else ""
                )
            ),
            "use more --samples"
            + (" and a longer --burn-in" if found.start > _LARGE_ERROR / 10 else "")
            + ("" if machine.parameters.sequencer is not Sequencer.RANDOM else ", or another --sequencer"),
        )


def _always_known(chain: CheckedChain) -> set[int]:
    pairs = zip(chain.machine.parameters.known, chain.known, strict=True)
    return {at for at, variable in pairs if variable.on_missing != "missing"}


def _opposite_clips(chain: CheckedChain) -> Iterator[Finding]:
    """Find bits at which factors clip in opposite directions, so that the move takes long."""
    p = chain.machine.parameters
    always, wide, found = _always_known(chain), [], []
    for variable, (offset, bits) in enumerate(zip(p.offsets, p.bits, strict=True)):
        if variable in always:
            continue
        worst = (0.0, -1, -1)
        for bit in range(offset, offset + bits):
            blanket = sorted(
                {other for cde in range(p.cdes) for other in p.factor_bits(cde) if bit in p.factor_bits(cde)}
                - {bit}
            )
            if len(blanket) > _BLANKET_BITS:
                wide.append(chain.names[variable])
                break
            worst = max(worst, _slowest(chain.machine, bit, blanket))
        if worst[1] >= 0:
            found.append((*worst, variable))
    found.sort(reverse=True)
    for cycles, low, high, variable in found[:_MOST_LISTED]:
        first, second = sorted((low, high))
        risky = p.ops_timeout < -cycles * math.log(_TIMEOUT_RISK)
        yield warning(
            Check.OPPOSITE_CLIPS,
            chain.names[variable],
            (
                f"{chain.titles[first]} and {chain.titles[second]} can clip one of its bits in opposite directions; such a "
                f"move takes {cycles:,.0f} cycles in the mean"
                + (f", and may exceed the {p.ops_timeout} of ops_timeout" if risky else "")
            ),
            "use fewer --prob-bits" + (", or a larger --ops-timeout" if risky else ""),
        )
    if len(found) > _MOST_LISTED:
        names = ", ".join(chain.names[variable] for *_, variable in found[_MOST_LISTED:])
        yield warning(
            Check.OPPOSITE_CLIPS, names, "factors can clip bits of these variables in opposite directions too"
        )
    if wide:
        yield note(
            Check.OPPOSITE_CLIPS,
            ", ".join(wide),
            f"not checked: more than {_BLANKET_BITS} bits share a factor with one of theirs",
        )


def _slowest(machine: BM2Machine, bit: int, blanket: Sequence[int]) -> tuple[float, int, int]:
    """Return the longest mean time of a move at a bit where two CDEs clip in opposite directions, and which these are.

    All values of the bits that share a factor with it are tried, without unused codes; (0, -1, -1) if there are none.
    """
    p = machine.parameters
    index = np.arange(1 << len(blanket))
    values = {other: index >> at & 1 for at, other in enumerate(blanket)}
    legal = np.ones(len(index), dtype=bool)
    whole = values | {bit: np.ones_like(index)}
    for offset, bits, cardinality in zip(p.offsets, p.bits, p.cardinalities, strict=True):
        if bits and cardinality != 1 << bits and offset in whole:
            legal &= (
                sum((whole[offset + k] << k for k in range(bits)), start=np.zeros_like(index)) < cardinality
            )
    concerned = agreement(machine, bit, values)
    chances = np.array([np.broadcast_to(chance, index.shape) for _, chance in concerned])
    limit = 1 / 2.0**p.prob_bits
    low, high = chances <= limit, chances >= 1 - limit
    places = np.flatnonzero(low.any(axis=0) & high.any(axis=0) & legal)
    if not places.size:
        return 0.0, -1, -1
    cycles = 1 / (np.prod(chances[:, places], axis=0) + np.prod(1 - chances[:, places], axis=0))
    worst = int(cycles.argmax())
    at = places[worst]
    return float(cycles[worst]), concerned[low[:, at].argmax()][0], concerned[high[:, at].argmax()][0]


def _connections(chain: CheckedChain) -> Iterator[Finding]:
    """Find legal states that single-bit moves do not connect, whichever readings are there or missing."""
    p = chain.machine.parameters
    optional = [at for at in p.known if at not in _always_known(chain)]
    if 1 << p.state_bits > _MOST_STATES or 1 << (p.state_bits + len(optional)) > _MOST_PATTERN_STATES:
        yield note(
            Check.CONNECTION,
            "the states",
            f"whether single-bit moves connect them was not checked: there are 2^{p.state_bits}",
        )
        return
    legal = legal_states(chain.machine)
    for count in range(len(optional) + 1):
        for missing in combinations(optional, count):
            known = [at for at in p.known if at not in missing]
            pair = unconnected(chain.machine, legal, known)
            if pair is None:
                continue
            one, other = (unpack(p, state) for state in pair)
            differing = [at for at in range(len(one)) if one[at] != other[at]]
            reason = f"with {chain.state(one, known)}, " if known else ""
            gone = ", ".join(chain.names[at] for at in missing)
            yield warning(
                Check.CONNECTION,
                "the states",
                (
                    f"{reason}{f'without {gone}, ' if gone else ''}no path of possible states that change one bit at a "
                    f"time leads from {chain.state(one, differing)} to {chain.state(other, differing)}, so samples cross "
                    "by clipped zeros alone, which is rare"
                ),
                "do not trust its posterior without comparing it; search or know fewer of the variables of factors with "
                "zeros, or use a small probability instead of each zero",
            )
            return


def legal_states(machine: BM2Machine) -> NDArray[np.bool_]:
    """Return which states are possible, bool[2**state_bits]."""
    p = machine.parameters
    index = np.arange(1 << p.state_bits)
    codes = [index >> offset & (1 << bits) - 1 for offset, bits in zip(p.offsets, p.bits, strict=True)]
    legal: NDArray[np.bool_] = np.ones(len(index), dtype=np.bool_)
    for code, cardinality in zip(codes, p.cardinalities, strict=True):
        legal &= code < cardinality
    for scope, support in zip(p.factors, machine.supports, strict=True):
        places = np.flatnonzero(legal)
        legal[places] = support[tuple(codes[variable][places] for variable in scope)]
    return legal


def unconnected(
    machine: BM2Machine, legal: NDArray[np.bool_], known: Sequence[int]
) -> tuple[int, int] | None:
    """Return two legal states with the same values of the known variables and no path between them, or None."""
    p = machine.parameters
    mask = sum(p.masks[variable] for variable in known)
    index = np.arange(len(legal))
    # The label of a state is the smallest one that it is connected to; illegal states never pass on theirs.
    labels = np.where(legal, index, len(legal))
    while True:
        before = labels.copy()
        for bit in range(p.state_bits):
            if not mask >> bit & 1:
                halves = labels.reshape(-1, 2, 1 << bit)
                own = legal.reshape(halves.shape)
                both = own[:, :1] & own[:, 1:]
                halves[:] = np.where(both, np.minimum(halves[:, :1], halves[:, 1:]), halves)
        # a label's own label is at least as small
        labels = np.where(legal, np.append(labels, len(legal))[labels], labels)
        if np.array_equal(labels, before):
            break
    places = np.flatnonzero(legal)
    evidence = index[places] & mask
    first = np.full(len(legal), len(legal))
    np.minimum.at(first, evidence, labels[places])
    wrong = np.flatnonzero(labels[places] != first[evidence])
    if not wrong.size:
        return None
    return int(first[evidence[wrong[0]]]), int(labels[places[wrong[0]]])


def blocks_of(words: int, width: int) -> int:
    """Return the number of memory blocks of one table."""
    return min(math.ceil(words / deep) * math.ceil(width / wide) for deep, wide in BLOCK_SHAPES)


def _memories(chain: CheckedChain) -> Iterator[Finding]:
    """Find factors whose tables do not fit the memory of a board's FPGA."""
    width, device = chain.machine.parameters.prob_bits, device_named("proce-v-d8")
    room = math.floor(device.usable * device.blocks)
    blocks = [blocks_of(table.size, width) if table.size else 0 for table in chain.machine.tables]
    limit = max(deep * (room // math.ceil(width / wide)) for deep, wide in BLOCK_SHAPES)
    advice = "give it fewer variables or fewer values, fix one of them with --given, or use fewer --prob-bits"
    for title, table, each in zip(chain.titles, chain.machine.tables, blocks, strict=True):
        if each > room:
            yield warning(
                Check.WIDE_FACTOR,
                title,
                (
                    f"its table has {table.size:,} words of {width} bits, and the memory of a {device.title} holds "
                    f"{limit:,}, so this machine runs in emulation only"
                ),
                advice,
            )
    if max(blocks, default=0) <= room < sum(blocks):
        widest = blocks.index(max(blocks))
        yield warning(
            Check.WIDE_FACTOR,
            chain.titles[widest],
            (
                f"all tables take {sum(blocks):,} memory blocks, of which a {device.title} has {room:,} for them; this one "
                f"is the widest, with {chain.machine.tables[widest].size:,} words"
            ),
            advice,
        )


def _numbers(chain: CheckedChain, found: ChainError | None) -> Iterator[Finding]:
    """Find random numbers that are shared between boards, banks or CDEs, related, repeated, or not fresh."""
    p = chain.machine.parameters
    width = p.rng.lfsr_bits
    if p.rng_banks == 1 and p.rng_reset is RngReset.BANK:
        yield warning(
            Check.RNG_BANKS,
            "rng_banks = 1",
            "every frame uses the same random numbers, so averaging over frames does not remove their error",
            "use --rng-banks 16, or --rng-reset free",
        )
    if width is None:
        return
    if p.steps_per_clock < p.prob_bits:
        yield warning(
            Check.RNG_STEPS,
            f"steps_per_clock = {p.steps_per_clock}",
            (
                f"numbers of {p.prob_bits} bits share bits with those of the next cycle, which biases the samples (the "
                "sprinkler's by 0.02 to 0.05), however many there are"
            ),
            "omit --steps-per-clock",
        )
    sets = p.rng_banks * chain.boards
    seeds = LFSR(p.rng).seeds(np.arange(sets * p.cdes, dtype=np.uint64))
    own, counts = np.unique(seeds, return_counts=True)
    if own.size < seeds.size:
        numbers = np.flatnonzero(seeds == own[counts.argmax()])[:2].tolist()
        one, other = (
            f"{chain.titles[at % p.cdes]} (board {at // p.cdes % chain.boards}, bank {at // p.cdes // chain.boards})"
            for at in numbers
        )
        yield error(
            Check.RNG_RELATION,
            f"rng = {p.rng}",
            f"the generators of {one} and {other} have the same seed",
            "use a wider --rng, or fewer --rng-banks",
        )
    related, groups = relations(p.rng, seeds.reshape(sets, p.cdes), p.prob_bits)
    for size, finding in ((2, error), (3, warning), (4, note)):
        those = [relation for relation in related if len(relation.bits) == size]
        if those:
            first = those[0]
            bank, board = divmod(first.group, chain.boards)
            bits = " and ".join(f"bit {bit} of {chain.titles[cde]}" for cde, bit in first.bits)
            yield finding(
                Check.RNG_RELATION,
                f"rng = {p.rng}",
                (
                    f"in {len(those)} of {groups} banks of boards {size} random bits "
                    f"{'are the same' if size == 2 else 'XOR to 0'} in every cycle (bank {bank}, board {board}: {bits})"
                ),
                "use --rng lfsr32 or fewer --prob-bits",
            )
    if found is not None:
        sweeps = p.burn_in + chain.samples
        cycles = min(chain.max_cycles, sweeps * found.cycles) * chain.boards
        if cycles > 2**width / 10:
            yield warning(
                Check.RNG_PERIOD,
                f"rng = {p.rng}",
                (
                    f"a frame takes about {cycles:.2g} cycles on all boards, more than a tenth of the generators' period of "
                    f"{2**width - 1}, so that boards and CDEs see each other's numbers"
                ),
                "use a wider --rng, fewer --samples or fewer --partitions",
            )
