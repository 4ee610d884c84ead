"""The model of a pixel's disparity, P(d) P(k1 | d) P(k2 | d) P(k3 | d), and the case study's topics (thesis 4.4)."""

from typing import Final

import numpy as np

from casestudies.disparity.matching import FILTERS, OUTLIER, SCALES
from toolchain.models import IntegerType, JointDistribution, Question, Symbol, table, uniform

DISPARITIES: Final = 16
"""Number of disparities, 0 to 15 pixels: the lines of a machine."""
PIXELS: Final = 160
"""Number of pixels that a board computes at once, each with a machine of its own: the board's replicas."""

LEFT_TOPIC: Final = "/stereo/left/image_rect"
RIGHT_TOPIC: Final = "/stereo/right/image_rect"
TRUTH_TOPIC: Final = "/stereo/true_disparity"
"""Topic of the simulated cameras' true disparities, 32FC1; NaN where the right camera does not see the point."""
DISPARITY_TOPIC: Final = "/stereo/disparity"
TILE_TOPIC: Final = "/disparity/likelihoods"
TILE_TYPE: Final = "disparity_msgs/Likelihoods"
"""Fields: a header, and a `uint8[]` named after each filter, with likelihoods per pixel and disparity, at most 255."""

_COSTS: Final = 64
"""Number of costs in the tables, which are only for the model: a machine that gets likelihoods has no tables."""


def model(disparities: int = DISPARITIES) -> Question:
    """Return the question: which disparity does a pixel have, given the matching costs of three filters?

    Args:
        disparities: The number of disparities, from 0.
    """
    disparity = Symbol("disparity", IntegerType(0, disparities - 1, unit="px"))
    factors = [uniform(disparity)]
    known = [Symbol(name, IntegerType(0, _COSTS - 1)) for name in FILTERS]
    for symbol, scale in zip(known, SCALES, strict=True):
        likely = (1 - OUTLIER) * np.exp(-np.arange(_COSTS) / scale) + OUTLIER
        costs = np.repeat((likely / likely.sum())[:, np.newaxis], disparities, axis=1)
        factors.append(table(symbol, costs, given=[disparity]))
    return JointDistribution("disparity", tuple(factors)).ask(searched=[disparity], known=known)
