"""Findings about random numbers: their period, generator steps per cycle, and relations between columns.

A bit of an LFSR's state is a linear function of the initial state. Columns use one sequence with different phases.
So a few random bits of two to four columns may XOR to 0 in every cycle. Such columns are not independent. The AND of
their bits then has an error that no number of cycles averages out.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machines.bm2 import BM2Parameters
from machines.parameters import BM1Parameters, RngKind, RngReset
from machines.rng import LFSR
from toolchain.building.report import SHARED_BITS
from toolchain.checks.findings import Check, CheckedMachine, Finding, Severity, error, note, warning
from toolchain.outputs.memories import seed_words

_RANDOM_SIGMAS: Final = 5


def generator_findings(machine: CheckedMachine) -> Iterator[Finding]:
    """Find random numbers that repeat or share bits between cycles, and columns with related random numbers."""
    parameters = machine.parameters
    if parameters.rng is RngKind.IDEAL:
        what = "these generators exist only in emulation, so there is no hardware project"
        yield note(Check.RNG, "rng = ideal", what, "use an LFSR for a board")
        return
    yield from fresh_numbers(parameters, SHARED_BITS["BM1"])
    if (table := machine.board.rng_table) is not None:
        yield from _period(machine, len(table))
        yield from _table_numbers(machine, table & np.uint32(parameters.ones_code))
    else:
        yield from _period(machine, LFSR(parameters.rng).period)
        yield from _relations(machine)


def fresh_numbers(p: BM1Parameters | BM2Parameters, effect: str) -> Iterator[Finding]:
    """Find random numbers that are equal in every frame, or that share bits with the next cycle's random numbers.

    `effect` is a clause that says what shared bits do to the results.
    """
    if p.rng_banks == 1 and p.rng_reset is RngReset.BANK:
        what = (
            "every frame uses the same random numbers, so averaging over frames does not remove their error"
        )
        yield warning(Check.RNG_BANKS, "rng_banks = 1", what, "use --rng-banks 16, or --rng-reset free")
    # both together are the generators of `--thesis`, which are intended; the report of the build says what they do
    thesis = p.rng_reset is RngReset.FREE and p.steps_per_clock == 1
    if p.rng.lfsr_bits is not None and p.steps_per_clock < p.prob_bits and not thesis:
        what = f"numbers of {p.prob_bits} bits share {p.prob_bits - p.steps_per_clock} bits with those of the next cycle: {effect}"
        advice = "omit --steps-per-clock, except for the thesis's machine (--thesis)"
        yield warning(Check.RNG_STEPS, f"steps_per_clock = {p.steps_per_clock}", what, advice)


def _period(machine: CheckedMachine, length: int) -> Iterator[Finding]:
    parameters, limits = machine.parameters, machine.deployment.machine
    period = length // math.gcd(length, parameters.steps_per_clock)
    if limits.max_cycles > period:
        ways = {RngKind.TABLE: ", or a longer --rng-table", RngKind.LFSR32: ""}
        longer = ways.get(parameters.rng, ", or a wider --rng")
        steps = (
            ""
            if period == length
            else f" ({length} steps, of which a clock takes {parameters.steps_per_clock})"
        )
        what = f"the random numbers repeat after {period} cycles{steps}, and a frame may run {limits.max_cycles}: later cycles "
        what += "add no information"
        advice = f"use --max-cycles {period}{longer}"
        yield warning(Check.RNG_PERIOD, f"rng = {parameters.rng}", what, advice)


def _relations(machine: CheckedMachine) -> Iterator[Finding]:
    """Find columns whose random bits are related by XOR within a bank of seeds.

    If each cell has a generator, find the relations within each line of a bank.
    """
    parameters, names, about = machine.parameters, machine.names, f"rng = {machine.parameters.rng}"
    seeds = seed_words(machine.board).reshape(-1, parameters.columns)
    found, groups = relations(parameters.rng, seeds, parameters.prob_bits)
    what_groups = "banks" if parameters.shared else "lines in a bank"
    for count in (2, 3, 4):
        related = [relation for relation in found if len(relation.bits) == count]
        if not related:
            continue
        first = related[0]
        bank, line = divmod(first.group, 1 if parameters.shared else parameters.lines)
        where = f"bank {bank}" + ("" if parameters.shared else f", line {line} of board 0")
        bits = " and ".join(f"bit {bit} of {names[column]}" for column, bit in first.bits)
        apart = len({column for column, _ in first.bits}) == count
        same = count == 2 and first.bits[0][1] == first.bits[1][1]
        severity = Severity.ERROR if count < 4 else Severity.WARNING
        if not parameters.shared and not same:
            severity = Severity.WARNING if count < 4 else Severity.NOTE
        clean = first.group if parameters.shared else 0
        what = f"in {len(related)} of {groups} {what_groups} {count} random bits of {'different' if apart else 'several'} columns "
        what += f"{'are the same' if count == 2 else 'XOR to 0'} in every cycle ({where}: {bits}), so these columns are not "
        advice = f"use {'' if parameters.rng is RngKind.LFSR32 else 'a wider --rng or '}fewer --prob-bits"
        advice += f", or --rng-banks {clean}, which excludes these banks" if clean > 1 else ""
        yield Finding(severity, Check.RNG_RELATION, about, what + "independent", advice)
    if groups < len(seeds):
        what = f"relations were searched in {groups} of {len(seeds)} {what_groups}, to save time"
        yield note(Check.RNG_RELATION, about, what)


def _table_numbers(machine: CheckedMachine, numbers: NDArray[np.uint32]) -> Iterator[Finding]:
    """Find the mistakes that a table of random numbers causes.

    The table may distort the frequency of a code. Two columns may read the table from one index, or from two indices
    at which their random numbers correlate.
    """
    parameters, names = machine.parameters, machine.names
    codes = 1 << parameters.prob_bits
    # codes 0 and all-ones don't depend on the random numbers
    below = np.cumsum(np.bincount(numbers, minlength=codes))[: codes - 2] / len(numbers)
    errors = np.abs(below - np.arange(1, codes - 1) / codes)
    worst = int(errors.argmax()) if errors.size else 0
    if errors.size and errors[worst] > 0.5 / codes:
        what = f"code {worst + 1} counts in {below[worst]:.4g} of the cycles instead of {(worst + 1) / codes:.4g}, because the "
        what += "numbers are not equally frequent in the table"
        advice = "use a table with equally frequent numbers, such as the one generated without --rng-table"
        yield warning(Check.RNG_TABLE, "rng = table", what, advice)
    starts = seed_words(machine.board).reshape(-1, parameters.columns)
    for group, row in enumerate(starts):
        order = np.argsort(row, kind="stable")
        for one, other in pairwise(int(index) for index in order):
            if row[one] == row[other]:
                pair = f"{names[one]} and {names[other]}"
                what = f"they start at the same index of the table (index {row[one]}, group {group}), so they are the same"
                yield error(Check.RNG_RELATION, pair, what, "use a longer --rng-table")
                return
    yield from _table_correlation(machine, numbers, starts)


def _table_correlation(
    machine: CheckedMachine, numbers: NDArray[np.uint32], starts: NDArray[np.uint64]
) -> Iterator[Finding]:
    """Find columns whose random numbers correlate, because they read one table at a fixed distance from each other."""
    length = len(numbers)
    centred = numbers - numbers.mean()
    if not centred.any():
        return
    spectrum = np.fft.rfft(centred)
    correlation = np.fft.irfft(np.abs(spectrum) ** 2, length) / (centred @ centred)
    limit = _RANDOM_SIGMAS / math.sqrt(length)
    first = starts[0].astype(np.int64)
    one, other = np.triu_indices(len(first), 1)
    found = np.abs(correlation[(first[one] - first[other]) % length])
    worst = int(found.argmax()) if found.size else 0
    if found.size and found[worst] > limit:
        pair = f"{machine.names[one[worst]]} and {machine.names[other[worst]]}"
        what = f"their random numbers correlate by {found[worst]:.2g}; up to {limit:.2g} is due to chance in a table of {length}"
        advice = "use a table in a more random order, such as the one generated without --rng-table"
        yield warning(Check.RNG_RELATION, pair, what, advice)


Bit = tuple[int, int]
"""Index of a column (0 is the prior), and index of a bit of the column's random numbers (0 is the lowest)."""

_MOST_PAIRS: Final = 20_000_000


@dataclass(frozen=True, slots=True)
class Relation:
    """Bits whose XOR is 0 in every cycle."""

    group: int
    """Index of the group of seeds for which the XOR is 0. A group has one seed per column (BM1) or per CDE (BM2).

    A BM1 has one group per bank of seeds. If each cell of the BM1 has its own generator, each line of a bank is a
    group, with the index bank * lines + line. In a BM2, each board has one group per bank, with the index
    bank * boards + board.
    """
    bits: tuple[Bit, ...]


def relations(kind: RngKind, seeds: NDArray[np.uint64], prob_bits: int) -> tuple[list[Relation], int]:
    """Search each group of generators for 2, 3 or 4 random bits whose XOR is 0 in every cycle (a `Relation`).

    `seeds` are uint64[groups, columns], with a generator per column of a BM1 or per CDE of a BM2. The random bits of a
    generator are the low `prob_bits` bits of its state, which the machine compares with a code. To limit the time to a
    few seconds, the search may stop before the last group.

    Returns:
        The relations (for each group at most one, with the fewest bits), and the number of searched groups.
    """
    groups, columns = seeds.shape
    bits = columns * prob_bits
    pairs = max(1, bits * (bits - 1) // 2)
    groups = min(groups, max(1, _MOST_PAIRS // pairs))
    words = _bit_words(kind, seeds[:groups], prob_bits)
    found = [
        Relation(group, tuple((at // prob_bits, at % prob_bits) for at in related))
        for group, row in enumerate(words)
        if (related := _related(row)) is not None
    ]
    return found, groups


def _bit_words(kind: RngKind, seeds: NDArray[np.uint64], prob_bits: int) -> NDArray[np.uint64]:
    """Return one word per bit of the random numbers, uint64[groups, bits]: its values in the generators' first steps.

    A word has as many steps as a state has bits. These determine all later steps: bits with equal words always agree.
    """
    lfsr = LFSR(kind)
    shifts = np.arange(prob_bits, dtype=np.uint64)
    words = np.zeros((*seeds.shape, prob_bits), dtype=np.uint64)
    states = seeds
    for step in range(lfsr.bits):
        words |= ((states[..., np.newaxis] >> shifts) & np.uint64(1)) << np.uint64(step)
        states = lfsr.step(states)
    return words.reshape(len(seeds), -1)


def _related(words: NDArray[np.uint64]) -> tuple[int, ...] | None:
    """Return the indices of the fewest words, at most 4, whose XOR is 0."""
    order = np.argsort(words, kind="stable")
    ordered = words[order]
    same = np.flatnonzero(ordered[1:] == ordered[:-1])
    if same.size:
        return tuple(sorted(int(index) for index in order[same[0] : same[0] + 2]))
    first, second = np.triu_indices(len(words), 1)
    sums = words[first] ^ words[second]
    places = np.minimum(np.searchsorted(ordered, sums), len(words) - 1)
    third = np.flatnonzero(ordered[places] == sums)
    if third.size:
        at = third[0]
        return tuple(sorted((int(first[at]), int(second[at]), int(order[places[at]]))))
    by_sum = np.argsort(sums, kind="stable")
    sums = sums[by_sum]
    fourth = np.flatnonzero(sums[1:] == sums[:-1])
    if fourth.size:
        # two pairs with the same XOR do not share a word, because then their other words would be equal
        one, other = by_sum[fourth[0]], by_sum[fourth[0] + 1]
        return tuple(sorted(int(index) for pair in (one, other) for index in (first[pair], second[pair])))
    return None
