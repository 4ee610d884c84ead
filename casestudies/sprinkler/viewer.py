"""Viewer of the sprinkler's samples, and of the estimates of P(R | G) from them; it needs only topics."""

import asyncio
import base64
from collections import deque
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer
from numpy.typing import NDArray

from bridge.client import Subscription, connect
from bridge.errors import NoMessageError
from casestudies import DEFAULT_URI, Uri
from casestudies.pictures import check_pictures_possible
from casestudies.sprinkler.estimates import GRASS, Frame, draw, frame_of, mean_and_error, rain_of
from casestudies.sprinkler.garden import Rain
from casestudies.sprinkler.model import RAIN, TRUTH_TOPIC, TYPE, exact_rain
from casestudies.topics import Readiness, serve_readiness
from posteriors.errors import NoResultError
from posteriors.listening import posteriors
from posteriors.posterior import SAMPLES_TOPIC, SAMPLES_TYPE, Posterior
from terminal.command_line import CommandLine
from terminal.connection import report_connection
from terminal.errors import ExitCode, StoppedError
from terminal.output import check_writable, say, warn
from terminal.signals import run_async

PICTURE: Final = "sprinkler.png"
KEPT: Final = 2000
"""Number of frames that a viewer keeps for the picture if it runs until Ctrl-C."""
HEADING: Final = "frame  grass  P(R = 1)   error   exact  effective samples"
_WAITING: Final = 4
"""Number of messages of samples that wait for their frame; if none of them is the frame's, its own is lost."""


def read_samples(message: dict[str, Any]) -> NDArray[np.uint8]:
    """Return the packed states of a message on `/bm/samples`, uint8[samples, bytes]."""
    data = message["data"]
    octets = base64.b64decode(data) if isinstance(data, str) else bytes(data)
    return np.frombuffer(octets, np.uint8).reshape(-1, message["layout"]["dim"][1]["size"])


class Viewer:
    """The frames of a run, from which estimates and picture are made.

    Attributes:
        frames: The frames that say something new, the newest last.
        results: The number of results, with those whose samples are lost or those of an earlier frame.
        repeated: The number of frames with the very samples of an earlier one: the banks of seeds have come round.
        mornings: For dry and for wet grass, the number of mornings in the garden, and of those after rain.
    """

    def __init__(self, count: int | None, rain: float) -> None:
        """Start without frames; `count` is the number of results to wait for, None to run until Ctrl-C."""
        self.frames: deque[Frame] = deque(maxlen=KEPT if count is None else None)
        self.results = 0
        self.repeated = 0
        self.mornings = [[0, 0], [0, 0]]
        self._count = count
        self._rain = rain
        self._seen: set[int] = set()
        self._unclaimed: list[NDArray[np.uint8]] = []  # samples without their frame, in the order of arrival

    async def watch(self, uri: str, *, first_limit_s: float, limit_s: float) -> None:
        """Listen until all results have arrived, and print a line for each.

        Raises:
            NoResultError: No result, or no samples, came in time.
            BadResultError: A message was not a result.
            BridgeError: No rosbridge server answers at the URI.
        """
        readiness = Readiness("a result was shown")
        async with (
            serve_readiness("sprinkler-viewer", readiness),
            connect(uri, retry=True, on_state=report_connection(uri)) as ros,
            posteriors(ros) as heard,
            ros.subscribe(SAMPLES_TOPIC, SAMPLES_TYPE) as samples,
            ros.subscribe(TRUTH_TOPIC, TYPE) as truths,
        ):
            say(f"sprinkler-viewer: listening to {uri}")
            print(HEADING, flush=True)
            counting = asyncio.create_task(self._count_mornings(truths))
            try:
                while self._count is None or self.results < self._count:
                    posterior = await heard.next(limit_s if self.results else first_limit_s)
                    self.add(posterior, await self._samples_of(posterior, samples, limit_s))
                    readiness.record()
            finally:
                counting.cancel()

    def add(self, posterior: Posterior, samples: NDArray[np.uint8] | None) -> None:
        """Add a result with its samples, None if they are lost, and print its line."""
        self.results += 1
        if samples is None:
            warn(f"the samples of frame {posterior.number} are lost; the estimate is made without it")
            return
        frame = frame_of(posterior, samples)
        print(
            f"{frame.number:>5}  {GRASS[frame.grass]:>5}  {frame.share:8.4f}  {frame.error:6.4f}  "
            f"{exact_rain(frame.grass, self._rain):6.4f}  {frame.effective:17.0f}",
            flush=True,
        )
        digest = hash(samples.tobytes())
        if digest in self._seen:
            self.repeated += 1
        else:
            self._seen.add(digest)
            self.frames.append(frame)

    async def _samples_of(
        self, posterior: Posterior, samples: Subscription, limit_s: float
    ) -> NDArray[np.uint8] | None:
        """Return the samples whose share of R = 1 is that of a posterior, or None if they are lost."""
        share = rain_of(posterior)
        while True:
            for at, states in enumerate(self._unclaimed):
                if abs(np.mean(states[:, 0] & 1) - share) < 1e-9:
                    del self._unclaimed[: at + 1]
                    return states
            if len(self._unclaimed) >= _WAITING:
                return None
            try:
                message = await samples.next(limit_s)
            except NoMessageError as error:
                raise NoResultError(f"{error}: was the deployment built with --stream?") from None
            self._unclaimed.append(read_samples(message.msg))

    async def _count_mornings(self, truths: Subscription) -> None:
        async for message in truths:
            state = int(message.msg["data"])
            morning = self.mornings[state >> 2 & 1]
            morning[0] += 1
            morning[1] += state & 1

    def finish(self, out: Path | None) -> None:
        """Print the estimates, and draw the picture."""
        for grass, (mornings, rainy) in enumerate(self.mornings):
            if here := [frame for frame in self.frames if frame.grass == grass]:
                mean, error = mean_and_error(here)
                print(
                    f"{GRASS[grass]} grass: P(R = 1 | G = {grass}) is {mean:.4f} +- {error:.4f} in {len(here)} "
                    f"frames, and {exact_rain(grass, self._rain):.4f} exactly; "
                    f"it had rained on {rainy} of {mornings} mornings"
                )
        if self.repeated:
            print(
                f"{self.repeated} frames have the samples of an earlier one, and are left out: add --rng-banks"
            )
        if out is not None and self.frames:
            draw(out / PICTURE, self.frames, self._rain)
            print(f"wrote {out / PICTURE}")


app = CommandLine()


@app.command(epilog="`sprinkler-viewer --uri ws://127.0.0.1:9090 --count 25 --out out`")
def sprinkler_viewer(
    uri: Uri = DEFAULT_URI,
    count: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Exit after this many results.",
            show_default=f"at Ctrl-C, with the last {KEPT} in the picture",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help=f"Write {PICTURE} into this folder.", file_okay=False)
    ] = None,
    rain: Rain = RAIN,
    first_timeout: Annotated[float, typer.Option(min=0.1, help="Seconds until the first result.")] = 60.0,
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds between two results.")] = 30.0,
) -> None:
    """Show P(R = 1) of each frame and its error next to the exact value, and draw how the estimates converge.

    It subscribes to /BMresults, /bm/frame, /bm/samples and /sprinkler/truth, and needs nothing else.
    """
    viewer = Viewer(count, rain)
    if out is not None:
        check_pictures_possible()
        check_writable(out)
    try:
        run_async(viewer.watch(uri, first_limit_s=first_timeout, limit_s=timeout))
    except (NoResultError, StoppedError) as ended:
        if isinstance(ended, NoResultError) or ended.exit_code == ExitCode.INTERRUPTED:
            viewer.finish(out)
        raise
    viewer.finish(out)


if __name__ == "__main__":
    app()
