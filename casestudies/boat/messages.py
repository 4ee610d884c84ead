"""The boat's ROS messages: fields named after the sensors, or an array of six numbers.

Messages with named fields (`boat_msgs/Raw`, `boat_msgs/Sensors`) are easy to read and carry a time stamp. A
ROS server accepts only types of installed packages; on one without `boat_msgs` the same numbers are sent as
std_msgs/Float64MultiArray, in the order of `SENSOR_NAMES`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from casestudies.boat.geometry import DISTANCE_NAMES, SENSOR_NAMES
from casestudies.errors import CaseStudyError

RAW_TOPIC: Final = "/boat/raw"
RAW_TYPE: Final = "boat_msgs/Raw"
SENSORS_TOPIC: Final = "/boat/sensors"
SENSORS_TYPE: Final = "boat_msgs/Sensors"
ARRAY_TYPE: Final = "std_msgs/Float64MultiArray"
TRUE_POSE_TOPIC: Final = "/boat/true_pose"
TRUE_POSE_TYPE: Final = "geometry_msgs/PoseStamped"
MAP_FRAME: Final = "map"

RAW_MSG: Final = """\
# boat_msgs/Raw: what the boat's sensors measure. Capitals in field names are ROS 1's; for ROS 2 use --array.
std_msgs/Header header
float64 D1  # distances to the three beacons, in map units
float64 D2
float64 D3
float64 B1  # absolute bearings of the boat as seen from the beacons, in radians, counter-clockwise from +x
float64 B2
float64 B3
"""
SENSORS_MSG: Final = """\
# boat_msgs/Sensors: readings in the ranges of the Bayesian machine's columns.
# Capitals in field names are ROS 1's; for ROS 2 use --array.
std_msgs/Header header
uint8 D1   # distances to the three beacons, whole map units, 0..100
uint8 D2
uint8 D3
uint16 B1  # absolute bearings of the boat as seen from the beacons, whole degrees, 0..359
uint16 B2
uint16 B3
"""


class BadReadingError(CaseStudyError):
    """A message on the raw topic does not hold six numbers."""


def true_pose(x: float, y: float, head: dict[str, Any]) -> dict[str, Any]:
    """Return a geometry_msgs/PoseStamped at (x, y), without rotation."""
    return {
        "header": head,
        "pose": {
            "position": {"x": x, "y": y, "z": 0.0},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
    }


def readings_message(
    values: Sequence[float], head: Mapping[str, Any] | None, *, array: bool
) -> dict[str, Any]:
    """Return six readings, in the order of `SENSOR_NAMES`, as a message with this header, if any.

    With `array` it is a std_msgs/Float64MultiArray, which does not have a header.
    """
    if array:
        return {
            "layout": {
                "dim": [{"label": "sensor", "size": len(values), "stride": len(values)}],
                "data_offset": 0,
            },
            "data": [float(value) for value in values],
        }
    fields: dict[str, Any] = dict(zip(SENSOR_NAMES, values, strict=True))
    return fields if head is None else {"header": dict(head), **fields}


def read_raw(
    message: Mapping[str, Any], *, array: bool
) -> tuple[tuple[float, ...], Mapping[str, Any] | None]:
    """Return the six raw readings of a message and its header, if any, or raise a BadReadingError."""
    if array:
        data = message.get("data")
        if not isinstance(data, list) or len(data) != len(SENSOR_NAMES):
            raise BadReadingError(f"`data` must hold {len(SENSOR_NAMES)} numbers, not {data!r}")
        named = dict(zip(SENSOR_NAMES, data, strict=True))
        head = None
    else:
        named = {name: message.get(name) for name in SENSOR_NAMES}
        head = message.get("header")
    values = []
    for name, value in named.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise BadReadingError(f"the raw reading {name} must be a finite number, not {value!r}")
        values.append(float(value))
    return tuple(values), head if isinstance(head, Mapping) else None


def is_distance(name: str) -> bool:
    """Return whether a sensor measures a distance; the others measure bearings."""
    return name in DISTANCE_NAMES
