"""Output of the master's results: a line of JSON, a sentence, or a posterior for drawing."""

import time
from collections.abc import Sequence

from posteriors.axes import Axis, deployment_axes, in_words
from posteriors.posterior import Posterior
from services.errors import StackError
from services.pipeline.inference import infer, report_of
from services.sockets.records import Publish, Published
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
    """Return a result as a line of text, in the wording of `listen`."""
    axes = deployment_axes(deployment)
    return (
        f"frame {record.number}: {in_words(axes, _cell(axes, record.best_line))} with {record.best_probability:.3g}; "
        f"{record.cycles} cycles; {record.total_ns / 1e6:.2f} ms"
    )


def _cell(axes: Sequence[Axis], line: int) -> dict[str, int]:
    """Convert the number of a cell (a line of the machine) to indices by label; the last dimension changes fastest."""
    indices: dict[str, int] = {}
    for axis in reversed(axes):
        line, indices[axis.label] = divmod(line, axis.size)
    return {axis.label: indices[axis.label] for axis in axes}


def posterior_of(publish: Publish, deployment: Deployment) -> Posterior | None:
    """Return the posterior of a computed frame, with the frame's report, or None if all counts were 0."""
    inference = infer(publish.result, deployment)
    if inference.posterior is None:
        return None
    dimensions = deployment.result_dimensions
    # the result has not been sent to the robot yet, so the time of that stage is 0
    now = time.time_ns(), time.monotonic_ns()
    return Posterior(
        probabilities=tuple(inference.posterior.tolist()),
        labels=tuple(dimension.label for dimension in dimensions),
        sizes=tuple(dimension.size for dimension in dimensions),
        heard_ns=now[0],
        report=report_of(publish, inference, deployment, now=now, previous_out_ns=0),
    )
