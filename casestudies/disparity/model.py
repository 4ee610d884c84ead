"""The topics of the disparity case study, and its model of a pixel (thesis 4.4).

The model is P(d) P(k1 | d) P(k2 | d) P(k3 | d), with the disparity d and the matching costs k1 to k3.
"""

from typing import Final

import numpy as np

from casestudies.disparity.matching import FILTERS, OUTLIER, SCALES
from toolchain.models import IntegerType, JointDistribution, Question, Symbol, table, uniform

DISPARITIES: Final = 16
"""Number of disparities, 0 to 15 pixels. A machine has a line for each."""
PIXELS: Final = 160
"""Number of pixels that a board computes at once. The board has a replica of the machine for each pixel."""

LEFT_TOPIC: Final = "/stereo/left/image_rect"
RIGHT_TOPIC: Final = "/stereo/right/image_rect"
TRUTH_TOPIC: Final = "/stereo/true_disparity"
"""Topic of the simulator's true disparities (32FC1). A point that the right camera does not see has NaN."""
DISPARITY_TOPIC: Final = "/stereo/disparity"
TILE_TOPIC: Final = "/disparity/likelihoods"
TILE_TYPE: Final = "disparity_msgs/Likelihoods"
"""Type of messages with a header, and a `uint8[]` field named after each filter.

A field has a likelihood from 0 to 255 for each pixel and disparity.
"""

_COSTS: Final = 64
"""Number of costs in the tables, which are only for the model: a machine that gets likelihoods has no tables."""


def model(disparities: int = DISPARITIES) -> Question:
    """Return the question for the disparity of a pixel, given the matching costs of three filters.

    Args:
        disparities: The number of disparities. The smallest disparity is 0.
    """
    disparity = Symbol("disparity", IntegerType(0, disparities - 1, unit="px"))
    factors = [uniform(disparity)]
    known = [Symbol(name, IntegerType(0, _COSTS - 1)) for name in FILTERS]
    for symbol, scale in zip(known, SCALES, strict=True):
        likely = (1 - OUTLIER) * np.exp(-np.arange(_COSTS) / scale) + OUTLIER
        costs = np.repeat((likely / likely.sum())[:, np.newaxis], disparities, axis=1)
        factors.append(table(symbol, costs, given=[disparity]))
    return JointDistribution("disparity", tuple(factors)).ask(searched=[disparity], known=known)
