"""Pictures: matplotlib without a display."""

from pathlib import Path
from typing import Any, Final

from terminal.errors import OutputError

VIRIDIS: Final = (
    *((68, 1, 84), (72, 36, 117), (64, 67, 135), (52, 94, 141), (41, 120, 142), (32, 144, 140)),
    *((34, 167, 132), (68, 190, 112), (121, 209, 81), (189, 222, 38), (253, 231, 36)),
)
"""Eleven colours of the colour map viridis, as red, green and blue from 0 to 255."""


def new_figure(width: float, height: float) -> Any:
    """Return a figure of this size in inches. It is made without pyplot, which keeps state and may need a display."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Any, path: Path, *, dpi: int = 130) -> None:
    """Write a figure, or raise an OutputError. A PNG does not contain matplotlib's version."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=dpi, metadata={"Software": None} if path.suffix == ".png" else None)
    except (OSError, ValueError) as error:
        raise OutputError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from None
