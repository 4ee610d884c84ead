"""Output of results by `master`: one JSON object per line, or one sentence."""

from services.errors import StackError
from services.pipeline.generations import InForce
from services.sockets.records import Published
from terminal.output import put_json
from toolchain.deployment import Deployment


def print_json(record: Published, in_force: InForce) -> None:
    """Print a result as a line of JSON.

    Raises:
        BrokenPipeError: The reader has closed the pipe.
        StackError: Standard output can't be written.
    """
    result = {
        "frame": record.number,
        "best": cell(in_force.deployment, record.best_line),
        "probability": record.best_probability,
        "cycles": record.cycles,
        "ms": round(record.total_ns / 1e6, 3),
        "seen": record.seen,
        "generation": in_force.generation,
    }
    try:
        put_json(result)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise StackError(f"standard output can't be written: {error.strerror or error}") from error


def print_sentence(record: Published, in_force: InForce) -> None:
    """Print a result as a sentence."""
    where = ", ".join(
        f"{label} = {value:g}" for label, value in cell(in_force.deployment, record.best_line).items()
    )
    print(
        f"frame {record.number}: most probable {where} (p = {record.best_probability:.3g}), "
        f"{record.cycles} cycles, {record.total_ns / 1e6:.2f} ms",
        flush=True,
    )


def cell(deployment: Deployment, line: int) -> dict[str, float]:
    """Return the values of a line of the result, by label; the last dimension is the fastest."""
    values: dict[str, float] = {}
    for dimension in reversed(deployment.result_dimensions):
        line, index = divmod(line, dimension.size)
        values[dimension.label] = dimension.value(index)
    return dict(reversed(values.items()))
