"""The campaign's model: a position among 16 cells, measured by two small sensors.

Readings are the addresses themselves (whole numbers from 0), so the observer needs no code of the stack to convert
them.
"""

import numpy as np

from toolchain.models import IntegerType, IntervalType, JointDistribution, Question, Symbol, table, uniform

CELLS = 16
VALUES = {"near": 7, "far": 5}


def model() -> Question:
    """Return the question: the place, given both sensors."""
    place = Symbol("x", IntervalType(0.0, 16.0, CELLS))
    x = np.arange(CELLS)
    factors = [uniform(place)]
    for name, values in VALUES.items():
        sensor = Symbol(name, IntegerType(0, values - 1), on_missing="missing", on_range="clamp")
        peak = np.arange(values)[:, np.newaxis] * (CELLS - 1) / (values - 1)
        likely = np.exp(-np.abs(x - peak) / 4) + 0.01
        factors.append(table(sensor, likely / likely.sum(axis=0), given=[place]))
    return JointDistribution("campaign", tuple(factors)).ask(searched=[place], known=list(VALUES))
