"""Correct results of the campaign's readings, from the reference kernel and the deployment's images."""

import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from machines.bm1 import BM1Machine, Start, StopReason
from machines.reference import ReferenceBM1
from pcie_shim.programming_file import read_image
from scripts.campaigning.model.model import VALUES

LINES = 16
BOARDS = 2
BANKS = 4
TARGET, MAX_CYCLES = 127, 1 << 17
FIRST_SLICE = 256
"""End of the first slice of a frame; each further slice ends at twice the cycle at which the previous one ended."""
BUILD_OPTIONS = ("--partitions", "2", "--counter-bits", "7", "--rng-banks", "4")
WORDS = {StopReason.OVERFLOW: "overflow", StopReason.SLICE: "slice", StopReason.MAX_CYCLES: "max cycles"}

Addresses = tuple[int | None, ...]

POOL: tuple[Addresses, ...] = (
    *((0, 0), (2, 1), (3, 2), (5, 3), (6, 4), (3, None), (None, 2), (None, None)),
    *((4, 1), (5, 1), (6, 1), (0, 3)),  # sensors that contradict each other need several slices
)
"""The readings of a campaign, only a few because the reference kernel is slow."""


@dataclass(frozen=True, slots=True)
class BoardOutcome:
    """A board's part of a frame."""

    cycles: int
    total: int
    reason: str


@dataclass(frozen=True, slots=True)
class Outcome:
    """A frame's correct result: the posterior of all lines, and each board's part."""

    posterior: tuple[float, ...]
    boards: tuple[BoardOutcome, ...]


def addresses_of(values: dict[str, object]) -> Addresses | None:
    """Return the addresses of a reading's values, in the order of the columns; None if one is not a number."""
    addresses: list[int | None] = []
    for name, count in VALUES.items():
        value = values.get(name)
        if value is not None and not isinstance(value, int | float):
            return None
        if value is None or value != value:  # noqa: PLR0124 - NaN; math.isnan fails on integers beyond a double
            addresses.append(None)
        else:
            addresses.append(math.floor(min(max(value, 0), count - 1) + 0.5))
    return tuple(addresses)


class Expected:
    """The correct results of a deployment, computed once for each set of addresses and each bank."""

    def __init__(self, folder: Path) -> None:
        """Read the images of the boards, and compute the results of `POOL`."""
        images = [read_image(folder / "boards" / f"board{at}.bm") for at in range(BOARDS)]
        self._machines: list[BM1Machine] = [image.machine for image in images]
        self.outcome = cache(self._outcome)
        for addresses in POOL:
            for bank in range(BANKS):
                self.outcome(addresses, bank)

    def _outcome(self, addresses: Addresses, bank: int) -> Outcome:
        boards = [ReferenceBM1(machine) for machine in self._machines]
        start = Start(
            addresses=(), target_count=TARGET, max_cycles=MAX_CYCLES, bank=bank, run_until=FIRST_SLICE
        )
        for machine, board in zip(self._machines, boards, strict=True):
            tops = [(1 << bits) - 1 for bits in machine.parameters.sensor_bits]
            inputs = tuple(top if own is None else own for own, top in zip(addresses, tops, strict=True))
            board.start(replace(start, addresses=inputs))
        end = FIRST_SLICE
        while not any(board.reason is StopReason.OVERFLOW for board in boards):
            running = [board for board in boards if board.reason is StopReason.SLICE]
            if not running:
                break
            end *= 2
            for board in running:
                board.resume(0 if end >= MAX_CYCLES else end)
        weights = np.concatenate([board.counts / board.cycles for board in boards])
        return Outcome(
            posterior=tuple((weights / weights.sum()).tolist()),
            boards=tuple(
                BoardOutcome(board.cycles, int(board.counts.sum()), WORDS[board.reason]) for board in boards
            ),
        )
