"""A BM2 for tests, written from its description with lists and dictionaries of Python, apart from the product.

The state is a list of bits; codes are computed from the factors in every cycle, and nothing is prepared.
"""

import math
from functools import cache
from itertools import product

from machines.bm2 import BM2StopReason

EXPONENTS = {
    "lfsr8": (8, 6, 5, 4), "lfsr16": (16, 15, 13, 4), "lfsr24": (24, 23, 22, 17), "lfsr32": (32, 22, 2, 1),
}  # fmt: skip
"""Exponents of the polynomials; the first is the width."""
WORD = 2**64 - 1


def lfsr_step(kind, state):
    exponents = EXPONENTS[kind]
    return (state << 1 | sum(state >> exponent - 1 for exponent in exponents) & 1) & (1 << exponents[0]) - 1


def times(columns, vector):
    image = 0
    for bit, column in enumerate(columns):
        image ^= column if vector >> bit & 1 else 0
    return image


@cache
def power(kind, doublings):
    """The columns of the matrix of 2**doublings steps."""
    if doublings == 0:
        return [lfsr_step(kind, 1 << bit) for bit in range(EXPONENTS[kind][0])]
    half = power(kind, doublings - 1)
    return [times(half, column) for column in half]


def lfsr_seed(kind, number):
    """The state after as many steps as the number says."""
    width = EXPONENTS[kind][0]
    state = (0x2545F4914F6CDD1D & (1 << width) - 1) or 1
    steps = ((((number + 1) * 0x9E3779B97F4A7C15) >> 32) & 0xFFFFFFFF) % (2**width - 1)
    for bit in range(width):
        if steps >> bit & 1:
            state = times(power(kind, bit), state)
    return state


def mixed(word):
    word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9 & WORD
    word = (word ^ word >> 27) * 0x94D049BB133111EB & WORD
    return word ^ word >> 31


class PageBM2:
    """A machine with the calls of a kernel."""

    def __init__(self, parameters, factors, rng_table):
        self.p, self.factors, self.rng_table = parameters, factors, rng_table
        # the number of a bit, and whose it is: (variable, bit of its code)
        self.names = [
            (variable, k)
            for variable, cardinality in enumerate(parameters.cardinalities)
            for k in range(math.ceil(math.log2(cardinality)))
        ]
        self.restart(0)

    def restart(self, bank):
        p, n = self.p, len(self.factors)
        board = bank * p.chains + p.chain
        if p.rng == "table":
            sets = p.rng_banks * p.chains
            self.rngs = [(m * sets + board) * len(self.rng_table) // (n * sets) for m in range(n)]
        elif p.rng == "ideal":
            self.rngs = [
                mixed(mixed(p.ideal_seed) + (board * n + m + 1) * 0x9E3779B97F4A7C15 & WORD) for m in range(n)
            ]
        else:
            self.rngs = [lfsr_seed(p.rng, board * n + m) for m in range(n)]
        self.order_rng = lfsr_seed("lfsr16", board)

    def presented(self):
        """The numbers r of all CDEs; then the RNGs step."""
        p, numbers = self.p, self.rngs
        if p.rng == "table":
            numbers = [int(self.rng_table[at]) for at in numbers]
            self.rngs = [(at + p.steps_per_clock) % len(self.rng_table) for at in self.rngs]
        elif p.rng == "ideal":
            numbers = [mixed(word) for word in numbers]
            self.rngs = [word + p.steps_per_clock * 0x9E3779B97F4A7C15 & WORD for word in self.rngs]
        else:
            for _ in range(p.steps_per_clock):
                self.rngs = [lfsr_step(p.rng, state) for state in self.rngs]
        return [number % 2**p.prob_bits for number in numbers]

    def code(self, m, name):
        """The code of CDE m for a pointed bit."""
        p, bits = self.p, self.bits
        values = []
        for pointed in (0, 1):
            bits = {**self.bits, name: pointed}
            values.append([self.value(bits, variable) for variable in p.factors[m]])
        used = [
            [value < p.cardinalities[variable] for variable, value in zip(p.factors[m], side, strict=True)]
            for side in values
        ]
        own = p.factors[m].index(name[0])
        others_used = all(flag for at, flag in enumerate(used[0]) if at != own)
        if not others_used or (not used[0][own] and not used[1][own]):
            return 2 ** (p.prob_bits - 1)
        f0, f1 = (
            float(self.factors[m][tuple(side)]) if legal[own] else 0.0
            for side, legal in zip(values, used, strict=True)
        )
        top = 2**p.prob_bits - 1
        if used[0][own] != used[1][own]:
            return top if used[1][own] else 1
        if f0 == f1 == 0:
            return 2 ** (p.prob_bits - 1)
        return min(max(math.floor(2**p.prob_bits * (f1 / (f1 + f0)) + 1 / 2), 1), top)

    def value(self, bits, variable):
        return sum(bit << k for (other, k), bit in bits.items() if other == variable)

    def colours(self):
        variables = range(len(self.p.cardinalities))
        neighbours = {v: {o for f in self.p.factors if v in f for o in f if o != v} for v in variables}
        colours = {}
        for v in sorted(variables, key=lambda v: (-len(neighbours[v]), v)):
            colour = 0
            while any(colours.get(o) == colour for o in neighbours[v]):
                colour += 1
            colours[v] = colour
        return colours

    def sweep(self, start):
        """The moves of a sweep: lists of names of bits."""
        unknown = [name for at, name in enumerate(self.names) if not start.known >> at & 1]
        if start.sequencer != "coloured":
            return [[name] for name in unknown]
        colours = self.colours()
        moves = {}
        for variable, k in unknown:
            moves.setdefault((colours[variable], k), []).append((variable, k))
        return [moves[key] for key in sorted(moves)]

    def start(self, start, pause_at=0):
        p = self.p
        self.cycles = self.drawn = self.unused = 0
        self.timed_out = -1
        self.bits = {name: start.state >> at & 1 for at, name in enumerate(self.names)}
        self.histograms = {}
        self.joint = {}
        self.buffer = []
        if p.rng_reset == "bank":
            self.restart(start.bank)
        self.total, self.registers = start.samples, start
        self.moves = self.sweep(start)
        self.moved = 0  # moves since the start
        self.point()
        return self.run(pause_at) if start.samples else self.stopped("IMPOSSIBLE")

    def resume(self, total, pause_at=0):
        self.total, self.buffer = total, []
        return self.step(pause_at)

    def step(self, pause_at=0):
        over = self.cycles == self.registers.max_cycles
        return self.stopped("MAX_CYCLES") if over else self.run(pause_at)

    def run(self, pause_at):
        stop = None
        while stop is None:
            stop = self.cycle() or ("PAUSED" if self.cycles == pause_at else None)
        return self.stopped(stop)

    def stopped(self, name):
        self.reason = BM2StopReason[name]
        return self.reason

    @property
    def samples(self):
        return self.drawn

    def point(self):
        at = self.moved % len(self.moves)
        if self.registers.sequencer == "random":
            at = (self.order_rng * len(self.moves)) >> 16
        self.left = list(self.moves[at])
        self.tries = 0

    def cycle(self):
        """One cycle; return the name of the reason why the machine stops after it, or none."""
        numbers = self.presented()
        written = {}
        for name in self.left:
            concerned = [m for m, factor in enumerate(self.p.factors) if name[0] in factor]
            flags = [numbers[m] < self.code(m, name) for m in concerned]
            if self.p.literal:
                half = 2 ** (self.p.prob_bits - 1)
                flags += [numbers[m] < half for m in range(len(numbers)) if m not in concerned]
            if all(flags) or not any(flags):
                written[name] = int(flags[0])
        self.bits |= written
        self.left = [name for name in self.left if name not in written]
        self.cycles += 1
        self.tries += 1
        stop = None
        if not self.left:
            self.moved += 1
            rest = self.moved % len(self.moves)
            # the sweep that this move belongs to comes after the burn-in
            if -(-self.moved // len(self.moves)) > self.registers.burn_in and (
                rest == 0 or self.p.sample_every == "move"
            ):
                stop = self.sample()
            if self.registers.sequencer == "random":
                for _ in range(16):
                    self.order_rng = lfsr_step("lfsr16", self.order_rng)
            self.point()
        elif self.tries == self.registers.ops_timeout:
            self.timed_out = min(self.names.index(name) for name in self.left)
            stop = "OPS_TIMEOUT"
        if stop in {"SAMPLES", "OPS_TIMEOUT"}:
            return stop
        return "MAX_CYCLES" if self.cycles == self.registers.max_cycles else stop

    def sample(self):
        self.drawn += 1
        values = [self.value(self.bits, variable) for variable in range(len(self.p.cardinalities))]
        if self.p.stream:
            self.buffer.append([self.bits[name] for name in self.names])
        unknown = {name[0] for at, name in enumerate(self.names) if not self.registers.known >> at & 1}
        if any(values[variable] >= self.p.cardinalities[variable] for variable in unknown):
            self.unused += 1
        else:
            for variable in unknown:
                key = variable, values[variable]
                self.histograms[key] = self.histograms.get(key, 0) + 1
            key = tuple(values[variable] for variable in self.p.searched)
            self.joint[key] = self.joint.get(key, 0) + 1
        if self.drawn == self.total:
            return "SAMPLES"
        return "FULL" if self.p.stream and len(self.buffer) == self.p.stream else None

    def shown(self, reason):
        """Return the attributes of a kernel, in the form of `random_networks.seen`."""
        p = self.p
        codes = [range(2 ** math.ceil(math.log2(cardinality))) for cardinality in p.cardinalities]
        results = [self.histograms.get((at, code), 0) for at, own in enumerate(codes) for code in own]
        joint = [self.joint.get(key, 0) for key in product(*(codes[variable] for variable in p.searched))]
        if p.searched and len(results) + len(joint) <= 4096:
            results += joint
        words = -(-len(self.names) // 32)
        return {
            "reason": reason,
            "state": tuple(self.value(self.bits, variable) for variable in range(len(p.cardinalities))),
            "cycles": self.cycles,
            "samples": self.drawn,
            "unused": self.unused,
            "timed out": self.timed_out,
            "results": results,
            "RNGs": self.rngs,
            "sequencer": self.order_rng,
            "stream": [
                [sum(bit << at for at, bit in enumerate(bits[32 * w : 32 * w + 32])) for w in range(words)]
                for bits in self.buffer
            ],
        }
