"""Real robot data through the whole stack: distance between each posterior's mean and the reference.

recording --> player --> hub --> master and its processes, one deployment for both robots --> hub --> player
"""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casestudies.demo import build
from casestudies.mrclam.model import BEARING_SIGMA, FLOOR, RANGE_SIGMA, Landmark, model, read_landmarks
from casestudies.mrclam.player import RecordedFrame, area_grid, median_distance, play, read_recording
from scripts.running.flags import ScriptParser
from scripts.running.script import ROOT, print_table
from scripts.running.stand import Stand, temporary_stand
from terminal.processes import Process
from toolchain.deployment.address import to_address
from toolchain.models import Model, exact_posterior
from toolchain.models.model import fuse

TOPIC, TYPE = "/mrclam/sightings", "mrclam_msgs/Sightings"
RECORDINGS = ("ds1_robot3.csv", "ds1_robot5.csv")
BOUND = 1.15
"""Limit of the stack's median distance, as a multiple of the median distance by float64 fusion."""
MAX_CYCLES = 2**22
"""Limit of cycles, above 2^17, because in frames with three outliers the best line counts once in 4e5 cycles."""

Figures = dict[str, Any]
"""Figures of one robot's run with one model, by column; distances are in metres, `exact` ones by float64 inference."""


LandmarkReading = tuple[float | None, float | None]
"""Range in metres and absolute bearing in radians (in any turn) of one landmark. A missing value is None."""


def unquantised_posterior(
    landmarks: Sequence[Landmark],
    readings: Sequence[LandmarkReading],
    *,
    width: int = 32,
    height: int = 32,
    floor: float = FLOOR,
) -> NDArray[np.float64]:
    """Return the posterior over the cells, float64[width * height] with line = y * width + x.

    There is one reading for each landmark, in the same order. `floor` is the density of outliers, equal everywhere,
    as a share of the normal's peak. If it is 0, readings that are impossible on every line raise a ModelError.
    """
    grid = area_grid(width, height)
    rows = grid.y_low + (np.arange(height) + 0.5) * grid.cell_height
    columns = grid.x_low + (np.arange(width) + 0.5) * grid.cell_width
    y, x = np.repeat(rows, width), np.tile(columns, height)
    factors = []
    for landmark, (range_m, bearing_rad) in zip(landmarks, readings, strict=True):
        if range_m is not None:
            away = range_m - np.hypot(landmark.x - x, landmark.y - y)
            factors.append(np.exp(-0.5 * (away / RANGE_SIGMA) ** 2) + floor)
        if bearing_rad is not None:
            away = bearing_rad - np.arctan2(landmark.y - y, landmark.x - x)
            away = (away + np.pi) % (2 * np.pi) - np.pi
            factors.append(np.exp(-0.5 * (away / BEARING_SIGMA) ** 2) + floor)
    return fuse(np.ones(width * height), factors)


def exact_distance(
    frame: RecordedFrame, landmarks: tuple[Landmark, ...], cells: int, fitted: Model | None
) -> float:
    """Return the distance from the reference to the mean of exact inference (float64, without quantising)."""
    values, posterior = frame.readings, np.empty(0)
    if fitted is None:
        readings = [
            (values.get(f"range_{each.number}"), values.get(f"bearing_{each.number}")) for each in landmarks
        ]
        posterior = unquantised_posterior(landmarks, readings, width=cells, height=cells)
    else:
        addresses = [to_address(known.as_variable(), values.get(known.name)) for known in fitted.known]
        posterior = exact_posterior(fitted, addresses)
    return math.dist(area_grid(cells, cells).mean(posterior.tolist()), (frame.x, frame.y))


async def fit(arguments: argparse.Namespace) -> Model:
    """Return the model with the fitted tables in the file `arguments.fit`.

    If the file does not exist, the model is first fitted to robot 3. Raises a ProcessError if the fit fails.
    """
    landmarks = arguments.data / "landmarks.csv"
    if not arguments.fit.exists():
        print(f"learning {arguments.fit} from {RECORDINGS[0]} ...", file=sys.stderr)
        arguments.fit.parent.mkdir(parents=True, exist_ok=True)
        toolchain = Process("toolchain fit", arguments.fit.with_name(arguments.fit.name + ".log"))
        await toolchain.start(
            *("toolchain", "fit", str(ROOT / "casestudies" / "mrclam"), str(arguments.data / RECORDINGS[0])),
            *("-o", str(arguments.fit), "--set", f"landmarks={landmarks}"),
            *("--truth", "y=ref_y_m", "--truth", "x=ref_x_m", "--pool", "range_*", "--pool", "bearing_*"),
            *("--reading", "range_*=range_*_m", "--reading", "bearing_*=bearing_*_rad"),
        )
        await toolchain.succeed()
    return model(landmarks, arguments.cells, arguments.cells, fit=arguments.fit)


async def run_stack(
    stand: Stand, arguments: argparse.Namespace, names: tuple[str, ...], fitted: Model | None
) -> list[Figures]:
    """Build a model, and play recordings through a stack that runs it."""
    title, cells = "by hand" if fitted is None else "fitted", arguments.cells
    landmarks = read_landmarks(arguments.data / "landmarks.csv")
    settings = {"landmarks": arguments.data / "landmarks.csv", "width": cells, "height": cells}
    if fitted is not None:
        settings["fit"] = arguments.fit
    options = [word for name, value in settings.items() for word in ("--set", f"{name}={value}")]
    deployment = stand.folder / title.replace(" ", "-")
    await build("mrclam", deployment, stand.uri, TOPIC, TYPE, "--max-cycles", str(MAX_CYCLES), *options)
    await stand.start_master(deployment)
    found = []
    for name in names:
        frames = read_recording(arguments.data / name)
        print(f"playing {name}: {len(frames)} frames, {title} ...", file=sys.stderr)
        played = await play(stand.uri, frames)
        for each in played:
            if each.posterior is None:
                print(f"{name}, frame {each.frame.number}: {each.outcome}", file=sys.stderr)
        exact = [exact_distance(frame, landmarks, cells, fitted) for frame in frames]
        found.append(
            {
                "recording": name,
                "model": title,
                "frames": len(played),
                "no result": sum(each.posterior is None for each in played),
                "stack median": median_distance(played),
                "mean": fmean(each.distance() for each in played),
                "exact median": median(exact),
                "exact mean": fmean(exact),
                "ratio of medians": median_distance(played) / median(exact),
                "cycles": median(each.cycles for each in played if each.cycles is not None),
            }
        )
    await stand.end("master")
    return found


async def bench(arguments: argparse.Namespace) -> int:
    """Play recordings through stacks; return 1 if a robot exceeds `BOUND`, or learnt tables are no better."""
    arguments.data = arguments.data.resolve()  # for the processes of the run
    arguments.fit = arguments.fit and arguments.fit.resolve()
    for name in RECORDINGS:
        read_recording(arguments.data / name)  # refuse an invalid recording before anything starts
    fitted = None if arguments.fit is None else await fit(arguments)
    names = RECORDINGS if fitted is None else RECORDINGS[1:]
    async with temporary_stand() as stand:
        await stand.start_hub()
        found = await run_stack(stand, arguments, names, None)
        if fitted is not None:
            found += await run_stack(stand, arguments, names, fitted)
    print_table(
        "distance of the posterior's mean to the reference position, in metres",
        list(found[0]),
        [[f"{each:.3f}" if isinstance(each, float) else str(each) for each in row.values()] for row in found],
        left=2,
    )
    if fitted is not None:
        by_hand, learnt = found
        better = learnt["mean"] < by_hand["mean"]
        print(
            f"learnt on {RECORDINGS[0]}, judged on {RECORDINGS[1]}: mean {learnt['mean'] / by_hand['mean']:.2f} of "
            f"that by hand: the fitted tables are {'' if better else 'NOT '}better"
        )
        return 0 if better else 1
    beyond = [each["recording"] for each in found if each["ratio of medians"] > BOUND]
    print(f"bound: {BOUND} of float64's; {f'beyond it: {beyond}' if beyond else 'held by both'}")
    return 1 if beyond else 0


def cells(text: str) -> int:
    """Return the value of --cells, the width and height of the grid; at most 128, because four boards hold 4 x 4096."""
    if not 1 <= int(text) <= 128:
        raise argparse.ArgumentTypeError("must be 1 to 128")
    return int(text)


if __name__ == "__main__":
    parser = ScriptParser(
        "scripts/bench mrclam",
        "Replay the data of recorded robots through the whole stack, and compare with float64.",
    )
    parser.add_argument(
        "data", type=Path, help="folder with landmarks.csv and ds1_robot3.csv, ds1_robot5.csv"
    )
    parser.flag(
        "--fit",
        "on robot 5, compare tables set by hand with tables learnt on robot 3; if FILE does not exist, they are "
        "learnt now and written to it",
        type=Path,
    )
    parser.flag("--cells", "number of cells along x, and along y", 32, type=cells, metavar="NUMBER")
    parser.run(bench, 600)
