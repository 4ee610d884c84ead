"""Names of ROS topics and services, and names of types in ROS 1 (`pkg/Type`) and ROS 2 (`pkg/msg/Type`).

Sources: http://wiki.ros.org/Names, https://design.ros2.org/articles/topic_and_service_names.html.
"""

import re
from functools import lru_cache
from typing import Literal

from bridge.errors import NameFormError

Kind = Literal["msg", "srv", "action"]
RosVersion = Literal[1, 2]

MAX_NAME = 255
"""Maximum length of a name in characters. ROS 2 has this limit for topics."""

_TYPE = re.compile(r"([A-Za-z][A-Za-z0-9_]*)/(?:(msg|srv|action)/)?([A-Za-z][A-Za-z0-9_]*)")
_TOPIC = re.compile(r"[~/]?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*")
_CACHED_TYPES = 1024


# Cached, because the few types of a robot are compared often.
@lru_cache(maxsize=_CACHED_TYPES)
def split_type(name: str) -> tuple[str, str, str]:
    """Return the package, the kind and the name of a type.

    The kind is `msg`, `srv` or `action`. The kind is empty if `name` has the ROS 1 form, `package/Type`.
    """
    match = _TYPE.fullmatch(name) if len(name) <= MAX_NAME else None
    if match is None:
        raise NameFormError(
            f"type name {name[:80]!r} is neither package/Type (ROS 1) nor package/msg/Type (ROS 2)"
        )
    package, kind, own = match.groups()
    return package, kind or "", own


def ros1_type(name: str) -> str:
    """Return the ROS 1 form of a type name, such as `std_msgs/String`."""
    package, _kind, own = split_type(name)
    return f"{package}/{own}"


def ros2_type(name: str, kind: Kind = "msg") -> str:
    """Return the ROS 2 form of a type name, such as `std_msgs/msg/String`. A name without a kind gets `kind`."""
    package, its_kind, own = split_type(name)
    return f"{package}/{its_kind or kind}/{own}"


def same_type(one: str, other: str) -> bool:
    """Return whether two type names denote the same type. Each name may have the form of ROS 1 or ROS 2.

    If a name is malformed, the result is True only if the two names are equal.
    """
    if one == other:
        return True
    try:
        package_1, kind_1, own_1 = split_type(one)
        package_2, kind_2, own_2 = split_type(other)
    except NameFormError:
        return False
    # The form of ROS 1 leaves the kind open.
    return (package_1, own_1) == (package_2, own_2) and (kind_1 == kind_2 or not kind_1 or not kind_2)


def ros_version_of_type(name: str) -> RosVersion | None:
    """Return the ROS version in whose form a type name is written, or None if the name is malformed."""
    try:
        return 2 if split_type(name)[1] else 1
    except NameFormError:
        return None


def check_name(name: str) -> str:
    """Return a valid name of a topic or service, or raise a NameFormError. Relative names are valid."""
    if len(name) > MAX_NAME:
        raise NameFormError(
            f"name {name[:40]!r}... has {len(name)} characters, at most {MAX_NAME} are allowed"
        )
    if _TOPIC.fullmatch(name) is None:
        raise NameFormError(
            f"{name!r} cannot be the name of a topic or service: letters, digits, _ and / are allowed, "
            "and no part may be empty or start with a digit (example: /boat/sensors)"
        )
    return name


def absolute(name: str) -> str:
    """Return a name, with a leading slash added if the name has none."""
    return name if name.startswith("/") else "/" + name
