"""Files of the frames that the dashboard keeps: a NumPy archive, and a CSV table with a column for each cell."""

import csv
import io
from collections.abc import Sequence

import numpy as np

from posteriors.axes import Axis
from services.dashboard.feed import KeptFrame
from services.output.posterior_file import cell_names, write_archive


def same_shape(frames: Sequence[KeptFrame], shown: KeptFrame | None) -> list[KeptFrame]:
    """Return the frames whose posteriors have the same variables and sizes as the posterior of `shown`.

    If `shown` has no posterior, the newest frame with a posterior is used instead of `shown`.
    """
    with_posterior = [each for each in frames if each.values is not None]
    if shown is None or shown.values is None:
        shown = with_posterior[-1] if with_posterior else None
    return [each for each in with_posterior if shown is not None and each.form == shown.form]


def archive(frames: Sequence[KeptFrame], axes: Sequence[Axis]) -> bytes:
    """Return frames as an archive for `numpy.load`, with the array names of `listen --save`.

    `frames` must not be empty.
    """
    file = io.BytesIO()
    write_archive(
        file,
        [each.report for each in frames],
        axes,
        probabilities=[each.values for each in frames],
        heard_ns=[each.heard_ns for each in frames],
        labels=frames[0].labels,
    )
    return file.getvalue()


def table(frames: Sequence[KeptFrame]) -> bytes:
    """Return frames as a CSV table, one row per frame, with the most probable cell and all probabilities.

    `frames` must not be empty.
    """
    labels, first = frames[0].labels, frames[0].values
    cells = cell_names(labels, first.shape) if first is not None else ()
    file = io.StringIO(newline="")
    rows = csv.writer(file, lineterminator="\n")
    names = ("frame", "stamp_ns", "heard_ns", "cycles", *labels, "probability", *cells)
    rows.writerow(map(_harmless, names))
    for frame in frames:
        report, values = frame.report, frame.values
        if values is None:
            continue
        best = np.unravel_index(int(values.argmax()), values.shape)
        rows.writerow(
            [
                *((report.number, report.stamp_ns) if report else (None, None)),
                *(frame.heard_ns, report.cycles if report else None, *map(int, best), float(values.max())),
                *map(float, values.ravel()),
            ]
        )
    return file.getvalue().encode()


def _harmless(name: str) -> str:
    # a spreadsheet would compute a name that begins like a formula
    return f"'{name}" if name.startswith(("=", "+", "-", "@", "\t", "\r")) else name
