"""Distances of posteriors over a grid from the truth, and from each other."""

import numpy as np


def coverage(lines, posteriors, mass=0.95):
    """Return the share of frames whose true line lies in the smallest region with this much probability."""
    at_truth = np.take_along_axis(posteriors, np.asarray(lines)[:, None], axis=1)
    above = np.where(posteriors > at_truth, posteriors, 0.0).sum(axis=1)
    return ((above < mass) & (at_truth[:, 0] > 0)).mean()


def means(posteriors, width):
    """Return the mean (column, row) of each posterior in cells, float64[frames, 2]."""
    rows, columns = np.divmod(np.arange(posteriors.shape[1]), width)
    return np.stack([posteriors @ columns, posteriors @ rows], axis=1)


def distances(ours, theirs):
    """Return the distance of each pair of means, in cells."""
    return np.linalg.norm(ours - theirs, axis=1)
