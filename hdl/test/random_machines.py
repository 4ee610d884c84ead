"""Random machines of every mode and width, whose hardware is compared with the emulated board."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from hdl.test.project import (
    BM1Machine,
    BM1Parameters,
    Image,
    PriorMode,
    RngKind,
    RngReset,
    SensorMode,
    image_of,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

MOST_CELLS: Final = 450
"""Maximum number of cells over all replicas; with this many, a simulator runs some thousand cycles per second.
"""

_KINDS: Final = (RngKind.LFSR32, RngKind.LFSR16, RngKind.TABLE, RngKind.LFSR24, RngKind.LFSR8)
_MODES: Final = (SensorMode.COLUMN, SensorMode.CELL, SensorMode.COLUMN, SensorMode.THRESHOLD)


@dataclass(frozen=True)
class Case:
    """A machine on a board, and the seed of its session."""

    image: Image
    seed: int

    @property
    def name(self) -> str:
        """Size and modes of the machine, for reports."""
        p = self.image.machine.parameters
        return (
            f"case {self.seed}: {p.lines} x {p.sensors}, codes {p.prob_bits}, counters {p.counter_bits}, {p.rng}, "
            f"{p.steps_per_clock} steps, {p.rng_banks} banks"
            + ("" if p.shared else ", per cell")
            + (", free" if p.rng_reset is RngReset.FREE else "")
            + (", written prior" if p.prior_mode is PriorMode.WRITTEN else f", prior {p.prior_bits}")
            + ("" if p.sensor_mode is SensorMode.COLUMN else f", {p.sensor_mode}")
            + (f", {p.replicas} replicas" if p.replicas > 1 else "")
        )


def random_case(seed: int, most_cells: int = MOST_CELLS) -> Case:
    """Return a case with a random machine. Equal seeds give equal cases.

    Successive seeds cycle through the generator kinds, sensor modes, sharing, prior modes and numbers of replicas. All
    other parameters are random.
    """
    random = np.random.default_rng(seed)
    kind = _KINDS[seed % len(_KINDS)]
    mode = _MODES[seed % len(_MODES)]
    shared = seed % 3 != 1
    written = seed % 7 in {2, 5}
    replicas = (1, 2, 1, 3, 1, 1, 5, 1, 1, 2, 1)[seed % 11]
    if seed % 29 == 6:
        replicas = 40
    sensors = int(random.choice([0, 1, 2, 3, 4, 5, 6], p=[0.06, 0.14, 0.2, 0.2, 0.16, 0.12, 0.12]))
    most_lines = max(min(most_cells // (replicas * (sensors + 1)), 64), 1)
    few = int(random.integers(1, min(most_lines, 6) + 1))
    lines = few if random.random() < 0.4 else int(random.integers(1, most_lines + 1))
    if seed % 13 == 7:
        lines = most_lines
    widest = min(16, (kind.lfsr_bits or 17) - 1)
    prob_bits = int(
        random.choice([1, 2, 3, 4, 6, 8, 8, 8, 10, 12, 15, 16][: 5 if widest < 8 else None]).clip(1, widest)
    )
    widths = random.integers(1, 5, sensors)
    if mode is SensorMode.THRESHOLD:
        widths = np.full(sensors, prob_bits)
    parameters = BM1Parameters(
        lines=lines,
        sensor_bits=tuple(int(width) for width in widths),
        prob_bits=prob_bits,
        prior_bits=0 if written else int(random.choice([0, 0, 1, 2, 3])),
        prior_mode=PriorMode.WRITTEN if written else PriorMode.TABLE,
        counter_bits=int(random.choice([1, 2, 3, 5, 8, 8, 8, 10, 16, 32])),
        rng=kind,
        shared=shared,
        steps_per_clock=int(random.choice([0, 0, 1, 1, 3, 20])),
        rng_banks=int(random.choice([1, 2, 3, 5, 16])),
        rng_reset=RngReset.FREE if random.random() < 0.3 else RngReset.BANK,
        sensor_mode=mode,
        replicas=replicas,
    )
    machine = BM1Machine(parameters, *_tables(random, parameters), _numbers(random, parameters))
    more = (0, 0) if random.random() < 0.5 else (int(random.integers(0, 9)), int(random.integers(0, 9)))
    return Case(image_of(machine, *more), seed)


def _tables(
    random: np.random.Generator, parameters: BM1Parameters
) -> tuple[NDArray[np.uint16], tuple[NDArray[np.uint16], ...]]:
    """Return the prior and the columns' tables, whose codes range from mostly zeros to mostly ones."""
    zeros = float(random.choice([0.0, 0.02, 0.1]))
    typical = float(random.choice([0.3, 0.7, 0.9, 1.0]))
    prior = codes(random, parameters, parameters.prior_addresses, zeros, typical)
    tables = []
    for bits in parameters.sensor_bits if parameters.has_tables else ():
        table = codes(random, parameters, 1 << bits, zeros, typical)
        if bits > 1 and random.random() < 0.5:
            table[0] = 0  # an address at which every line is impossible
        table[-1] = parameters.ones_code
        tables.append(table)
    return prior, tuple(tables)


def codes(
    random: np.random.Generator, parameters: BM1Parameters, rows: int, zeros: float, typical: float
) -> NDArray[np.uint16]:
    """Return random codes, uint16[rows, lines]. Often several lines are equal and their counters overflow together."""
    ones = parameters.ones_code
    shape = (rows, parameters.lines)
    spread = random.uniform(max(2 * typical - 1, 0), min(2 * typical, 1.1), shape)
    drawn = np.clip(np.rint(spread * ones), 1, ones).astype(np.uint16)
    drawn[random.random(shape) < zeros] = 0
    drawn[random.random(shape) < 0.1] = ones
    if parameters.lines > 1:
        equal = random.random(parameters.lines) < 0.3
        drawn[:, equal] = drawn[:, :1]
    return drawn


def _numbers(random: np.random.Generator, parameters: BM1Parameters) -> NDArray[np.uint32] | None:
    """Return a table of random numbers, or None if the machine has no table. Few lengths are powers of two."""
    if parameters.rng is not RngKind.TABLE:
        return None
    length = int(random.choice([1, 2, 17, 64, 199, 500]))
    return random.integers(0, 2**parameters.prob_bits, length, dtype=np.uint32)
