"""The renderer: what it says about disparities and occlusions holds between its two images."""

import numpy as np
import pytest

from casestudies.disparity.scene import BASELINE, FOCAL, RIGHT_GAIN, Scene

WIDTH, HEIGHT = 96, 64


def pair(seed, number=0):
    return Scene(seed).pair(number, WIDTH, HEIGHT)


def test_a_seed_is_a_scene_which_moves():
    first, same, next_, other = pair(1), pair(1), pair(1, 1), pair(2)
    assert (first.left == same.left).all()
    assert (first.right == same.right).all()
    for each in (next_, other):
        assert (first.disparity != each.disparity).mean() > 0.05


def test_the_wall_is_five_metres_away():
    assert pair(1).disparity[0, -1] == pytest.approx(FOCAL * WIDTH * BASELINE / 5)


@pytest.mark.parametrize("seed", [1, 2, 7])
def test_the_right_camera_sees_a_point_further_left_by_the_disparity(seed):
    each = pair(seed)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    seen_at = columns - each.disparity
    inside = seen_at >= 0
    low = np.clip(np.floor(seen_at).astype(int), 0, WIDTH - 2)
    part = np.clip(seen_at - low, 0, 1)
    right = each.right.astype(float)
    there = (1 - part) * right[rows, low] + part * right[rows, low + 1]
    difference = np.abs(RIGHT_GAIN * each.left.astype(float) - there)
    assert np.median(difference[~each.occluded]) < 4
    assert np.median(difference[each.occluded & inside]) > 10
    assert each.occluded[seen_at < -0.5].all()
    assert 0.02 < each.occluded.mean() < 0.3


def test_near_things_hide_far_ones():
    """The z-buffer of another way of rendering: of left points that fall on one right pixel, the nearest is seen."""
    each = pair(7)
    for y in range(0, HEIGHT, 4):
        nearest = np.zeros(WIDTH)
        at = np.rint(np.arange(WIDTH) - each.disparity[y]).astype(int)
        for x in np.flatnonzero(at >= 0):
            nearest[at[x]] = max(nearest[at[x]], each.disparity[y, x])
        for x in np.flatnonzero(each.occluded[y] & (at >= 0)):
            # at most a pixel away, since the occluder's own left points lie between pixels
            around = nearest[max(at[x] - 1, 0) : at[x] + 2]
            assert around.max() > each.disparity[y, x] + 0.2
