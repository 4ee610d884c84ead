"""The thesis's claims as experiments: the number of cycles (2.1.2, 4.3), and flipped bits (2.1.1).

The model is a boat among any number of beacons, so that lines, sensors and counters can be varied one at a
time. Bits are flipped in the tables, random numbers and streams of a machine in this module, which runs like
the reference; the kernels do not support faults.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import BM1Machine
from machines.encode import decode_code
from machines.parameters import BM1Parameters
from machines.rng import random_numbers
from toolchain.analysis.emulation import EmulatedBoards
from toolchain.analysis.readings import Readings, sample_readings
from toolchain.building.quantise import quantise
from toolchain.deployment import Scale, Stop
from toolchain.models.conditional import normal
from toolchain.models.model import Model, cell_centres, exact_posterior, interval

_Word = TypeVar("_Word", np.uint16, np.uint32)

SIDE: Final = 100.0
"""Side of the square in which the boat is, in metres."""
SIGMA: Final = 12.0
"""Sigma of a distance in metres: more than a cell of the coarsest grid, so that the grid has no influence."""
STEP: Final = 2.0
"""Resolution of a distance in metres."""
CODE_BITS: Final = 8
GRIDS: Final = (8, 12, 16, 24, 32, 48, 64)
SENSORS: Final = (1, 2, 3, 4, 6, 8, 10, 12)
TARGETS: Final = (15, 31, 63, 127, 255, 511, 1023, 2047, 4095)
RATES: Final = (0.0, 1e-5, 1e-4, 1e-3, 1e-2, 0.03, 0.1)
MAX_CYCLES: Final = 2**20
FAULT_FRAMES: Final = 100
"""Maximum number of frames at each rate of flipped bits, because they run cycle by cycle."""

_MIDDLE_SENSORS: Final = 4
_MIDDLE_GRID: Final = 16
_MIDDLE_TARGET: Final = 255
_FAULT_CYCLES: Final = 2**14
_FAULT_BANKS: Final = 4


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
    """Results of all experiments."""

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
    """Return the model: the position of a boat on a grid, given its distances to beacons around the square."""
    rows, columns = interval("y", 0, SIDE, cells=grid), interval("x", 0, SIDE, cells=grid)
    y, x = cell_centres(rows, columns)
    turn = np.arange(sensors) * (
        2 * np.pi * 0.381966
    )  # the golden angle: any number of beacons is spread evenly
    places = SIDE / 2 * (1 + 1.2 * np.stack([np.cos(turn), np.sin(turn)]))
    known = tuple(
        normal(f"D{at + 1}", mean=np.hypot(x - bx, y - by), sigma=SIGMA, values=80, step=STEP, bits=7)
        for at, (bx, by) in enumerate(places.T)
    )
    return Model(name="beacons", searched=(rows, columns), known=known)


def machine_of(model: Model, counter_bits: int = 12) -> BM1Machine:
    """Return the model's machine with codes of 8 bits, on one board."""
    quantised = quantise(model, prob_bits=CODE_BITS, scale=Scale.ADDRESS)
    parameters = BM1Parameters(
        lines=model.lines, sensor_bits=tuple(known.bits for known in model.known), counter_bits=counter_bits
    )
    return BM1Machine(parameters, quantised.prior, quantised.tables)


def run_claims(*, frames: int, seed: int, advance: Callable[[str], None] = lambda _: None) -> Claims:
    """Run all experiments; `advance` is called with the name of each before it begins."""
    fault_frames = min(frames, FAULT_FRAMES)
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
        faults=_all_faults(fault_frames, seed, advance),
    )


def experiments() -> int:
    """Return the number of calls of `advance` by `run_claims`."""
    return len(GRIDS) + len(SENSORS) + len(TARGETS) + len(KINDS) * len(RATES)


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
    """A reference machine with bits flipped in its random numbers and in its cells' streams."""

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
        """Run a frame of codes, uint16[columns, lines], and return the counts, int64[lines], and its cycles.

        The bit of a cell in a cycle is flipped with probability `stream_rate`, and a bit of a random number,
        which a whole column uses, with `number_rate`.
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
                ones_here = (shown[:, column, np.newaxis] < row) | (row == ones)
                if stream_rate:
                    ones_here ^= self._random.random(ones_here.shape) < stream_rate
                bits &= ones_here
            rising = counts + np.cumsum(bits, axis=0)
            full = np.flatnonzero((rising >= target_count).any(axis=1))
            if full.size:
                return rising[full[0]], begun + int(full[0]) + 1
            counts, begun = rising[-1], end
        return counts, begun

    def _column_numbers(self, bank: int, cycles: int) -> NDArray[np.uint16]:
        """Return and cache a bank's first random numbers: uint16[cycles, columns]."""
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


@dataclass(frozen=True, slots=True, eq=False)
class DrawnFrame:
    """A frame's codes, uint16[columns, lines], likelihoods, float64[sensors, lines], and bank."""

    codes: NDArray[np.uint16]
    likelihoods: NDArray[np.float64]
    bank: int


class Faults:
    """Ways to compute a posterior while bits are flipped; each returns None if there is none."""

    def __init__(self, machine: BM1Machine, *, seed: int) -> None:
        self._machine = FaultyMachine(machine, seed=seed)
        self.reseed(seed)

    def reseed(self, seed: int) -> None:
        """Flip other bits from now on."""
        self._machine.reseed(seed)
        self._random = np.random.default_rng([seed, 1])

    def streams(self, frame: DrawnFrame, rate: float) -> NDArray[np.float64] | None:
        """Flip the bit of a cell in a cycle."""
        return self._counted(frame, frame.codes, stream_rate=rate)

    def numbers(self, frame: DrawnFrame, rate: float) -> NDArray[np.float64] | None:
        """Flip a bit of a random number, which a whole column uses."""
        return self._counted(frame, frame.codes, number_rate=rate)

    def tables(self, frame: DrawnFrame, rate: float) -> NDArray[np.float64] | None:
        """Flip a bit of a code, for the whole frame."""
        return self._counted(frame, _flipped(frame.codes, CODE_BITS, rate, self._random))

    def fixed_point(self, frame: DrawnFrame, rate: float) -> NDArray[np.float64] | None:
        """Multiply the codes in 8 bits with an exponent common to all lines; flip a bit of a factor or product."""
        product = np.full(frame.codes.shape[1], 2**CODE_BITS - 1, dtype=np.uint16)
        for row in frame.codes:
            factor = decode_code(_flipped(row, CODE_BITS, rate, self._random), CODE_BITS)
            wide = product.astype(np.uint32) * np.round(2**CODE_BITS * factor).astype(np.uint32)
            shift = max(0, int(wide.max()).bit_length() - CODE_BITS)
            rounded = np.minimum((wide + (1 << shift >> 1)) >> shift, 2**CODE_BITS - 1).astype(np.uint16)
            product = _flipped(rounded, CODE_BITS, rate, self._random)
        total = int(product.sum())
        return product / total if total else None

    def floating_point(self, frame: DrawnFrame, rate: float) -> NDArray[np.float64] | None:
        """Multiply float32s; flip a bit of a factor or of a product."""
        product = np.ones(frame.likelihoods.shape[1], dtype=np.float32)
        with np.errstate(all="ignore"):  # flipped exponents overflow
            for row in frame.likelihoods.astype(np.float32):
                factor = _flipped(row.view(np.uint32), 32, rate, self._random).view(np.float32)
                words = (product * factor).view(np.uint32)
                product = _flipped(words, 32, rate, self._random).view(np.float32)
            weights = np.clip(product.astype(np.float64), 0.0, None)
            posterior: NDArray[np.float64] = weights / weights.sum()
        # an infinite or undefined posterior is meaningless
        return posterior if np.isfinite(posterior).all() else None

    def _counted(
        self,
        frame: DrawnFrame,
        codes: NDArray[np.uint16],
        *,
        stream_rate: float = 0.0,
        number_rate: float = 0.0,
    ) -> NDArray[np.float64] | None:
        counts, _ = self._machine.counts(
            codes,
            bank=frame.bank,
            target_count=_MIDDLE_TARGET,
            max_cycles=_FAULT_CYCLES,
            stream_rate=stream_rate,
            number_rate=number_rate,
        )
        total = int(counts.sum())
        return counts / total if total else None


KINDS: Final[dict[str, Callable[[Faults, DrawnFrame, float], NDArray[np.float64] | None]]] = {
    "machine: stream bits": Faults.streams,
    "machine: bits of random numbers": Faults.numbers,
    "machine: table bits": Faults.tables,
    "8-bit fixed point": Faults.fixed_point,
    "32-bit floating point": Faults.floating_point,
}
"""The compared ways, by their names in the picture."""


def frames_of(model: Model, machine: BM1Machine, readings: Readings) -> list[DrawnFrame]:
    """Return the frames of some readings."""
    return [
        DrawnFrame(
            codes=np.stack(
                [machine.prior[0], *(table[at] for table, at in zip(machine.tables, addresses, strict=True))]
            ),
            likelihoods=np.stack([known.table[at] for known, at in zip(model.known, addresses, strict=True)]),
            bank=number % _FAULT_BANKS,
        )
        for number, addresses in enumerate(readings.addresses.tolist())
    ]


def _all_faults(count: int, seed: int, advance: Callable[[str], None]) -> dict[str, list[Fault]]:
    model = beacons()
    machine = machine_of(model)
    readings = sample_readings(model, count, seed=seed)
    frames = frames_of(model, machine, readings)
    exact = [exact_posterior(model, readings.of_model(at)[0]) for at in range(count)]
    faults = Faults(machine, seed=seed)
    found: dict[str, list[Fault]] = {}
    for name, kind in KINDS.items():
        found[name] = []
        for number, rate in enumerate(RATES):
            advance(f"{name}, {rate:g} flipped")
            faults.reseed(seed + number)
            ours = [kind(faults, frame, rate) for frame in frames]
            variations = [
                1.0 if posterior is None else 0.5 * float(np.abs(posterior - truth).sum())
                for posterior, truth in zip(ours, exact, strict=True)
            ]
            mean = float(np.mean(variations))
            half = 1.96 * float(np.std(variations)) / np.sqrt(count)
            found[name].append(Fault(rate, mean, max(0.0, mean - half), min(1.0, mean + half)))
    return found


def _flipped(words: NDArray[_Word], width: int, rate: float, random: np.random.Generator) -> NDArray[_Word]:
    """Return the words with each of their low bits flipped with this probability."""
    flips = random.random((*words.shape, width)) < rate
    mask = (flips.astype(np.uint64) << np.arange(width, dtype=np.uint64)).sum(axis=-1)
    faulty: NDArray[_Word] = words ^ mask.astype(words.dtype)
    return faulty
