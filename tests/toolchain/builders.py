"""A small model and its machine, and a deployment that is made without a model."""

import numpy as np

from machines.bm1 import BM1Machine
from machines.parameters import BM1Parameters
from toolchain.building.quantise import quantise
from toolchain.deployment import BM1Section, BoardSection, Deployment, Dimension, Source, Variable
from toolchain.models.conditional import normal_table, wrapped_normal_table
from toolchain.models.distribution import IntervalType, Symbol
from toolchain.models.model import Known, Model, Normal, PriorSelect, cell_centres


def interval(label, low, high, *, cells):
    """A searched dimension of equal cells."""
    return Symbol(label, IntervalType(low, high, cells)).dimension()


def normal(name, *, mean, sigma, values, offset=0.0, step=1.0, floor=0.0, outliers=0.0, period=None, **rule):
    """A known variable that is normal given S, and clamps its readings, or wraps them if it has a period."""
    shape = Normal(mean=mean, sigma=sigma, floor=floor, outliers=outliers)
    make = wrapped_normal_table if period else normal_table
    table = make(name, shape, values=values, offset=offset, step=step)
    rule = {"on_range": "error" if period else "clamp", "period": period} | rule
    return Known(name=name, table=table, offset=offset, step=step, floor=floor, normal=shape, **rule)


def wrapped_normal(name, *, values, **others):
    """A known variable on a circle that is a wrapped normal given S."""
    return normal(name, values=values, period=values, **others)


def corridor(cells=12, *, sigma=1.0, select=False, missing=False):
    """A corridor of ten metres: a range, a loudness that may be missing, and a prior that may be selected."""
    place = interval("x", 0.0, 10.0, cells=cells)
    (x,) = cell_centres(place)
    loud = 0.05 + 0.9 * np.exp(-x / 3)
    on_missing = "missing" if missing else "error"
    rows = np.stack([np.exp(-x / 4), np.exp(x / 4), np.ones(cells)])
    return Model(
        name="corridor",
        searched=(place,),
        known=(
            normal("range", mean=x, sigma=sigma, values=21, step=0.5, on_missing=on_missing),
            Known(name="loud", table=np.array([1 - loud, loud]), on_missing=on_missing),
        ),
        prior_select=PriorSelect(name="door", table=rows / rows.sum(axis=1, keepdims=True))
        if select
        else None,
    )


def posts(count, *, floor=0.02):
    """Ranges to posts along a corridor of ten metres, so many that the likelihoods' product is tiny on every line."""
    place = interval("x", 0.0, 10.0, cells=20)
    (x,) = cell_centres(place)
    known = (
        normal(f"r{at}", mean=np.abs(x - 10 * at / count), sigma=0.5, values=101, step=0.1, floor=floor)
        for at in range(count)
    )
    return Model(name="posts", searched=(place,), known=tuple(known))


def machine_of(model, *, prob_bits=8, **others):
    """The model's machine on one board."""
    quantised = quantise(model, prob_bits=prob_bits)
    parameters = BM1Parameters(
        lines=model.lines,
        sensor_bits=tuple(known.bits for known in model.known),
        prior_bits=0 if model.prior_select is None else model.prior_select.bits,
        prob_bits=prob_bits,
        **others,
    )
    return BM1Machine(parameters, quantised.prior, quantised.tables)


BOAT = {
    "name": "boat",
    "sources": (Source(uri="ws://a:9090", topic="/boat/sensors", type="boat_msgs/Sensors"),),
    "variables": (
        Variable(name="D1", bits=7, values=101, on_range="clamp"),
        Variable(name="B1", bits=9, values=360, period=360, path="bearings[0]"),
    ),
    "searched": (Dimension(label="y", size=4, offset=-3.0, step=2.0), Dimension(label="x", size=3)),
    "machine": BM1Section(lines=12),
    "boards": tuple(
        BoardSection(image=f"boards/board{at}.bm", image_hash=str(at) * 64, line_offset=6 * at, lines=6)
        for at in (0, 1)
    ),
}


def boat(**fields):
    """Make a deployment of two variables and twelve lines on two boards, but for some fields."""
    return Deployment(**(BOAT | fields))
