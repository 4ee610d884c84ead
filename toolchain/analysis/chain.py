"""Exact analysis of the Markov chain of a BM2 with few bits: law, cycles and correlations.

The law is the distribution of the chain's state. A move writes one or several bits of the state. In every cycle of the
move, each CDE draws 0 or 1. A bit is written when all CDEs whose factors contain this bit draw the same value. If
random numbers are ideal, the probability that these CDEs all draw 1 is the product of their probabilities of a 1. The
probability that they all draw 0 is the product of the complements. These products give the transition matrix of a
sweep. The matrix gives all values that long runs approach. The codes are those of the machine, so the effects of
quantising and clipping are included. If the machine takes a sample after every move, the analysis still uses only one
sample per sweep.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machines.bm2 import BM2Machine, start_state
from machines.bm2_estimate import searched_values
from machines.parameters import SampleEvery, Sequencer
from toolchain.errors import ModelError
from toolchain.models.inference import eliminate, product
from toolchain.models.network import NetworkModel

MOST_BITS: Final = 9
"""Maximum number of unknown bits. With n unknown bits, the matrix of a sweep has 2**n rows and columns."""
_MOST_READINGS: Final = 64
_WORK: Final = 2**27
"""Maximum number of readings times multiplications of one matrix product, so that all take a few seconds."""


def agreement(
    machine: BM2Machine, bit: int, values: Mapping[int, NDArray[np.int64]]
) -> list[tuple[int, NDArray[np.float64]]]:
    """Return the index of each CDE whose factor contains the bit `bit`, and the CDE's probabilities of drawing 1.

    Each CDE has one probability for each state in `values`: float64[states]. `values` describes the states. It maps
    every other bit of these factors to the values of that bit in the states: int64[states].
    """
    p, found = machine.parameters, []
    variable = next(at for at, mask in enumerate(p.masks) if mask >> bit & 1)
    for cde in (at for at, factor in enumerate(p.factors) if variable in factor):
        local = p.factor_bits(cde)
        j = local.index(bit)
        places = np.zeros(next(iter(values.values())).shape if values else 1, dtype=np.int64)
        for i, other in enumerate(local[:j] + local[j + 1 :]):
            places |= values[other] << i
        found.append((cde, machine.tables[cde][(j << (len(local) - 1)) + places] / 2.0**p.prob_bits))
    return found


class ExactChain:
    """The Markov chain over the states of the unknown bits. Bit i of a state's index is the i-th unknown bit.

    `evidence` maps the index of each known variable to its value. At most `MOST_BITS` bits may be left unknown.
    """

    def __init__(self, machine: BM2Machine, evidence: Mapping[int, int]) -> None:
        p = self._parameters = machine.parameters
        known = sum(p.masks[variable] for variable in evidence)
        fixed = sum(value << p.offsets[variable] for variable, value in evidence.items())
        self._unknown = [bit for bit in range(p.state_bits) if not known >> bit & 1]
        self._moves = [[self._unknown.index(bit) for bit in move] for move in p.moves(known, p.sequencer)]
        """The unknown bits at which each move of a sweep points."""
        index = np.arange(1 << len(self._unknown))
        self._values = {
            bit: index >> self._unknown.index(bit) & 1
            if bit in self._unknown
            else np.full_like(index, fixed >> bit & 1)
            for bit in range(p.state_bits)
        }
        self._one = np.ones((len(self._unknown), len(index)))
        """The chance that in one cycle all CDEs of a bit agree on 1: float64[unknown bits, states]."""
        self._zero = np.ones_like(self._one)
        for at, bit in enumerate(self._unknown):
            concerned = agreement(machine, bit, self._values)
            # a literal machine also waits until the other CDEs agree, which they do by chance
            start = 0.5 ** (p.cdes - len(concerned)) if p.literal else 1.0
            self._one[at] = start * np.prod([chance for _, chance in concerned], axis=0)
            self._zero[at] = start * np.prod([1 - chance for _, chance in concerned], axis=0)

    def _moved(self, laws: NDArray[np.float64], move: Sequence[int]) -> NDArray[np.float64]:
        """Return the distributions of the state after a move, from those before it, float64[..., states]."""
        for at in move:
            one, zero = (each.reshape(-1, 2, 1 << at)[:, :1] for each in (self._one[at], self._zero[at]))
            split = laws.reshape(*laws.shape[:-1], -1, 2, 1 << at).sum(axis=-2, keepdims=True)
            laws = (split * np.concatenate([zero, one], axis=1) / (zero + one)).reshape(laws.shape)
        return laws

    def _tries(self, move: Sequence[int]) -> NDArray[np.float64]:
        """Return the mean number of cycles, in each state, until the CDEs have agreed on all bits of a move."""
        agree = self._one[move] + self._zero[move]
        total = np.zeros(agree.shape[1])
        for count in range(1, len(move) + 1):
            for chosen in itertools.combinations(range(len(move)), count):
                # mean of a maximum, by inclusion and exclusion; a term is the mean until one chosen bit is agreed on
                total -= (-1) ** count / (1 - np.prod(1 - agree[list(chosen)], axis=0))
        return total

    @cached_property
    def sweep(self) -> NDArray[np.float64]:
        """float64[states, states]: the probability that a sweep leads from one state (row) to another (column)."""
        after = np.eye(self._one.shape[1])
        if self._parameters.sequencer is Sequencer.RANDOM:
            mean = np.mean([self._moved(after, move) for move in self._moves], axis=0)
            return np.asarray(np.linalg.matrix_power(mean, len(self._moves)))
        for move in self._moves:
            after = self._moved(after, move)
        return after

    @cached_property
    def law(self) -> NDArray[np.float64]:
        """float64[states]: the stationary distribution of the chain, whose transition matrix is `sweep`.

        It is computed by the elimination of Grassmann, Taksar and Heyman. This method subtracts nothing, so the result
        is accurate even if clipped codes make some states nearly inescapable.
        """
        left = self.sweep.copy()
        for n in range(len(left) - 1, 0, -1):
            left[:n, n] /= left[n, :n].sum()
            left[:n, :n] += np.outer(left[:n, n], left[n, :n])
        law = np.ones(len(left))
        for n in range(1, len(left)):
            law[n] = law[:n] @ left[:n, n]
        return np.asarray(law / law.sum())

    @cached_property
    def cycles(self) -> float:
        """The mean number of cycles of a sweep."""
        law, total = self.law, 0.0
        for move in self._moves:
            total += float(law @ self._tries(move))
            if self._parameters.sequencer is not Sequencer.RANDOM:
                law = self._moved(law, move)
        return total

    @cached_property
    def _searched(self) -> NDArray[np.int64]:
        """int64[states]: the index of the searched variables' joint value, or -1 if any variable has an unused code."""
        bits = np.stack([self._values[bit] for bit in range(self._parameters.state_bits)], axis=1)
        packed = np.packbits(bits.astype(np.uint8), axis=1, bitorder="little")
        words = np.pad(packed, ((0, 0), (0, -packed.shape[1] % 4))).view("<u4")
        return searched_values(self._parameters, words)

    def posterior(self, law: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the posterior of the searched variables' joint values, float64[values].

        `law` is the distribution of the chain's state, float64[states].
        """
        p, used = self._parameters, self._searched >= 0
        size = int(np.prod([p.cardinalities[variable] for variable in p.searched]))
        found = np.bincount(self._searched[used], law[used], size)
        return np.asarray(found / found.sum())

    @cached_property
    def _fundamental(self) -> NDArray[np.float64]:
        """float64[states, states]: the fundamental matrix, the sum of all later laws' deviations from `law`."""
        return np.asarray(np.linalg.inv(np.eye(len(self.law)) - self.sweep + self.law))

    def effective(self) -> NDArray[np.float64]:
        """Return how many independent samples one sweep is worth, for each searched value: float64[values]."""
        places = np.arange(len(self.posterior(self.law)))
        values = (self._searched[:, np.newaxis] == places).astype(np.float64)
        centred = values - self.law @ values
        own = self.law @ centred**2
        total = self.law @ (centred * (2 * self._fundamental @ centred - centred))
        return np.asarray(np.divide(own, total, out=np.ones_like(own), where=own > 0))

    def frame(self, state: int, burn_in: int, sweeps: int) -> NDArray[np.float64]:
        """Return the mean distribution of the state over the sweeps of a frame after the burn-in: float64[states].

        `state` is the start state of all variables. Bit i of `state` is bit i of the machine.
        """
        first = np.linalg.matrix_power(self.sweep, burn_in + 1)[
            sum((state >> bit & 1) << at for at, bit in enumerate(self._unknown))
        ]
        after = first @ np.linalg.matrix_power(self.sweep, sweeps)
        return np.asarray(self.law + (first - after) @ self._fundamental / sweeps)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChainError:
    """The expected error of a frame, averaged over readings, and computed without a run.

    Distances are total variations between posteriors of the searched variables.
    """

    share: float
    """The total probability of the examined readings. The most probable readings are examined."""
    quantising: float
    """Mean distance between the posterior of long runs and exact inference, over the examined readings.

    Quantised and clipped codes cause this distance.
    """
    worst: float
    """Largest distance between the posterior of long runs and exact inference, over the examined readings."""
    worst_reading: tuple[int, ...]
    """The reading with the distance `worst`: one address per known variable."""
    start: float
    """Mean distance between a frame's expected posterior and the posterior of long runs.

    The start state causes this distance.
    """
    sampling: float
    """Mean distance of a frame's posterior from the frame's expected posterior: the effect of random sampling.

    More samples reduce the distance. Correlation of the samples increases it.
    """
    cycles: float
    """Mean cycles of a sweep."""
    effective: float
    """Minimum of the effective samples per sweep, over all examined readings and searched values."""


def distance(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> float:
    """Return the total variation distance of two distributions, 0 to 1."""
    return float(np.abs(ours - theirs).sum() / 2)


def chain_error(machine: BM2Machine, model: NetworkModel, *, samples: int) -> ChainError | None:
    """Return the expected error of a frame with readings of all known variables, or None if the chain is too large.

    `machine` must have been built from `model`. The result assumes that all boards start in the same state.
    """
    p = machine.parameters
    unknown = p.state_bits - sum(p.bits[variable] for variable in p.known)
    if not 0 < unknown <= MOST_BITS:
        return None
    sizes = dict(zip(model.names, model.cardinalities, strict=True))
    try:
        left = eliminate(model.factors, [name for name in sizes if name not in model.known], sizes)
        weights = product(left, model.known, sizes)
    except ModelError:  # a table above the limit
        return None
    most = min(_MOST_READINGS, max(1, _WORK >> 3 * unknown), int((weights > 0).sum()))
    likeliest = np.argsort(-weights, axis=None, kind="stable")[:most]
    sweeps = samples if p.sample_every is SampleEvery.SWEEP else max(1, samples // unknown)
    rows, readings = [], []
    for place in likeliest.tolist():
        addresses = tuple(int(at) for at in np.unravel_index(place, weights.shape))
        evidence = dict(zip(p.known, addresses, strict=True))
        chain = ExactChain(machine, evidence)
        state = start_state(machine, evidence)
        if state is None:  # the reading's probability is a rounding error
            continue
        stationary = chain.posterior(chain.law)
        shares = chain.effective()
        deviations = np.sqrt(stationary * (1 - stationary) / np.maximum(p.chains * sweeps * shares, 1))
        readings.append(addresses)
        quantising = distance(stationary, model.exact(addresses))
        begun = distance(chain.posterior(chain.frame(state, p.burn_in, sweeps)), stationary)
        sampling = deviations.sum() / np.sqrt(2 * np.pi)  # half of the mean absolute values
        rows.append((weights[addresses], quantising, begun, sampling, chain.cycles, shares.min()))
    table = np.array(rows)
    quantising, start, sampling, cycles, _ = np.average(table[:, 1:], axis=0, weights=table[:, 0]).tolist()
    worst = int(table[:, 1].argmax())
    return ChainError(
        share=float(table[:, 0].sum() / weights.sum()),
        quantising=quantising,
        worst=float(table[worst, 1]),
        worst_reading=readings[worst],
        start=start,
        sampling=sampling,
        cycles=cycles,
        effective=float(table[:, 5].min()),
    )
