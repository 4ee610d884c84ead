"""Absent fields of a message, filled with their defaults, so that every subscriber sees the whole message.

The reference server builds a ROS message from the JSON and forwards that (`_to_object_inst` in
rosbridge_library/internal/message_conversion.py): an absent field has the message's default, and the stamp of a
`std_msgs/Header` without one is the time of receipt. So is that of an absent header, as the specification says
(ROSBRIDGE_PROTOCOL.md, 3.3.3). Unlike the reference server, the hub does not check present values.
"""

import itertools
from base64 import b64encode
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

import orjson

from bridge.hub.errors import RefusedError
from bridge.stamps import stamp

RosVersion = Literal[1, 2]
FieldTypes = Mapping[str, tuple[str, int]]
"""The types of a message's fields or of their elements, and their lengths: -1 for a scalar, 0 for any."""
_Fill = Callable[[Any, "_Room"], None]
"""Fills a value in place."""

_BRACE: Final = ord("}")
HEADER: Final = "std_msgs/msg/Header"
_TIME: Final = {1: ("secs", "nsecs"), 2: ("sec", "nanosec")}
_TIME_SIZE: Final = len('"nanosec":0000000000,')
_ONE: Final = {("geometry_msgs/msg/Quaternion", "w"): 1.0}
"""The only field of the common ROS 2 messages whose default is not zero."""


@dataclass(slots=True)
class _Room:
    """The bytes by which one message may grow."""

    left: int

    def spend(self, size: int) -> None:
        self.left -= size
        if self.left < 0:
            raise RefusedError("a message is too large with the default values of its absent fields")


class Filler:
    """The fields of one message type, and their defaults."""

    def __init__(self, types: "Types", name: str) -> None:
        """Prepare the defaults of a known type."""
        self._check = _compiled_check(types, name)
        self._fill = types.fill(name)
        self._new_header = types.new_header
        is_special = name == HEADER or name in types.times
        self._defaults = {} if is_special else types.defaults(name)
        self._headers: frozenset[str] = frozenset() if is_special else types.headers(name)
        self._usual: dict[str, Any] = {}
        """The defaults that were last appended, because a publisher usually leaves out the same fields."""
        self._usual_fields: frozenset[str] = frozenset()
        self._usual_tail = b""

    def fill(self, message: dict[str, Any], data: bytes | None, room: int) -> bytes | None:
        """Fill the absent fields of a message in place.

        Args:
            message: The message.
            data: The same as JSON, or None.
            room: Bytes by which it may grow.

        Returns:
            None if nothing was absent, otherwise the whole message as JSON. A value of another type than the
            field's counts as absent and is left as it is.

        Raises:
            RefusedError: It would grow by more.
        """
        if self._usual and message and self._usual_fields.isdisjoint(message):
            message.update(self._usual)
            if data is None or data[-1] != _BRACE or not self._is_complete(message):
                return self._fill_absent(message, None, _Room(room))
            return data[:-1] + self._usual_tail
        try:  # `_is_complete` without its call
            self._check(message)
        except (KeyError, TypeError):
            return self._fill_absent(message, data, _Room(room))
        return None

    def named(self, values: list[Any]) -> dict[str, Any]:
        """Return the message with these values in the order of the fields, as arguments of services may be given."""
        return dict(zip(self._defaults, values, strict=False))

    def _fill_absent(self, message: dict[str, Any], data: bytes | None, room: _Room) -> bytes:
        if not message.keys() >= self._defaults.keys():
            was_empty = not message
            added = self._add(message)
            room.spend(len(added) + 1)
            if data is not None and self._is_complete(message):
                # The fields are appended, because rewriting takes long if the message has long arrays.
                return b"{%b}" % added if was_empty else b"%b,%b}" % (data[: data.rindex(b"}")], added)
        self._fill(message, room)
        return orjson.dumps(message)

    def _is_complete(self, message: dict[str, Any]) -> bool:
        try:
            self._check(message)
        except (KeyError, TypeError):
            return False
        return True

    def _add(self, message: dict[str, Any]) -> bytes:
        """Add the absent fields to a message, and return their JSON without the braces."""
        absent = {
            field: self._new_header() if field in self._headers else default
            for field, default in self._defaults.items()
            if field not in message
        }
        message |= absent
        if not self._headers.isdisjoint(absent):
            return orjson.dumps(absent)[1:-1]
        added = orjson.dumps(absent)[1:-1]
        self._usual, self._usual_fields, self._usual_tail = absent, frozenset(absent), b",%b}" % added
        return added


class Types:
    """Defaults and filling functions of the types of one ROS version."""

    def __init__(
        self,
        field_types: Callable[[str], FieldTypes],
        scalars: Mapping[str, Any],
        times: Container[str],
        ros_version: RosVersion,
        wall_clock: Callable[[], int],
    ) -> None:
        """Start without prepared types.

        Args:
            field_types: Returns the fields of a message; of a basic type, raises a KeyError.
            scalars: Defaults of the basic types.
            times: Names of the types of times.
            ros_version: 1 or 2.
            wall_clock: Returns nanoseconds since 1970.
        """
        self.times = times
        self._field_types = field_types
        self._scalars = scalars
        self._ros_version = ros_version
        self._wall_clock = wall_clock
        self._defaults: dict[str, dict[str, Any]] = {}
        self._fills: dict[str, _Fill] = {}

    def new_header(self) -> dict[str, Any]:
        """Return a `std_msgs/Header` with the current time."""
        return self.defaults(HEADER) | {"stamp": self.new_stamp()}

    def new_stamp(self) -> dict[str, int]:
        """Return the current time in the form of the ROS version."""
        return stamp(self._wall_clock(), self._ros_version)

    def headers(self, name: str) -> frozenset[str]:
        """Return the fields of a message that are headers."""
        fields = self._field_types(name).items()
        return frozenset(field for field, (element, length) in fields if element == HEADER and length < 0)

    def defaults(self, name: str) -> dict[str, Any]:
        """Return the default of a message, which must not be changed."""
        known = self._defaults.get(name)
        if known is None:
            if name in self.times:
                known = dict.fromkeys(_TIME[self._ros_version], 0)
            else:
                known = {
                    field: self._default(name, field, element, length)
                    for field, (element, length) in self._field_types(name).items()
                }
            self._defaults[name] = known
        return known

    def _default(self, name: str, field: str, element: str, length: int) -> Any:
        if element not in self._scalars:
            one: Any = self.defaults(element)
        else:
            one = self._scalars[element]
            if self._ros_version == 2:
                one = _ONE.get((name, field), one)
        if length < 0:
            return one
        # as the reference server writes bytes
        return b64encode(bytes(length)).decode() if element in {"uint8", "char"} else [one] * length

    def fill(self, name: str) -> _Fill:
        """Return the function that fills a message of this type in place."""
        known = self._fills.get(name)
        if known is None:
            known = self._fills[name] = (
                _fill_time(self._ros_version) if name in self.times else self._message_fill(name)
            )
        return known

    def fields(self, name: str) -> FieldTypes:
        """Return the types of a message's fields, and their lengths."""
        if name in self.times:
            return dict.fromkeys(_TIME[self._ros_version], ("uint32", -1))
        return self._field_types(name)

    def is_scalar(self, name: str) -> bool:
        """Return whether a type is a basic one, without fields."""
        return name in self._scalars

    def _message_fill(self, name: str) -> _Fill:
        nested = [
            (field, _fill_each(self.fill(element)) if length >= 0 else self.fill(element))
            for field, (element, length) in self._field_types(name).items()
            if element not in self._scalars
        ]
        defaults = self.defaults(name)
        sizes = {field: len(orjson.dumps({field: default})) - 1 for field, default in defaults.items()}
        new: dict[str, Callable[[], Any]] = {"stamp": self.new_stamp} if name == HEADER else {}
        new |= dict.fromkeys(self.headers(name), self.new_header)

        def fill(message: Any, room: _Room) -> None:
            if type(message) is not dict:
                return
            for field in defaults:
                if field not in message:
                    room.spend(sizes[field])
                    message[field] = new[field]() if field in new else defaults[field]
            for field, fill_value in nested:
                fill_value(message[field], room)

        return fill


def _compiled_check(types: Types, name: str) -> Callable[[dict[str, Any]], None]:
    """Return a function that raises a KeyError or a TypeError unless all fields of a message are present.

    It runs for every message, most of which are complete, and takes a fifth of the time of a loop over the fields.
    """
    lines = ["def check(m0):"]
    numbers = itertools.count(1)

    def add(part: str, variable: str, indent: str) -> None:
        lines.append(f"{indent}pass")
        for field, (element, length) in types.fields(part).items():
            value = f"{variable}[{field!r}]"
            if types.is_scalar(element):
                lines.append(f"{indent}{value}")
                continue
            inner = f"m{next(numbers)}"
            is_one = length < 0
            lines.append(f"{indent}{inner} = {value}" if is_one else f"{indent}for {inner} in {value}:")
            add(element, inner, indent if is_one else indent + " ")

    add(name, "m0", " ")
    namespace: dict[str, Any] = {}
    exec("\n".join(lines), namespace)  # noqa: S102 - the names of fields are those of installed definitions
    check: Callable[[dict[str, Any]], None] = namespace["check"]
    return check


def _fill_each(fill: _Fill) -> _Fill:
    def fill_each(values: Any, room: _Room) -> None:
        if type(values) is list:
            for value in values:
                fill(value, room)

    return fill_each


def _fill_time(ros_version: RosVersion) -> _Fill:
    """Return the function for times, which takes an absent field from the other ROS version's, if that is present."""
    fields, others = _TIME[ros_version], _TIME[3 - ros_version]

    def fill(time: Any, room: _Room) -> None:
        if type(time) is dict:
            for field, other in zip(fields, others, strict=True):
                if field not in time:
                    room.spend(_TIME_SIZE)
                    given = time.get(other)
                    time[field] = given if type(given) is int else 0

    return fill
