"""Simulator, normaliser and model agree: float64 fusion finds the boat as often as it predicts.

Boat.measure  ->  normalise  ->  the model's exact posterior  ->  coverage of its 95 % region
"""

import numpy as np
import pytest

from casestudies.boat.model import model
from casestudies.boat.normaliser import normalise
from casestudies.boat.sensors import map_grid
from casestudies.boat.simulator import Boat
from tests.casestudies.figures import coverage, distances, means
from toolchain.models.model import exact_posterior


@pytest.mark.parametrize("seed", [1, 2])
def test_float64_fusion_covers_the_truth(seed):
    the_model, grid, boat = model(), map_grid(), Boat(seed, 60)
    lines, posteriors = [], []
    for _ in range(500):
        boat.sail(0.5)
        readings = normalise(boat.measure())
        posteriors.append(exact_posterior(the_model, readings))
        lines.append(grid.line(boat.x, boat.y))
    exact = np.array(posteriors)
    assert coverage(lines, exact) == pytest.approx(0.95, abs=0.03)
    truth = np.stack(np.divmod(lines, grid.width)[::-1], axis=1)
    assert np.median(distances(means(exact, grid.width), truth)) < 3
