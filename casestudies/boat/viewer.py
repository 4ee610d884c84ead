"""Viewer of the boat's posteriors, true positions and frame reports, each received from its own topic."""

import math
from collections import deque
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias

import typer

from casestudies import DEFAULT_URI, KEPT, Count, FirstTimeout, Timeout, Uri
from casestudies.boat.sensors import TRUE_POSE_TOPIC
from posteriors.errors import NoResultError
from terminal.command_line import CommandLine
from terminal.output import check_writable, say, warn, write_json
from toolchain.errors import counted

if TYPE_CHECKING:
    from collections.abc import Iterable

    from casestudies.boat.pictures import StageShare
    from casestudies.topics import Instance, Truth

POSITIONS_PICTURE: Final = "figure-4.4.png"
SHARES_PICTURE: Final = "figure-4.5.png"
PROJECTED_PICTURE: Final = "figure-4.5-projected.png"
CLOCK_HZ: Final = 100e6
"""Assumed clock of real boards in hertz, as in `toolchain inspect`. The thesis does not state a clock."""
Clock: TypeAlias = Annotated[
    float,
    typer.Option(
        "--clock", min=1, max=1e12, help=f"Clock of the boards in {PROJECTED_PICTURE}.", metavar="HERTZ"
    ),
]
HEADING: Final = "frame     true x, y     mean x, y  distance     cycles   time (ms)"


Numbers = dict[str, Any]
"""A frame as a JSON object. An unknown value is None."""


def numbers_of(instance: "Instance") -> Numbers:
    """Return a frame as a JSON object, or raise an OutputError if its posterior is not over a map.

    `true_cell` and `mean` are indices of cells, counted from the lower left corner as in `listen --json`.
    `true_position` and `mean_value` are positions in map units. `distance_cells` is the distance from the
    posterior's mean to the centre of the true cell.
    """
    from casestudies.boat.pictures import posterior_grid
    from casestudies.boat.sensors import map_grid

    truth, posterior, report = instance.truth, instance.posterior, instance.report
    grid = map_grid() if posterior is None else posterior_grid(posterior)
    places: Numbers = dict.fromkeys(
        ("true_position", "true_position_age_ms", "true_cell", "mean", "mean_value", "distance_cells")
    )
    if truth is not None:
        column, row = grid.cell(truth.x, truth.y)
        places["true_position"] = {"x": truth.x, "y": truth.y}
        places["true_position_age_ms"] = instance.truth_age_ns / 1e6
        places["true_cell"] = {"x": column, "y": row}
    if posterior is not None:
        x, y = grid.mean(posterior.probabilities)
        mean = (x - grid.x_low) / grid.cell_width - 0.5, (y - grid.y_low) / grid.cell_height - 0.5
        places["mean"] = dict(zip(("x", "y"), mean, strict=True))
        places["mean_value"] = {"x": x, "y": y}
        if truth is not None:
            places["distance_cells"] = math.dist((column, row), mean)
    latency_us = posterior.latency_us if posterior else None
    return {
        "frame": report.number if report else None,
        "stamp_ns": report.stamp_ns if report else None,
        **places,
        "cycles": report.cycles if report else None,
        "counts_total": report.counts_total if report else None,
        "boards_compute_us": report.stages.boards_compute if report else None,
        "time_ms": None if latency_us is None else latency_us / 1000,
        "outcome": report.outcome if report else "",
        "boards": [
            {"name": b.name, "stopped": b.stopped, "cycles": b.cycles}
            for b in (report.boards if report else ())
        ],
    }


def line(numbers: Numbers) -> str:
    """Return the line printed for a frame, aligned with the columns of `HEADING`."""

    def shown(key: str, form: str, unknown: str = "-") -> str:
        value = numbers[key]
        if isinstance(value, dict):
            return f"{value['x']:{form}}, {value['y']:{form}}"
        return unknown if value is None else f"{value:{form}}"

    start = f"{shown('frame', 'd'):>5}  {shown('true_position', '.1f', 'not known'):>12}"
    if numbers["mean_value"] is None:
        return f"{start}  {numbers['outcome'] or 'no posterior: no reason given'}"
    times = f"{shown('cycles', 'd'):>9}  {shown('time_ms', '.2f'):>10}"
    return f"{start}  {shown('mean_value', '.1f'):>12}  {shown('distance_cells', '.2f'):>8}  {times}"


class BoatViewer:
    """The frames that arrive while the viewer runs, and the pictures drawn from the frames.

    Attributes:
        instances: The frames, the newest last. If the viewer runs until Ctrl-C, only the last `KEPT` frames are stored.
        numbers: Each stored frame as a JSON object.
        frames: The number of frames that have arrived.
        results: The number of frames that have a posterior.
    """

    def __init__(self, count: int | None, clock_hz: float = CLOCK_HZ) -> None:
        """Start without frames. `count` is the number of results to wait for, or None to run until Ctrl-C."""
        self.count = count
        self.clock_hz = clock_hz
        kept = KEPT if count is None else None
        self.instances: deque[Instance] = deque(maxlen=kept)
        self.route: tuple[Truth, ...] = ()
        self.numbers: deque[Numbers] = deque(maxlen=kept)
        self.frames = 0
        self.results = 0

    def add(self, instance: "Instance") -> str:
        """Add a frame, and return the line to print for the frame."""
        self.instances.append(instance)
        self.numbers.append(numbers_of(instance))
        self.frames += 1
        self.results += instance.posterior is not None
        return line(self.numbers[-1])

    async def watch(
        self, uri: str, *, truth_topic: str, truth_tolerance_s: float, first_limit_s: float, limit_s: float
    ) -> None:
        """Listen and print a line for each frame, until `self.count` results have arrived.

        Raises:
            NoResultError: No result came in time.
            BadResultError: A message was not a result.
            BridgeError: No rosbridge server answers at the URI.
        """
        from casestudies.topics import connected, listen

        async with (
            connected("boat-viewer", "a result was shown", uri) as (ros, readiness),
            listen(ros, truth_topic=truth_topic, truth_tolerance_s=truth_tolerance_s) as listener,
        ):
            say(f"boat-viewer: listening to {uri}")
            print(HEADING, flush=True)
            try:
                while self.count is None or self.results < self.count:
                    print(
                        self.add(await listener.next(limit_s if self.numbers else first_limit_s)), flush=True
                    )
                    readiness.record()
            except NoResultError as error:
                if not self.numbers:
                    raise
                raise NoResultError(f"after {counted(self.results, 'result')}, {error}") from None
            finally:
                self.route = tuple(listener.route)
                if listener.announced_only:
                    warn(f"frames on /bm/frame without their result: {listener.announced_only}")

    def draw(self, folder: Path) -> tuple[Path, ...]:
        """Write the pictures into `folder` and return their paths, or raise an OutputError."""
        from casestudies.boat.pictures import (
            PCIE,
            THESIS_SHARES,
            draw_positions,
            draw_shares,
            far_apart,
            mean_link_us,
            projected_shares,
            stage_shares,
        )

        written = []
        if chosen := far_apart(self.instances):
            written.append(folder / POSITIONS_PICTURE)
            draw_positions(written[-1], chosen, route=self.route)
        if shares := stage_shares(self.instances):
            written.append(folder / SHARES_PICTURE)
            draw_shares(written[-1], shares, frames=self.results)
        if shares := projected_shares(self.instances, self.clock_hz):
            written.append(folder / PROJECTED_PICTURE)
            jtag = mean_link_us(self.instances, "jtag") - mean_link_us(self.instances, PCIE)
            draw_shares(
                written[-1],
                shares,
                frames=self.results,
                title="Projected for hardware",
                note=f"\nhost and rosbridge as measured, PCIe gen 2 as modelled (USB/JTAG: {jtag / 1000:+.2f} ms)",
                beside=THESIS_SHARES,
            )
        return tuple(written)

    def medians(self) -> tuple[float | None, float | None]:
        """Return the medians of `distance_cells` (see `numbers_of`) and of a frame's time in ms.

        A median of no values is None.
        """
        distances, times = (
            [each[key] for each in self.numbers if each[key] is not None]
            for key in ("distance_cells", "time_ms")
        )
        return median(distances) if distances else None, median(times) if times else None

    def write_numbers(self, path: Path) -> None:
        """Write the frames and the mean time of each stage as one JSON object, or raise an OutputError."""
        from casestudies.boat.pictures import projected_shares, stage_shares

        def stages(shares: "Iterable[StageShare]") -> list[Numbers]:
            return [
                {"stage": each.name, "part": each.part.value, "mean_us": each.mean_us, "share": each.share}
                for each in shares
            ]

        distance, time = self.medians()
        numbers = {
            "results": self.results,
            "frames_without_posterior": self.frames - self.results,
            "median_distance_cells": distance,
            "median_time_ms": time,
            "stages": stages(stage_shares(self.instances)),
            "projected_stages": stages(projected_shares(self.instances, self.clock_hz)),
            "frames": list(self.numbers),
        }
        write_json(path, numbers)


app = CommandLine()


@app.command(epilog="`boat-viewer --uri ws://127.0.0.1:9090 --count 25 --out out`")
def boat_viewer(
    uri: Uri = DEFAULT_URI,
    count: Count = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help=f"Write {POSITIONS_PICTURE}, {SHARES_PICTURE} and {PROJECTED_PICTURE} into this folder.",
            file_okay=False,
        ),
    ] = None,
    numbers: Annotated[
        Path | None, typer.Option("--json", help="Write the numbers to this file, as one JSON object.")
    ] = None,
    truth_topic: Annotated[
        str, typer.Option(help="Topic of the true pose.", metavar="TOPIC")
    ] = TRUE_POSE_TOPIC,
    truth_tolerance: Annotated[
        float, typer.Option(min=0, help="Seconds by which a true pose may be older than the reading.")
    ] = 0.5,
    clock: Clock = CLOCK_HZ,
    first_timeout: FirstTimeout = 60.0,
    timeout: Timeout = 30.0,
) -> None:
    """Show each posterior's mean next to the boat's true position, and draw the thesis's figures 4.4 and 4.5.

    The viewer needs only the topics /BMresults and /bm/frame, and the topic of the true pose.
    """
    from casestudies.topics import run_viewer

    viewer = BoatViewer(count, clock)
    if out is not None:
        check_writable(out)
    if numbers is not None:
        check_writable(numbers.parent)
    watching = viewer.watch(
        uri,
        truth_topic=truth_topic,
        truth_tolerance_s=truth_tolerance,
        first_limit_s=first_timeout,
        limit_s=timeout,
    )
    run_viewer(watching, partial(_finish, viewer, out, numbers))


def _finish(viewer: BoatViewer, out: Path | None, numbers: Path | None) -> None:
    """Print the summary, and write the JSON object and the pictures that were asked for."""
    if not viewer.results:
        return
    distance, time = viewer.medians()
    summary = [counted(viewer.results, "result")]
    if without := viewer.frames - viewer.results:
        summary.append(f"{without} frames without a posterior")
    if distance is not None:
        summary.append(f"median distance {distance:.2f} cells")
    if time is not None:
        summary.append(f"median time {time:.2f} ms")
    print(", ".join(summary), flush=True)
    if numbers is not None:
        viewer.write_numbers(numbers)
    if out is not None:
        for path in viewer.draw(out):
            print(f"wrote {path}", flush=True)


if __name__ == "__main__":
    app()
