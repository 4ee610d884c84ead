"""A case study's folder and a network file, for the tests of the toolchain's commands."""

import pytest

CORRIDOR = """
from tests.toolchain.builders import corridor

def model(cells: int = 12):
    return corridor(cells, missing=True)
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
