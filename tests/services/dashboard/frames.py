"""Frames as they reach the page."""

import numpy as np

from posteriors.frame_report import FrameReport, StageTimes
from tests.posteriors.messages import posterior_of


def report(number, **more):
    return FrameReport(
        **{"stamp_ns": number, "heard_ns": number, "outcome": "posterior", "number": number} | more
    )


def posterior(number, values=None, labels=("y", "x"), **more):
    found = report(number, **more)
    values = np.full((3, 4), 1 / 12) if values is None else values
    return posterior_of(values, *labels, heard_ns=number, report=found, details=found.details)


def stages(**times):
    return StageTimes(**times)
