"""The base class of the BM2 kernels, and the check of the values that start a frame."""

from abc import ABC, abstractmethod
from functools import cache

import numpy as np
import numpy.typing as npt

from machines.bm2 import SAMPLES_MAX, BM2Machine, BM2Parameters, BM2Start, BM2StopReason, unpack
from machines.errors import StartError
from machines.kernel import check_start_value
from machines.parameters import CYCLES_MAX, RngReset, Sequencer
from machines.rng import Words, random_numbers, sequencer_seed


class BM2Kernel(ABC):
    """A kernel that runs a BM2: one chain of samples (thesis 2.1.3).

    After the same calls, all subclasses have the same results and state, bit for bit.
    """

    def __init__(self, machine: BM2Machine) -> None:
        self.machine = machine
        self._parameters = machine.parameters
        self._random_numbers = random_numbers(machine)
        # the states of the CDEs' generators and of the sequencer's generator, computed once for each bank
        self._seeds = cache(
            lambda bank: (self._random_numbers.restart(bank), sequencer_seed(self._parameters, bank))
        )
        self._results = np.zeros(machine.parameters.result_words, dtype=np.int64)

    def _begin(self, start: BM2Start, *, restarts: bool) -> None:
        # Set by each kernel's `_run`; counted since the frame's start.
        self.cycles = 0
        self.samples = 0
        """Number of samples drawn after the burn-in."""
        self.unused = 0
        """Number of samples with an unknown variable at an unused code; no histogram counts them."""
        self.reason = BM2StopReason.NONE
        self.timed_out_bit = -1
        """After `OPS_TIMEOUT`: the lowest-numbered bit of the move that was not written."""
        if restarts:
            self._states, self.sequencer_state = self._seeds(start.bank)
            """The state of the sequencer's own generator, which steps only in the order `random`."""
        else:
            self._states = self.rng_state
        self._state = start.state
        self._samples_due = start.samples
        self._max_cycles = start.max_cycles
        self._results[:] = 0
        self._empty_stream()
        self._load(start)

    @property
    def state(self) -> int:
        """The packed state after the last cycle."""
        return self._state

    @property
    def results(self) -> npt.NDArray[np.uint32]:
        """A copy of the result words, uint32[result_words]: each variable's histogram, then the joint histogram."""
        return self._results.astype(np.uint32)

    @property
    def rng_state(self) -> Words:
        """A copy of the generators' states: uint64[CDEs]."""
        return self._states.copy()

    @property
    @abstractmethod
    def stream(self) -> npt.NDArray[np.uint32]:
        """A copy of the stream's buffer, uint32[samples, state_words]: the samples since the last start or resume."""

    def reset(self) -> None:
        """Set state, results and cycles to 0, and restart the generators from bank 0."""
        self._begin(
            BM2Start(state=0, known=0, samples=0, burn_in=0, ops_timeout=1, max_cycles=1), restarts=True
        )

    def start(self, start: BM2Start, pause_at: int = 0) -> BM2StopReason:
        """Run a new frame from the start state, and return the reason why the machine stopped.

        The machine pauses after cycle `pause_at`, unless `pause_at` is 0.

        Raises:
            StartError: The start does not fit the machine. The machine is unchanged.
        """
        check_bm2_start(self._parameters, start)
        check_start_value("pause_at", pause_at, 0, CYCLES_MAX)
        self._begin(start, restarts=self._parameters.rng_reset is RngReset.BANK)
        if start.samples:
            self._run(pause_at)
        else:
            self.reason = BM2StopReason.IMPOSSIBLE
        return self.reason

    def resume(self, samples: int, pause_at: int = 0) -> BM2StopReason:
        """Empty the stream's buffer, and continue the frame to a new total of samples, without another burn-in.

        Raises:
            StartError: The frame cannot be continued, or a value is out of range. The machine is then unchanged.
        """
        if self.reason not in {BM2StopReason.SAMPLES, BM2StopReason.FULL}:
            raise StartError(
                f"There is nothing to resume: the machine has stopped with reason {self.reason.name.lower()}."
            )
        check_start_value("samples", samples, self.samples + 1, SAMPLES_MAX)
        check_start_value("pause_at", pause_at or CYCLES_MAX, self.cycles + 1, CYCLES_MAX)
        self._samples_due = samples
        self._empty_stream()
        return self._continue(pause_at)

    def step(self, pause_at: int = 0) -> BM2StopReason:
        """Continue after a pause. The machine pauses again after cycle `pause_at`, unless `pause_at` is 0.

        Raises:
            StartError: The machine is not paused, or cycle `pause_at` has already passed.
        """
        if self.reason is not BM2StopReason.PAUSED:
            raise StartError(
                f"The machine is not paused: it has stopped with reason {self.reason.name.lower()}."
            )
        check_start_value("pause_at", pause_at or CYCLES_MAX, self.cycles + 1, CYCLES_MAX)
        return self._continue(pause_at)

    def _continue(self, pause_at: int) -> BM2StopReason:
        # all samples may have been drawn in the frame's last cycle
        if self.cycles == self._max_cycles:
            self.reason = BM2StopReason.MAX_CYCLES
        else:
            self._run(pause_at)
        return self.reason

    @abstractmethod
    def _load(self, start: BM2Start) -> None:
        """Set the state, the results, the stream's buffer and the generators to their values at the frame's start."""

    @abstractmethod
    def _empty_stream(self) -> None:
        """Empty the stream's buffer."""

    @abstractmethod
    def _run(self, pause_at: int) -> None:
        """Run at least one cycle, until the frame stops or pauses; set the public attributes."""


def check_bm2_start(parameters: BM2Parameters, start: BM2Start) -> None:
    """Raise a StartError if a start does not fit the machine. The error names the wrong value and the allowed range."""
    for name, value, lowest, highest in (
        ("state", start.state, 0, (1 << parameters.state_bits) - 1),
        ("known", start.known, 0, (1 << parameters.state_bits) - 1),
        ("samples", start.samples, 0, SAMPLES_MAX),
        ("burn_in", start.burn_in, 0, SAMPLES_MAX),
        ("ops_timeout", start.ops_timeout, 1, SAMPLES_MAX),
        ("max_cycles", start.max_cycles, 1, CYCLES_MAX),
        ("bank", start.bank, 0, parameters.rng_banks - 1),
    ):
        check_start_value(name, value, lowest, highest)
    if start.known == (1 << parameters.state_bits) - 1:
        raise StartError("All variables are known; one or more must be unknown.")
    values = zip(parameters.masks, unpack(parameters, start.state), parameters.cardinalities, strict=True)
    for variable, (mask, value, cardinality) in enumerate(values):
        if start.known & mask not in {0, mask}:
            raise StartError(f"known has some of the bits of variable {variable}; it must have all or none.")
        if start.known & mask and value >= cardinality:
            check_start_value(f"The value of variable {variable}", value, 0, cardinality - 1)
    if start.sequencer is Sequencer.COLOURED and parameters.literal:
        raise StartError(
            "The order coloured is not possible on a machine with literal = true; use linear or random."
        )
