import tempfile
from pathlib import Path

import pytest

from machines import warm_up
from tests.pcie_shim.boards import ServedBoard, free_places


@pytest.fixture(scope="session", autouse=True)
def _kernels():
    """Loaded once, before boards are forked from this process, and before a board's thread would compile them."""
    warm_up()


@pytest.fixture(autouse=True)
def _places():
    yield
    free_places()


@pytest.fixture
def folder():
    """A folder with a short name: a unix socket's path has 107 bytes at most."""
    with tempfile.TemporaryDirectory(prefix="bm") as name:
        yield Path(name)


@pytest.fixture
def start_board(folder):
    """Serves boards in threads of this process, and ends them after the test."""
    started: list[ServedBoard] = []

    def start(endpoint="", *, index=0, **how):
        board = ServedBoard(endpoint or f"unix:{folder}/board{index}.sock", index=index, **how)
        started.append(board)
        return board

    yield start
    for board in started:
        board.stop()
