"""The host's computations: image filters, matching costs and likelihoods, and fusion in float64 (thesis 4.4).

Each function computes all pixels and disparities at once.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

FILTERS: Final = ("gradient_x", "gradient_y", "surround")
"""The image filters. The machine has one sensor for each filter.

Two filters are the derivatives across and down. `surround` is the mean of a small window minus the mean of a large
window (a Laplacian). No filter responds to a difference in brightness between the cameras. The noise of the filters is
nearly independent, as naive fusion assumes.
"""
SCALES: Final = (2.0, 2.0, 4.0)
"""Mean matching cost of each filter at the true disparity, in grey levels."""
OUTLIER: Final = 0.05
"""Minimum likelihood of a cost, relative to the likelihood of cost 0.

Without this minimum, an occlusion or a reflection could rule out the true disparity.
"""
WINDOW: Final = 2
"""Number of pixels from the centre to the edge of the window in which costs are averaged."""


def box_sum(values: NDArray[np.float32], reach: int) -> NDArray[np.float32]:
    """Return, for each pixel, the sum over a square window of side 2 * reach + 1, cut off at the image's borders."""
    for axis in (-1, -2):
        size = values.shape[axis]
        zero = np.zeros_like(np.take(values, [0], axis))
        # float64, because running sums in float32 would lose precision far from the border
        running = np.concatenate([zero, np.cumsum(values, axis, dtype=np.float64)], axis)
        ends = np.minimum(np.arange(size) + reach + 1, size)
        starts = np.maximum(np.arange(size) - reach, 0)
        values = (np.take(running, ends, axis) - np.take(running, starts, axis)).astype(np.float32)
    return values


def filtered(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the output of each filter, float32[filters, height, width], for an image uint8[height, width].

    `gradient_x` and `gradient_y` need one pixel beyond the border. This pixel is a copy of the edge pixel.
    """
    padded = np.pad(image.astype(np.float32), 1, mode="edge")
    across = padded[:, 2:] - padded[:, :-2]
    down = padded[2:] - padded[:-2]
    ones = np.ones(image.shape, np.float32)
    near, far = (box_sum(image.astype(np.float32), reach) / box_sum(ones, reach) for reach in (1, 4))
    return np.stack(
        [
            (across[:-2] + 2 * across[1:-1] + across[2:]) / 4,
            (down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:]) / 4,
            near - far,
        ]
    )


def matching_costs(
    left: NDArray[np.uint8], right: NDArray[np.uint8], disparities: int
) -> NDArray[np.float32]:
    """Return the matching costs of the left image, float32[filters, disparities, height, width].

    A cost at disparity d is the mean of |left(x, y) - right(x - d, y)| over a window, for the filtered images. If x - d
    lies beyond the border, the cost is NaN.
    """
    ours, theirs = filtered(left), filtered(right)
    height, width = left.shape
    costs = np.full((len(FILTERS), disparities, height, width), np.nan, np.float32)
    for d in range(min(disparities, width)):
        difference = np.abs(ours[:, :, d:] - theirs[:, :, : width - d])
        count = box_sum(np.ones((height, width - d), np.float32), WINDOW)
        costs[:, d, :, d:] = box_sum(difference, WINDOW) / count
    return costs


def likelihoods(costs: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return P(cost | disparity), scaled so that the cost 0 has likelihood 1, in the shape of `costs`.

    A disparity beyond the border has no cost. It gets the mean likelihood of the pixel's other disparities, so a
    missing cost neither favours nor excludes a disparity. In the first column of pixels, all likelihoods are equal.
    """
    scales = np.array(SCALES, np.float32)[:, np.newaxis, np.newaxis, np.newaxis]
    likely = (1 - OUTLIER) * np.exp(-costs / scales) + np.float32(OUTLIER)
    return np.where(np.isnan(likely), np.float32(np.nanmean(likely, axis=1, keepdims=True)), likely)


def as_bytes(likely: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return likelihoods as bytes for the machine. In each filter, the likeliest disparity of a pixel gets 255."""
    codes: NDArray[np.uint8] = np.rint(likely * (255 / likely.max(axis=1, keepdims=True))).astype(np.uint8)
    return codes


def fused(likely: NDArray[np.float32] | NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the posterior, float64[disparities, height, width]: the normalised product of the filters' likelihoods."""
    product = likely.astype(np.float64).prod(axis=0)
    return np.asarray(product / product.sum(axis=0))
