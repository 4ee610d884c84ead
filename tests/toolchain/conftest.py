"""A case study's folder and a network file, for the tests of the toolchain's commands."""

import pytest

CORRIDOR = """
import numpy as np
from toolchain.models.conditional import normal
from toolchain.models.model import Known, Model, cell_centres, interval

def model(cells: int = 12):
    place = interval("x", 0.0, 10.0, cells=cells)
    (x,) = cell_centres(place)
    loud = 0.05 + 0.9 * np.exp(-x / 3)
    return Model(name="corridor", searched=(place,), known=(
        normal("range", mean=x, sigma=1.0, values=21, step=0.5, on_missing="missing"),
        Known(name="loud", table=np.array([1 - loud, loud]))))
"""


@pytest.fixture
def case(request, tmp_path):
    """A folder whose model.py is the test module's `MODEL`, or a corridor's."""
    folder = tmp_path / "case"
    folder.mkdir()
    (folder / "model.py").write_text(getattr(request.module, "MODEL", CORRIDOR))
    return folder


NETWORK = """
variable rain { type discrete [ 2 ] { yes, no }; }
variable sprinkler { type discrete [ 2 ] { on, off }; }
variable grass { type discrete [ 2 ] { wet, dry }; }
variable shoes { type discrete [ 2 ] { wet, dry }; }
probability ( rain ) { table 0.2, 0.8; }
probability ( sprinkler | rain ) { (yes) 0.01, 0.99; (no) 0.4, 0.6; }
probability ( grass | sprinkler, rain ) { table 0.99 0.9 0.8 0.0 0.01 0.1 0.2 1.0; }
probability ( shoes | grass ) { (wet) 0.7, 0.3; (dry) 0.1, 0.9; }
"""


@pytest.fixture
def network(tmp_path):
    """A network file of a garden."""
    path = tmp_path / "garden.bif"
    path.write_text(NETWORK)
    return path
