"""Findings about a BM2: clipped factors, unconnected states, oversized tables, and related random numbers.

A zero of a factor is clipped to the smallest chance that a code can express. The chain therefore enters impossible
states, but rarely. If there are few states, the resulting error is computed exactly. Otherwise a finding says that the
error was not computed.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machines.bm2 import BM2Machine, unpack
from machines.parameters import PROB_BITS_MAX, RngKind, SampleEvery
from machines.rng import LFSR
from toolchain.analysis.chain import ChainError, agreement, chain_error
from toolchain.analysis.logic import BLOCK_SHAPES, blocks_of, device_named
from toolchain.building.bm2_machine import clipped
from toolchain.building.report import SHARED_BITS
from toolchain.checks.findings import Check, Finding, Severity, error, note, reading, warning
from toolchain.checks.generators import fresh_numbers, relations
from toolchain.deployment import Deployment
from toolchain.models.network import NetworkModel

_LARGE_ERROR: Final = 0.01
"""Total variation above which an error is a warning, not a note."""
_STATE_BITS: Final = 20
"""Maximum number of bits of a state for the check whether all states are connected."""
_PATTERN_BITS: Final = 24
"""Maximum sum of state bits and optional known variables at which it is checked that all states are connected."""
_BLANKET_BITS: Final = 16
"""Maximum number of bits that share a factor with one bit. `Check.OPPOSITE_CLIPS` tries all values of these bits."""
_RELATED_BITS: Final = 2048
"""Maximum number of random bits among which relations are searched, because all pairs of bits are kept."""
_TIMEOUT_RISK: Final = 1e-6
_MOVE_CYCLES: Final = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class CheckedChain:
    """The machine of a BM2's first board, for the checks.

    Without `model`, only known and searched variables have names for their values. The values of all other variables
    are shown as numbers.
    """

    deployment: Deployment
    machine: BM2Machine
    model: NetworkModel | None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the machine's variables."""
        return self.deployment.machine.variables

    @property
    def titles(self) -> tuple[str, ...]:
        """The names of the machine's factors."""
        if self.model is not None:
            return self.model.titles
        scopes = [", ".join(self.names[at] for at in scope) for scope in self.machine.parameters.factors]
        return tuple(f"CDE {at} ({scope})" for at, scope in enumerate(scopes))

    def state(self, values: Sequence[int], variables: Sequence[int]) -> str:
        """Return the values of the variables at the indices `variables` as text: `rain = yes, grass = wet`."""
        p, deployment = self.machine.parameters, self.deployment
        if self.model is None:
            labels = dict(zip(p.known, (each.states for each in deployment.variables), strict=True))
            labels |= dict(zip(p.searched, (each.states for each in deployment.searched), strict=True))
        else:
            labels = {at: symbol.type.labels for at, symbol in enumerate(self.model.symbols)}
        words = {at: labels[at][values[at]] if labels.get(at) else str(values[at]) for at in variables}
        return ", ".join(f"{self.names[at]} = {word}" for at, word in words.items())

    @property
    def always_known(self) -> set[int]:
        """The indices of the variables that have a reading in every frame."""
        pairs = zip(self.machine.parameters.known, self.deployment.variables, strict=True)
        return {at for at, variable in pairs if variable.on_missing != "missing"}


def chain_findings(chain: CheckedChain) -> Iterator[Finding]:
    """Yield a finding for everything in a BM2 that can make results wrong or slow, or that does not fit a board."""
    yield from _clips(chain)
    yield from _opposite_clips(chain)
    yield from _connections(chain)
    yield from _memories(chain)
    found = None
    if chain.model is not None:
        found = chain_error(chain.machine, chain.model, samples=chain.deployment.machine.target_count)
        yield from _error(chain, found)
    yield from _limits(chain, found)
    yield from _numbers(chain, found)


def _clips(chain: CheckedChain) -> Iterator[Finding]:
    """Find the factors with clipped odds; without the model, only zeros are known, so other clipping is not found."""
    width, model = chain.machine.parameters.prob_bits, chain.model
    for at, (title, support) in enumerate(zip(chain.titles, chain.machine.supports, strict=True)):
        clips, zeros, count = clipped(
            support.astype(np.float64) if model is None else model.factors[at].table, width
        )
        if clips:
            what = f"{clips} of its {count} odds are clipped to 1 in {2**width}"
            what += f", {zeros} of them because of zeros" if zeros else ""
            rarer = "more --prob-bits make crossing a zero rarer, and the samples less independent"
            advice = rarer if zeros else "use more --prob-bits"
            yield note(Check.CLIPPED, title, what, advice if width < PROB_BITS_MAX else "")


def _error(chain: CheckedChain, found: ChainError | None) -> Iterator[Finding]:
    """Find the errors due to the codes, the start state and the number of samples."""
    p = chain.machine.parameters
    if found is None:
        what = "the error that they cause was not computed, because too many bits are unknown"
        yield note(Check.CODES_ERROR, "the codes", what, "build it, and use 'toolchain inspect' with --model")
        return
    of_all = "" if found.share > 0.9995 else f" over {found.share:.0%} of the readings"
    pairs = zip(chain.deployment.variables, found.worst_reading, strict=True)
    where = ", ".join(f"{variable.name} = {reading(variable, address)}" for variable, address in pairs)
    large = found.worst > _LARGE_ERROR
    if large or not all(support.all() for support in chain.machine.supports):
        severity = Severity.WARNING if large else Severity.NOTE
        advice = "use more --prob-bits" if large and p.prob_bits < PROB_BITS_MAX else ""
        what = f"quantising and clipping change the posterior by a total variation of {found.quantising:.2g} in the mean{of_all}"
        what += f", {found.worst:.2g} at worst ({where})" if where else ""
        yield Finding(severity, Check.CODES_ERROR, "the codes", what, advice)
    if found.start + found.sampling > _LARGE_ERROR:
        stuck, samples = found.start > _LARGE_ERROR / 10, chain.deployment.machine.target_count * p.chains
        severity = Severity.WARNING if max(found.start, found.sampling / 5) > _LARGE_ERROR else Severity.NOTE
        what = f"{samples} of them are worth {max(1.0, samples * found.effective):.0f} independent ones at worst, so a total variation "
        what += f"of {found.sampling:.2g} is left in the mean"
        what += (
            f", and {p.burn_in} sweeps of burn-in leave {found.start:.2g} of the start state" if stuck else ""
        )
        advice = "use more --samples" + (" and a longer --burn-in" if stuck else "")
        yield Finding(severity, Check.MIXING, "the samples", what, advice)


def _opposite_clips(chain: CheckedChain) -> Iterator[Finding]:
    """Find bits that one factor clips towards 0 and another towards 1, so that their CDEs take long to agree."""
    p, wide = chain.machine.parameters, []
    for variable in sorted(set(range(len(p.cardinalities))) - chain.always_known):
        own = range(p.offsets[variable], p.offsets[variable] + p.bits[variable])
        blanket = set().union(*(p.factor_bits(at) for at, scope in enumerate(p.factors) if variable in scope))
        if own and len(blanket) > _BLANKET_BITS + 1:
            wide.append(chain.names[variable])
            continue
        found = [_slowest(chain.machine, bit, sorted(blanket - {bit})) for bit in own]
        cycles, one, other = max(found, default=(0.0, 0, 0))
        if cycles:
            risky = p.ops_timeout < -cycles * math.log(_TIMEOUT_RISK)
            what = f"{chain.titles[one]} and {chain.titles[other]} can clip one of its bits in opposite directions; such a move takes "
            what += f"{cycles:,.0f} cycles in the mean" + (
                f", and may exceed the {p.ops_timeout} of ops_timeout" if risky else ""
            )
            advice = "use fewer --prob-bits" + (", or a larger --ops-timeout" if risky else "")
            yield warning(Check.OPPOSITE_CLIPS, chain.names[variable], what, advice)
    if wide:
        what = f"not checked: more than {_BLANKET_BITS} bits share a factor with one of theirs"
        yield note(Check.OPPOSITE_CLIPS, ", ".join(wide), what)


def _slowest(machine: BM2Machine, bit: int, blanket: Sequence[int]) -> tuple[float, int, int]:
    """Return the largest mean cycles of a move at a bit that two CDEs clip in opposite directions, and these CDEs.

    `blanket` contains the bits that share a factor with this bit; all their values that occur are tried. If no two
    CDEs clip in opposite directions, the cycles are 0.
    """
    p, index = machine.parameters, np.arange(1 << len(blanket))
    values = {other: index >> at & 1 for at, other in enumerate(blanket)}
    whole, legal = values | {bit: np.ones_like(index)}, np.ones_like(index)
    for offset, bits, cardinality in zip(p.offsets, p.bits, p.cardinalities, strict=True):
        if bits and offset in whole:
            code = np.sum([whole[offset + k] << k for k in range(bits)], axis=0)
            legal &= code < cardinality
    concerned = agreement(machine, bit, values)
    chances = np.array([np.broadcast_to(chance, index.shape) for _, chance in concerned])
    low, high = chances <= 0.5**p.prob_bits, chances >= 1 - 0.5**p.prob_bits
    places = np.flatnonzero(low.any(axis=0) & high.any(axis=0) & (legal > 0))
    if not places.size:
        return 0.0, 0, 0
    cycles = 1 / (np.prod(chances[:, places], axis=0) + np.prod(1 - chances[:, places], axis=0))
    at = places[cycles.argmax()]
    one, other = sorted(concerned[clips[:, at].argmax()][0] for clips in (low, high))
    return float(cycles.max()), one, other


def _connections(chain: CheckedChain) -> Iterator[Finding]:
    """Find two possible states between which no single-bit moves lead; every set of missing readings is tried."""
    p = chain.machine.parameters
    optional = [at for at in p.known if at not in chain.always_known]
    if p.state_bits > _STATE_BITS or p.state_bits + len(optional) > _PATTERN_BITS:
        what = f"whether single-bit moves connect them was not checked: there are 2^{p.state_bits}"
        yield note(Check.CONNECTION, "the states", what)
        return
    legal = legal_states(chain.machine)
    for missing in (each for count in range(len(optional) + 1) for each in combinations(optional, count)):
        known = [at for at in p.known if at not in missing]
        pair = unconnected(chain.machine, legal, known)
        if pair is not None:
            one, other = (unpack(p, state) for state in pair)
            differing = [at for at in range(len(one)) if one[at] != other[at]]
            reason = f"with {chain.state(one, known)}, " if known else ""
            reason += f"without {', '.join(chain.names[at] for at in missing)}, " if missing else ""
            what = f"{reason}no path of possible states that change one bit at a time leads from {chain.state(one, differing)} to "
            what += f"{chain.state(other, differing)}, so samples cross by clipped zeros alone, which is rare"
            advice = "compare its posterior with exact inference before you trust it, or replace zeros by small probabilities"
            yield warning(Check.CONNECTION, "the states", what, advice)
            return


def legal_states(machine: BM2Machine) -> NDArray[np.bool_]:
    """Return for each state whether the state is possible: bool[2**state_bits]. The bits of a state are its index."""
    p, index = machine.parameters, np.arange(1 << machine.parameters.state_bits)
    codes = [index >> offset & (1 << bits) - 1 for offset, bits in zip(p.offsets, p.bits, strict=True)]
    used = [code < cardinality for code, cardinality in zip(codes, p.cardinalities, strict=True)]
    legal: NDArray[np.bool_] = np.all(used, axis=0)
    for scope, support in zip(p.factors, machine.supports, strict=True):
        places = np.flatnonzero(legal)
        legal[places] = support[tuple(codes[variable][places] for variable in scope)]
    return legal


def unconnected(
    machine: BM2Machine, legal: NDArray[np.bool_], known: Sequence[int]
) -> tuple[int, int] | None:
    """Return two legal states without a path between them, or None if there are no such states.

    Both states have equal values of the variables at the indices `known`. A path leads through legal states with the
    same values of these variables, and changes one bit at a time.
    """
    p, index = machine.parameters, np.arange(len(legal))
    mask = sum(p.masks[variable] for variable in known)
    # the label of a state is the smallest state found to be connected to it; illegal states pass no labels on
    labels = np.where(legal, index, len(legal))
    before = labels + 1
    while not np.array_equal(labels, before):
        before = labels.copy()
        for bit in (bit for bit in range(p.state_bits) if not mask >> bit & 1):
            halves, own = labels.reshape(-1, 2, 1 << bit), legal.reshape(-1, 2, 1 << bit)
            least = np.minimum(halves[:, :1], halves[:, 1:])
            halves[:] = np.where(own[:, :1] & own[:, 1:], least, halves)
        # follow a label to its own label, which is at most as large
        labels = np.where(legal, np.append(labels, len(legal))[labels], labels)
    places = np.flatnonzero(legal)
    evidence = index[places] & mask
    first = np.full(len(legal), len(legal))
    np.minimum.at(first, evidence, labels[places])
    wrong = np.flatnonzero(labels[places] != first[evidence])
    return (int(first[evidence[wrong[0]]]), int(labels[places[wrong[0]]])) if wrong.size else None


def _memories(chain: CheckedChain) -> Iterator[Finding]:
    """Find factors whose tables do not fit the memory of a board's FPGA."""
    width, device = chain.machine.parameters.prob_bits, device_named("proce-v-d8")
    room = math.floor(device.usable * device.blocks)
    limit = max(deep * (room // math.ceil(width / wide)) for deep, wide in BLOCK_SHAPES)
    blocks = [blocks_of(table.size, width) for table in chain.machine.tables]
    widest = blocks.index(max(blocks))
    for at, (title, table) in enumerate(zip(chain.titles, chain.machine.tables, strict=True)):
        what = f"its table has {table.size:,} words of {width} bits, and the memory of a {device.title} holds {limit:,}"
        if at == widest and blocks[at] <= room < sum(blocks):
            what += f", but all tables together take {sum(blocks):,} of {room:,} memory blocks"
        elif blocks[at] <= room:
            continue
        advice = "give it fewer variables or values, or fix one with --given; until then the machine is only emulated"
        yield warning(Check.WIDE_FACTOR, title, what, advice)


def _limits(chain: CheckedChain, found: ChainError | None) -> Iterator[Finding]:
    """Find limits on cycles (max_cycles, ops_timeout) that probably stop a frame before its last sample."""
    p, limits = chain.machine.parameters, chain.deployment.machine
    own = max(1, len(p.moves(sum(p.masks[at] for at in p.known), p.sequencer)))
    moves = p.burn_in * own + limits.target_count * (own if p.sample_every is SampleEvery.SWEEP else 1)
    # mean cycles of a move; without the model, those if no zeros are clipped
    mean = _MOVE_CYCLES if found is None else found.cycles / own
    if limits.max_cycles < moves * mean:
        finding = error if limits.max_cycles < moves else warning
        what = f"burn-in and samples are {moves:,} moves, which take about {moves * mean:,.0f} cycles"
        advice = "use more --max-cycles, fewer --samples or a shorter --burn-in"
        yield finding(Check.STOPPING, f"max_cycles = {limits.max_cycles}", what, advice)
    if p.ops_timeout < mean * math.log(moves):
        what = (
            f"one of a frame's {moves:,} moves probably takes longer, as the mean is about {mean:.2g} cycles"
        )
        yield warning(Check.STOPPING, f"ops_timeout = {p.ops_timeout}", what, "use a larger --ops-timeout")


def _numbers(chain: CheckedChain, found: ChainError | None) -> Iterator[Finding]:
    """Find random numbers that CDEs, banks or boards share, that are related, or that repeat in or between frames."""
    p, about = chain.machine.parameters, f"rng = {chain.machine.parameters.rng}"
    width, boards, sets = p.rng.lfsr_bits, p.chains, p.rng_banks * p.chains
    wider = "" if p.rng is RngKind.LFSR32 else "--rng lfsr32, or "
    yield from fresh_numbers(p, SHARED_BITS["BM2"])
    if width is None:
        return
    seeds = LFSR(p.rng).seeds(np.arange(sets * p.cdes, dtype=np.uint64))
    own, counts = np.unique(seeds, return_counts=True)
    if own.size < seeds.size:
        one, other = (
            f"{chain.titles[at % p.cdes]} (board {at // p.cdes % boards}, bank {at // p.cdes // boards})"
            for at in np.flatnonzero(seeds == own[counts.argmax()])[:2].tolist()
        )
        what = f"the generators of {one} and {other} have the same seed"
        yield error(Check.RNG_RELATION, about, what, f"use {wider}fewer --rng-banks")
    related, groups = relations(
        p.rng, seeds.reshape(sets, p.cdes)[:, : _RELATED_BITS // p.prob_bits], p.prob_bits
    )
    if p.cdes * p.prob_bits > _RELATED_BITS:
        what = f"relations were searched among {_RELATED_BITS // p.prob_bits} of {p.cdes} CDEs, to save time"
        yield note(Check.RNG_RELATION, about, what)
    for size, finding in ((2, error), (3, warning), (4, note)):
        those = [relation for relation in related if len(relation.bits) == size]
        if those:
            bank, board = divmod(those[0].group, boards)
            bits = " and ".join(f"bit {bit} of {chain.titles[cde]}" for cde, bit in those[0].bits)
            what = f"in {len(those)} of {groups} banks of boards {size} random bits {'are the same' if size == 2 else 'XOR to 0'} in "
            what += f"every cycle (bank {bank}, board {board}: {bits})"
            yield finding(Check.RNG_RELATION, about, what, f"use {wider}fewer --prob-bits")
    limits, sweep = chain.deployment.machine, p.state_bits if found is None else found.cycles
    cycles = min(limits.max_cycles, (p.burn_in + limits.target_count) * sweep) * boards
    if cycles > 2**width / 10:
        what = f"a frame takes {cycles:.2g} cycles on all boards, more than a tenth of the generators' period of {2**width - 1}"
        ways = ["fewer --samples", "a shorter --burn-in", "fewer --partitions"][: 2 if boards == 1 else 3]
        yield warning(Check.RNG_PERIOD, about, what, f"use {wider}{' or '.join(ways)}")
