"""Comparison of the machines' disparities with float64 fusion, the truth and the thesis, as text and picture."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from terminal.pictures import new_figure, save_figure

THESIS_S: Final = 0.6
"""Seconds in which the thesis's host computes the matching costs of a pair (4.4). The thesis gives no image size."""
UNKNOWN: Final = -1.0
"""Value for the disparity of a pixel without a posterior."""
_BAD: Final = 1.0
"""Largest error in pixels for which a disparity is not counted as bad."""
HEADING: Final = "pair  host (ms)  pairs/s  projected/s    cycles  bad float64  bad BM1  agreement  variation"


def most_probable(posterior: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each pixel's most probable disparity, or `UNKNOWN` if all probabilities of the pixel are 0.

    `posterior` is float64[disparities, height, width].
    """
    return np.where(posterior.any(axis=0), posterior.argmax(axis=0), UNKNOWN)


def bad_share(disparity: NDArray[np.float64], truth: NDArray[Any]) -> float:
    """Return the share of pixels with an error above one pixel, among the pixels with a known true disparity."""
    known = np.isfinite(truth)
    return float((np.abs(disparity - truth)[known] > _BAD).mean()) if known.any() else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Matched:
    """The left image of a stereo pair, the posteriors of its pixels, and the times of the computation.

    Posteriors are float64[disparities, height, width].
    """

    left: NDArray[np.uint8]
    truth: NDArray[Any] | None
    """True disparities, float32[height, width], or None if unknown. Points hidden from the right camera have NaN."""
    exact: NDArray[np.float64]
    """The posteriors of float64 fusion."""
    posterior: NDArray[np.float64]
    """The posteriors of the machines. A pixel without a posterior has zeros."""
    host_s: float
    """CPU time for filters, costs and likelihoods."""
    total_s: float
    """Seconds from the start of the matching to the last posterior."""
    boards_s: float
    """Seconds that the boards' cycles would take at the clock of real boards, without transfers over links."""
    cycles: int

    @property
    def disparity(self) -> NDArray[np.float64]:
        """The machines' most probable disparities."""
        return most_probable(self.posterior)

    def line(self, number: int) -> str:
        """Return the line to print below `HEADING`."""
        exact, disparity = most_probable(self.exact), self.disparity
        bad = ["-", "-"]
        if self.truth is not None and self.truth.shape == disparity.shape:
            bad = [f"{bad_share(each, self.truth):.1%}" for each in (exact, disparity)]
        variation = np.abs(self.exact - self.posterior).sum(axis=0).mean() / 2
        return (
            f"{number:>4}  {1000 * self.host_s:9.1f}  {1 / self.total_s:7.2f}  "
            f"{1 / (self.host_s + self.boards_s):11.1f}  {self.cycles:8d}  {bad[0]:>11}  {bad[1]:>7}  "
            f"{(disparity == exact).mean():9.1%}  {variation:9.3f}"
        )

    def summary(self) -> str:
        """Return a sentence that compares the times with the time in the thesis."""
        height, width = self.left.shape
        return (
            f"a pair of {width} x {height} pixels takes {self.host_s:.3f} s on the host ({THESIS_S} s in the thesis, of "
            f"unknown size), and {self.boards_s:.4f} s on real boards without their links"
        )


def draw(path: Path, matched: Matched) -> None:
    """Draw the left image, and the disparities of the truth, of float64 fusion and of BM1, or raise an OutputError."""
    figure = new_figure(8, 5.6)
    panels = figure.subplots(2, 2).ravel()
    panels[0].imshow(matched.left, cmap="gray", vmin=0, vmax=255)
    panels[0].set_title("left image", fontsize=9)
    shown: Any = None
    for axes, title, picture in (
        (panels[1], "truth (white: not seen by the right camera)", matched.truth),
        (panels[2], "float64 fusion", most_probable(matched.exact)),
        (panels[3], "BM1", np.where(matched.disparity == UNKNOWN, np.nan, matched.disparity)),
    ):
        if picture is not None:
            axes.set_title(title, fontsize=9)
            shown = axes.imshow(picture, cmap="viridis", vmin=0, vmax=len(matched.exact) - 1)
    for axes in panels:
        axes.set_axis_off()
    figure.colorbar(shown, ax=panels, label="disparity (pixels)", shrink=0.6)
    save_figure(figure, path, dpi=100)
