"""Sweeps over the possible machines of a model: measured points, their Pareto front, a table and a picture."""

import fcntl
import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from machines.parameters import RngKind
from terminal.pictures import new_figure, save_figure
from toolchain.analysis import Sweep
from toolchain.analysis.accuracy import Difference, measure
from toolchain.analysis.emulation import EmulatedBoards
from toolchain.analysis.logic import Device
from toolchain.analysis.readings import Readings
from toolchain.analysis.resources import estimate
from toolchain.bounded_files import file_errors, read_bounded, whole_file
from toolchain.building.machine import (
    MachinePlan,
    board_layout,
    partition_lines,
    plan_machine,
    split,
    whole_machine,
)
from toolchain.building.quantise import quantise
from toolchain.cluster import Run, Work
from toolchain.errors import BuildError
from toolchain.models.model import Model

MAX_FILE_BYTES: Final = 1 << 28

_BEGIN: Final = b'{"key":"'
"""The first bytes of every line of results."""


class Point(BaseModel):
    """The measurement of one machine in a sweep: a line of the results file.

    Attributes:
        key: SHA-256 of everything on which the results depend.
        total_variation: Mean, over all frames, of the total variation between the machine's posterior and the model's
            posterior. If the machine gives a frame no posterior, the frame has a total variation of 1.
        total_variation_low: Lower end of the 95 % interval of `total_variation`.
        total_variation_high: Upper end of the 95 % interval of `total_variation`.
        quantising: Mean total variation between the model's posterior and exact inference on the machine's codes.
        map_agreement: Share of all frames in which machine and model have the same most probable line.
        alone_total_variation: `total_variation` over only the frames with a posterior, or None without such frames.
        alone_map_agreement: `map_agreement` over only the frames with a posterior, or None without such frames.
        kl_bits: Mean KL(machine || model) in bits over the frames with a posterior, or None without such frames.
        z_rms: Root mean square of z-scores (`ZScores`), ideally 1. It is None if all expected counts are too low.
        without: Share of runs without a posterior.
        cycles_median: Median cycles of a frame.
        cycles_95: 95th percentile of the cycles of a frame.
        alms: ALMs of the largest board, or None with ideal random numbers, because no FPGA can generate them.
        blocks: Memory blocks of the largest board.
        fits: Whether the largest board fits the device.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    key: str = Field(pattern="[0-9a-f]{64}")
    scale: Literal["address", "column", "none"]
    rng: Literal["lfsr8", "lfsr16", "lfsr24", "lfsr32", "table", "ideal"]
    steps_per_clock: int
    prob_bits: int
    target_count: int
    counter_bits: int
    partitions: int
    frames: int
    total_variation: float
    total_variation_low: float
    total_variation_high: float
    quantising: float
    map_agreement: float
    alone_total_variation: float | None
    alone_map_agreement: float | None
    kl_bits: float | None
    z_rms: float | None
    without: float
    cycles_median: float
    cycles_95: float
    alms: float | None
    blocks: int | None
    fits: bool | None


class Results:
    """The results file of a sweep: one JSON object per line. An interrupted sweep continues from this file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.points: dict[str, Point] = {}
        content = read_bounded(path, MAX_FILE_BYTES, BuildError) if path.exists() else b""
        lines = content.split(b"\n")
        # A power failure may leave an incomplete last line: that point is measured again.
        torn = lines.pop()
        if torn and not torn.startswith(_BEGIN[: len(torn)]):
            lines.append(torn)
        self._torn_at, self._torn = len(content) - len(torn), torn
        for number, line in enumerate(lines, start=1):
            try:
                point = Point.model_validate_json(line)
            except ValidationError:
                raise BuildError(
                    f"{path}, line {number}, is not a result of a sweep; name another file with -o"
                ) from None
            self.points[point.key] = point

    def check_writable(self) -> None:
        """Create the file if it is missing. Raise a BuildError, before a long run, if the file cannot be written."""
        with file_errors(self.path, "written", BuildError), self.path.open("ab"):
            pass

    def append(self, point: Point) -> None:
        """Append a point in a single write, and wait until the point is on the disk."""
        line = point.model_dump_json().encode() + b"\n"
        with file_errors(self.path, "written", BuildError), self._locked() as file:
            file.seek(self._torn_at)
            if self._torn and file.read() == self._torn:  # otherwise, another sweep has removed it
                file.truncate(self._torn_at)
            self._torn = b""
            written = file.write(line)
            os.fsync(file.fileno())
        if written != len(line):
            raise BuildError(f"{self.path} cannot be written: the disk is full")
        self.points[point.key] = point

    @contextmanager
    def _locked(self) -> Iterator[BinaryIO]:
        """Open the file to append, and lock it against other sweeps."""
        while True:
            with self.path.open("a+b", buffering=0) as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                if os.fstat(file.fileno()).st_nlink:  # otherwise, another sweep has replaced it
                    yield file
                    return

    def sort(self, keys: Sequence[str]) -> None:
        """Move the points with these keys to the end of the file, in the order of `keys`."""
        with self._locked():
            points = Results(self.path).points  # with those of other sweeps
            last = dict.fromkeys(keys)
            order = [*(key for key in points if key not in last), *last]
            if order != list(points):
                lines = (points[key].model_dump_json() + "\n" for key in order)
                with whole_file(self.path, BuildError) as partial:
                    partial.write_text("".join(lines), encoding="utf-8")


_MOST_LOST: Final = 0.5
"""Maximum share of runs without a posterior, for a machine to be on the Pareto front."""


def pareto(points: Sequence[Point]) -> list[Point]:
    """Return the Pareto front of total variation, cycles and ALMs.

    Leave out machines that return no posterior in more than half of their runs.
    """
    judged = [
        (each, (each.total_variation, each.cycles_median, math.inf if each.alms is None else each.alms))
        for each in points
        if each.without <= _MOST_LOST
    ]
    return [
        point
        for point, own in judged
        if not any(
            other != own and all(a <= b for a, b in zip(other, own, strict=True)) for _, other in judged
        )
    ]


def table(points: Sequence[Point], front: Sequence[Point]) -> str:
    """Return the points of a sweep as a text table. A star marks each point of `front`."""
    keys = {point.key for point in front}
    rows = [
        (
            "  scale    rng     steps  codes  target  total variation (95 %), alone     by codes    same MAP, alone    KL bits"
            "   z rms  without   cycles      95 %     ALMs  blocks  fits"
        )
    ]
    for point in sorted(points, key=lambda each: (each.cycles_median, each.total_variation)):
        variation = (
            f"{point.total_variation:.4f} ({point.total_variation_low:.4f}..{point.total_variation_high:.4f})"
        )
        variation += f"  {_cell(point.alone_total_variation, '.4f'):>6}"
        same = f"{point.map_agreement:.0%}  {_cell(point.alone_map_agreement, '.0%'):>5}"
        rows.append(
            ("* " if point.key in keys else "  ")
            + f"{point.scale:8} {point.rng:7} {point.steps_per_clock:5d}  {point.prob_bits:5d}  "
            f"{point.target_count:6d}  {variation:>31}  {point.quantising:11.4f}  {same:>17}  {_cell(point.kl_bits, '.4f'):>9}  "
            f"{_cell(point.z_rms, '.2f'):>6}  {point.without:7.1%}  "
            f"{point.cycles_median:7,.0f}  {point.cycles_95:8,.0f}  {_cell(point.alms, ',.0f'):>7}  {_cell(point.blocks, ','):>6}  "
            f"{'-' if point.fits is None else 'yes' if point.fits else 'no':>4}"
        )
    rows.append(
        "A frame without a posterior counts as a total variation of 1 and a wrong MAP; 'alone' is over the others."
    )
    rows.append(
        "* no other machine is better in one of total variation, cycles and ALMs, and as good in the others; none for a "
        "machine without a posterior in most runs"
    )
    return "\n".join(rows) + "\n"


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


COLOURS: Final = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#bbbbbb")
MARKERS: Final = "osD^v<>P"
_SUFFIXES: Final = (".png", ".svg", ".pdf")
_KINDS_INSIDE: Final = 5
"""Maximum number of entries of a legend inside the axes, because a longer one would cover points."""


def check_plot(path: Path) -> None:
    """Check before a long run that a picture can be written to `path`. Raise a BuildError if not."""
    if path.suffix not in _SUFFIXES:
        raise BuildError(
            f"{path} is not the name of a picture; expected a name that ends in {', '.join(_SUFFIXES)}"
        )
    there = path.exists()
    with file_errors(path, "written", BuildError, "; name another file"):
        path.open("ab").close()
        if not there:
            path.unlink()


def draw_sweep(path: Path, name: str, points: Sequence[Point], front: Sequence[Point]) -> None:
    """Plot total variation against cycles. A larger dot has more ALMs, and a circle marks each point of `front`."""
    largest = max((point.alms or 0.0 for point in points), default=0.0) or 1.0
    kinds = sorted({(point.scale, point.rng) for point in points})
    beside = len(kinds) > _KINDS_INSIDE
    is_stepped = len({point.steps_per_clock for point in points}) > 1
    figure = new_figure(10.2 if beside else 7.2, 4.8)
    axes = figure.subplots()
    for at, (scale, rng) in enumerate(kinds):
        of_kind = [point for point in points if (point.scale, point.rng) == (scale, rng)]
        axes.scatter(
            [point.cycles_median for point in of_kind],
            [point.total_variation for point in of_kind],
            s=[20 + 120 * (point.alms or 0.0) / largest for point in of_kind],
            color=COLOURS[at % len(COLOURS)],
            marker=MARKERS[at % len(MARKERS)],
            alpha=0.6,
            label=f"{rng}, scale {scale}",
        )
    axes.scatter(
        [point.cycles_median for point in front],
        [point.total_variation for point in front],
        s=220,
        facecolors="none",
        edgecolors="black",
        linewidths=0.8,
        label="Pareto front",
    )
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="cycles of a frame (median)",
        ylabel="total variation to exact inference (mean)",
        title=f"{name}: accuracy against cycles; the larger, the more ALMs\n"
        f"(numbers: bits of a code, target count{', steps' * is_stepped})",
    )
    axes.margins(x=0.15)  # room for the names beside the last points
    axes.tick_params(which="minor", labelsize=6)
    axes.grid(alpha=0.3, which="both")
    steps = [f", {point.steps_per_clock}" * is_stepped for point in points]
    names = [
        f"{point.prob_bits}, {point.target_count}{more}" for point, more in zip(points, steps, strict=True)
    ]
    places = [(point.cycles_median, point.total_variation) for point in points]
    _name_points(axes, sorted(zip(places, names, strict=True), key=lambda each: -each[0][1]))
    if beside:
        figure.legend(loc="outside right center", fontsize="small", frameon=False)
    else:
        axes.legend(fontsize="small", frameon=False)
    save_figure(figure, path, dpi=120)


def _name_points(axes: Any, names: Iterable[tuple[tuple[float, float], str]]) -> None:
    """Write names beside points, beginning with the highest point.

    If a name would cover another name, the name is written lower, with a line to the point.
    """
    line = 9.5
    dots = axes.figure.dpi / 72
    axes.get_xlim()  # sets the limits, on which the places depend
    taken: list[tuple[float, float, str]] = []
    for place, name in names:
        x, y = axes.transData.transform(place) / dots
        if any(
            name == other and abs(x - left) < line and abs(y - high) < line for left, high, other in taken
        ):
            continue  # the same machine, except for the generator
        low = y
        while any(abs(x - left) < 5 * line and abs(low - high) < line for left, high, _ in taken):
            low -= 1
        taken.append((x, low, name))
        to_point = None if low == y else {"arrowstyle": "-", "linewidth": 0.3, "relpos": (0, 0.5)}
        at_point = {"xytext": (8, low - y - 2), "textcoords": "offset points", "fontsize": 6.5}
        axes.annotate(name, place, arrowprops=to_point, **at_point)


@dataclass(frozen=True, slots=True)
class Task:
    """A machine to measure, and the key of its point in the results file."""

    plan: MachinePlan
    key: str


def _fingerprint(model: Model, readings: Readings) -> str:
    """Return a hash of the model and of the readings."""
    select = [] if model.prior_select is None else [model.prior_select.table]
    tables = [*(known.table for known in model.known), model.prior_distribution, *select]
    arrays = (*tables, readings.addresses, readings.prior_addresses)
    return hashlib.sha256(b"".join(each.tobytes() for each in arrays)).hexdigest()


def tasks(model: Model, sweep: Sweep, readings: Readings, device: Device) -> list[Task]:
    """Return a task for each machine of a sweep that can be built. Raise a BuildError if there is no such machine."""
    found: dict[str, Task] = {}
    refused, inputs = "", _fingerprint(model, readings)
    for options in sweep.options():
        try:
            plan = plan_machine(model, options)
            board_layout(plan.parameters, options.partitions, None)
        except BuildError as reason:
            refused = refused or str(reason)
            continue
        words = {
            "inputs": inputs,
            "parameters": str(plan.parameters),
            "scale": options.scale,
            "target": options.target_count,
            "max_cycles": options.max_cycles,
            "stop": options.stop,
            "partitions": options.partitions,
            "banks": sweep.banks,
            "device": device.name,
        }
        key = hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()
        # `--steps 0` and the number of steps that it selects give the same machine
        found.setdefault(key, Task(plan, key))
    if not found:
        raise BuildError(f"none of these machines can be built: {refused}")
    return list(found.values())


def run_task(task: Task, readings: Readings, device: Device, banks: int) -> Point:
    """Measure one machine, or raise a ToolchainError if the machine cannot be built or run."""
    model, options, parameters = task.plan.model, task.plan.options, task.plan.parameters
    quantised = quantise(model, prob_bits=task.plan.parameters.prob_bits, scale=options.scaling)
    machines = split(whole_machine(task.plan, quantised), options.partitions)
    boards = EmulatedBoards(
        machines, target_count=task.plan.target_count, max_cycles=task.plan.max_cycles, stop=options.stop
    )
    accuracy = measure(boards, readings, model, banks=banks)
    # not None, because there is a model to compare with
    machine, quantising = cast("Difference", accuracy.machine), cast("Difference", accuracy.quantising)
    alone = machine.alone
    point = Point(
        key=task.key,
        scale=options.scaling.value,
        rng=options.rng.value,
        steps_per_clock=parameters.steps_per_clock,
        prob_bits=parameters.prob_bits,
        target_count=task.plan.target_count,
        counter_bits=parameters.counter_bits,
        partitions=options.partitions,
        frames=accuracy.frames,
        total_variation=machine.total_variation.value,
        total_variation_low=machine.total_variation.low,
        total_variation_high=machine.total_variation.high,
        quantising=quantising.total_variation.value,
        map_agreement=machine.map_agreement.value,
        alone_total_variation=None if alone is None else alone.total_variation.value,
        alone_map_agreement=None if alone is None else alone.map_agreement.value,
        kl_bits=alone.kl_bits.value if alone and alone.kl_bits else None,
        z_rms=None if accuracy.z is None else accuracy.z.rms.value,
        without=accuracy.without,
        cycles_median=accuracy.cycles.median.value,
        cycles_95=accuracy.cycles.percentile_95.value,
        alms=None,
        blocks=None,
        fits=None,
    )
    return with_resources(task, point, device)


def with_resources(task: Task, point: Point, device: Device) -> Point:
    """Return a point with a new estimate of the resources of the machine's largest board."""
    parameters, options = task.plan.parameters, task.plan.options
    if options.rng is RngKind.IDEAL:
        return point
    largest = replace(parameters, lines=partition_lines(parameters.lines, options.partitions)[0].lines)
    took = estimate(largest, device, inputs=(options.interface or (0, 0))[0])
    update = {"alms": took.alms, "blocks": took.memories.blocks, "fits": took.fits}
    return point.model_copy(update=update)


@dataclass(frozen=True, slots=True)
class SweepJob:
    """A sweep as a job in pieces. Piece n measures the machine of task n."""

    tasks: Sequence[Task]
    readings: Readings
    device: Device
    banks: int

    def prepare(self) -> Work:
        """Return the function that measures a machine."""
        return lambda number: run_task(self.tasks[number], self.readings, self.device, self.banks)


def run_sweep(job: SweepJob, run: Run, results: Results, advance: Callable[[Point], None]) -> None:
    """Measure each machine that has no stored result, and store its point as soon as it is measured.

    `advance` receives every point, including points that were stored before. At the end, the points stand in the file
    in the order of the tasks, whichever process measured them.
    """
    left = [number for number, task in enumerate(job.tasks) if task.key not in results.points]
    for key in (task.key for task in job.tasks if task.key in results.points):
        advance(results.points[key])

    def keep(_: int, point: Point) -> None:
        results.append(point)
        advance(point)

    run(job, left, keep)
    if left:
        results.sort([task.key for task in job.tasks])
