"""Views of a posterior for notebooks: bars or a map, as HTML or drawn with matplotlib.

Labels, states and details come from files and networks. They are shortened and escaped, and matplotlib shows them as
plain text, not as formulas.
"""

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from posteriors.axes import Axis, printable, reading_order

_MOST_BARS: Final = 24
"""Maximum number of cells that are shown as one row each; more are drawn as a picture."""
_BAR: Final = 24
_SIDE: Final = 256
"""Maximum size of a picture in pixels, along the longer side.

If a posterior has more cells along a side, a pixel shows a block of cells.
"""
_MOST_NAMES: Final = 16
"""Maximum number of states that are written along an axis."""
_LONGEST: Final = 8
"""Maximum ratio of the sides of a map whose cells are drawn as squares."""


def _plane(axes: Sequence[Axis], values: NDArray[Any]) -> tuple[list[Axis], NDArray[np.float64], list[str]]:
    """Return the axes to draw, the marginal over these axes, and the labels of the other axes.

    The one or two longest axes are drawn. Axes `x` and `y` are returned in the order y, x.
    """
    kept = sorted(sorted(range(len(axes)), key=lambda at: -axes[at].size)[:2])
    others = tuple(at for at in range(len(axes)) if at not in kept)
    drawn, marginal = [axes[at] for at in kept], values.sum(axis=others)
    if [axis.label.lower() for axis in drawn] == ["x", "y"]:
        drawn, marginal = drawn[::-1], marginal.T
    return drawn, marginal, [printable(axes[at].label) for at in others]


# HTML


def as_html(axes: Sequence[Axis], values: NDArray[np.float64], facts: Iterable[str]) -> str:
    """Return HTML that contains a table of the axes, the facts as text, and a picture.

    The HTML contains no scripts or styles, because viewers would remove scripts and styles.
    """
    best = np.unravel_index(values.argmax(), values.shape)
    rows = [
        (
            printable(axis.label),
            f"{axis.size:,}",
            axis.shown(0),
            axis.shown(axis.size - 1),
            axis.shown(int(at)),
        )
        for axis, at in ((axes[place], best[place]) for place in reading_order([each.label for each in axes]))
    ]
    table = _table(("", "cells", "from", "to", "most probable"), rows)
    return table + _sentence(facts) + _picture(*_plane(axes, values))


def _picture(axes: Sequence[Axis], values: NDArray[np.float64], rest: Sequence[str]) -> str:
    reaches = [
        f"{printable(axis.label)} from {axis.shown(0)} to {axis.shown(axis.size - 1)}" for axis in axes
    ]
    blocks = values
    for at in range(len(axes)):
        step = -(-values.shape[at] // _SIDE)
        blocks = np.add.reduceat(blocks, np.arange(0, values.shape[at], step), axis=at)
    shares = blocks / blocks.max()
    if len(axes) == 2:
        # the first row is at the bottom, as on a map
        words = [f"{reaches[1]} to the right", f"{reaches[0]} upwards"]
        return _image(shares[::-1] * 255) + _sentence(words + [f"summed over {label}" for label in rest])
    if len(values) > _MOST_BARS:
        levels = 1 - (np.arange(_SIDE // 4)[:, np.newaxis] + 0.5) / (_SIDE // 4)
        return _image(np.where(shares > levels, 85, 255)) + _sentence(reaches)
    rows = []
    for at, share in enumerate(shares.tolist()):
        whole, eighths = divmod(round(8 * _BAR * share), 8)
        bar = "█" * whole + " ▏▎▍▌▋▊▉"[eighths].strip()
        rows.append((axes[0].shown(at), f"{values[at]:.4f}", bar))
    return _table((printable(axes[0].label), "probability", ""), rows)


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    def row(cells: Iterable[str], tag: str) -> str:
        return "".join(f'<{tag} align="left">{escape(cell)}</{tag}>' for cell in cells)

    body = "".join(f"<tr>{row(cells, 'td')}</tr>" for cells in rows)
    return f"<table><tr>{row(head, 'th')}</tr>{body}</table>"


def _sentence(facts: Iterable[str]) -> str:
    return f"<p>{escape('; '.join(facts))}</p>"


def _image(shades: NDArray[Any]) -> str:
    """Return shades from 0 to 255 as an enlarged PNG."""
    from matplotlib.image import imsave

    long = max(shades.shape)
    sides = shades.shape if long > _LONGEST * min(shades.shape) else (long, long)
    down, across = (max(1, _SIDE // side) for side in sides)
    pixels, file = shades.repeat(down, axis=0).repeat(across, axis=1), io.BytesIO()
    imsave(file, pixels, vmin=0, vmax=255, cmap="viridis", format="png")
    return f'<img alt="posterior" src="data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"/>'


# matplotlib


def draw(all_axes: Sequence[Axis], all_values: NDArray[np.float64], into: Any) -> Any:
    """Draw bars or a map into matplotlib Axes, and return the Axes. If `into` is None, the figure is new."""
    if into is None:
        from matplotlib import pyplot as plt

        _, into = plt.subplots(layout="constrained")
    axes, values, rest = _plane(all_axes, all_values)
    across = axes[-1]
    if len(axes) == 1:
        width = 0.8 if across.has_states else abs(_step(across))
        into.bar([_place(across, at) for at in range(across.size)], values, width=width)
        into.set_ylabel("probability")
    else:
        extent = [_place(axis, at) for axis in (across, axes[0]) for at in (-0.5, axis.size - 0.5)]
        short, long = sorted(values.shape)
        alike = (axes[0].unit, abs(_step(axes[0]))) == (across.unit, abs(_step(across)))
        aspect = "equal" if alike and long <= _LONGEST * short else "auto"
        image = into.imshow(values, origin="lower", extent=extent, aspect=aspect)
        into.figure.colorbar(image, ax=into, label="probability")
        _name(into.yaxis, axes[0])
    _name(into.xaxis, across)
    if rest:
        into.set_title(f"summed over {', '.join(rest)}", parse_math=False)
    return into


def _step(axis: Axis) -> float:
    return 1.0 if axis.dimension is None or axis.has_states else axis.dimension.step


def _place(axis: Axis, index: float) -> float:
    """Return the coordinate of an index: its value, or the index itself if it stands for a named state."""
    return index if axis.dimension is None or axis.has_states else axis.dimension.value(index)


def _name(drawn: Any, axis: Axis) -> None:
    unit = f" ({axis.unit})" if axis.unit else ""
    drawn.set_label_text(f"{printable(axis.label)}{unit}", parse_math=False)
    if axis.has_states:
        places = range(0, axis.size, -(-axis.size // _MOST_NAMES))
        drawn.set_ticks(places, labels=[axis.shown(at) for at in places], parse_math=False)
