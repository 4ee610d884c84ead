"""The thesis's claims as experiments: what cycles depend on (2.1.2, 4.3), and what flipped bits do (2.1.1).

The model is one of its own, a boat among beacons of which there may be any number, so that lines, sensors and counters
can be varied one by one. Bits are flipped in copies of a machine's tables, random numbers and streams, in a machine
of this module's own that runs as the reference does; nothing in the kernels knows of faults.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from machines.bm1 import BM1Machine
from machines.encode import decode_code
from machines.parameters import BM1Parameters
from machines.rng import random_numbers
from toolchain.conditional import normal
from toolchain.deployment import Stop
from toolchain.emulation import EmulatedBoards
from toolchain.fusion import exact_posterior
from toolchain.model import Model, cell_centres, interval
from toolchain.options import Scale
from toolchain.quantise import quantise
from toolchain.readings import sample_readings

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from toolchain.readings import Readings

_Word = TypeVar("_Word", np.uint16, np.uint32)

SIDE: Final = 100.0
"""Of the square in which the boat is, in metres."""
SIGMA: Final = 12.0
"""Of a distance, in metres: more than a cell of the coarsest grid, or the grid would decide how well a line fits."""
STEP: Final = 2.0
GRIDS: Final = (8, 12, 16, 24, 32, 48, 64)
SENSORS: Final = (1, 2, 3, 4, 6, 8, 10, 12)
TARGETS: Final = (15, 31, 63, 127, 255, 511, 1023, 2047, 4095)
RATES: Final = (0.0, 1e-5, 1e-4, 1e-3, 1e-2, 0.03, 0.1)
MAX_CYCLES: Final = 2**20

_MIDDLE_SENSORS: Final = 4
_MIDDLE_GRID: Final = 16
_MIDDLE_TARGET: Final = 255
_FAULT_CYCLES: Final = 2**14


@dataclass(frozen=True, slots=True)
class Course:
    """Cycles at one size: their median and quartiles over frames."""

    x: float
    median: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Fault:
    """Total variation at one rate of flipped bits: its mean over frames and a 95 % interval."""

    rate: float
    total_variation: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Claims:
    """What came out of all experiments."""

    frames: int
    fault_frames: int
    seed: int
    lines: list[Course]
    sensors: list[Course]
    targets: list[Course]
    faults: dict[str, list[Fault]]

    @property
    def lowest_rate(self) -> float:
        """The lowest rate above 0."""
        return min(
            (fault.rate for faults in self.faults.values() for fault in faults if fault.rate), default=1e-5
        )

    def as_json(self) -> str:
        """Return everything as one JSON object."""
        return json.dumps(asdict(self)) + "\n"


def beacons(grid: int = _MIDDLE_GRID, sensors: int = _MIDDLE_SENSORS) -> Model:
    """Return the model: where a boat is on a grid, from its distances to beacons around the square."""
    rows, columns = interval("y", 0, SIDE, cells=grid), interval("x", 0, SIDE, cells=grid)
    y, x = cell_centres(rows, columns)
    turn = np.arange(sensors) * (
        2 * np.pi * 0.381966
    )  # the golden angle: any number of them is spread evenly
    places = SIDE / 2 * (1 + 1.2 * np.stack([np.cos(turn), np.sin(turn)]))
    known = tuple(
        normal(f"D{at + 1}", mean=np.hypot(x - bx, y - by), sigma=SIGMA, values=80, step=STEP, bits=7)
        for at, (bx, by) in enumerate(places.T)
    )
    return Model(name="beacons", searched=(rows, columns), known=known)


def machine_of(model: Model, counter_bits: int = 12) -> BM1Machine:
    """Return the model's machine with codes of 8 bits, on one board."""
    quantised = quantise(model, prob_bits=8, scale=Scale.ADDRESS)
    parameters = BM1Parameters(
        lines=model.lines, sensor_bits=tuple(known.bits for known in model.known), counter_bits=counter_bits
    )
    return BM1Machine(parameters, quantised.prior, quantised.tables)


def run_claims(
    *, frames: int, fault_frames: int, seed: int, advance: Callable[[str], None] = lambda _: None
) -> Claims:
    """Run all experiments.

    Args:
        frames: Frames of each size.
        fault_frames: Frames of each rate of flipped bits.
        seed: Of readings and flips.
        advance: Told of every experiment before it begins.
    """
    lines, sensors, targets = [], [], []
    for grid in GRIDS:
        advance(f"{grid * grid} lines")
        lines.append(_course(grid * grid, beacons(grid), _MIDDLE_TARGET, frames, seed))
    for count in SENSORS:
        advance(f"{count} sensors")
        sensors.append(_course(count, beacons(sensors=count), _MIDDLE_TARGET, frames, seed))
    for target in TARGETS:
        advance(f"a target of {target}")
        targets.append(_course(target, beacons(), target, frames, seed))
    return Claims(
        frames=frames,
        fault_frames=fault_frames,
        seed=seed,
        lines=lines,
        sensors=sensors,
        targets=targets,
        faults=_faults(fault_frames, seed, advance),
    )


def experiments() -> int:
    """How many times `run_claims` calls `advance`."""
    return len(GRIDS) + len(SENSORS) + len(TARGETS) + len(_KINDS) * len(RATES)


def _course(x: float, model: Model, target: int, frames: int, seed: int) -> Course:
    machine = machine_of(model)
    boards = EmulatedBoards([machine], target_count=target, max_cycles=MAX_CYCLES, stop=Stop.OWN)
    readings = sample_readings(model, frames, seed=seed)
    cycles = [
        boards.run(*readings.of_machine(frame, machine), bank=frame % machine.parameters.rng_banks).length
        for frame in range(frames)
    ]
    low, median, high = np.quantile(cycles, [0.25, 0.5, 0.75]).tolist()
    return Course(x, median, low, high)


class FaultyMachine:
    """A machine that runs as the reference does, with bits flipped in its random numbers and in its cells' streams.

    Args:
        machine: What runs; LFSRs or a table, shared by columns.
        seed: Of the flips.
    """

    def __init__(self, machine: BM1Machine, *, seed: int) -> None:
        self._machine = machine
        self.reseed(seed)
        self._numbers = random_numbers(machine)
        self._shown: dict[int, NDArray[np.uint16]] = {}

    def reseed(self, seed: int) -> None:
        """Flip other bits from now on."""
        self._random = np.random.default_rng(seed)

    def counts(
        self,
        codes: NDArray[np.uint16],
        *,
        bank: int,
        target_count: int,
        max_cycles: int,
        stream_rate: float = 0.0,
        number_rate: float = 0.0,
    ) -> tuple[NDArray[np.int64], int]:
        """Run a frame and return the counts, int64[lines], and its cycles.

        Args:
            codes: uint16[columns, lines], what the tables answered.
            bank: Set of seeds.
            target_count: The count that stops it.
            max_cycles: The cycle at which it stops anyway.
            stream_rate: Probability that a cell's bit of a cycle is flipped.
            number_rate: Probability that a bit of a random number, which a whole column compares with, is flipped.
        """
        ones = self._machine.parameters.ones_code
        width = self._machine.parameters.prob_bits
        counts = np.zeros(codes.shape[1], dtype=np.int64)
        begun = 0
        while begun < max_cycles:
            end = min(begun + 512, max_cycles)
            shown = self._column_numbers(bank, end)[begun:end]
            if number_rate:
                flips = self._random.random((*shown.shape, width)) < number_rate
                shown = shown ^ (flips << np.arange(width)).sum(axis=2).astype(np.uint16)
            bits = np.ones((len(shown), codes.shape[1]), dtype=np.bool_)
            for column, row in enumerate(codes):
                made = (shown[:, column, np.newaxis] < row) | (row == ones)
                if stream_rate:
                    made ^= self._random.random(made.shape) < stream_rate
                bits &= made
            rising = counts + np.cumsum(bits, axis=0)
            full = np.flatnonzero((rising >= target_count).any(axis=1))
            if full.size:
                return rising[full[0]], begun + int(full[0]) + 1
            counts, begun = rising[-1], end
        return counts, begun

    def _column_numbers(self, bank: int, cycles: int) -> NDArray[np.uint16]:
        """What the generators show in a bank's first cycles: uint16[cycles, columns]; kept, since they are always the same."""
        kept = self._shown.get(bank)
        if kept is None or len(kept) < cycles:
            length = max(2048, 2 * cycles)
            states = self._numbers.restart(bank)
            kept = np.empty((length, len(states)), dtype=np.uint16)
            for cycle in range(length):
                kept[cycle] = self._numbers.show(states)
                states = self._numbers.clock(states)
            self._shown[bank] = kept
        return kept


def _faults(frames: int, seed: int, advance: Callable[[str], None]) -> dict[str, list[Fault]]:
    model = beacons()
    machine = machine_of(model)
    readings = sample_readings(model, frames, seed=seed)
    exact = [exact_posterior(model, *_model_frame(readings, frame)) for frame in range(frames)]
    likelihoods = [
        np.stack([known.table[at] for known, at in zip(model.known, readings.addresses[frame], strict=True)])
        for frame in range(frames)
    ]
    codes = [
        np.stack(
            [
                machine.prior[0],
                *(table[at] for table, at in zip(machine.tables, readings.addresses[frame], strict=True)),
            ]
        )
        for frame in range(frames)
    ]
    found: dict[str, list[Fault]] = {}
    faulty = FaultyMachine(machine, seed=seed)
    for name, kind in _KINDS.items():
        faults = []
        for number, rate in enumerate(RATES):
            advance(f"{name}, {rate:g} flipped")
            random = np.random.default_rng([seed, number])
            faulty.reseed(seed + number)
            variations = []
            for frame in range(frames):
                ours = kind(faulty, codes[frame], likelihoods[frame], rate, random, frame)
                # No posterior, or one that is no number, says nothing at all.
                good = ours is not None and bool(np.isfinite(ours).all())
                variations.append(
                    0.5 * float(np.abs(ours - exact[frame]).sum()) if ours is not None and good else 1.0
                )
            mean = float(np.mean(variations))
            half = 1.96 * float(np.std(variations)) / np.sqrt(frames)
            faults.append(Fault(rate, mean, max(0.0, mean - half), min(1.0, mean + half)))
        found[name] = faults
    return found


def _model_frame(readings: Readings, frame: int) -> tuple[tuple[int | None, ...]]:
    return (readings.of_model(frame)[0],)


def _machine_posterior(
    faulty: FaultyMachine,
    codes: NDArray[np.uint16],
    frame: int,
    *,
    stream_rate: float = 0.0,
    number_rate: float = 0.0,
) -> NDArray[np.float64] | None:
    counts, _ = faulty.counts(
        codes,
        bank=frame % 4,
        target_count=_MIDDLE_TARGET,
        max_cycles=_FAULT_CYCLES,
        stream_rate=stream_rate,
        number_rate=number_rate,
    )
    total = counts.sum()
    return counts / total if total else None


def _flipped_stream(
    faulty: FaultyMachine,
    codes: NDArray[np.uint16],
    _likelihoods: NDArray[np.float64],
    rate: float,
    _random: np.random.Generator,
    frame: int,
) -> NDArray[np.float64] | None:
    """A cell's bit of a cycle is flipped."""
    return _machine_posterior(faulty, codes, frame, stream_rate=rate)


def _flipped_numbers(
    faulty: FaultyMachine,
    codes: NDArray[np.uint16],
    _likelihoods: NDArray[np.float64],
    rate: float,
    _random: np.random.Generator,
    frame: int,
) -> NDArray[np.float64] | None:
    """A bit of a random number is flipped."""
    return _machine_posterior(faulty, codes, frame, number_rate=rate)


def _flipped_tables(
    faulty: FaultyMachine,
    codes: NDArray[np.uint16],
    _likelihoods: NDArray[np.float64],
    rate: float,
    random: np.random.Generator,
    frame: int,
) -> NDArray[np.float64] | None:
    """A bit of a table is flipped, and stays so for the frame."""
    return _machine_posterior(faulty, _flipped(codes, 8, rate, random), frame)


def _fixed_point(
    _faulty: FaultyMachine,
    codes: NDArray[np.uint16],
    _likelihoods: NDArray[np.float64],
    rate: float,
    random: np.random.Generator,
    _frame: int,
) -> NDArray[np.float64] | None:
    """The same codes multiplied in 8 bits, with an exponent common to all lines; a bit of a factor or a product is flipped."""
    product = np.full(codes.shape[1], 255, dtype=np.uint16)
    for row in codes:
        wide = product.astype(np.uint32) * np.round(
            256 * decode_code(_flipped(row, 8, rate, random), 8)
        ).astype(np.uint32)
        largest = int(wide.max())
        if largest == 0:
            return None
        shift = max(0, largest.bit_length() - 8)
        product = np.minimum((wide + (1 << shift >> 1)) >> shift, 255).astype(np.uint16)
        product = _flipped(product, 8, rate, random)
    total = int(product.sum())
    return product / total if total else None


def _floating_point(
    _faulty: FaultyMachine,
    _codes: NDArray[np.uint16],
    likelihoods: NDArray[np.float64],
    rate: float,
    random: np.random.Generator,
    _frame: int,
) -> NDArray[np.float64] | None:
    """float32 products; a bit of a factor or of a product is flipped."""
    product = np.ones(likelihoods.shape[1], dtype=np.float32)
    with np.errstate(all="ignore"):  # flipped exponents overflow
        for row in likelihoods:
            factor = _flipped(row.astype(np.float32).view(np.uint32), 32, rate, random).view(np.float32)
            product = _flipped((product * factor).view(np.uint32), 32, rate, random).view(np.float32)
        weights = np.clip(product.astype(np.float64), 0.0, None)
        posterior: NDArray[np.float64] = weights / weights.sum()
    return posterior


def _flipped(words: NDArray[_Word], width: int, rate: float, random: np.random.Generator) -> NDArray[_Word]:
    """The words with each of their low bits flipped with this probability."""
    flips = random.random((*words.shape, width)) < rate
    mask = (flips.astype(np.uint64) << np.arange(width, dtype=np.uint64)).sum(axis=-1)
    faulty: NDArray[_Word] = words ^ mask.astype(words.dtype)
    return faulty


_KINDS: Final = {
    "machine: stream bits": _flipped_stream,
    "machine: bits of random numbers": _flipped_numbers,
    "machine: table bits": _flipped_tables,
    "8-bit fixed point": _fixed_point,
    "32-bit floating point": _floating_point,
}
