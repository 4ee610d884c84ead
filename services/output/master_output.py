"""Output of results by `master`: one JSON object per line, or one sentence."""

from collections.abc import Sequence

from services.errors import StackError
from services.output.axes import Axis, deployment_axes, in_words
from services.sockets.records import Published
from terminal.output import print_json_line
from toolchain.deployment import Deployment


def print_json(record: Published, deployment: Deployment) -> None:
    """Print a result as a line of JSON.

    Raises:
        BrokenPipeError: The reader has closed the pipe.
        StackError: Standard output cannot be written.
    """
    axes = deployment_axes(deployment)
    best = _cell(axes, record.best_line)
    result = {
        "frame": record.number,
        "probability": record.best_probability,
        "best": best,
        "best_value": {axis.label: axis.value(best[axis.label]) for axis in axes},
        "cycles": record.cycles,
        "ms": round(record.total_ns / 1e6, 3),
        "seen": record.seen,
    }
    try:
        print_json_line(result)
    except BrokenPipeError:
        # the reader has enough, which is no error
        raise
    except OSError as error:
        raise StackError(f"standard output cannot be written: {error.strerror or error}") from error


def sentence(record: Published, deployment: Deployment) -> str:
    """Return a result as a line, worded like those of `listen`."""
    axes = deployment_axes(deployment)
    return (
        f"frame {record.number}: {in_words(axes, _cell(axes, record.best_line))} with {record.best_probability:.3g}; "
        f"{record.cycles} cycles; {record.total_ns / 1e6:.2f} ms"
    )


def _cell(axes: Sequence[Axis], line: int) -> dict[str, int]:
    """Return the index of each dimension at a line of the result; the last dimension is the fastest."""
    indices: dict[str, int] = {}
    for axis in reversed(axes):
        line, indices[axis.label] = divmod(line, axis.size)
    return {axis.label: indices[axis.label] for axis in axes}
