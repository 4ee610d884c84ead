"""The command `toolchain infer`, which computes the posteriors of a whole recording."""

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from toolchain.cluster import SchedulerOptions, runner
from toolchain.commands.explore import progress
from toolchain.flags import BagTolerance, ReadingColumns


def infer(
    recording: Annotated[
        Path, typer.Argument(help="Recorded readings: CSV, MCAP or bag.", metavar="RECORDING")
    ],
    directory: Annotated[
        Path, typer.Option("--deployment", "-d", help="Folder written by `toolchain build`.", metavar="DIR")
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="Posteriors: .npz, or .mcap with messages on /BMresults.", metavar="FILE"
        ),
    ],
    where: SchedulerOptions,
    reading: ReadingColumns = None,
    tolerance_s: BagTolerance = 0.1,
) -> None:
    """Compute the posterior of every row of a recording, as the boards would.

    For example `toolchain infer DATA/ds1_robot3.csv -d build/mrclam -o posteriors.npz --reading 'range_*=range_*_m'
    --reading 'bearing_*=bearing_*_rad'`. To continue after Ctrl-C, run the same command again.
    """
    from toolchain.analysis.readings import recorded_frames
    from toolchain.analysis.replay import check_request, replay
    from toolchain.deployment import load_deployment

    deployment = load_deployment(directory)
    check_request(output, deployment)
    frames = recorded_frames(recording, deployment.variables, reading or (), tolerance_s=tolerance_s)

    def begun(done: int) -> None:
        there = f"; {done} of them are in {output}.frames" if done else ""
        typer.echo(f"{len(frames)} frames of {recording.name} through {deployment.name}{there}", err=True)
        for _ in range(done):
            step("")

    with runner(where) as run, progress(len(frames)) as step:
        started = time.perf_counter()
        computed, without = replay(deployment, frames, output, run, begun=begun, advance=lambda: step(""))
        seconds = time.perf_counter() - started
    print(f"{output}: {len(frames)} frames, {without} without a posterior", file=sys.stderr)
    if unfit := int((~frames.fits).sum()):
        print(f"{unfit} rows have no posterior because they do not fit: {frames.why}", file=sys.stderr)
    if computed:
        print(f"{computed} frames in {seconds:.1f} s: {computed / seconds:,.0f} frames/s", file=sys.stderr)
