import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from machines.kernel import warm_up
from tests.pcie_shim.boards import BoardProcess


@pytest.fixture(scope="session", autouse=True)
def _kernels() -> None:
    """Loaded once, before boards are forked from this process."""
    warm_up()


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder with a short name: a unix socket's path has 107 bytes at most."""
    with tempfile.TemporaryDirectory(prefix="bm") as name:
        yield Path(name)


@pytest.fixture
def start_board(folder: Path) -> Iterator[Callable[..., BoardProcess]]:
    """Starts board processes; those that still run are ended."""
    started: list[BoardProcess] = []

    def start(endpoint: str = "", *, index: int = 0, misbehave: str = "") -> BoardProcess:
        board = BoardProcess(endpoint or f"unix:{folder}/board{index}.sock", index=index, misbehave=misbehave)
        started.append(board)
        return board

    yield start
    for board in started:
        board.kill()
