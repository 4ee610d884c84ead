"""The data of a BM2: parameters, tables, start states of frames, and stop reasons (thesis 2.1.3)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import lru_cache
from itertools import accumulate
from typing import Final

import numpy as np
import numpy.typing as npt

from machines.bm1 import MachineContents, checked_codes, checked_rng_table, frozen
from machines.errors import ParameterError, StartError
from machines.kernel import check_start_value
from machines.parameters import (
    PROB_BITS_MAX,
    RNG_BANKS_MAX,
    STEPS_PER_CLOCK_MAX,
    RngKind,
    RngReset,
    SampleEvery,
    Sequencer,
    check_parameter,
    set_choices,
)

STATE_BITS_MAX: Final = 2048
"""Maximum number of bits of the state. The register map has 64 words for a state."""

FACTOR_BITS_MAX: Final = 20
"""Maximum total number of bits of a factor's variables.

Each bit has a code for every combination of the other bits. A factor of 20 bits has 20 * 2**19 codes, or 20 MiB.
"""

RESULT_WORDS_MAX: Final = 4096
"""Maximum number of words of all histograms, including the joint histogram. RESULTS has this size."""

CHAINS_MAX: Final = 65536
"""Maximum number of boards that run chains of one model."""

SAMPLES_MAX: Final = 2**32 - 1
"""Maximum number of samples of a frame, so that no 32-bit count in a histogram overflows."""

CDES_MAX: Final = 8192
"""Maximum number of factors. Each factor has a conditional distribution encoder (CDE)."""

FACTOR_VARIABLES_MAX: Final = 32
"""Maximum number of variables of a factor. The array of the factor has one axis for each variable."""

SEARCH_MAX: Final = 150_000
"""Maximum work of the search for a start state, in arbitrary units. This work takes about a second."""


class BM2StopReason(IntEnum):
    """The reason why a BM2 stopped, with the number of the reason in the status register."""

    NONE = 0
    """The machine has not run since the reset."""
    SAMPLES = 1
    """The machine has drawn all requested samples. A host can resume the run with a higher number of samples."""
    MAX_CYCLES = 2
    """The machine reached the frame's maximum number of cycles before it had drawn all samples."""
    PAUSED = 3
    """The machine paused after the cycle `pause_at`. `step` continues the run."""
    IMPOSSIBLE = 4
    """The machine did not run: no state agrees with the evidence, so the host asked for 0 samples."""
    OPS_TIMEOUT = 5
    """In a move, the CDEs of a bit's factors did not agree on the bit within `ops_timeout` cycles."""
    FULL = 6
    """The buffer of the stream of samples is full. A resumed run empties the buffer and continues."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BM2Parameters:
    """Parameters of a BM2: bit-level Gibbs sampling in a product of factors.

    Each factor has a conditional distribution encoder (CDE). In a move, the sequencer points at one or more bits of
    the state, and the machine draws new values for these bits. A sweep points once at each unknown bit. If the
    sequencer is `random`, a sweep is as many moves as there are unknown bits.

    Attributes:
        cardinalities: Number of values of each variable, in the model's order.
        factors: Variables of each factor, in rising order. Every variable is in a factor.
        searched: Variables whose joint distribution is counted. The first variable varies slowest.
        known: Variables whose values a frame may set, in the order of the frame's addresses.
        prob_bits: Bits of a CDE's probability code (W), 2 to 16.
        sequencer: Default order in which the sequencer points at bits.
        literal: Whether all CDEs of the machine must agree before a bit is written, as the thesis draws it.
            Otherwise only the CDEs whose factor contains the bit must agree.
        sample_every: Interval of samples: a sweep or a move.
        burn_in: Default number of whole sweeps before the first sample.
        ops_timeout: Default maximum number of cycles of a move.
        rng: Kind of random number generators. `lfsr8` and `lfsr16` are refused, because they bias the samples.
        steps_per_clock: Steps of a generator per cycle, a power of two. 0 stands for the default.
        rng_banks: Number of seed sets of each board. A start selects one seed set.
        rng_reset: Whether a start restarts the generators.
        ideal_seed: Seed of the `ideal` generator, 64 bits.
        chain: Index of this board, from 0.
        chains: Total number of boards. Each board runs a chain of its own.
        stream: Number of samples that the board can store for the host to read, or 0 for none.

    Raises:
        ParameterError: A machine with these parameters cannot be built.
    """

    cardinalities: tuple[int, ...]
    factors: tuple[tuple[int, ...], ...]
    searched: tuple[int, ...] = ()
    known: tuple[int, ...] = ()
    prob_bits: int = 16
    sequencer: Sequencer = Sequencer.LINEAR
    literal: bool = False
    sample_every: SampleEvery = SampleEvery.SWEEP
    burn_in: int = 1000
    ops_timeout: int = 2**20
    rng: RngKind = RngKind.LFSR32
    steps_per_clock: int = 0
    rng_banks: int = 16
    rng_reset: RngReset = RngReset.BANK
    ideal_seed: int = 0
    chain: int = 0
    chains: int = 1
    stream: int = 0

    def __post_init__(self) -> None:
        """Check every parameter, convert strings to enum members, and set the default of `steps_per_clock`."""
        set_choices(self, sequencer=Sequencer, sample_every=SampleEvery, rng=RngKind, rng_reset=RngReset)
        for name in ("cardinalities", "searched", "known"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        object.__setattr__(self, "factors", tuple(map(tuple, self.factors)))
        for name, lowest, highest in (
            ("prob_bits", 2, PROB_BITS_MAX),
            ("burn_in", 0, SAMPLES_MAX),
            ("ops_timeout", 1, SAMPLES_MAX),
            ("steps_per_clock", 0, STEPS_PER_CLOCK_MAX),
            ("rng_banks", 1, RNG_BANKS_MAX),
            ("ideal_seed", 0, 2**64 - 1),
            ("chains", 1, CHAINS_MAX),
            ("chain", 0, self.chains - 1),
            ("stream", 0, SAMPLES_MAX),
        ):
            check_parameter(name, getattr(self, name), lowest, highest)
        self._check_variables()
        if self.literal and self.sequencer is Sequencer.COLOURED:
            raise ParameterError(
                "sequencer = coloured is not possible with literal = true; use linear or random."
            )
        if self.rng in {RngKind.LFSR8, RngKind.LFSR16}:
            raise ParameterError(
                f"{self.rng} biases the samples of a BM2; use lfsr24, lfsr32, table or ideal."
            )
        if self.steps_per_clock == 0:
            steps = 1 if self.rng.lfsr_bits is None else 1 << (self.prob_bits - 1).bit_length()
            object.__setattr__(self, "steps_per_clock", steps)
        if self.steps_per_clock.bit_count() != 1:
            raise ParameterError(
                f"steps_per_clock is {self.steps_per_clock}; on a BM2 it must be a power of two."
            )

    def _check_variables(self) -> None:
        """Check variables, factors, and the sizes that follow from them."""
        check_parameter("The number of variables", len(self.cardinalities), 1, RESULT_WORDS_MAX)
        check_parameter("The number of factors", len(self.factors), 1, CDES_MAX)
        for variable, cardinality in enumerate(self.cardinalities):
            check_parameter(f"The cardinality of variable {variable}", cardinality, 1, 2**16)
        check_parameter("The number of bits of the state", self.state_bits, 1, STATE_BITS_MAX)
        last, bits = len(self.cardinalities) - 1, self.bits
        for name, variables in (
            *((f"factor {at}", factor) for at, factor in enumerate(self.factors)),
            ("searched", self.searched),
            ("known", self.known),
        ):
            for variable in variables:
                check_parameter(f"A variable of {name}", variable, 0, last)
            if len(set(variables)) != len(variables):
                raise ParameterError(f"A variable occurs twice in {name}.")
        for at, factor in enumerate(self.factors):
            if list(factor) != sorted(factor) or not factor:
                raise ParameterError(
                    f"The variables of factor {at} are {factor}; give one or more in rising order."
                )
            check_parameter(f"The number of variables of factor {at}", len(factor), 1, FACTOR_VARIABLES_MAX)
            width = sum(bits[variable] for variable in factor)
            check_parameter(f"The number of bits of factor {at}", width, 0, FACTOR_BITS_MAX)
        alone = set(range(last + 1)).difference(*self.factors)
        if alone:
            raise ParameterError(f"Variable {min(alone)} is in no factor, so no CDE can sample it.")
        both = set(self.searched) & set(self.known)
        if both:
            raise ParameterError(f"Variable {min(both)} is both searched and known.")
        check_parameter("The number of words of the histograms", self.histogram_words, 1, RESULT_WORDS_MAX)

    @property
    def bits(self) -> tuple[int, ...]:
        """Number of bits of each variable's code."""
        return _layout(self.cardinalities)[0]

    @property
    def offsets(self) -> tuple[int, ...]:
        """First (lowest) state bit of each variable."""
        return _layout(self.cardinalities)[1]

    @property
    def state_bits(self) -> int:
        """Number of bits of the state."""
        return sum(self.bits)

    @property
    def state_words(self) -> int:
        """Number of 32-bit words of the packed state."""
        return -(-self.state_bits // 32)

    @property
    def masks(self) -> tuple[int, ...]:
        """For each variable, the mask of its bits in the state."""
        return tuple(
            ((1 << bits) - 1) << offset for bits, offset in zip(self.bits, self.offsets, strict=True)
        )

    @property
    def cdes(self) -> int:
        """Number of CDEs: one per factor."""
        return len(self.factors)

    @property
    def histogram_words(self) -> int:
        """Number of words of the variables' histograms. Each code of a variable has a word, even an unused code."""
        return sum(1 << bits for bits in self.bits)

    @property
    def joint_words(self) -> int:
        """Number of words of the joint histogram of the searched variables.

        If the joint histogram does not fit in the results after the other histograms, the number is 0.
        """
        words = 1 << sum(self.bits[variable] for variable in self.searched) if self.searched else 0
        return words if self.histogram_words + words <= RESULT_WORDS_MAX else 0

    @property
    def result_words(self) -> int:
        """Number of words of all histograms, including the joint histogram."""
        return self.histogram_words + self.joint_words

    @property
    def ones_code(self) -> int:
        """The largest probability code. It is also the mask of a generator's output."""
        return (1 << self.prob_bits) - 1

    @property
    def generator_shape(self) -> tuple[int, ...]:
        """Shape of the generators' states: [CDEs]."""
        return (self.cdes,)

    def factor_bits(self, factor: int) -> tuple[int, ...]:
        """Return the local bits of a factor: the state bits of its variables, in rising order."""
        bits, offsets = _layout(self.cardinalities)
        return tuple(
            offsets[variable] + bit for variable in self.factors[factor] for bit in range(bits[variable])
        )

    @property
    def colours(self) -> tuple[int, ...]:
        """The colour of each variable, as a number from 0. A factor never has two variables of one colour.

        Variables with more neighbours are coloured first. A variable gets the smallest colour that no neighbour has.
        """
        neighbours: list[set[int]] = [set() for _ in self.cardinalities]
        for factor in self.factors:
            for variable in factor:
                neighbours[variable].update(factor)
        colours: dict[int, int] = {}
        for variable in sorted(range(len(neighbours)), key=lambda at: (-len(neighbours[at]), at)):
            taken = {colours.get(neighbour) for neighbour in neighbours[variable]}
            colours[variable] = next(colour for colour in range(len(neighbours)) if colour not in taken)
        return tuple(colours[variable] for variable in range(len(neighbours)))

    def moves(self, known: int, sequencer: Sequencer) -> tuple[tuple[int, ...], ...]:
        """Return the moves of a sweep. Each move is a tuple of the state bits that it draws, in rising order.

        The bits in the mask `known` are in no move. The sequencer `random` draws its moves from this list.
        """
        if sequencer is not Sequencer.COLOURED:
            return tuple((bit,) for bit in range(self.state_bits) if not known >> bit & 1)
        unknown = [
            (colour, range(offset, offset + bits))
            for colour, bits, offset, mask in zip(
                self.colours, self.bits, self.offsets, self.masks, strict=True
            )
            if not known & mask
        ]
        moves = (
            tuple(own[k] for own_colour, own in unknown if own_colour == colour and k < len(own))
            for colour in range(max(self.colours) + 1)
            for k in range(max(self.bits))
        )
        return tuple(move for move in moves if move)


@lru_cache(64)
def _layout(cardinalities: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return each variable's number of bits, and each variable's first bit."""
    bits = tuple((cardinality - 1).bit_length() for cardinality in cardinalities)
    return bits, tuple(accumulate(bits, initial=0))[:-1]


@dataclass(frozen=True, eq=False, slots=True)
class BM2Machine(MachineContents):
    """A complete machine: parameters and the tables of its CDEs. Arrays are stored as read-only copies.

    Attributes:
        parameters: Variables, factors, widths and generators.
        tables: One uint16[n * 2**(n - 1)] per CDE, where n is the number of bits of the CDE's factor. Bit j is drawn
            with the probability code in entry j * 2**(n - 1) + v. The other n - 1 bits, in rising order, form v.
        supports: One bool[cardinalities of the variables] per factor. It is True where the factor is not 0.
        rng_table: uint32[length], the random numbers for all CDEs if `rng` is `table`, or otherwise None.

    Raises:
        ParameterError: The arrays do not match the parameters.
    """

    parameters: BM2Parameters
    tables: tuple[npt.NDArray[np.uint16], ...] = field(repr=False)
    supports: tuple[npt.NDArray[np.bool_], ...] = field(repr=False)
    rng_table: npt.NDArray[np.uint32] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Check shapes and codes, and store read-only copies."""
        parameters = self.parameters
        if not len(self.tables) == len(self.supports) == parameters.cdes:
            raise ParameterError(
                f"There are {len(self.tables)} tables and {len(self.supports)} supports; these parameters have "
                f"{parameters.cdes} factors."
            )
        tables, supports = [], []
        for at, (table, support) in enumerate(zip(self.tables, self.supports, strict=True)):
            values = tuple(parameters.cardinalities[variable] for variable in parameters.factors[at])
            if support.shape != values:
                raise ParameterError(
                    f"Factor {at} has the shape {support.shape}; its variables have {values} values."
                )
            supports.append(frozen(support.astype(np.bool_, copy=False)))
            bits = len(parameters.factor_bits(at))
            tables.append(
                checked_codes(
                    f"The table of CDE {at}", table, (bits << bits >> 1,), parameters.prob_bits, lowest=1
                )
            )
        object.__setattr__(self, "tables", tuple(tables))
        object.__setattr__(self, "supports", tuple(supports))
        object.__setattr__(self, "rng_table", checked_rng_table(self.rng_table, parameters.rng))

    @classmethod
    def from_factors(
        cls,
        parameters: BM2Parameters,
        factors: Sequence[npt.ArrayLike],
        rng_table: npt.NDArray[np.uint32] | None = None,
    ) -> "BM2Machine":
        """Return the machine that samples from the product of the factors.

        A factor is a float64 array with one axis per variable of the factor.

        Raises:
            ParameterError: A factor has a wrong shape, a negative or non-finite entry, or only zeros.
        """
        arrays = [np.asarray(factor, dtype=np.float64) for factor in factors]
        for at, array in enumerate(arrays):
            if not (np.isfinite(array) & (array >= 0)).all() or not array.any():
                raise ParameterError(f"Factor {at} has a negative or non-finite entry, or only zeros.")
        tables = tuple(cde_table(array, parameters.prob_bits) for array in arrays)
        return cls(parameters, tables, tuple(array > 0 for array in arrays), rng_table)


@dataclass(frozen=True, slots=True, kw_only=True)
class BM2Start:
    """The registers that the host writes to start a frame.

    Attributes:
        state: The packed start state, with the evidence.
        known: Mask of the state bits of the known variables.
        samples: Number of samples after which the machine stops, 1 to 2**32 - 1. It is 0 if no state fits the evidence.
        burn_in: Number of whole sweeps before the first sample.
        ops_timeout: Maximum number of cycles of a move.
        max_cycles: Maximum number of cycles of the frame.
        bank: Set of seeds from which the generators restart. If `rng_reset` is `free`, the bank has no effect.
        sequencer: Order in which the sequencer points at bits.
    """

    state: int
    known: int
    samples: int
    burn_in: int
    ops_timeout: int
    max_cycles: int
    bank: int = 0
    sequencer: Sequencer = Sequencer.LINEAR


def cde_table(factor: npt.NDArray[np.float64], prob_bits: int) -> npt.NDArray[np.uint16]:
    """Return the table of a factor's CDE (`BM2Machine.tables`).

    The factor is float64[cardinalities of the variables]. For n bits, the result is uint16[n * 2**(n - 1)]. Each entry
    expresses the odds of one bit. The odds are the value of the factor for bit = 1, divided by its value for bit = 0.

    If the cardinality of a variable is not a power of two, its bits can also form unused numbers. For example, a
    variable with the values 0 to 2 has two bits, which can also form the unused number 3. If a bit decides between a
    value and an unused number, the odds favour the value as far as an entry can express. If the bit decides between two
    unused numbers, or if another variable of the factor has an unused number, the odds are 1.
    """
    # NaN at unused codes: what is computed with one is NaN, too
    padded = np.full([1 << (cardinality - 1).bit_length() for cardinality in factor.shape], np.nan)
    padded[tuple(map(slice, factor.shape))] = factor
    values = padded.ravel(order="F")
    tables = [np.empty(0)]
    for j in range(values.size.bit_length() - 1):
        zero, one = values.reshape(-1, 2, 1 << j).swapaxes(0, 1).reshape(2, -1)
        with np.errstate(invalid="ignore"):
            code = np.floor((1 << prob_bits) * (one / (one + zero)) + 0.5)
        code = np.where(np.isnan(code), 1 << (prob_bits - 1), np.clip(code, 1, (1 << prob_bits) - 1))
        # of two codes, the one with the bit set is larger, so only this one can be unused while the other is used
        tables.append(np.where(np.isnan(one) & ~np.isnan(zero), 1, code))
    return np.concatenate(tables).astype(np.uint16)


def pack(parameters: BM2Parameters, values: Sequence[int]) -> int:
    """Pack values, one for each variable, into a state."""
    return sum(value << offset for value, offset in zip(values, parameters.offsets, strict=True))


def unpack(parameters: BM2Parameters, state: int) -> tuple[int, ...]:
    """Return the code of every variable in a packed state. Codes are not checked against cardinalities."""
    return tuple(
        state >> offset & (1 << bits) - 1
        for offset, bits in zip(parameters.offsets, parameters.bits, strict=True)
    )


def unpack_all(cardinalities: tuple[int, ...], states: npt.NDArray[np.uint32]) -> npt.NDArray[np.int64]:
    """Unpack states, uint32[states, words], into the codes of their variables, int64[states, variables]."""
    bits = np.unpackbits(states.astype("<u4").view(np.uint8), axis=1, bitorder="little")
    layout = zip(*_layout(cardinalities), strict=True)
    return np.stack([bits[:, at : at + width] @ (1 << np.arange(width)) for width, at in layout], axis=1)


# ---- start state ----------------------------------------------------------------------------------


def start_state(machine: BM2Machine, evidence: Mapping[int, int], *, largest: bool = False) -> int | None:
    """Return the lexicographically smallest state of non-zero probability that agrees with the evidence, or None.

    Variable 0 comes first in the order. The evidence is the values of the known variables. With `largest`, the largest
    state is returned. Every second board starts from it, because chains that start far apart show whether they mix.

    Raises:
        StartError: A value is out of range, or the work of the search exceeds `SEARCH_MAX`.
    """
    parameters = machine.parameters
    domains = [np.ones(cardinality, dtype=np.bool_) for cardinality in parameters.cardinalities]
    for variable, value in evidence.items():
        check_start_value(f"The value of variable {variable}", value, 0, len(domains[variable]) - 1)
        domains[variable] = np.arange(len(domains[variable])) == value
    # the factors with zeros, and for each variable the indices in this list of those that have the variable
    zeros = [
        (scope, support)
        for scope, support in zip(parameters.factors, machine.supports, strict=True)
        if not support.all()
    ]
    of_variable: list[list[int]] = [[] for _ in domains]
    for at, (scope, _) in enumerate(zeros):
        for variable in scope:
            of_variable[variable].append(at)
    work = 0

    def spend(amount: int) -> None:
        nonlocal work
        work += amount
        if work > SEARCH_MAX:
            raise StartError(
                "The search for a start state takes too long; the model has too many zeros: replace some by small "
                "probabilities."
            )

    def propagate(domains: list[npt.NDArray[np.bool_]], changed: Sequence[int]) -> bool:
        """Remove values that a factor excludes, until nothing changes; return False if a variable has no value left."""
        due = dict.fromkeys(changed)  # indices of the factors in `zeros` that are yet to be looked at
        while due:
            at, _ = due.popitem()
            scope, support = zeros[at]
            possible = support[np.ix_(*(domains[variable] for variable in scope))]
            spend(len(scope) * (1 + possible.size // 2048))
            for axis, variable in enumerate(scope):
                kept = possible.any(axis=tuple(other for other in range(len(scope)) if other != axis))
                if not kept.any():
                    return False
                if not kept.all():
                    domain = np.zeros_like(domains[variable])
                    domain[np.flatnonzero(domains[variable])[kept]] = True
                    domains[variable] = domain
                    due |= dict.fromkeys(other for other in of_variable[variable] if other != at)
        return True

    # Choices that are still to try, the next one last: the domains before the choice, a variable (all before it have a
    # single value), and the value to try. Choices are tried in order, so the first complete state is the answer.
    left: list[tuple[list[npt.NDArray[np.bool_]], int, int]] = []
    changed: Sequence[int] = range(len(zeros))
    variable = 0
    while True:
        spend(1 + len(domains) // 256)
        if propagate(domains, changed):
            while variable < len(domains) and domains[variable].sum() == 1:
                variable += 1
            if variable == len(domains):
                return pack(parameters, [int(domain.argmax()) for domain in domains])
            values = np.flatnonzero(domains[variable]).tolist()
            left += [(domains, variable, value) for value in (values if largest else reversed(values))]
        if not left:
            return None
        before, variable, value = left.pop()
        domains, changed = list(before), of_variable[variable]
        domains[variable] = np.arange(len(before[variable])) == value
