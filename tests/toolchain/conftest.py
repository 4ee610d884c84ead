"""A case study's folder, for the tests of the toolchain's commands."""

import pytest


@pytest.fixture
def case(request, tmp_path):
    """A folder whose model.py is the test module's `MODEL`."""
    folder = tmp_path / "case"
    folder.mkdir()
    (folder / "model.py").write_text(request.module.MODEL)
    return folder
