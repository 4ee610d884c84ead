"""Player of a recording on a rosbridge server; it prints each posterior's distance from the reference.

python -m casestudies.mrclam.player DATA_DIR/ds1_robot3.csv --uri ws://127.0.0.1:9090
"""

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Final

import typer

from bridge.client import Publication
from bridge.client.protocol import RosVersion
from casestudies.mrclam.recording import (
    MAP_FRAME,
    SIGHTINGS_MSG,
    SIGHTINGS_TOPIC,
    SIGHTINGS_TYPE,
    RecordedFrame,
    area_grid,
    read_recording,
    sightings_message,
)
from casestudies.server import DEFAULT_URI, Uri
from posteriors.errors import BadResultError, NoResultError
from posteriors.posterior import Posterior
from terminal.command_line import CommandLine
from terminal.connection import report_connection
from terminal.output import check_writable, say, write_json
from terminal.signals import run_async

if TYPE_CHECKING:
    from casestudies.listening import Listener
    from casestudies.truths import Instance

LOST_DISTANCE: Final = 9.0
"""Distance in metres at which a frame without a result is counted: the width of the area."""
_REPEAT_S: Final = 1.0
"""Seconds between publications of the first frame, until its result arrives."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayedFrame:
    """A recorded frame and its result: the published posterior, or None and why there is none."""

    frame: RecordedFrame
    posterior: "Posterior | None"
    cycles: int | None
    outcome: str

    def estimate(self) -> tuple[float, float] | None:
        """Return the posterior's mean (x, y) in metres, or raise a BadResultError if it is not over the area."""
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
        """Return the distance from the estimate to the reference, in metres; `LOST_DISTANCE` without an estimate."""
        estimate = self.estimate()
        return LOST_DISTANCE if estimate is None else math.dist(estimate, (self.frame.x, self.frame.y))


def median_distance(played: Sequence[PlayedFrame]) -> float:
    """Return the median distance to the reference position over all frames, in metres."""
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

    Frames are stamped with the time of their publication, which identifies their results. The first frame is
    published every second until its result arrives, since the master may not have subscribed yet. Every other
    frame is published once and counts as lost after `timeout_s`.

    Raises:
        NoResultError: The first frame had no result.
        BadResultError: A message was not a result.
        BridgeError: No rosbridge server answers at the URI, or it was lost.
    """
    from bridge.client import connect
    from casestudies.listening import listen

    played: list[PlayedFrame] = []
    async with connect(uri, retry=True, on_state=report_connection(uri)) as ros, listen(ros) as listener:
        version = await ros.detect_ros_version()
        publication = await ros.advertise(topic, SIGHTINGS_TYPE)
        for frame in frames:
            first = not played
            turn = _Turn(frame, publication, listener, version)
            instance = await turn.take(
                first_timeout_s if first else timeout_s, repeat_s=_REPEAT_S if first else math.inf
            )
            if first and instance is None:
                raise NoResultError(
                    f"the first frame on {topic} had no result from {uri} within {first_timeout_s:g} s: "
                    "is the master running, with the deployment of casestudies/mrclam?"
                )
            played.append(_played(frame, instance, timeout_s))
            on_frame(played[-1])
    return played


class _Turn:
    """The publication of one frame and the wait for its result."""

    def __init__(
        self,
        frame: RecordedFrame,
        publication: "Publication",
        listener: "Listener",
        version: "RosVersion | None",
    ) -> None:
        self._frame = frame
        self._publication = publication
        self._listener = listener
        self._version = version
        self._stamps: set[int] = set()

    async def take(self, limit_s: float, *, repeat_s: float) -> "Instance | None":
        """Publish until a result arrives and return it, or None after the limit."""
        end = time.monotonic() + limit_s
        while (left := end - time.monotonic()) > 0:
            await self._publish()
            with contextlib.suppress(NoResultError):
                return await self._answer(min(left, repeat_s))
        return None

    async def _publish(self) -> None:
        from bridge.stamps import header

        stamp_ns = time.time_ns()
        self._stamps.add(stamp_ns)
        await self._publication.publish(
            sightings_message(self._frame, header(stamp_ns, MAP_FRAME, self._version))
        )

    async def _answer(self, limit_s: float) -> "Instance":
        """Return the next result of this frame; skip late results of earlier frames."""
        end = time.monotonic() + limit_s
        while True:
            instance = await self._listener.next(max(end - time.monotonic(), 0.0))
            if instance.report is not None and instance.report.stamp_ns in self._stamps:
                return instance


def _played(frame: RecordedFrame, instance: "Instance | None", timeout_s: float) -> PlayedFrame:
    if instance is None or instance.report is None:
        return PlayedFrame(
            frame=frame, posterior=None, cycles=None, outcome=f"no result within {timeout_s:g} s"
        )
    return PlayedFrame(
        frame=frame,
        posterior=instance.posterior,
        cycles=instance.report.cycles,
        outcome=instance.report.outcome,
    )


def _line(played: PlayedFrame) -> str:
    """Return the line to print for a frame."""
    frame = played.frame
    seen = len(frame.sightings)
    start = f"{frame.number:>5}  {seen:>4}  ({frame.x:6.3f}, {frame.y:6.3f})"
    estimate = played.estimate()
    if estimate is None:
        return f"{start}  no posterior: {played.outcome or 'no reason given'}"
    cycles = "-" if played.cycles is None else str(played.cycles)
    return f"{start}  ({estimate[0]:6.3f}, {estimate[1]:6.3f})  {played.distance():>12.3f}  {cycles:>7}"


_HEADING: Final = "frame  seen  reference (m)       estimate (m)      distance (m)   cycles"


def _write_numbers(path: Path, played: Sequence[PlayedFrame]) -> None:
    numbers = {
        "frames": len(played),
        "without_result": sum(frame.posterior is None for frame in played),
        "median_distance_m": median_distance(played),
        "distances_m": [frame.distance() for frame in played],
        "cycles": [frame.cycles for frame in played],
    }
    write_json(path, numbers)


app = CommandLine()


@app.command(epilog="`python -m casestudies.mrclam.player data/ds1_robot3.csv --count 20`")
def player(
    recording: Annotated[
        Path | None, typer.Argument(help="A file like ds1_robot3.csv.", show_default=False)
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
    """Play a recorded robot's sightings of landmarks, and compare each posterior's mean with the reference.

    Each frame is published after the result of the previous one.
    """
    if print_msg:
        print(SIGHTINGS_MSG, end="")
        return
    if recording is None:
        raise typer.BadParameter("name a file like ds1_robot3.csv", param_hint="RECORDING")
    frames = read_recording(recording)[:count]
    if numbers is not None:
        check_writable(numbers.parent)
    played: list[PlayedFrame] = []

    def show(frame: PlayedFrame) -> None:
        played.append(frame)
        print(_line(frame), flush=True)

    async def body() -> None:
        say(f"player: {len(frames)} frames of {recording} to {topic}, {uri}")
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
        _write_numbers(numbers, played)


if __name__ == "__main__":
    app()
