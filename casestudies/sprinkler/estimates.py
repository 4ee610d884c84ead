"""Estimates of P(R | G) from the samples of frames, their errors, and the picture of how they converge."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from casestudies.pictures import new_figure, save_figure
from casestudies.sprinkler.model import RAIN, exact_rain
from posteriors.posterior import Posterior

GRASS: Final = ("dry", "wet")
"""The states of G."""
_COLOURS: Final = ("#aa7744", "#4477aa")
_POINTS: Final = 200
"""Number of points of a curve."""


def rain_of(posterior: Posterior) -> float:
    """Return P(R = 1) of a posterior, or raise a LabelError if it is another model's."""
    return float(posterior.marginal("R")[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """The samples of a frame in summary."""

    number: int
    grass: int
    """G."""
    share: float
    """P(R = 1) on `/BMresults`."""
    effective: float
    """Effective sample size on `/bm/frame`."""
    curve: NDArray[np.int64]
    """int64[points, 2]: the number of samples so far, and of those with R = 1; the last point is the whole frame."""

    @property
    def error(self) -> float:
        """Standard error of `share`; not 0 if all samples are equal."""
        share = (self.share * self.effective + 1) / (self.effective + 2)
        return math.sqrt(share * (1 - share) / self.effective)


def frame_of(posterior: Posterior, samples: NDArray[np.uint8]) -> Frame:
    """Return a frame from its posterior and its samples, uint8[samples, bytes of a packed state]."""
    rained = np.cumsum(samples[:, 0] & 1, dtype=np.int64)
    at = np.unique(np.geomspace(1, len(samples), _POINTS).astype(np.int64))
    details = posterior.report.details if posterior.report else {}
    return Frame(
        number=posterior.number or 0,
        grass=int(samples[0, 0]) >> 2 & 1,
        share=rain_of(posterior),
        effective=max(float(details.get("effective_samples", 1)), 1.0),
        curve=np.stack([at, rained[at - 1]], axis=1),
    )


def mean_and_error(frames: Sequence[Frame]) -> tuple[float, float]:
    """Return the mean share of some frames, at least one, and its standard error."""
    mean = math.fsum(frame.share for frame in frames) / len(frames)
    return mean, math.sqrt(math.fsum(frame.error**2 for frame in frames)) / len(frames)


def draw(path: Path, frames: Sequence[Frame], rain: float = RAIN) -> None:
    """Draw the running estimates over the samples, next to the estimate of each frame.

    Raises:
        OutputError: matplotlib is missing, or the file cannot be written.
    """
    figure = new_figure(11, 4.6)
    running, each = figure.subplots(1, 2, sharey=True)
    for grass, (name, colour) in enumerate(zip(GRASS, _COLOURS, strict=True)):
        here = [frame for frame in frames if frame.grass == grass]
        if not here:
            continue
        for frame in here:
            samples, rained = frame.curve.T
            running.plot(samples, rained / samples, color=colour, alpha=0.25, linewidth=0.6)
        before = np.cumsum([(0, 0), *(frame.curve[-1] for frame in here[:-1])], axis=0)
        samples, rained = np.concatenate([f.curve + b for f, b in zip(here, before, strict=True)]).T
        running.plot(samples, rained / samples, color=colour, linewidth=1.8, label=f"all frames, {name}")
        exact = exact_rain(grass, rain)
        per_effective = float(np.mean([frame.curve[-1, 0] / frame.effective for frame in here]))
        axis = np.geomspace(1, samples[-1], _POINTS)
        half = 2 * np.sqrt(exact * (1 - exact) * per_effective / axis)
        running.fill_between(axis, exact - half, exact + half, color=colour, alpha=0.12, linewidth=0)
        each.errorbar(
            [frame.number for frame in here],
            [frame.share for frame in here],
            yerr=[2 * frame.error for frame in here],
            fmt="o",
            markersize=4,
            elinewidth=1,
            color=colour,
            label=f"{name} grass",
        )
        for axes in (running, each):
            axes.axhline(exact, color=colour, linewidth=0.9, linestyle=(0, (4, 3)))
        each.annotate(f"{exact:.4f}", (1.01, exact), xycoords=("axes fraction", "data"), color=colour)
    running.set(xscale="log", ylim=(-0.02, 1.02), xlabel="samples", ylabel="P(R = 1 | G)")
    running.set_title("running estimates; shaded: two standard errors", fontsize=10)
    each.set_xlabel("frame")
    each.set_title("estimate of each frame, with two standard errors", fontsize=10)
    for axes in (running, each):
        axes.legend(frameon=False, fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle("Has it rained? Estimates from the samples of a BM2, and the exact answers (dashed)")
    save_figure(figure, path)
