"""Analyses of a machine without a board: accuracy, cycles, resources, energy.

The dataclasses here hold the command-line options of the analyses. This module needs no NumPy, so `--help` is fast.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final, TypeAlias, TypeVar

import typer

from machines.parameters import RngKind, RngReset
from toolchain.building.options import BuildOptions, Thesis
from toolchain.deployment import Scale, Stop
from toolchain.errors import BuildError
from toolchain.flags import BagTolerance, MaxCycles, Partitions, ReadingColumns, StopWhen

MAX_POINTS: Final = 10_000

Clock: TypeAlias = Annotated[
    float, typer.Option("--clock", help="Clock frequency of the boards.", metavar="HERTZ", min=1, max=1e12)
]
DeviceName: TypeAlias = Annotated[str, typer.Option(help="FPGA of the boards.", metavar="proce-v-d8")]
Progress: TypeAlias = Callable[[int], AbstractContextManager[Callable[[str], None]]]
"""Function that returns the context of a progress bar for a number of steps.

The context yields a function to call after each step, with the text to show.
"""

_Member = TypeVar("_Member", bound=StrEnum)
_Numbers: TypeAlias = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """The options that select the readings of an analysis, and the FPGA for its estimates."""

    readings: Annotated[
        Path | None,
        typer.Option(
            help="Recorded readings: CSV, MCAP or bag; without it, readings are drawn.", metavar="RECORDING"
        ),
    ] = None
    reading: ReadingColumns = None
    seed: Annotated[int, typer.Option(help="Seed of drawn readings.", min=0)] = 1
    device: DeviceName = "proce-v-d8"

    def __post_init__(self) -> None:
        if self.readings is None and self.reading:
            raise BuildError(f"--reading {self.reading[0]} refers to a recording; add --readings FILE")


@dataclass(frozen=True, kw_only=True)
class InspectOptions(ReadingOptions):
    """The options of `toolchain inspect`, which analyses a deployment."""

    tolerance_s: BagTolerance = 0.1
    frames: Annotated[
        int | None,
        typer.Option(
            help="Maximum number of frames; fewer with replicas.",
            show_default="200, or 20 for a slow machine",
        ),
    ] = None
    banks: Annotated[
        int | None,
        typer.Option(
            help="Number of seed sets for each frame.", min=1, show_default="4, or 1 for a slow machine"
        ),
    ] = None
    clock_hz: Clock = 100e6


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """The options of a sweep. A sweep measures a machine for each combination of the values in the LIST options.

    The other options are the same for all machines.
    """

    prob_bits: Annotated[str, typer.Option(help="Bits of a code, comma-separated.", metavar="LIST")] = (
        "4,6,8,10"
    )
    targets: Annotated[
        str, typer.Option(help="Target counts, each with the narrowest counter.", metavar="LIST")
    ] = "63,255,1023"
    rngs: Annotated[str, typer.Option(help="Generators.", metavar="LIST")] = "lfsr16,lfsr32"
    scales: Annotated[
        str,
        typer.Option(
            help="Part of a table that is divided by its maximum before quantising.", metavar="LIST"
        ),
    ] = "address,column"
    steps: Annotated[
        str, typer.Option(help="Steps of a generator per cycle; 0: fresh bits.", metavar="LIST")
    ] = "0"
    thesis: Thesis = False
    partitions: Partitions = 1
    stop: StopWhen = Stop.SLICES
    max_cycles: MaxCycles = 2**17
    banks: Annotated[int, typer.Option(help="Number of seed sets for each frame.", min=1)] = 2

    def __post_init__(self) -> None:
        """Refuse a malformed list in a flag before a model is read."""
        self._lists()

    def _lists(self) -> tuple[tuple[Scale, ...], tuple[RngKind, ...], _Numbers, _Numbers, _Numbers]:
        return (
            _members("--scales", self.scales, Scale),
            _members("--rngs", self.rngs, RngKind),
            _numbers("--steps", self.steps),
            _numbers("--prob-bits", self.prob_bits),
            _numbers("--targets", self.targets),
        )

    def options(self) -> Iterator[BuildOptions]:
        """Yield the build options of each machine. Raises a BuildError if there are no or too many combinations."""
        lists = self._lists()
        count = math.prod(map(len, lists))
        if not 0 < count <= MAX_POINTS:
            raise BuildError(f"these lists give {count} machines, expected 1 to {MAX_POINTS}")
        for scale, rng, steps, prob_bits, target in itertools.product(*lists):
            if target < 1:
                raise BuildError(f"a target count of {target} is too small; expected 1 or more")
            yield BuildOptions(
                partitions=self.partitions,
                scale=scale,
                prob_bits=prob_bits,
                counter_bits=target.bit_length(),
                target_count=target,
                max_cycles=self.max_cycles,
                stop=self.stop,
                rng=rng,
                rng_reset=RngReset.FREE if self.thesis else RngReset.BANK,
                steps_per_clock=steps,
            )


@dataclass(frozen=True, kw_only=True)
class AdviceOptions:
    """The options of `toolchain advise`, which compares a BM1, a BM2 and exact inference for one model."""

    accuracy: Annotated[
        float, typer.Option(help="Mean total variation from exact inference.", min=1e-4, max=0.5)
    ] = 0.01
    frames: Annotated[int, typer.Option(help="Number of readings.", min=1, max=1000)] = 50
    seed: Annotated[int, typer.Option(help="Seed of the readings.", min=0)] = 1
    clock_hz: Clock = 100e6
    device: DeviceName = "proce-v-d8"


def _numbers(flag: str, text: str) -> _Numbers:
    try:
        return tuple(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        raise BuildError(
            f"{flag} {text}: expected comma-separated whole numbers, such as {flag} 4,8"
        ) from None


def _members(flag: str, text: str, kind: type[_Member]) -> tuple[_Member, ...]:
    try:
        return tuple(dict.fromkeys(kind(part.strip()) for part in text.split(",")))
    except ValueError:
        raise BuildError(
            f"{flag} {text}: expected some of {', '.join(kind)}, with commas between them"
        ) from None


def with_unit(value: float, unit: str) -> str:
    """Return a value as text with a unit. The SI prefix is chosen to leave 1 to 999 before the decimal point."""
    if value <= 0:
        return f"0 {unit}"
    prefixes = ("p", "n", "u", "m", "", "k", "M", "G")
    power = max(-4, min(3, math.floor(math.log10(value) / 3 + 1e-12)))
    return f"{value / 1000.0**power:.3g} {prefixes[power + 4]}{unit}"
