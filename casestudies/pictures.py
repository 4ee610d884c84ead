"""Pictures of case studies: matplotlib without a display, if it is installed."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from terminal.errors import OutputError
from terminal.output import check_writable

_DPI: Final = 130


def check_pictures_possible(folder: Path) -> None:
    """Raise an OutputError before a long run if matplotlib is missing, or the pictures' folder cannot be written."""
    if find_spec("matplotlib") is None:
        raise OutputError(
            "the pictures need matplotlib, which is not installed: run pip install matplotlib, "
            "or leave out --out"
        )
    check_writable(folder)


def new_figure(width: float, height: float) -> Any:
    """Return a figure of this size in inches, made without pyplot, which would need a display and keep state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure to a file, or raise an OutputError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=_DPI)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from None
