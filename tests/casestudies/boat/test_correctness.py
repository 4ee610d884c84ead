"""Coverage, means and total variation, on posteriors whose figures are known."""

import numpy as np
import pytest

from casestudies.boat.correctness import correctness, in_region, means, total_variation


def test_the_region_takes_the_most_probable_cells_until_it_has_its_mass():
    posterior = [0.5, 0.3, 0.16, 0.04]
    assert in_region([0, 1, 2, 3], [posterior] * 4).tolist() == [True, True, True, False]
    assert in_region([0, 1, 2, 3], [posterior] * 4, mass=0.5).tolist() == [True, False, False, False]


def test_equal_cells_enter_together():
    assert in_region([0, 1, 2, 3], [[0.25] * 4] * 4, mass=0.1).all()


def test_a_cell_without_probability_is_in_no_region():
    assert not in_region([2], [[0.5, 0.45, 0.0, 0.05]], mass=1.0).any()


def test_means_are_in_cells():
    posterior = np.zeros((1, 12))
    posterior[0, 5] = 0.5  # column 1 of row 1, four cells in a row
    posterior[0, 11] = 0.5  # column 3 of row 2
    assert means(posterior, 4).tolist() == [[2.0, 1.5]]


def test_total_variation():
    assert total_variation([[1.0, 0.0], [0.5, 0.5]], [[0.0, 1.0], [0.5, 0.5]]).tolist() == [1.0, 0.0]


def test_a_machine_that_is_two_cells_off():
    exact = np.eye(16)[[0, 4, 8, 12]]  # the first cell of each row
    ours = np.eye(16)[[2, 6, 10, 12]]  # two columns further, except the last
    result = correctness([0, 4, 8, 12], ours, exact, width=4)
    assert result.coverage == 0.25
    assert result.exact_coverage == 1
    assert result.mean_within_one_cell == 0.25
    assert result.mean_distance_median == result.truth_distance_median == 2
    assert result.total_variation_mean == 0.75
    assert result.total_variation_median == 1


def test_what_does_not_belong_together():
    with pytest.raises(ValueError, match="posteriors"):
        correctness([0, 1], np.eye(4), np.eye(4), width=2)
    with pytest.raises(ValueError, match="posteriors"):
        total_variation([1.0], [1.0])
