"""Results as standard ROS messages, which robot tools can show: counts, grid, pose, decision and health.

`services/pipeline/standard_topics.py` publishes the messages (docs/reference/topics.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, Self

import numpy as np

from bridge.stamps import header, stamp
from posteriors.axes import reading_order
from posteriors.posterior import REPLICA

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from machines.kind import BoardResult
    from toolchain.deployment import Deployment, Dimension

MAP_FRAME: Final = "map"
"""The tf frame of grid and pose. The searched variables are coordinates in this frame."""
MOST_OCCUPIED: Final = 98
"""Value of the most probable cell in a grid message. rviz would paint 99 and 100 as obstacles."""
_HEADING_VARIANCE: Final = math.pi**2 / 3
"""Variance of an angle that is uniform over the circle, published because a grid says nothing about the heading."""
_METRES: Final = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "km": 1000.0}

RosVersion = Literal[1, 2]
Values = Mapping[str, object]


class Level(IntEnum):
    """Levels of a diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Plane(NamedTuple):
    """The plane that two searched variables span. Lengths are in metres."""

    x: Dimension
    y: Dimension
    x_is_last: bool
    """True if x is the last dimension of the posterior, whose index varies fastest."""

    @classmethod
    def of(cls, dimensions: Sequence[Dimension], *, square: bool = False) -> Self:
        """Return the plane of a result's dimensions.

        Variables named x and y become the axes of these names. With other names, the last variable is x.

        Raises a ValueError if the dimensions span no plane, or if `square` is set and the cells are not square.
        """
        if len(dimensions) != 2 or dimensions[0].label == REPLICA:
            raise ValueError(f"a posterior over {', '.join(each.label for each in dimensions)} is no plane")
        if named := [each.label for each in dimensions if each.states]:
            raise ValueError(f"the values of {named[0]} are names")
        slow, fast = (
            each.replace(offset=each.offset * metres, step=each.step * metres)
            for each in dimensions
            for metres in (_METRES.get(each.unit, 1.0),)
        )
        x_is_last = (slow.label.lower(), fast.label.lower()) != ("x", "y")
        x, y = (fast, slow) if x_is_last else (slow, fast)
        if square and not math.isclose(abs(x.step), abs(y.step), rel_tol=1e-6):
            raise ValueError(
                f"its cells would not be square: {abs(x.step):g} along x, {abs(y.step):g} along y"
            )
        return cls(x, y, x_is_last)

    def cells(self, posterior: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a posterior as float64[y, x]."""
        if self.x_is_last:
            return posterior.reshape(self.y.size, self.x.size)
        return posterior.reshape(self.x.size, self.y.size).T


def has_coordinates(dimensions: Sequence[Dimension]) -> bool:
    """Return whether a posterior is over two coordinates.

    A coordinate is a length, or a number that has no unit and is not only an index.
    """
    return len(dimensions) == 2 and all(
        not each.states and (each.unit in _METRES or (not each.unit and (each.offset, each.step) != (0, 1)))
        for each in dimensions
    )


# --- posteriors ---------------------------------------------------------------------------------


def counts_message(boards: Sequence[BoardResult]) -> dict[str, Any]:
    """Return the result words of the boards as a std_msgs/UInt32MultiArray with a row for each board.

    Zeros fill each row up to the length of the longest row.
    """
    rows = [np.frombuffer(board.words, "<u4") for board in boards]
    width = max((len(row) for row in rows), default=0)
    counts = np.zeros((len(rows), width), np.uint32)
    for at, row in enumerate(rows):
        counts[at, : len(row)] = row
    dimensions = [
        {"label": "board", "size": len(rows), "stride": counts.size},
        {"label": "count", "size": width, "stride": width},
    ]
    return {"layout": {"dim": dimensions, "data_offset": 0}, "data": counts.ravel()}


def grid_message(
    posterior: NDArray[np.float64], plane: Plane, stamp_ns: int, ros_version: RosVersion
) -> dict[str, Any]:
    """Return a posterior as a nav_msgs/OccupancyGrid. The cells of `plane` must be square.

    A cell of probability p has the value `round(98 p / p_max)`, at index `y * width + x`. An axis
    with a negative step is reversed, because x and y increase with the index.
    """
    cells = plane.cells(posterior)[:: -1 if plane.y.step < 0 else 1, :: -1 if plane.x.step < 0 else 1]
    data = np.rint(cells * (MOST_OCCUPIED / posterior.max())).astype(np.int8)
    resolution = abs(plane.x.step)
    x, y = (min(axis.value(0), axis.value(axis.size - 1)) - resolution / 2 for axis in (plane.x, plane.y))
    return {
        "header": header(stamp_ns, MAP_FRAME, ros_version),
        "info": {
            "map_load_time": stamp(stamp_ns, ros_version),
            "resolution": resolution,
            "width": plane.x.size,
            "height": plane.y.size,
            "origin": pose_at(x, y),
        },
        "data": data.ravel(),
    }


def pose_message(
    posterior: NDArray[np.float64], plane: Plane, stamp_ns: int, ros_version: RosVersion
) -> dict[str, Any]:
    """Return the mean and the covariance of a posterior as a geometry_msgs/PoseWithCovarianceStamped."""
    (row, column), (rows, both, columns) = moments(plane.cells(posterior))
    covariance = np.zeros((6, 6))
    covariance[0, 0], covariance[1, 1] = columns * plane.x.step**2, rows * plane.y.step**2
    covariance[0, 1] = covariance[1, 0] = both * plane.x.step * plane.y.step
    covariance[5, 5] = _HEADING_VARIANCE
    pose = pose_at(plane.x.value(column), plane.y.value(row))
    return {
        "header": header(stamp_ns, MAP_FRAME, ros_version),
        "pose": {"pose": pose, "covariance": covariance.ravel()},
    }


def moments(cells: NDArray[np.float64]) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """Return mean (row, column) and covariance (row-row, row-column, column-column) of a distribution over cells."""
    rows, columns = np.arange(cells.shape[0]), np.arange(cells.shape[1])
    by_row, by_column = cells.sum(axis=1), cells.sum(axis=0)
    total = by_row.sum()
    row, column = float(by_row @ rows / total), float(by_column @ columns / total)
    down, across = rows - row, columns - column
    return (row, column), (
        by_row @ down**2 / total,
        down @ cells @ across / total,
        by_column @ across**2 / total,
    )


def pose_at(x: float, y: float) -> dict[str, Any]:
    """Return a geometry_msgs/Pose without rotation."""
    return {"position": {"x": x, "y": y, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


# --- diagnostics --------------------------------------------------------------------------------


def diagnostics(
    statuses: Iterable[dict[str, Any]], stamp_ns: int, frame_id: str, ros_version: RosVersion
) -> dict[str, Any]:
    """Return a diagnostic_msgs/DiagnosticArray with these statuses."""
    return {"header": header(stamp_ns, frame_id, ros_version), "status": list(statuses)}


def status(name: str, level: Level, message: str, hardware_id: str, values: Values) -> dict[str, Any]:
    """Return a diagnostic_msgs/DiagnosticStatus without the `values` that are None."""
    return {
        "level": int(level),
        "name": f"rosbayes: {name}",
        "message": message,
        "hardware_id": hardware_id,
        "values": [{"key": key, "value": str(value)} for key, value in values.items() if value is not None],
    }


def decision_statuses(
    posterior: NDArray[np.float64] | None, deployment: Deployment, *, why: str, number: int, age_ms: float
) -> list[dict[str, Any]]:
    """Return a DiagnosticStatus for each replica, with the replica's most probable value.

    `why` says why the decision is not valid, or is empty. `age_ms` is the time since the receipt of the reading.
    """
    replicas = deployment.machine.replicas
    rows = [None] * replicas if posterior is None else posterior.reshape(replicas, -1)
    statuses = []
    for replica, row in enumerate(rows):
        decided = row is not None and bool(row.any())
        reason = why or ("" if decided else "all counts of this replica are 0")
        values: dict[str, object] = {}
        message = reason
        if row is not None and decided:
            best = _best(row, deployment.searched)
            values = {f"value.{label}": value for label, value in best.items()} | _certainty(row)
            message = ", ".join(f"{label} {value}" for label, value in best.items())
        values |= {
            "valid": "false" if reason else "true",
            "why": reason,
            "age_ms": f"{age_ms:.1f}",
            "number": number,
        }
        name = f"decision of replica {replica}" if replicas > 1 else "decision"
        statuses.append(status(name, Level.WARN if reason else Level.OK, message, deployment.name, values))
    return statuses


def _best(row: NDArray[np.float64], dimensions: Sequence[Dimension]) -> dict[str, str]:
    """Return the most probable cell, x before y: for each variable the name of a state, or a number with its unit."""
    indices = np.unravel_index(int(row.argmax()), [each.size for each in dimensions])
    ordered = [(dimensions[at], indices[at]) for at in reading_order([each.label for each in dimensions])]
    return {
        each.label: each.states[index]
        if each.states
        else f"{each.value(int(index)):.9g} {each.unit}".rstrip()
        for each, index in ordered
    }


def _certainty(row: NDArray[np.float64]) -> dict[str, object]:
    """Return the largest probability, its margin to the second largest, and the entropy."""
    row = row / row.sum()
    second, first = np.partition(row, -2)[-2:] if row.size > 1 else (0.0, row[0])
    possible = row[row > 0]
    return {
        "probability": f"{first:.6g}",
        "margin": f"{first - second:.6g}",
        "entropy_bits": f"{abs(float(possible @ np.log2(possible))):.6g}",
    }
