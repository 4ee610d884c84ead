"""Canaries: known readings that walk through all addresses of all tables, and the counts that they must give.

The walk is a cyclic sequence. Each turn of it selects every row of the prior's table, with all readings missing,
and every address of every sensor column. In the first turns the other columns are missing, so that nothing hides a
cell; later turns, which need more cycles, combine addresses at random. A turn uses one bank, the next turn the
next one, so that different random numbers are compared with every code.

Expected counts come from the kernels in `machines` and from the images, never from a board.
"""

import hashlib
from collections.abc import Sequence
from math import ceil, log
from typing import Final

import numpy as np
import numpy.typing as npt

from machines.bm1 import Start, StopReason
from machines.kernel import BM1Kernel, make_kernel
from machines.parameters import BM1Parameters, PriorMode, RngReset, SensorMode
from pcie_shim.errors import FrameInputError
from pcie_shim.host.frame import BoardResult, FrameInput
from pcie_shim.programming_file import Image, is_plain

FAST_CYCLES: Final = 2**14
SLOW_CYCLES: Final = 2**10
"""Maximum number of cycles of a canary, with a fast kernel on the host and without one."""

_SURE: Final = 9.0
"""Exponent of the chance that a value of the random numbers has not occurred for a code: exp(-9)."""


class CanaryWalk:
    """The walk of one deployment; `len` is the number of its canaries.

    Args:
        images: The boards' images.

    Raises:
        FrameInputError: The generators never restart, so counts depend on all frames before.
    """

    def __init__(self, images: Sequence[Image]) -> None:
        parameters = images[0].machine.parameters
        if parameters.rng_reset is RngReset.FREE:
            raise FrameInputError(
                "Canaries need generators that restart with each frame; with rng_reset = free the counts of a frame "
                "depend on all frames before it"
            )
        self._images = tuple(images)
        self._parameters = parameters
        self._total_lines = sum(image.machine.parameters.lines for image in images)
        self._kernels: list[BM1Kernel] = []
        self.cycles = _longest_canary(parameters)
        self.turns = _turns(parameters, self.cycles)
        self._steps = _steps(parameters)
        # digests, 0 until computed; an array, because a walk of 100,000 canaries would take 30 MB as a dictionary
        self._expected = np.zeros((len(self), len(images)), np.uint64)

    def __len__(self) -> int:
        """Return the number of canaries until the walk begins again."""
        return self.turns * len(self._steps)

    @property
    def steps(self) -> int:
        """Number of canaries of one turn, which selects every address once."""
        return len(self._steps)

    @property
    def shape(self) -> tuple[int, tuple[tuple[int, int], ...]]:
        """Turns and addresses; walks of the same shape have the same positions."""
        return self.turns, tuple(self._steps)

    def prepare(self) -> None:
        """Make the kernels in advance."""
        if not self._kernels:
            self._kernels = [make_kernel(image.machine) for image in self._images]

    def canary(self, number: int) -> FrameInput:
        """Return canary `number`, 0 to `len` - 1, as the input of a frame."""
        addresses, row, bank = self._selection(number)
        parameters = self._parameters
        written = parameters.prior_mode is PriorMode.WRITTEN
        return FrameInput(
            addresses=tuple(addresses.tolist())
            if is_plain(parameters)
            else _of_cells(parameters, addresses, self._total_lines),
            prior_address=row,
            prior_codes=np.full(self._total_lines, parameters.ones_code, np.uint16) if written else None,
            target_count=parameters.target_count_max,
            max_cycles=self.cycles,
            bank=bank,
            stop="own",
        )

    def start(self, number: int, board: int) -> Start:
        """Return the registers of canary `number` on a board."""
        addresses, row, bank = self._selection(number)
        parameters = self._images[board].machine.parameters
        written = parameters.prior_mode is PriorMode.WRITTEN
        return Start(
            addresses=_of_cells(parameters, addresses, parameters.lines),
            prior_address=row,
            prior_codes=np.full(parameters.lines, parameters.ones_code, np.uint16) if written else None,
            target_count=parameters.target_count_max,
            max_cycles=self.cycles,
            bank=bank,
        )

    def differing_boards(self, number: int, results: Sequence[BoardResult]) -> list[int]:
        """Return the boards whose result is not that of canary `number`."""
        expected = self._expected[number]
        if not expected.all():
            expected[:] = self._computed(number)
            if self._expected.all():
                self._kernels = []  # they are not needed any more
        differing = []
        for board, (result, digest) in enumerate(zip(results, expected, strict=True)):
            cycles = result.replica_cycles or (result.cycles,)
            reasons = result.replica_reasons or (result.reason,)
            if _digest(result.words, cycles, reasons) != digest:
                differing.append(board)
        return differing

    def _computed(self, number: int) -> list[int]:
        """Compute a canary on the host; return a digest for each board."""
        self.prepare()
        digests = []
        for board, kernel in enumerate(self._kernels):
            kernel.start(self.start(number, board))
            words = kernel.counts.astype("<u4").tobytes()
            digests.append(_digest(words, kernel.replica_cycles, kernel.replica_reasons))
        return digests

    def _selection(self, number: int) -> tuple[npt.NDArray[np.int64], int, int]:
        """Return the address of each sensor column, the row of the prior, and the bank."""
        parameters = self._parameters
        turn, step = divmod(number, len(self._steps))
        column, address = self._steps[step]
        tops = (1 << np.array(parameters.sensor_bits, dtype=np.int64)) - 1
        addresses, row = tops, turn % parameters.prior_addresses
        if turn >= parameters.rng_banks:
            random = np.random.default_rng(number)
            chosen = random.integers(0, tops + 1)
            # half of the columns, because a line that many cells hide is seen in fewer cycles
            addresses = np.where(random.integers(0, 2, len(tops)) > 0, chosen, tops)
            row = int(random.integers(0, parameters.prior_addresses))
        if column:
            addresses[column - 1] = address
        else:
            row = address
        return addresses, row, turn % parameters.rng_banks


def _longest_canary(parameters: BM1Parameters) -> int:
    """Return the maximum number of cycles of a canary."""
    is_fast = parameters.shared and parameters.rng.lfsr_bits is not None
    return min(_enough_cycles(parameters), FAST_CYCLES if is_fast else SLOW_CYCLES)


def _enough_cycles(parameters: BM1Parameters) -> int:
    """Return the cycles after which every value of the random numbers has occurred, except with a small probability."""
    values = 1 << parameters.prob_bits
    return ceil(values * (log(values) + _SURE))


def _turns(parameters: BM1Parameters, cycles: int) -> int:
    """Return the number of turns: a line that always counts ends a canary at the maximum of its counter."""
    least = min(cycles, parameters.target_count_max)
    return max(ceil(_enough_cycles(parameters) / least), parameters.prior_addresses)


def _steps(parameters: BM1Parameters) -> list[tuple[int, int]]:
    """Return a turn's steps: a row of the prior (column 0), or a column and its address."""
    steps = [(0, row) for row in range(parameters.prior_addresses)]
    if parameters.sensor_mode is not SensorMode.THRESHOLD:
        for column, bits in enumerate(parameters.sensor_bits, start=1):
            steps += [(column, address) for address in range((1 << bits) - 1)]
    return steps


def _of_cells(
    parameters: BM1Parameters, addresses: npt.NDArray[np.int64], lines: int
) -> npt.NDArray[np.int64]:
    """Return the inputs in the shape of the machine: the same in all lines and replicas."""
    shape: tuple[int, ...] = (len(addresses),)
    if parameters.sensor_mode is not SensorMode.COLUMN:
        addresses, shape = addresses[:, np.newaxis], (len(addresses), lines)
    if parameters.replicas > 1:
        shape = (parameters.replicas, *shape)
    return np.broadcast_to(addresses, shape).copy()


def _digest(words: bytes, cycles: Sequence[int], reasons: Sequence[StopReason]) -> int:
    """Return a short digest of a board's result, which is not 0."""
    outcome = np.array([*cycles, *reasons], dtype="<u8").tobytes()
    return int.from_bytes(hashlib.blake2b(words + outcome, digest_size=8).digest()) or 1
