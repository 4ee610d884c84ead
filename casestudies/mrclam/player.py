"""Player of a robot's recorded sightings of landmarks. It compares posteriors with the robot's reference positions.

python -m casestudies.mrclam.player DATA_DIR/ds1_robot3.csv --uri ws://127.0.0.1:9090
"""

import contextlib
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from statistics import median
from typing import Annotated, Final

import typer

from bridge.client import Publication, connect
from bridge.client.protocol import RosVersion
from bridge.stamps import header
from casestudies import DEFAULT_URI, Uri
from casestudies.grid import Grid
from casestudies.topics import Instance, Listener, listen
from posteriors.errors import BadResultError, NoResultError
from posteriors.posterior import Posterior
from terminal.command_line import CommandLine
from terminal.connection import report_connection
from terminal.output import check_writable, say, write_json
from terminal.signals import run_async
from toolchain.errors import ModelError
from toolchain.learning import recording

SIGHTINGS_TOPIC: Final = "/mrclam/sightings"
SIGHTINGS_TYPE: Final = "mrclam_msgs/Sightings"
MAP_FRAME: Final = "map"
LANDMARKS: Final = range(6, 21)
"""The numbers of the 15 landmarks. They start at 6, because the data set gives the numbers 1 to 5 to robots."""

SIGHTINGS_MSG: Final = (
    "# mrclam_msgs/Sightings: range (m) and absolute bearing (rad, counter-clockwise from +x) of the landmarks "
    "seen.\n# NaN where a landmark was not seen; a client without message definitions leaves the field out.\n"
    "std_msgs/Header header\n"
    + "".join(f"float64 range_{number}\nfloat64 bearing_{number}\n" for number in LANDMARKS)
)

_REFERENCE_COLUMNS: Final = ("ref_x_m", "ref_y_m")


def area_grid(width: int = 32, height: int = 32) -> Grid:
    """Return the grid of cells over the experiment's area: x in [-2, 7] m, y in [-7, 7] m."""
    return Grid(x_low=-2.0, x_high=7.0, y_low=-7.0, y_high=7.0, width=width, height=height)


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedFrame:
    """A robot's sightings of landmarks in one second, and the robot's reference position in metres."""

    number: int
    x: float
    y: float
    readings: Mapping[str, float]
    """Ranges in metres and absolute bearings in radians of the seen landmarks. Keys are names such as `range_6`."""


def read_recording(path: Path) -> tuple[RecordedFrame, ...]:
    """Return the frames of a file such as `ds1_robot3.csv`. A ModelError names the wrong row or column."""
    pairs = {landmark: (f"range_{landmark}_m", f"bearing_{landmark}_rad") for landmark in LANDMARKS}
    columns = recording.read_recording(path, (*_REFERENCE_COLUMNS, *chain(*pairs.values()))).columns
    frames = []
    for number, row in enumerate(zip(*columns.values(), strict=True), start=1):
        cells: dict[str, float] = {}
        for column, cell in zip(columns, row, strict=True):
            if isinstance(cell, float) and math.isfinite(cell):
                cells[column] = cell
            elif cell is not None or column in _REFERENCE_COLUMNS:
                raise ModelError(f"{path}, row {number}: {column} must be a number, not {cell!r}")
        readings: dict[str, float] = {}
        for landmark, pair in pairs.items():
            seen = [cells[column] for column in pair if column in cells]
            if len(seen) == 1:
                raise ModelError(
                    f"{path}, row {number}: landmark {landmark} has a range or a bearing, but not both"
                )
            readings |= zip((f"range_{landmark}", f"bearing_{landmark}"), seen, strict=False)
        x, y = (cells[column] for column in _REFERENCE_COLUMNS)
        frames.append(RecordedFrame(number=number, x=x, y=y, readings=readings))
    return tuple(frames)


LOST_DISTANCE: Final = 9.0
"""Distance in metres that counts for a frame without a result. It equals the width of the area."""
_REPEAT_S: Final = 1.0
"""Seconds between publications of the first frame, until its result arrives."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayedFrame:
    """A recorded frame with its published posterior, or with the reason why it has no posterior."""

    frame: RecordedFrame
    posterior: Posterior | None = None
    cycles: int | None = None
    outcome: str

    def estimate(self) -> tuple[float, float] | None:
        """Return the posterior's mean (x, y) in metres, or None without a posterior.

        Raises a BadResultError if the posterior does not have two axes, y and x.
        """
        if self.posterior is None:
            return None
        if len(self.posterior.sizes) != 2:
            raise BadResultError(
                f"the posterior has {' x '.join(map(str, self.posterior.sizes))} values instead of one for each cell over "
                "y and x: is this the deployment of casestudies/mrclam?"
            )
        height, width = self.posterior.sizes
        return area_grid(width, height).mean(self.posterior.probabilities)

    def distance(self) -> float:
        """Return the distance in metres from the estimate to the reference, or `LOST_DISTANCE` without an estimate."""
        estimate = self.estimate()
        return LOST_DISTANCE if estimate is None else math.dist(estimate, (self.frame.x, self.frame.y))


def median_distance(played: Sequence[PlayedFrame]) -> float:
    """Return the median of the frames' distances to the reference position, in metres."""
    return median(frame.distance() for frame in played)


async def play(
    uri: str,
    frames: Sequence[RecordedFrame],
    *,
    topic: str = SIGHTINGS_TOPIC,
    first_timeout_s: float = 30.0,
    timeout_s: float = 10.0,
    on_frame: Callable[[PlayedFrame], None] = lambda _: None,
) -> list[PlayedFrame]:
    """Publish each frame, wait for its result before the next one, and return the played frames in order.

    A frame's stamp is the time of publication, and the frame's result has this stamp too. The first frame is
    published every second until its result arrives, because the master may not have subscribed yet. The later frames
    are published only once each. A later frame without a result after `timeout_s` counts as lost.

    Raises:
        NoResultError: The first frame had no result.
        BadResultError: A message was not a result.
        BridgeError: No rosbridge server answers at the URI, or the connection was lost.
    """
    played: list[PlayedFrame] = []
    async with connect(uri, retry=True, on_state=report_connection(uri)) as ros, listen(ros) as listener:
        version = await ros.detect_ros_version()
        publication = await ros.advertise(topic, SIGHTINGS_TYPE)
        for frame in frames:
            first = not played
            instance = await _take_turn(
                frame,
                publication,
                listener,
                version,
                limit_s=first_timeout_s if first else timeout_s,
                repeat_s=_REPEAT_S if first else math.inf,
            )
            if first and instance is None:
                raise NoResultError(
                    f"the first frame on {topic} had no result from {uri} within {first_timeout_s:g} s: "
                    "is the master running, with the deployment of casestudies/mrclam?"
                )
            outcome = PlayedFrame(frame=frame, outcome=f"no result within {timeout_s:g} s")
            if instance is not None and (report := instance.report) is not None:
                outcome = PlayedFrame(
                    frame=frame, posterior=instance.posterior, cycles=report.cycles, outcome=report.outcome
                )
            played.append(outcome)
            on_frame(outcome)
    return played


async def _take_turn(
    frame: RecordedFrame,
    publication: Publication,
    listener: Listener,
    version: RosVersion | None,
    *,
    limit_s: float,
    repeat_s: float,
) -> Instance | None:
    """Publish a frame, and wait for the result. Return the result, or None if it does not arrive in `limit_s` seconds.

    Until the result arrives, the frame is published again every `repeat_s` seconds.
    """
    stamps: set[int] = set()
    end = time.monotonic() + limit_s
    while (now := time.monotonic()) < end:
        stamp_ns = time.time_ns()
        stamps.add(stamp_ns)
        await publication.publish({"header": header(stamp_ns, MAP_FRAME, version), **frame.readings})
        again = min(end, now + repeat_s)
        with contextlib.suppress(NoResultError):
            while True:
                instance = await listener.next(max(again - time.monotonic(), 0.0))
                if instance.report is not None and instance.report.stamp_ns in stamps:
                    return instance
    return None


def _line(played: PlayedFrame) -> str:
    """Return the line to print for a frame."""
    frame = played.frame
    seen = len(frame.readings) // 2
    start = f"{frame.number:>5}  {seen:>4}  ({frame.x:6.3f}, {frame.y:6.3f})"
    estimate = played.estimate()
    if estimate is None:
        return f"{start}  {played.outcome or 'no posterior: no reason given'}"
    cycles = "-" if played.cycles is None else str(played.cycles)
    return f"{start}  ({estimate[0]:6.3f}, {estimate[1]:6.3f})  {played.distance():>12.3f}  {cycles:>7}"


_HEADING: Final = "frame  seen  reference (m)       estimate (m)      distance (m)   cycles"


app = CommandLine()


@app.command(epilog="`python -m casestudies.mrclam.player data/ds1_robot3.csv --count 20`")
def player(
    path: Annotated[
        Path | None,
        typer.Argument(help="A file like ds1_robot3.csv.", show_default=False, metavar="RECORDING"),
    ] = None,
    uri: Uri = DEFAULT_URI,
    topic: Annotated[str, typer.Option(help="Topic of the sightings.", metavar="TOPIC")] = SIGHTINGS_TOPIC,
    count: Annotated[
        int | None, typer.Option(min=1, help="Play this many frames.", show_default="all")
    ] = None,
    first_timeout: Annotated[float, typer.Option(min=0.1, help="Seconds until the first result.")] = 30.0,
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds until any other result.")] = 10.0,
    numbers: Annotated[
        Path | None, typer.Option("--json", help="Write the numbers to this file, as one JSON object.")
    ] = None,
    print_msg: Annotated[
        bool, typer.Option("--print-msg", help="Print the .msg file of mrclam_msgs/Sightings and exit.")
    ] = False,
) -> None:
    """Play a robot's recorded sightings of landmarks, and compare posteriors with the robot's reference positions.

    Each frame is published after the result of the previous frame.
    """
    if print_msg:
        print(SIGHTINGS_MSG, end="")
        return
    if path is None:
        raise typer.BadParameter("name a file like ds1_robot3.csv", param_hint="RECORDING")
    frames = read_recording(path)[:count]
    if numbers is not None:
        check_writable(numbers.parent)
    played: list[PlayedFrame] = []

    def show(frame: PlayedFrame) -> None:
        played.append(frame)
        print(_line(frame), flush=True)

    async def body() -> None:
        say(f"player: {len(frames)} frames of {path} to {topic}, {uri}")
        print(_HEADING, flush=True)
        await play(uri, frames, topic=topic, first_timeout_s=first_timeout, timeout_s=timeout, on_frame=show)

    run_async(body())
    without = sum(frame.posterior is None for frame in played)
    print(
        f"{len(played)} frames, {without} without a result, median distance "
        f"{median_distance(played):.3f} m (a frame without a result counts as {LOST_DISTANCE:g} m)",
        flush=True,
    )
    if numbers is not None:
        figures = {
            "frames": len(played),
            "without_result": without,
            "median_distance_m": median_distance(played),
            "distances_m": [frame.distance() for frame in played],
            "cycles": [frame.cycles for frame in played],
        }
        write_json(numbers, figures)


if __name__ == "__main__":
    app()
