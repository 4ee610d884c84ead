"""Time stamps in messages: `secs`/`nsecs` in ROS 1 and `sec`/`nanosec` in ROS 2."""

from collections.abc import Mapping
from typing import Any, Final, Literal

_NS: Final = 1_000_000_000
# Seconds are uint32 in ROS 1 and int32 in ROS 2, nanoseconds uint32 in both.
_WORD: Final = 1 << 32
_KEYS: Final = (("sec", "nanosec", 2), ("secs", "nsecs", 1))


def stamp(time_ns: int, ros_version: Literal[1, 2] | None = None) -> dict[str, int]:
    """Return nanoseconds since 1970 as a ROS time with the keys of one version, or of both if `ros_version` is None."""
    seconds, nanoseconds = divmod(time_ns, _NS)
    time: dict[str, int] = {}
    for second, nanosecond, version in _KEYS:
        if ros_version in (None, version):
            time[second] = seconds
            time[nanosecond] = nanoseconds
    return time


def header(time_ns: int, frame_id: str = "", ros_version: Literal[1, 2] | None = None) -> dict[str, Any]:
    """Return a `std_msgs/Header` without `seq`, because ROS 1 fills `seq` in and ROS 2 refuses it."""
    return {"stamp": stamp(time_ns, ros_version), "frame_id": frame_id}


def stamp_ns(time: object) -> int | None:
    """Return a time of either ROS version in nanoseconds since 1970, or None if `time` is not a valid time."""
    if not isinstance(time, Mapping):
        return None
    # A message with both pairs has the same time in both, so the first one found is enough.
    for second, nanosecond, _version in _KEYS:
        if second in time:
            seconds, nanoseconds = time[second], time.get(nanosecond, 0)
            # A time beyond the ranges of both versions would not fit into 64 bits of nanoseconds.
            if type(seconds) is not int or type(nanoseconds) is not int:
                break
            if -_WORD // 2 <= seconds < _WORD and 0 <= nanoseconds < _WORD:
                return seconds * _NS + nanoseconds
            break
    return None


def header_stamp_ns(msg: Mapping[str, Any]) -> int | None:
    """Return the `header.stamp` of a message in nanoseconds since 1970, or None if the stamp is missing or zero."""
    head = msg.get("header")
    return (stamp_ns(head.get("stamp")) or None) if isinstance(head, Mapping) else None


def ros_version_of_message(msg: Mapping[str, Any]) -> Literal[1, 2] | None:
    """Return the ROS version that the keys of `header.stamp` show, or None if the keys are missing or ambiguous."""
    head = msg.get("header")
    time = head.get("stamp") if isinstance(head, Mapping) else None
    if not isinstance(time, Mapping) or ("sec" in time) == ("secs" in time):
        return None
    return 2 if "sec" in time else 1
