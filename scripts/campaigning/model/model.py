"""The campaign's model: a position among 16 cells, measured by two small sensors.

Readings are the addresses themselves (whole numbers from 0), so the observer needs no code of the stack to convert
them.
"""

import numpy as np

from toolchain.models import Known, Model, interval

CELLS = 16
VALUES = {"near": 7, "far": 5}


def model() -> Model:
    """Return the model."""
    place = interval("x", 0.0, 16.0, cells=CELLS)
    x = np.arange(CELLS)
    known = []
    for name, values in VALUES.items():
        peak = np.arange(values)[:, np.newaxis] * (CELLS - 1) / (values - 1)
        table = np.exp(-np.abs(x - peak) / 4) + 0.01
        known.append(
            Known(name=name, table=table / table.sum(axis=0), on_missing="missing", on_range="clamp")
        )
    return Model(name="campaign", searched=(place,), known=tuple(known))
