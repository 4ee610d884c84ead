"""Output of frames on standard output, as a line, a JSON object or a picture each."""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Final

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from posteriors.errors import LabelError
from posteriors.pairing import FrameOutcome
from posteriors.posterior import Posterior
from services.output.axes import Axis, in_words
from services.output.posterior_file import record
from services.output.posterior_picture import ROWS, in_colour, picture
from terminal.output import print_json_line

_PICTURES_A_SECOND: Final = 10
_REPLICAS: Final = 4
"""Maximum number of replicas in a line; a file contains all."""
_WORDS: Final = 7
"""Number of terminal lines reserved for the text around a picture."""

Show = Callable[[FrameOutcome, list[Axis]], None]
"""Function that shows a frame; the axes are those of its posterior."""


def line(frame: FrameOutcome, axes: list[Axis]) -> str:
    """Return the line of one frame."""
    number = "-" if frame.number is None else str(frame.number)
    if not isinstance(frame, Posterior):
        return f"frame {number}: {frame.outcome if frame.outcome.isprintable() else repr(frame.outcome)}"
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
    return "; ".join(parts)


def _best(posterior: Posterior, axes: list[Axis]) -> str:
    return f"{in_words(axes, posterior.best())} with {posterior.probability:.3g}"


def _means(posterior: Posterior, axes: list[Axis]) -> list[str]:
    """Return the part of a line with the means, or an empty text if no axis has one."""
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
    """Draw one picture that is updated on a terminal, and separate pictures elsewhere."""
    # labels come from the robot's side, so neither brackets nor numbers in them are formatted
    console = Console(highlight=False, markup=False)
    colour = in_colour(console)
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
    # The last frame, drawn at the end even if its turn had not come; and the time of the last picture (monotonic, s).
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
