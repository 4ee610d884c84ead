"""The loader: it checks the file before it changes a board, and reads the board's identity back."""

import pytest

from pcie_shim import register_map as rm
from pcie_shim.errors import (
    DamagedImageError,
    GreetingMismatchError,
    ImageError,
    ImageMismatchError,
)
from pcie_shim.host import loader
from pcie_shim.host.loader import program
from pcie_shim.host.socket_link import SocketLink
from pcie_shim.programming_file import image_bytes
from tests.pcie_shim.boards import image, machine


def test_a_damaged_or_missing_file_is_refused_before_the_board_is_touched(folder):
    nowhere = f"unix:{folder}/nobody.sock"
    path = folder / "board0.bm"
    with pytest.raises(ImageError):
        program(nowhere, path)
    path.write_bytes(image_bytes(image(machine(1)))[:-2] + b"xx")
    with pytest.raises(DamagedImageError):
        program(nowhere, path)


def test_a_board_with_another_map_is_refused_with_both_hashes(start_board):
    board = start_board(misbehave="wrong-map")
    with pytest.raises(GreetingMismatchError):
        program(board.endpoint, image(machine(1)))


def test_a_board_that_does_not_become_what_was_loaded_is_an_error(start_board, monkeypatch):
    board = start_board()
    good = SocketLink.read_block

    def other(link, address, count):
        return bytes(4 * count) if address == rm.IMAGE_HASH else good(link, address, count)

    monkeypatch.setattr(loader.SocketLink, "read_block", other)
    with pytest.raises(ImageMismatchError):
        program(board.endpoint, image(machine(1)))
