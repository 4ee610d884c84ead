"""Frames as they reach the page."""

import numpy as np

from posteriors.frame_report import FrameReport, StageTimes
from posteriors.posterior import Posterior


def report(number, **more):
    return FrameReport(
        **{"stamp_ns": number, "heard_ns": number, "outcome": "posterior", "number": number} | more
    )


def posterior(number, values=None, labels=("y", "x"), **more):
    values = np.full((3, 4), 1 / 12) if values is None else np.asarray(values, float)
    found = report(number, **more)
    return Posterior(
        probabilities=tuple(values.ravel().tolist()),
        labels=labels,
        sizes=values.shape,
        heard_ns=number,
        report=found,
        details=found.details,
    )


def stages(**times):
    return StageTimes(**times)
