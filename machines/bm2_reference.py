"""The reference BM2, which runs one cycle at a time as in the thesis.

The tests compare every other BM2 kernel with the reference.
"""

import numpy as np
import numpy.typing as npt

from machines.bm2 import BM2Machine, BM2Start, BM2StopReason, unpack
from machines.bm2_kernel import BM2Kernel
from machines.parameters import RngKind, SampleEvery, Sequencer
from machines.rng import LFSR

_SEQUENCER_STEPS = 16


class ReferenceBM2(BM2Kernel):
    """A kernel for any BM2. It computes one cycle at a time (thesis 2.1.3, figure 2.9)."""

    def __init__(self, machine: BM2Machine) -> None:
        super().__init__(machine)
        parameters = machine.parameters
        self._factor_bits = [parameters.factor_bits(factor) for factor in range(parameters.cdes)]
        # the CDEs whose factor has the bit, for each bit of the state
        self._concerned = [
            [cde for cde, bits in enumerate(self._factor_bits) if bit in bits]
            for bit in range(parameters.state_bits)
        ]
        self.reset()

    @property
    def stream(self) -> npt.NDArray[np.uint32]:
        """A copy of the stream's buffer, uint32[samples, state_words]: all samples since the last start or resume."""
        words = self._parameters.state_words
        packed = b"".join(state.to_bytes(4 * words, "little") for state in self._stream)
        return np.frombuffer(packed, "<u4").astype(np.uint32).reshape(-1, words)

    def _load(self, start: BM2Start) -> None:
        parameters = self._parameters
        self._unknown = [
            variable for variable, mask in enumerate(parameters.masks) if mask and not start.known & mask
        ]
        self._sequencer = start.sequencer
        self._moves = parameters.moves(start.known, start.sequencer)
        self._ops_timeout = start.ops_timeout
        self._burn_in = start.burn_in  # sweeps left
        self._move = 0  # number of the move within the sweep
        self._begin_move()

    def _empty_stream(self) -> None:
        self._stream: list[int] = []

    def _run(self, pause_at: int) -> None:
        self.reason = BM2StopReason.NONE
        while self.reason is BM2StopReason.NONE:
            self.reason = self._cycle()
            if self.reason is BM2StopReason.NONE and self.cycles == pause_at:
                self.reason = BM2StopReason.PAUSED

    def _cycle(self) -> BM2StopReason:
        """Run one cycle: write each bit of the move for which its CDEs agree, and step all generators."""
        random = self._random_numbers.show(self._states).tolist()
        for bit in tuple(self._pending):
            # no CDE of this bit sees another bit of the move
            stochastic_bits = self._stochastic_bits(bit, random)
            if len(stochastic_bits) == 1:
                self._state = self._state & ~(1 << bit) | stochastic_bits.pop() << bit
                self._pending.remove(bit)
        self._states = self._random_numbers.clock(self._states)
        self.cycles += 1
        self._move_cycles += 1

        reason = BM2StopReason.NONE
        if self._pending:
            if self._move_cycles == self._ops_timeout:
                self.timed_out_bit = min(self._pending)
                return BM2StopReason.OPS_TIMEOUT
        else:
            reason = self._end_move()
        if reason is not BM2StopReason.SAMPLES and self.cycles == self._max_cycles:
            return BM2StopReason.MAX_CYCLES
        return reason

    def _stochastic_bits(self, bit: int, random: list[int]) -> set[int]:
        """Return the set of values (0, 1) that the compared CDEs draw for a bit; a single value if they agree."""
        concerned = self._concerned[bit]
        bits = {int(random[cde] < self._code(cde, bit)) for cde in concerned}
        if self._parameters.literal:
            half = 1 << (self._parameters.prob_bits - 1)
            bits |= {int(random[cde] < half) for cde in range(self._parameters.cdes) if cde not in concerned}
        return bits

    def _code(self, cde: int, bit: int) -> int:
        """Return the code in a CDE's table for a bit of its factor, given the values of the factor's other bits."""
        local_bits = self._factor_bits[cde]
        others = [self._state >> other & 1 for other in local_bits if other != bit]
        address = local_bits.index(bit) << len(others) | sum(value << at for at, value in enumerate(others))
        return int(self.machine.tables[cde][address])

    def _end_move(self) -> BM2StopReason:
        """Take a sample if this move ends with one, and begin the move for the next bits."""
        ends_sweep = self._move == len(self._moves) - 1
        sampled = self._burn_in == 0 and (ends_sweep or self._parameters.sample_every is SampleEvery.MOVE)
        if sampled:
            self._take_sample()
        if self._burn_in and ends_sweep:
            self._burn_in -= 1
        self._move = 0 if ends_sweep else self._move + 1
        if self._sequencer is Sequencer.RANDOM:
            state = np.array(self.sequencer_state, dtype=np.uint64)
            for _ in range(_SEQUENCER_STEPS):
                state = LFSR(RngKind.LFSR16).step(state)
            self.sequencer_state = int(state)
        self._begin_move()
        if sampled and self.samples == self._samples_due:
            return BM2StopReason.SAMPLES
        if sampled and len(self._stream) == self._parameters.stream > 0:
            return BM2StopReason.FULL
        return BM2StopReason.NONE

    def _begin_move(self) -> None:
        move = self._move
        if self._sequencer is Sequencer.RANDOM:
            move = self.sequencer_state * len(self._moves) >> 16
        self._pending = set(self._moves[move])  # its bits that are not yet written
        self._move_cycles = 0

    def _take_sample(self) -> None:
        """Count the state in each unknown variable's histogram and in the joint histogram of the searched variables."""
        parameters = self._parameters
        self.samples += 1
        if parameters.stream:
            self._stream.append(self._state)
        codes = unpack(parameters, self._state)
        if any(codes[variable] >= parameters.cardinalities[variable] for variable in self._unknown):
            self.unused += 1
            return
        word = 0
        for variable, bits in enumerate(parameters.bits):
            if variable in self._unknown:
                self._results[word + codes[variable]] += 1
            word += 1 << bits
        if parameters.joint_words:
            joint = 0
            for variable in parameters.searched:
                joint = joint << parameters.bits[variable] | codes[variable]
            self._results[word + joint] += 1
