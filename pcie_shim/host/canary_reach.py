"""The bits of a board's tables whose flip a walk of canaries shows: computed exactly, one cycle at a time.

A flip changes the cell's bit in the cycles whose random number lies between the two codes. It changes the counts of
a canary, or its cycles, if in one of these cycles all other cells of the line make a one: a line that makes more
ones than expected has a higher count or stops the machine earlier, one that makes fewer has a lower count or does
not stop it. A flip also shows if it makes the only line that can count impossible, or an impossible one possible.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from machines.bm1 import BM1Machine, Start, addressed_codes
from machines.kernel import make_kernel
from machines.parameters import BM1Parameters
from machines.rng import random_numbers
from pcie_shim.host.canary_walk import CanaryWalk


@dataclass(frozen=True, slots=True)
class Reach:
    """Flips by column (0: the prior), address, line and bit.

    Attributes:
        shown: Flips that change the result of a canary: one bool[addresses, lines, prob_bits] per column.
        harmless: Flips that change no count of any frame, with any other readings, up to `max_cycles`.
    """

    shown: list[npt.NDArray[np.bool_]]
    harmless: list[npt.NDArray[np.bool_]]

    @property
    def unseen(self) -> list[tuple[int, int, int, int]]:
        """The flips that could change a count of a frame and change none of the canaries."""
        return [
            (column, int(address), int(line), int(bit))
            for column, (shown, harmless) in enumerate(zip(self.shown, self.harmless, strict=True))
            for address, line, bit in np.argwhere(~shown & ~harmless)
        ]

    @property
    def flips(self) -> int:
        """Number of all flips that could change a count."""
        return int(sum((~harmless).sum() for harmless in self.harmless))


def reach(walk: CanaryWalk, machine: BM1Machine, board: int, max_cycles: int) -> Reach:
    """Return the flips that a walk shows on a board, and those that no frame of `max_cycles` shows."""
    parameters = machine.parameters
    numbers = _Numbers(machine)
    tables = [machine.prior, *machine.tables]
    shown = [np.zeros((*table.shape, parameters.prob_bits), np.bool_) for table in tables]
    kernel = make_kernel(machine)
    for number in range(len(walk)):
        start = walk.start(number, board)
        kernel.start(start)
        random = numbers.of(start.bank, kernel.cycles)
        codes = _codes_of_one(machine, start)
        alone = _all_others(_bits(random, codes, parameters), kernel.cycles)
        for column, address in enumerate(_addresses(parameters, start)):
            if column or start.prior_codes is None:
                changes = _changes(random[:, :, column], codes[column], parameters)
                shown[column][address] |= (changes & alone[column][:, :, np.newaxis]).any(axis=0)
                shown[column][address] |= _changes_whether_it_runs(codes, column, parameters)
    harmless = []
    rows = [np.full((1, parameters.lines), parameters.ones_code)] if start.prior_codes is not None else None
    for column, table in enumerate(tables):
        possible = np.zeros((*table.shape, parameters.prob_bits), np.bool_)
        for bank in range(parameters.rng_banks):
            random = numbers.of(bank, max_cycles)
            # a frame's other readings select at best all-ones codes, and the row of the prior that counts most
            counting = np.ones((max_cycles, parameters.lines), np.bool_)
            if column:
                best = (rows or [machine.prior])[0].max(axis=0)
                counting = _bits(random[:, :, :1], best[np.newaxis], parameters)[0]
            for address, codes in enumerate(table):
                if column or start.prior_codes is None:
                    changes = _changes(random[:, :, column], codes, parameters)
                    possible[address] |= (changes & counting[:, :, np.newaxis]).any(axis=0)
        harmless.append(~possible)
    return Reach(shown, harmless)


class _Numbers:
    """The random numbers of each bank: uint64[cycles, lines or 1, columns]."""

    def __init__(self, machine: BM1Machine) -> None:
        self._generators = random_numbers(machine)
        self._columns = machine.parameters.columns
        self._of: dict[int, list[npt.NDArray[np.uint64]]] = {}
        self._states: dict[int, npt.NDArray[np.uint64]] = {}

    def of(self, bank: int, cycles: int) -> npt.NDArray[np.int64]:
        known = self._of.setdefault(bank, [])
        states = self._states.get(bank)
        if states is None:
            states = self._generators.restart(bank)
        while len(known) < cycles:
            known.append(np.atleast_2d(self._generators.show(states)))
            states = self._generators.clock(states)
        self._states[bank] = states
        first = np.array([*known[:cycles]], dtype=np.int64)
        return first if cycles else np.zeros((0, 1, self._columns), np.int64)


def _codes_of_one(machine: BM1Machine, start: Start) -> npt.NDArray[np.int64]:
    """Return the addressed codes of the first replica: [columns, lines]."""
    codes = addressed_codes(machine, start).astype(np.int64)
    return codes[0] if codes.ndim == 3 else codes


def _addresses(parameters: BM1Parameters, start: Start) -> list[int]:
    """Return the row of the prior, and the address of each sensor column that has a table."""
    row = start.prior_address if isinstance(start.prior_address, int) else start.prior_address[0]
    if not parameters.has_tables or not parameters.sensors:
        return [row]
    by_column = np.asarray(start.addresses).reshape(parameters.replicas, parameters.sensors, -1)
    return [row, *by_column[0, :, 0].tolist()]


def _ones(random: npt.NDArray[np.int64], codes: npt.NDArray[np.int64], ones: int) -> npt.NDArray[np.bool_]:
    made: npt.NDArray[np.bool_] = (random < codes) | (codes == ones)
    return made


def _bits(
    random: npt.NDArray[np.int64], codes: npt.NDArray[np.int64], parameters: BM1Parameters
) -> npt.NDArray[np.bool_]:
    """Return the cells' bits: bool[columns, cycles, lines]."""
    return np.stack(
        [
            np.broadcast_to(
                _ones(random[:, :, column], own, parameters.ones_code), (len(random), parameters.lines)
            )
            for column, own in enumerate(codes)
        ]
    )


def _all_others(bits: npt.NDArray[np.bool_], cycles: int) -> npt.NDArray[np.bool_]:
    """Return for each column the cycles and lines in which all other cells make a one."""
    zeros = (~bits).sum(axis=0)
    return (zeros - ~bits) == 0 if cycles else bits


def _changes_whether_it_runs(
    codes: npt.NDArray[np.int64], column: int, parameters: BM1Parameters
) -> npt.NDArray[np.bool_]:
    """Return whether the flip of each bit decides if a line of the board can count: bool[lines, prob_bits]."""
    lives = np.array(np.greater(codes, 0).all(axis=0))
    flipped: npt.NDArray[np.int64] = codes[column][:, np.newaxis] ^ (1 << np.arange(parameters.prob_bits))
    others_of_line = np.array(np.greater(np.delete(codes, column, axis=0), 0).all(axis=0))
    runs_then: npt.NDArray[np.bool_] = np.logical_and(np.greater(flipped, 0), others_of_line[:, np.newaxis])
    for line in range(len(lives)):
        runs_then[line] |= np.delete(lives, line).any()
    changes: npt.NDArray[np.bool_] = runs_then != bool(lives.any())
    return changes


def _changes(
    random: npt.NDArray[np.int64], codes: npt.NDArray[np.integer], parameters: BM1Parameters
) -> npt.NDArray[np.bool_]:
    """Return whether the flip of each bit of a code changes the cell's bit: bool[cycles, lines, prob_bits]."""
    own = codes.astype(np.int64)[:, np.newaxis]
    flipped = own ^ (1 << np.arange(parameters.prob_bits))
    shape = (len(random), parameters.lines, parameters.prob_bits)
    wide = random[:, :, np.newaxis]
    before, after = _ones(wide, own, parameters.ones_code), _ones(wide, flipped, parameters.ones_code)
    return np.broadcast_to(before != after, shape)
