"""The boat's map, its sensors with their noise, and their ROS messages.

The map and the sensors are those of thesis 2.1.2.1. The numbers are from the published version of this example
(Bessiere et al., Bayesian Programming, ch. 7). Distances are in map units, and bearings are in degrees.

The messages `boat_msgs/Raw` and `boat_msgs/Sensors` have named fields and a time stamp. But a ROS server accepts only
types of installed packages. To a server without `boat_msgs`, the readings are sent as std_msgs/Float64MultiArray, in
the order of `SENSOR_NAMES`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from bridge.fields import Field
from casestudies.grid import Grid
from terminal.one_line import shown

MAP_LOW: Final = -50.0
"""Lowest x and y of the map, in map units. The map is the square [MAP_LOW, MAP_HIGH]^2."""
MAP_HIGH: Final = 50.0
BEACONS: Final = ((-50.0, -50.0), (-50.0, 0.0), (0.0, -50.0))
"""Positions of the beacons: the lower left corner, and the middles of the left and the lower side (thesis 4.1)."""
BEACON_NAMES: Final = ("beacon1", "beacon2", "beacon3")
DISTANCE_NAMES: Final = ("D1", "D2", "D3")
BEARING_NAMES: Final = ("B1", "B2", "B3")
SENSOR_NAMES: Final = DISTANCE_NAMES + BEARING_NAMES
"""Names of the sensors. The machine's columns and the readings in an array message have this order."""
LONGEST_DISTANCE: Final = 100
"""Largest distance reading, in map units. Larger distances occur at the map's far corners, and are clamped."""
BEARING_SIGMA: Final = 10.0
"""Standard deviation of a bearing, in degrees."""


def map_grid(width: int = 32, height: int = 32) -> Grid:
    """Return the map as a grid of cells. The thesis ran 32 x 32 cells on four boards (4.2)."""
    return Grid(x_low=MAP_LOW, x_high=MAP_HIGH, y_low=MAP_LOW, y_high=MAP_HIGH, width=width, height=height)


def distance(x: float, y: float, beacon: tuple[float, float]) -> float:
    """Return the distance from (x, y) to a beacon."""
    return math.hypot(x - beacon[0], y - beacon[1])


def bearing(x: float, y: float, beacon: tuple[float, float]) -> float:
    """Return the absolute bearing of (x, y) from a beacon in degrees, 0 <= bearing < 360, counter-clockwise from +x."""
    degrees = math.degrees(math.atan2(y - beacon[1], x - beacon[0])) % 360.0
    return degrees if degrees < 360.0 else 0.0  # a tiny negative angle rounds up to 360 in the modulo


def distance_sigma(true_distance: float) -> float:
    """Return the standard deviation of distance readings at the distance `true_distance`, both in map units."""
    return true_distance / 10.0 + 5.0


RAW_TOPIC: Final = "/boat/raw"
RAW_TYPE: Final = "boat_msgs/Raw"
SENSORS_TOPIC: Final = "/boat/sensors"
SENSORS_TYPE: Final = "boat_msgs/Sensors"
ARRAY_TYPE: Final = "std_msgs/Float64MultiArray"
TRUE_POSE_TOPIC: Final = "/boat/true_pose"
TRUE_POSE_TYPE: Final = "geometry_msgs/PoseStamped"
SET_POSE_TOPIC: Final = "/boat/set_pose"
"""Topic on which any client may publish a pose (`TRUE_POSE_TYPE`) to move the boat there."""
DRIVE_TOPIC: Final = "/cmd_vel"
"""Topic on which any client may publish a velocity to drive the boat."""
DRIVE_TYPE: Final = "geometry_msgs/Twist"
COMPASS_TOPIC: Final = "/boat/imu"
COMPASS_TYPE: Final = "sensor_msgs/Imu"
BEACONS_TOPIC: Final = "/boat/beacons"
BEACONS_TYPE: Final = "visualization_msgs/MarkerArray"
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


class BadNumberError(Exception):
    """A command to the boat, or a message of raw readings, has no usable number in the field named `field`."""

    def __init__(self, field: str, value: object, wanted: str = "be a finite number") -> None:
        super().__init__(f"{field} must {wanted}, not {shown(repr(value))}")
        self.field = field


def read_set_pose(message: dict[str, Any]) -> tuple[float, float]:
    """Return x and y of a geometry_msgs/PoseStamped, or raise a BadNumberError."""
    return _number(message, "pose.position.x"), _number(message, "pose.position.y")


def read_drive(message: dict[str, Any]) -> tuple[float, float]:
    """Return the forward speed and the turn rate (positive to the left) of a Twist, or raise a BadNumberError."""
    return _number(message, "linear.x"), _number(message, "angular.z")


def _number(message: dict[str, Any], path: str) -> float:
    return _finite(path, Field(path).value(message)[1])


def _finite(field: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise BadNumberError(field, value)
    return float(value)


def beacon_markers(head: dict[str, Any]) -> dict[str, Any]:
    """Return a visualization_msgs/MarkerArray that shows each beacon as a sphere with the beacon's name."""
    return {
        "markers": [
            {
                "header": head,
                "ns": "beacon",
                "id": number,
                "type": 2,  # SPHERE
                "action": 0,  # ADD
                "pose": true_pose(x, y, head)["pose"],
                "scale": {"x": 3.0, "y": 3.0, "z": 3.0},
                "color": {"r": 0.9, "g": 0.6, "b": 0.0, "a": 1.0},
                "text": name,
            }
            for number, (name, (x, y)) in enumerate(zip(BEACON_NAMES, BEACONS, strict=True), 1)
        ]
    }


def true_pose(x: float, y: float, head: dict[str, Any], heading: float = 0.0) -> dict[str, Any]:
    """Return a geometry_msgs/PoseStamped at (x, y), with a heading in radians."""
    return {
        "header": head,
        "pose": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": _rotation(heading)},
    }


def compass(heading: float, head: dict[str, Any]) -> dict[str, Any]:
    """Return a heading in radians as a sensor_msgs/Imu. A covariance of -1 marks a quantity that is not measured."""
    nothing = {"x": 0.0, "y": 0.0, "z": 0.0}
    unknown = [-1.0, *[0.0] * 8]
    return {
        "header": head,
        "orientation": _rotation(heading),
        "orientation_covariance": [0.0] * 9,
        "angular_velocity": nothing,
        "angular_velocity_covariance": unknown,
        "linear_acceleration": nothing,
        "linear_acceleration_covariance": unknown,
    }


def _rotation(heading: float) -> dict[str, float]:
    return {"x": 0.0, "y": 0.0, "z": math.sin(heading / 2), "w": math.cos(heading / 2)}


def readings_message(
    values: Sequence[float | None], head: Mapping[str, Any] | None, *, array: bool
) -> dict[str, Any]:
    """Return a message with six readings, in the order of `SENSOR_NAMES`, and with the header `head`, if any.

    With `array`, the message is a std_msgs/Float64MultiArray without a header, in which a missing reading (None) is
    null, because rosbridge sends NaN as null. Without `array`, the field of a missing reading is absent.
    """
    if array:
        return {
            "layout": {
                "dim": [{"label": "sensor", "size": len(values), "stride": len(values)}],
                "data_offset": 0,
            },
            "data": [None if value is None else float(value) for value in values],
        }
    named = zip(SENSOR_NAMES, values, strict=True)
    fields: dict[str, Any] = {name: value for name, value in named if value is not None}
    return fields if head is None else {"header": dict(head), **fields}


def read_raw(
    message: Mapping[str, Any], *, array: bool
) -> tuple[tuple[float | None, ...], Mapping[str, Any] | None]:
    """Return the six raw readings and the header of a message, or raise a BadNumberError.

    A reading that is absent, null or NaN becomes None. The header may be None.
    """
    if array:
        data = message.get("data")
        if not isinstance(data, list) or len(data) != len(SENSOR_NAMES):
            raise BadNumberError("data", data, f"hold {len(SENSOR_NAMES)} numbers")
        named = dict(zip(SENSOR_NAMES, data, strict=True))
        head = None
    else:
        named = {name: message.get(name) for name in SENSOR_NAMES}
        head = message.get("header")
    values = tuple(
        None if value is None or value != value else _finite(name, value)  # noqa: PLR0124 - NaN; math.isnan takes only numbers
        for name, value in named.items()
    )
    return values, head if isinstance(head, Mapping) else None
