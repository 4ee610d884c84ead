"""docs/reference/boards.md: every error and operation is described, and its bytes are the encoder's."""

import inspect
from pathlib import Path

from pcie_shim import errors, framing

TEXT = (Path(__file__).parents[2] / "docs/reference/boards.md").read_text()


def test_every_error_of_a_board_or_image_is_documented_with_its_exit_code() -> None:
    for name, error in inspect.getmembers(errors, inspect.isclass):
        if issubclass(error, errors.BoardError | errors.ImageError) and error is not errors.BoardError:
            assert f"| `{name}` | {error.exit_code} |" in TEXT


def test_every_operation_and_the_bytes_of_a_frame_are_documented() -> None:
    for name in ("GREET", "READ", "WRITE", "IRQ", "ERROR", "PROGRAM"):
        assert f"| {getattr(framing, name)} {name} |" in TEXT
    for name in ("REPLY", "POSTED", "BEGIN", "END"):
        assert f"{getattr(framing, name)} {name}" in TEXT
    frame = framing.encode(framing.WRITE, framing.POSTED, 2, 0x104, 1, b"\7\0\0\0")
    assert frame.hex(" ", 4) in TEXT
