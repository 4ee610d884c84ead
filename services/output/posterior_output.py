"""Output of frames on standard output, each as a line, a JSON object or a picture.

A picture of one dimension has bars. A picture of two dimensions is a heat map.
"""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from posteriors.axes import Axis, in_words, printable
from posteriors.errors import LabelError
from posteriors.pairing import FrameOutcome
from posteriors.posterior import Posterior
from services.output.posterior_file import record
from terminal.one_line import one_line
from terminal.output import print_json_line
from terminal.pictures import VIRIDIS

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

_PICTURES_A_SECOND: Final = 10
_REPLICAS: Final = 4
"""Maximum number of replicas in a printed line; a saved file contains all."""
_WORDS: Final = 7
"""Number of terminal lines reserved for the text around a picture."""

ROWS: Final = 32
"""Maximum number of terminal lines in a picture. Finer posteriors are drawn in blocks of cells."""
WIDTH: Final = 160
"""Maximum width of a picture in characters."""
_SHADES: Final = " .:-=+*#%@"
Show = Callable[[FrameOutcome, list[Axis]], None]
"""Type of a function that shows a frame, given the axes of the frame's posterior."""


def line(frame: FrameOutcome, axes: list[Axis]) -> str:
    """Return the line of text for one frame."""
    number = "-" if frame.number is None else str(frame.number)
    if not isinstance(frame, Posterior):
        return f"frame {number}: {one_line(frame.outcome)}"
    # replicas are separate posteriors, so a mean over all of them is meaningless
    if frame.replicas > 1:
        parts = [f"frame {number}: {frame.replicas} replicas"]
        parts += [_of_replica(frame, at, axes[1:]) for at in range(min(frame.replicas, _REPLICAS))]
        if frame.replicas > _REPLICAS:
            parts.append(f"and {frame.replicas - _REPLICAS} more")
    else:
        parts = [f"frame {number}: {_best(frame, axes)}", *_means(frame, axes)]
    if frame.cycles is not None:
        parts.append(f"{frame.cycles} cycles")
    if frame.latency_us is not None:
        parts.append(f"{frame.latency_us / 1000:.2f} ms")
    if frame.report is not None and frame.report.is_biased:
        parts.append(one_line(frame.report.outcome))
    return "; ".join(parts)


def _best(posterior: Posterior, axes: list[Axis]) -> str:
    return f"{in_words(axes, posterior.best())} with {posterior.probability:.3g}"


def _means(posterior: Posterior, axes: list[Axis]) -> list[str]:
    """Return a list with the part of a line that shows the means.

    The list is empty if the values of all axes are names.
    """
    numbers = [axis for axis in axes if not axis.has_states]
    return [f"mean {in_words(numbers, posterior.mean())}"] if numbers else []


def _of_replica(frame: Posterior, at: int, axes: list[Axis]) -> str:
    try:
        one = frame.replica(at)
    except LabelError:
        return f"replica {at} no posterior"
    return f"replica {at} {_best(one, axes)}"


def print_line(frame: FrameOutcome, axes: list[Axis]) -> None:
    """Print a frame as a line."""
    print(line(frame, axes), flush=True)


def print_json(frame: FrameOutcome, axes: list[Axis]) -> None:
    """Print a frame as a JSON object."""
    print_json_line(record(frame, axes))


@contextlib.contextmanager
def drawing() -> Iterator[Show]:
    """Yield a function that draws frames. On a terminal, a frame replaces the last frame; elsewhere it is appended."""
    # labels come from the robot's side, so neither brackets nor numbers in them are formatted
    console = Console(highlight=False, markup=False)
    colour = console.color_system is not None and not console.no_color  # NO_COLOR disables it
    rows = max(console.height - _WORDS, 2) if console.is_terminal else ROWS

    def drawn(frame: FrameOutcome, axes: list[Axis]) -> Group | Text:
        words = Text(line(frame, axes))
        if not isinstance(frame, Posterior):
            return words
        return Group(words, picture(frame, axes, width=console.width, rows=rows, colour=colour))

    if not console.is_terminal:
        # a picture with wrapped rows could not be recognised
        yield lambda frame, axes: console.print(drawn(frame, axes), soft_wrap=True)
        return
    # The last frame, which is drawn at the end in any case; and the time of the last picture (monotonic, s).
    newest: list[tuple[FrameOutcome, list[Axis]]] = []
    shown = -1.0
    with Live(console=console, auto_refresh=False) as live:

        def show(frame: FrameOutcome, axes: list[Axis]) -> None:
            nonlocal shown
            newest[:] = [(frame, axes)]
            now = time.monotonic()
            # a picture takes longer than a frame of a fast stack
            if now - shown >= 1 / _PICTURES_A_SECOND:
                shown = now
                live.update(drawn(frame, axes), refresh=True)

        try:
            yield show
        finally:
            for frame, axes in newest:
                live.update(drawn(frame, axes), refresh=True)


# --- pictures ---------------------------------------------------------------------------------------


def picture(posterior: Posterior, axes: list[Axis], *, width: int, colour: bool, rows: int = ROWS) -> Text:
    """Draw a posterior with at most `width` columns and `rows` lines, plus text.

    Without colour, characters show the probabilities. If there are more than two dimensions, the two longest are
    drawn, and the others are summed out.
    """
    # the words around the picture stay on the screen
    width, rows = min(width, WIDTH), max(min(rows, ROWS), 2)
    if len(axes) == 1:
        return _bars(posterior.values, axes[0], width, rows, colour)
    largest = sorted(sorted(range(len(axes)), key=lambda at: -axes[at].size)[:2])
    down, across = (axes[at] for at in largest)
    # x goes across, as on a map; otherwise the order is the deployment's
    if (down.label.lower(), across.label.lower()) == ("x", "y"):
        down, across = across, down
    text = _heat(posterior.marginal(down.label, across.label), down, across, (width, rows), colour)
    if summed := [printable(axis.label) for at, axis in enumerate(axes) if at not in largest]:
        text.append(f"\nsummed over {', '.join(summed)}")
    return text


def _bars(values: "npt.NDArray[np.float64]", axis: Axis, width: int, rows: int, colour: bool) -> Text:
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
    values: "npt.NDArray[np.float64]", down: Axis, across: Axis, room: tuple[int, int], colour: bool
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


def _blocks(values: "npt.NDArray[np.float64]", step: int, axis: int) -> "npt.NDArray[np.float64]":
    """Return the sums over blocks of cells along an axis; the last block may have fewer."""
    import numpy as np

    return np.add.reduceat(values, np.arange(0, values.shape[axis], step), axis=axis)


def _range(axis: Axis, first: int, last: int) -> str:
    return axis.shown(first) if first == last else f"{axis.shown(first)} to {axis.shown(last)}"


def _style(share: float) -> str:
    red, green, blue = VIRIDIS[round(share * (len(VIRIDIS) - 1))]
    return f"on rgb({red},{green},{blue})"
