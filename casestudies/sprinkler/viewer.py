"""Viewer of a BM2's samples for the sprinkler. It prints and draws estimates of P(R | G) from the samples."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer
from numpy.typing import NDArray

from bridge.client import Subscription
from bridge.errors import NoMessageError
from casestudies import DEFAULT_URI, KEPT, Count, FirstTimeout, Timeout, Uri
from casestudies.sprinkler.model import exact_rain
from casestudies.topics import connected, run_viewer
from posteriors.errors import NoResultError
from posteriors.listening import posteriors
from posteriors.posterior import SAMPLES_TOPIC, SAMPLES_TYPE, Posterior, read_samples
from terminal.command_line import CommandLine
from terminal.output import check_writable, say, warn
from terminal.pictures import new_figure, save_figure
from toolchain.errors import counted

PICTURE: Final = "sprinkler.png"
HEADING: Final = "frame  grass  P(R = 1)   error   exact  effective samples"
GRASS: Final = ("dry", "wet")
"""The states of G."""
_SIZES: Final = (2, 2, 2)
"""The number of values of each variable, R, S and G, in a sampled state."""
_R, _G = 0, 2
_COLOURS: Final = ("#aa7744", "#4477aa")
_POINTS: Final = 200
"""Number of points at which the running estimate of a frame is drawn."""
_WAITING: Final = 4
"""Maximum number of sample messages kept to find a frame's samples. If none fits, the frame's samples are lost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSummary:
    """A summary of a frame's samples."""

    number: int
    grass: int
    """The value of G in this frame: 0 for dry grass, 1 for wet grass."""
    share: float
    """P(R = 1) in the posterior on `/BMresults`."""
    error: float
    """Standard error of `share`, from `/bm/frame`. If the report lacks it, the value is 0.5, the maximum."""
    effective: float
    """Number of effective samples, from `/bm/frame`. If the report lacks it, the value is 1."""
    curve: NDArray[np.int64]
    """int64[points, 2]: n, and how many of the first n samples have R = 1. The last n is the number of all samples."""


def frame_of(posterior: Posterior, samples: NDArray[np.int64]) -> FrameSummary:
    """Return the summary of a frame from its posterior and its samples, int64[samples, variables]."""
    rained = np.cumsum(samples[:, _R])
    at = np.unique(np.geomspace(1, len(samples), _POINTS).astype(np.int64))
    details = posterior.report.details if posterior.report else {}
    return FrameSummary(
        number=posterior.number or 0,
        grass=int(samples[0, _G]),
        share=float(posterior.marginal("R")[1]),
        error=float(details.get("standard_error", 0.5)),
        effective=max(float(details.get("effective_samples", 1)), 1.0),
        curve=np.stack([at, rained[at - 1]], axis=1),
    )


def mean_and_error(frames: Sequence[FrameSummary]) -> tuple[float, float]:
    """Return the mean of P(R = 1) over one or more frames, and the standard error of the mean."""
    mean = math.fsum(frame.share for frame in frames) / len(frames)
    return mean, math.sqrt(math.fsum(frame.error**2 for frame in frames)) / len(frames)


def draw(path: Path, frames: Sequence[FrameSummary]) -> None:
    """Draw estimates of P(R = 1 | G) against the number of samples, and the exact value, or raise an OutputError."""
    figure = new_figure(8, 4.6)
    axes = figure.subplots()
    for grass, (name, colour) in enumerate(zip(GRASS, _COLOURS, strict=True)):
        here = [frame for frame in frames if frame.grass == grass]
        if not here:
            continue
        for frame in here:
            samples, rained = frame.curve.T
            axes.plot(samples, rained / samples, color=colour, alpha=0.25, linewidth=0.6)
        before = np.cumsum([(0, 0), *(frame.curve[-1] for frame in here[:-1])], axis=0)
        samples, rained = np.concatenate([f.curve + b for f, b in zip(here, before, strict=True)]).T
        axes.plot(samples, rained / samples, color=colour, linewidth=1.8, label=f"{name} grass")
        exact = exact_rain(grass)
        per_effective = float(np.mean([frame.curve[-1, 0] / frame.effective for frame in here]))
        across = np.geomspace(1, samples[-1], _POINTS)
        half = 2 * np.sqrt(exact * (1 - exact) * per_effective / across)
        axes.fill_between(across, exact - half, exact + half, color=colour, alpha=0.12, linewidth=0)
        axes.axhline(exact, color=colour, linewidth=0.9, linestyle=(0, (4, 3)))
        axes.annotate(f"{exact:.4f}", (1.01, exact), xycoords=("axes fraction", "data"), color=colour)
    axes.set(xscale="log", ylim=(-0.02, 1.02), xlabel="samples", ylabel="P(R = 1 | G)")
    axes.legend(frameon=False, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle("Has it rained? Estimates from the samples of a BM2, and the exact answers (dashed)")
    save_figure(figure, path)


class SamplesViewer:
    """A viewer that collects frames with their samples, and makes the estimates and the picture.

    Attributes:
        frames: Summaries of frames, the newest last. A frame that repeats the samples of an earlier frame is left out.
        results: Number of all results. Results with lost or repeated samples count, too.
    """

    def __init__(self, count: int | None) -> None:
        """Start without frames. `count` is the number of results to wait for. If it is None, watch until Ctrl-C."""
        self.frames: deque[FrameSummary] = deque(maxlen=KEPT if count is None else None)
        self.results = 0
        self._count = count
        self._seen: set[int] = set()
        self._unclaimed: list[NDArray[np.int64]] = []  # without a frame yet, in the order of arrival

    async def watch(self, uri: str, *, first_limit_s: float, limit_s: float) -> None:
        """Listen until the requested number of results has arrived, and print a line for each result.

        Raises:
            NoResultError: No result, or no samples, came in time.
            BadResultError: A message was not a result.
            BridgeError: No rosbridge server answers at the URI.
        """
        async with (
            connected("sprinkler-viewer", "a result was shown", uri) as (ros, readiness),
            posteriors(ros) as heard,
            ros.subscribe(SAMPLES_TOPIC, SAMPLES_TYPE) as samples,
        ):
            say(f"sprinkler-viewer: listening to {uri}")
            print(HEADING, flush=True)
            while self._count is None or self.results < self._count:
                posterior = await heard.next(limit_s if self.results else first_limit_s)
                self.add(posterior, await self._samples_of(posterior, samples, limit_s))
                readiness.record()

    def add(self, posterior: Posterior, samples: NDArray[np.int64] | None) -> None:
        """Add a result with its samples, and print a line. If the samples are lost (None), print a warning instead."""
        self.results += 1
        if samples is None:
            warn(f"the samples of frame {posterior.number} are lost; the estimate is made without it")
            return
        frame = frame_of(posterior, samples)
        print(
            f"{frame.number:>5}  {GRASS[frame.grass]:>5}  {frame.share:8.4f}  {frame.error:6.4f}  "
            f"{exact_rain(frame.grass):6.4f}  {frame.effective:17.0f}",
            flush=True,
        )
        digest = hash(samples.tobytes())
        if digest in self._seen:
            warn(
                f"frame {frame.number} has the samples of an earlier one, and is left out: use more --rng-banks"
            )
        else:
            self._seen.add(digest)
            self.frames.append(frame)

    async def _samples_of(
        self, posterior: Posterior, samples: Subscription, limit_s: float
    ) -> NDArray[np.int64] | None:
        """Return the samples of the posterior's frame, or None if these samples are lost.

        Samples belong to the frame if the share of R = 1 in the samples equals the posterior of R = 1.
        """
        share = posterior.marginal("R")[1]
        while True:
            for at, states in enumerate(self._unclaimed):
                if abs(np.mean(states[:, _R]) - share) < 1e-9:
                    del self._unclaimed[: at + 1]
                    return states
            if len(self._unclaimed) >= _WAITING:
                return None
            try:
                message = await samples.next(limit_s)
            except NoMessageError as error:
                raise NoResultError(f"{error}: was the deployment built with --stream?") from None
            self._unclaimed.append(read_samples(message.msg, _SIZES))

    def finish(self, out: Path | None) -> None:
        """Print the estimates, and draw the picture."""
        for grass, name in enumerate(GRASS):
            if here := [frame for frame in self.frames if frame.grass == grass]:
                mean, error = mean_and_error(here)
                print(
                    f"{name} grass: P(R = 1 | G = {grass}) is {mean:.4f} +- {error:.4f} in "
                    f"{counted(len(here), 'frame')}, and {exact_rain(grass):.4f} exactly"
                )
        if out is not None and self.frames:
            draw(out / PICTURE, self.frames)
            print(f"wrote {out / PICTURE}")


app = CommandLine()


@app.command(epilog="`sprinkler-viewer --uri ws://127.0.0.1:9090 --count 25 --out out`")
def sprinkler_viewer(
    uri: Uri = DEFAULT_URI,
    count: Count = None,
    out: Annotated[
        Path | None, typer.Option(help=f"Write {PICTURE} into this folder.", file_okay=False)
    ] = None,
    first_timeout: FirstTimeout = 60.0,
    timeout: Timeout = 30.0,
) -> None:
    """Show P(R = 1) of each frame and its error next to the exact value, and draw how the estimates converge.

    The viewer needs only the topics /BMresults, /bm/frame and /bm/samples.
    """
    viewer = SamplesViewer(count)
    if out is not None:
        check_writable(out)
    run_viewer(viewer.watch(uri, first_limit_s=first_timeout, limit_s=timeout), partial(viewer.finish, out))


if __name__ == "__main__":
    app()
