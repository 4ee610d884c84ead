"""Pictures: matplotlib without a display."""

from pathlib import Path
from typing import Any, Final

from terminal.errors import OutputError

VIRIDIS: Final = (
    *((68, 1, 84), (72, 36, 117), (64, 67, 135), (52, 94, 141), (41, 120, 142), (32, 144, 140)),
    *((34, 167, 132), (68, 190, 112), (121, 209, 81), (189, 222, 38), (253, 231, 36)),
)
"""The colour map viridis in eleven steps of red, green and blue."""


def new_figure(width: float, height: float) -> Any:
    """Return a figure of this size in inches, made without pyplot, which would need a display and keep state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Any, path: Path, *, dpi: int = 130) -> None:
    """Write a figure without matplotlib's version: the file changes only with the drawing. May raise an OutputError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=dpi, metadata={"Software": None} if path.suffix == ".png" else None)
    except (OSError, ValueError) as error:
        raise OutputError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from None
