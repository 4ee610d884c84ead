"""The thesis's claims as experiments: the number of cycles (2.1.2, 4.3), and flipped bits (2.1.1).

    python docs/experiments/claims.py out/claims --frames 100

The model is a boat among any number of beacons, so that lines, sensors and counters vary one at a time. Bits
are flipped in a machine of this module, which runs like the reference; the kernels do not support faults.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from machines.bm1 import BM1Machine
from machines.encode import decode_code
from machines.parameters import BM1Parameters
from machines.rng import random_numbers
from toolchain.analysis.accuracy import Interval, bootstrap
from toolchain.analysis.emulation import EmulatedBoards, check_frames, sample_readings
from toolchain.analysis.sweep import COLOURS, MARKERS, new_figure, save_figure
from toolchain.building.quantise import quantise
from toolchain.commands.explore import progress
from toolchain.deployment import Scale, Stop
from toolchain.errors import BuildError
from toolchain.models.conditional import normal
from toolchain.models.model import Model, cell_centres, exact_posterior, interval

_Word = TypeVar("_Word", np.uint16, np.uint32)
_Floats = NDArray[np.float64]

GRIDS: Final = (8, 12, 16, 24, 32, 48, 64)
SENSORS: Final = (1, 2, 3, 4, 6, 8, 10, 12)
TARGETS: Final = (15, 31, 63, 127, 255, 511, 1023, 2047, 4095)
RATES: Final = (0.0, 1e-5, 1e-4, 1e-3, 1e-2, 0.03, 0.1)
FAULT_FRAMES: Final = 100
"""Maximum number of frames at each rate of flipped bits, because they run cycle by cycle."""
FAULT_CYCLES: Final = 2**14

_BITS: Final = 8  # of a code, and of the fixed point that it is compared with
_GRID, _SENSORS, _TARGET = 16, 4, 255  # the baseline, of which one at a time is varied
_BANKS: Final = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Claims:
    """Results of all experiments.

    Attributes:
        lines: Cycles by the number of lines: the median, with the quartiles as interval.
        sensors: The same by the number of sensors.
        targets: The same by the target count.
        faults: Total variation by the share of flipped bits, for each way to compute a posterior.
    """

    frames: int
    fault_frames: int
    seed: int
    lines: dict[int, Interval]
    sensors: dict[int, Interval]
    targets: dict[int, Interval]
    faults: dict[str, dict[float, Interval]]

    def as_json(self) -> str:
        """Return everything as one JSON object."""
        return json.dumps(asdict(self)) + "\n"

    def as_text(self) -> str:
        """Return everything as tables."""
        rows = []
        for what, cycles in (
            ("the number of lines (4 sensors, target 255)", self.lines),
            ("the number of sensors (256 lines, target 255)", self.sensors),
            ("the target count (256 lines, 4 sensors)", self.targets),
        ):
            rows += [f"Cycles by {what}:", "          median   quartiles"]
            rows += [
                f"  {x:6,}  {at.value:7,.0f}   {at.low:,.0f} to {at.high:,.0f}" for x, at in cycles.items()
            ]
        rows.append(f"Total variation by the share of flipped bits ({self.fault_frames} frames):")
        for name, faults in self.faults.items():
            rows.append(
                f"  {name:31} " + "  ".join(f"{rate:g}: {at.value:.3f}" for rate, at in faults.items())
            )
        return "\n".join(rows) + "\n"


def beacons(grid: int = _GRID, sensors: int = _SENSORS) -> Model:
    """Return the model: the position of a boat on a grid, given its distances to beacons around the square."""
    side = 100.0  # metres
    rows, columns = interval("y", 0, side, cells=grid), interval("x", 0, side, cells=grid)
    y, x = cell_centres(rows, columns)
    # the golden angle spreads any number of beacons evenly
    turn = np.arange(sensors) * (2 * np.pi * 0.381966)
    places = side / 2 * (1 + 1.2 * np.stack([np.cos(turn), np.sin(turn)]))
    # sigma is more than a cell of the coarsest grid, so that the grid has no influence
    known = tuple(
        normal(f"D{at + 1}", mean=np.hypot(x - bx, y - by), sigma=12.0, values=80, step=2.0, bits=7)
        for at, (bx, by) in enumerate(places.T)
    )
    return Model(name="beacons", searched=(rows, columns), known=known)


def machine_of(model: Model, counter_bits: int = 12) -> BM1Machine:
    """Return the model's machine with codes of 8 bits, on one board."""
    quantised = quantise(model, prob_bits=_BITS, scale=Scale.ADDRESS)
    parameters = BM1Parameters(
        lines=model.lines, sensor_bits=tuple(known.bits for known in model.known), counter_bits=counter_bits
    )
    return BM1Machine(parameters, quantised.prior, quantised.tables)


def experiments() -> int:
    """Return the number of calls of `advance` by `run_claims`."""
    return len(GRIDS) + len(SENSORS) + len(TARGETS) + len(KINDS) * len(RATES)


def run_claims(*, frames: int, seed: int, advance: Callable[[str], None] = lambda _: None) -> Claims:
    """Run all experiments; `advance` is called with the name of each before it begins."""

    def cycles(name: str, model: Model, target: int = _TARGET) -> Interval:
        advance(name)
        machine = machine_of(model)
        boards = EmulatedBoards([machine], target_count=target, max_cycles=2**20, stop=Stop.OWN)
        readings = sample_readings(model, frames, seed=seed)
        banks = machine.parameters.rng_banks
        lengths = [
            boards.run(*readings.of_machine(frame, machine), bank=frame % banks).length
            for frame in range(frames)
        ]
        low, median, high = np.quantile(lengths, [0.25, 0.5, 0.75]).tolist()
        return Interval(median, low, high)

    return Claims(
        frames=frames,
        fault_frames=min(frames, FAULT_FRAMES),
        seed=seed,
        lines={grid * grid: cycles(f"{grid * grid} lines", beacons(grid)) for grid in GRIDS},
        sensors={count: cycles(f"{count} sensors", beacons(sensors=count)) for count in SENSORS},
        targets={target: cycles(f"a target of {target}", beacons(), target) for target in TARGETS},
        faults=_all_faults(min(frames, FAULT_FRAMES), seed, advance),
    )


@dataclass(frozen=True, slots=True, eq=False)
class DrawnFrame:
    """A frame's codes, uint16[columns, lines], likelihoods, float64[sensors, lines], and bank."""

    codes: NDArray[np.uint16]
    likelihoods: _Floats
    bank: int


def draw_frames(
    model: Model, machine: BM1Machine, count: int, seed: int
) -> tuple[list[DrawnFrame], list[_Floats]]:
    """Return frames of readings drawn from the model, and the exact posterior of each."""
    readings = sample_readings(model, count, seed=seed)
    frames = [
        DrawnFrame(
            codes=np.stack(
                [machine.prior[0], *(table[at] for table, at in zip(machine.tables, addresses, strict=True))]
            ),
            likelihoods=np.stack([known.table[at] for known, at in zip(model.known, addresses, strict=True)]),
            bank=number % _BANKS,
        )
        for number, addresses in enumerate(readings.addresses.tolist())
    ]
    return frames, [exact_posterior(model, readings.of_model(at)[0]) for at in range(count)]


class Faults:
    """Ways to compute a posterior while bits are flipped; each returns None if there is none."""

    def __init__(self, machine: BM1Machine, *, seed: int) -> None:
        """Compute the random numbers of each bank for `FAULT_CYCLES`."""
        numbers = random_numbers(machine)
        self._shown = np.empty((_BANKS, FAULT_CYCLES, machine.parameters.columns), dtype=np.uint16)
        for bank, of_bank in enumerate(self._shown):
            states = numbers.restart(bank)
            for cycle in of_bank:
                cycle[:] = numbers.show(states)
                states = numbers.clock(states)
        self.reseed(seed)

    def reseed(self, seed: int) -> None:
        """Flip other bits from now on."""
        self._random = np.random.default_rng(seed)

    def streams(self, frame: DrawnFrame, rate: float) -> _Floats | None:
        """Flip the bit of a cell in a cycle."""
        return _normalised(self.counts(frame.codes, bank=frame.bank, stream_rate=rate)[0])

    def numbers(self, frame: DrawnFrame, rate: float) -> _Floats | None:
        """Flip a bit of a random number, which is used by a whole column."""
        return _normalised(self.counts(frame.codes, bank=frame.bank, number_rate=rate)[0])

    def tables(self, frame: DrawnFrame, rate: float) -> _Floats | None:
        """Flip a bit of a code, for the whole frame."""
        return _normalised(self.counts(self.flipped(frame.codes, _BITS, rate), bank=frame.bank)[0])

    def fixed_point(self, frame: DrawnFrame, rate: float) -> _Floats | None:
        """Multiply the codes in 8 bits with an exponent that all lines share; flip a bit of a factor or of a product."""
        top = 2**_BITS - 1
        product = np.full(frame.codes.shape[1], top, dtype=np.uint16)
        for row in frame.codes:
            factor = decode_code(self.flipped(row, _BITS, rate), _BITS)
            wide = product.astype(np.uint32) * np.round(2**_BITS * factor).astype(np.uint32)
            shift = max(0, int(wide.max()).bit_length() - _BITS)
            rounded = np.minimum((wide + (1 << shift >> 1)) >> shift, top).astype(np.uint16)
            product = self.flipped(rounded, _BITS, rate)
        return _normalised(product)

    def floating_point(self, frame: DrawnFrame, rate: float) -> _Floats | None:
        """Multiply float32s; flip a bit of a factor or of a product."""
        product = np.ones(frame.likelihoods.shape[1], dtype=np.float32)
        with np.errstate(all="ignore"):  # flipped exponents overflow
            for row in frame.likelihoods.astype(np.float32):
                factor = self.flipped(row.view(np.uint32), 32, rate).view(np.float32)
                product = self.flipped((product * factor).view(np.uint32), 32, rate).view(np.float32)
            weights = np.clip(product.astype(np.float64), 0.0, None)
            posterior: _Floats = weights / weights.sum()
        # an infinite or undefined posterior is meaningless
        return posterior if np.isfinite(posterior).all() else None

    def counts(
        self,
        codes: NDArray[np.uint16],
        *,
        bank: int,
        target_count: int = _TARGET,
        stream_rate: float = 0.0,
        number_rate: float = 0.0,
    ) -> tuple[NDArray[np.int64], int]:
        """Run a frame of codes, uint16[columns, lines], and return the counts, int64[lines], and the cycles.

        The bit of a cell in a cycle is flipped with probability `stream_rate`, and a bit of a random number, which is
        used by a whole column, with probability `number_rate`.
        """
        counts = np.zeros(codes.shape[1], dtype=np.int64)
        for begun in range(0, FAULT_CYCLES, 512):
            shown = self.flipped(self._shown[bank, begun : begun + 512], _BITS, number_rate)
            bits = np.ones((len(shown), codes.shape[1]), dtype=np.bool_)
            for column, row in enumerate(codes):
                ones = (shown[:, column, np.newaxis] < row) | (row == 2**_BITS - 1)
                if stream_rate:
                    ones ^= self._random.random(ones.shape) < stream_rate
                bits &= ones
            rising = counts + np.cumsum(bits, axis=0)
            full = np.flatnonzero((rising >= target_count).any(axis=1))
            if full.size:
                return rising[full[0]], begun + int(full[0]) + 1
            counts = rising[-1]
        return counts, FAULT_CYCLES

    def flipped(self, words: NDArray[_Word], width: int, rate: float) -> NDArray[_Word]:
        """Return the words with each of their low bits flipped with this probability."""
        if not rate:
            return words
        flips = self._random.random((*words.shape, width)) < rate
        mask = (flips.astype(np.uint64) << np.arange(width, dtype=np.uint64)).sum(axis=-1)
        faulty: NDArray[_Word] = words ^ mask.astype(words.dtype)
        return faulty


KINDS: Final[dict[str, Callable[[Faults, DrawnFrame, float], _Floats | None]]] = {
    "machine: stream bits": Faults.streams,
    "machine: bits of random numbers": Faults.numbers,
    "machine: table bits": Faults.tables,
    "8-bit fixed point": Faults.fixed_point,
    "32-bit floating point": Faults.floating_point,
}
"""The ways to compare, by their names in the picture."""


def _normalised(weights: NDArray[np.integer]) -> _Floats | None:
    total = int(weights.sum())
    return weights / total if total else None


def _all_faults(count: int, seed: int, advance: Callable[[str], None]) -> dict[str, dict[float, Interval]]:
    model = beacons()
    machine = machine_of(model)
    frames, exact = draw_frames(model, machine, count, seed)
    faults = Faults(machine, seed=seed)
    found: dict[str, dict[float, Interval]] = {}
    for name, kind in KINDS.items():
        found[name] = {}
        for number, rate in enumerate(RATES):
            advance(f"{name}, {rate:g} flipped")
            faults.reseed(seed + number)
            ours = [kind(faults, frame, rate) for frame in frames]
            variations = [
                1.0 if posterior is None else 0.5 * float(np.abs(posterior - truth).sum())
                for posterior, truth in zip(ours, exact, strict=True)
            ]
            found[name][rate] = bootstrap(np.array(variations), np.mean)
    return found


def draw_claims(path: Path, claims: Claims) -> None:
    """Draw the thesis's claims, one panel each."""
    figure = new_figure((11.0, 7.4))
    panels = figure.subplots(2, 2)
    for axes, cycles, title, label in (
        (panels[0, 0], claims.lines, "(a) lines: cycles do not depend on them (2.1.2)", "lines"),
        (panels[0, 1], claims.sensors, "(b) sensors: cycles grow with them (2.1.2, 4.3)", "sensors"),
        (panels[1, 0], claims.targets, "(c) counters: cycles grow with their size (2.1.2)", "target count"),
    ):
        values, low, high = _bounds(list(cycles.values()))
        axes.plot(list(cycles), values, "o-", color=COLOURS[0])
        axes.fill_between(list(cycles), low, high, color=COLOURS[0], alpha=0.2, linewidth=0)
        scale = "linear" if label == "sensors" else "log"
        axes.set(xscale=scale, yscale="log", xlabel=label, ylabel="cycles (median, quartiles)", title=title)
        axes.grid(alpha=0.3, which="both")
    bottom, top = panels[0, 0].get_ylim()
    panels[0, 0].set_ylim(bottom / 3, top * 3)
    axes = panels[1, 1]
    none = min((rate for faults in claims.faults.values() for rate in faults if rate), default=1e-5) / 3
    for at, (name, faults) in enumerate(claims.faults.items()):
        values, low, high = _bounds(list(faults.values()))
        axes.errorbar(
            [rate or none for rate in faults],
            values,
            yerr=[values - low, high - values],
            marker=MARKERS[at],
            markersize=4,
            color=COLOURS[at],
            linewidth=1.2,
            capsize=2,
            label=name,
        )
    axes.set(
        xscale="log",
        xlabel=f"share of bits that are flipped (leftmost: none, drawn at {none:.0e})",
        ylabel="total variation (mean, 95 %)",
        title="(d) flipped bits (2.1.1)",
        ylim=(0, 1.02),
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", frameon=False)
    save_figure(figure, path)


def _bounds(intervals: Sequence[Interval]) -> tuple[_Floats, _Floats, _Floats]:
    values = np.array([(each.value, each.low, each.high) for each in intervals])
    return values[:, 0], values[:, 1], values[:, 2]


def main() -> None:
    """Run all experiments, print tables, and write `claims.json` and `claims.png`."""
    parser = argparse.ArgumentParser(description="Test the thesis's claims with a model of its own.")
    parser.add_argument("directory", type=Path, help="folder for the numbers and the picture")
    parser.add_argument("--frames", type=int, default=50, help="frames for each point (50)")
    parser.add_argument(
        "--seed", type=int, default=1, help="seed of the readings and of the flipped bits (1)"
    )
    options = parser.parse_args()
    try:
        check_frames(options.frames)
        options.directory.mkdir(parents=True, exist_ok=True)
        with progress(experiments()) as advance:
            claims = run_claims(frames=options.frames, seed=options.seed, advance=advance)
        (options.directory / "claims.json").write_text(claims.as_json(), encoding="utf-8")
        draw_claims(options.directory / "claims.png", claims)
    except (BuildError, OSError) as reason:
        parser.error(str(reason))
    print(claims.as_text(), end="")
    print(f"Wrote claims.json and claims.png to {options.directory}")


if __name__ == "__main__":
    main()
