"""Messages and posteriors of a stack that are made by hand, and arbitrary JSON values for hostile ones."""

import numpy as np
from hypothesis import strategies as st

from posteriors.posterior import Posterior

JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.integers(10**18, 10**400)
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from(["9" * 5000, "1e999", "nan", "true"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)


def status(name, message="", hardware="", **values):
    pairs = [{"key": key, "value": str(value)} for key, value in values.items()]
    return {"level": 0, "name": name, "message": message, "hardware_id": hardware, "values": pairs}


def report_message(stamp, outcome="overflow", deployment="boat", **values):
    """Return a `/bm/frame` with these values, and the outcome on one board."""
    board = status("rosbayes: board 0", outcome, "board0", cycles=812, counts_total=900, reason=1)
    frame = status("rosbayes: frame", outcome, deployment, **values)
    return {"header": {"stamp": stamp, "frame_id": "bm"}, "status": [frame, board]}


def posterior_message(data, *sizes, offset=0):
    """Return a `/BMresults` over y and x."""
    dims = [{"label": label, "size": size, "stride": 1} for label, size in zip("yx", sizes, strict=False)]
    return {"layout": {"dim": dims, "data_offset": offset}, "data": data}


def posterior_of(values, *labels, heard_ns=0, **fields):
    """Return a posterior of these probabilities, with an axis for each label."""
    values = np.asarray(values, float)
    probabilities = tuple(values.ravel().tolist())
    return Posterior(
        probabilities=probabilities, labels=labels, sizes=values.shape, heard_ns=heard_ns, **fields
    )
