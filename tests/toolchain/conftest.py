"""A case study's folder, for the tests of the toolchain's commands."""

import pytest
from hypothesis import settings

# an example that takes long says something of the load, not of the code
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")


@pytest.fixture
def case(request, tmp_path):
    """A folder whose model.py is the test module's `MODEL`."""
    folder = tmp_path / "case"
    folder.mkdir()
    (folder / "model.py").write_text(request.module.MODEL)
    return folder
