"""Pictures of posteriors in a terminal: bars for one dimension, a heat map for two, with or without colour."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.text import Text

from posteriors.posterior import Posterior
from services.output.axes import Axis, printable

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

ROWS: Final = 32
"""Maximum number of lines in a picture; finer posteriors are drawn in blocks of cells."""
WIDTH: Final = 160
"""Maximum width in characters."""
_SHADES: Final = " .:-=+*#%@"
_COLOURS: Final = (
    *((68, 1, 84), (72, 36, 117), (64, 67, 135), (52, 94, 141), (41, 120, 142), (32, 144, 140)),
    *((34, 167, 132), (68, 190, 112), (121, 209, 81), (189, 222, 38), (253, 231, 36)),
)
"""Viridis in eleven steps."""


def in_colour(console: Console) -> bool:
    """Return whether a console supports colours and the user has not disabled them (NO_COLOR)."""
    return console.color_system is not None and not console.no_color


def picture(posterior: Posterior, axes: list[Axis], *, width: int, colour: bool, rows: int = ROWS) -> Text:
    """Draw a posterior in colour or with characters " " to "@", `width` characters wide, in `rows` lines with text.

    Of three or more dimensions, the two longest are drawn, and the others are summed out.
    """
    # the words around the picture stay on the screen
    width, rows = min(width, WIDTH), max(min(rows, ROWS), 2)
    if len(axes) == 1:
        return _bars(posterior.values, axes[0], width, rows, colour)
    # in the order of the deployment, so that y stays down and x across
    largest = sorted(sorted(range(len(axes)), key=lambda at: -axes[at].size)[:2])
    down, across = (axes[at] for at in largest)
    text = _heat(posterior.marginal(down.label, across.label), down, across, (width, rows), colour)
    if summed := [printable(axis.label) for at, axis in enumerate(axes) if at not in largest]:
        text.append(f"\nsummed over {', '.join(summed)}")
    return text


def _bars(values: npt.NDArray[np.float64], axis: Axis, width: int, rows: int, colour: bool) -> Text:
    # blocks of cells instead of a window: every cell counts in the picture
    step = -(-axis.size // rows)
    blocks = _blocks(values, step, 0)
    names = [_range(axis, at * step, min((at + 1) * step, axis.size) - 1) for at in range(len(blocks))]
    wide = max(map(len, names))
    room = max(width - wide - 10, 10)
    text = Text(no_wrap=True, overflow="crop")
    text.append(printable(axis.label))
    for name, value in zip(names, blocks, strict=True):
        # relative to the highest one: a flat posterior would be invisible otherwise
        share = float(value / blocks.max())
        bar = round(share * room)
        text.append(f"\n{name:>{wide}} ")
        text.append(" " * bar if colour else "#" * bar, style=_style(share) if colour else "")
        text.append(f" {value:.3g}")
    return text


def _heat(
    values: npt.NDArray[np.float64], down: Axis, across: Axis, room: tuple[int, int], colour: bool
) -> Text:
    width, rows = room
    ends = [down.shown(0), down.shown(down.size - 1)]
    margin = max(*map(len, ends), len(printable(down.label))) + 1
    # a cell has two characters, because a character is twice as high as wide
    columns = max((width - margin - 2) // 2, 4)
    down_step, across_step = -(-down.size // rows), -(-across.size // columns)
    blocks = _blocks(_blocks(values, down_step, 0), across_step, 1)
    text = Text(no_wrap=True, overflow="crop")
    text.append(f"{printable(down.label):>{margin - 1}}\n")
    last = len(blocks) - 1
    for row in range(last, -1, -1):  # the first row is at the bottom, as on a map
        name = ends[1] if row == last else ends[0] if row == 0 else ""
        text.append(f"{name:>{margin - 1}} |")
        for value in blocks[row]:
            share = float(value / blocks.max())
            if colour:
                text.append("  ", style=_style(share))
            else:
                text.append(_SHADES[min(int(share * len(_SHADES)), len(_SHADES) - 1)] * 2)
        text.append("|\n")
    first, end = across.shown(0), across.shown(across.size - 1)
    between = max(2 * blocks.shape[1] - len(first) - len(end), 1)
    middle = f" {printable(across.label)} ".center(between, " ")
    text.append(f"{'':>{margin}} {first}{middle}{end}")
    if down_step > 1 or across_step > 1:
        text.append(f"\neach mark is a block of {down_step} x {across_step} cells")
    return text


def _blocks(values: npt.NDArray[np.float64], step: int, axis: int) -> npt.NDArray[np.float64]:
    """Return the sums over blocks of cells along an axis; the last block may have fewer."""
    import numpy as np

    return np.add.reduceat(values, np.arange(0, values.shape[axis], step), axis=axis)


def _range(axis: Axis, first: int, last: int) -> str:
    return axis.shown(first) if first == last else f"{axis.shown(first)} to {axis.shown(last)}"


def _style(share: float) -> str:
    red, green, blue = _COLOURS[round(share * (len(_COLOURS) - 1))]
    return f"on rgb({red},{green},{blue})"
