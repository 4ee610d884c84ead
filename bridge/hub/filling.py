"""Absent fields of a message, filled with their defaults, so that every subscriber sees the whole message.

The reference server builds a ROS message from the JSON and forwards that (`_to_object_inst` in
rosbridge_library/internal/message_conversion.py): an absent field has the message's default, and the stamp of a
`std_msgs/Header` without one is the time of receipt. So is that of an absent header, as the specification says
(ROSBRIDGE_PROTOCOL.md, 3.3.3). Unlike the reference server, the hub does not check present values.

    {"op":"publish","topic":"/t","msg":{"data":[1.5]}}                                     as received
    {"op":"publish","topic":"/t","msg":{"data":[1.5],"layout":{"dim":[],"data_offset":0}}} as forwarded

A message that only lacks outermost fields, as most do, keeps its own JSON: the JSON of these fields, its *tail*, takes
the place of the last two braces. Only a message with an incomplete part is written again.
"""

from base64 import b64encode
from collections.abc import Callable, Container, Mapping
from typing import Any, Final

import orjson

from bridge.hub.limits import RefusedOperationError
from bridge.names import RosVersion
from bridge.stamps import stamp

FieldTypes = Mapping[str, tuple[str, int]]
"""The types of a message's fields or of their elements, and their lengths: -1 for a scalar, 0 for any."""

HEADER: Final = "std_msgs/msg/Header"
_TIME: Final = {1: ("secs", "nsecs"), 2: ("sec", "nanosec")}
# Number of combinations of absent fields that are remembered for one type.
_KNOWN: Final = 32
# The only field of the common ROS 2 messages whose default is not zero.
_ONE: Final = {("geometry_msgs/msg/Quaternion", "w"): 1.0}


_Parts = tuple[tuple[str, "Filler", bool], ...]
"""The fields of a message that are messages, or arrays of messages, and whether they are arrays."""

_Absent = tuple[dict[str, Any], bytes, _Parts]
"""The absent fields of a message and their defaults, which must not be changed; their tail; the present parts."""


class Filler:
    """The fields of one message type, and their defaults."""

    def __init__(self, types: "Types", name: str) -> None:
        """Prepare a known type and, recursively, the types of its fields."""
        self._defaults = types.defaults(name)
        # The defaults that differ from message to message: stamps, and the other ROS version's fields of a time.
        self._varying = types.varying(name)
        self.parts: _Parts = tuple(
            (field, types.filler(element), length >= 0)
            for field, (element, length) in types.fields(name).items()
            if types.has_fields(element)
        )
        # By the present fields. A publisher repeats the same few, so most messages are filled without a look at
        # single fields.
        self._known: dict[tuple[str, ...], _Absent] = {}
        # A message with as many fields as its type is complete. If it has unknown fields in place of absent ones,
        # the reference server refuses it; here its subscribers see what is wrong. Only the fields of a time may
        # replace each other, so its number of fields says nothing.
        self.count = -1 if name in types.times else len(self._defaults)

    def named(self, values: list[Any]) -> dict[str, Any]:
        """Return the message with these values in the order of the fields, as arguments of services may be given."""
        return dict(zip(self._defaults, values, strict=False))

    def fill(self, message: dict[str, Any], room: int) -> bytes | None:
        """Fill the absent fields of a message in place; a value of another type than its field's stays.

        Args:
            message: The message.
            room: Bytes by which its parts may grow.

        Returns:
            What to put in place of the last two braces of an operation that ends with the message, both as JSON. It
            is empty if nothing was absent, and None if the message must be written again.

        Raises:
            RefusedOperationError: They would grow by more.
        """
        if len(message) == self.count:
            return None if self.parts and _fill_parts(self.parts, message, room) else b""
        absent, tail, parts = self._known.get(tuple(message)) or self._look_up(message)
        is_grown = parts and _fill_parts(parts, message, room)
        message.update(absent)
        return None if is_grown else tail

    def fill_part(self, message: dict[str, Any], room: int) -> int:
        """Fill a message inside another one, and return the bytes by which it grew, or raise a RefusedOperationError."""
        grown = _fill_parts(self.parts, message, room)
        if len(message) != self.count:
            absent, tail, _parts = self._known.get(tuple(message)) or self._look_up(message)
            message.update(absent)
            grown += len(tail)
            # Checked at each message of an array: a megabyte of `{}` could become a gigabyte.
            if grown > room:
                raise RefusedOperationError(
                    "a message is too large with the default values of its absent fields"
                )
        return grown

    def _look_up(self, message: dict[str, Any]) -> _Absent:
        """Return what a message lacks, and remember it."""
        varying, defaults = self._varying, self._defaults
        absent = {
            field: varying[field](message) if field in varying else default
            for field, default in defaults.items()
            if field not in message
        }
        tail = b"%b%b}}" % (b"," if message else b"", orjson.dumps(absent)[1:-1]) if absent else b""
        parts = tuple(part for part in self.parts if part[0] in message)
        # Unknown fields can have any number and length, so a message with one is not remembered.
        if message.keys() <= defaults.keys() and varying.keys().isdisjoint(absent):
            if len(self._known) >= _KNOWN:
                self._known.clear()
            self._known[tuple(message)] = absent, tail, parts
        return absent, tail, parts


def _fill_parts(parts: _Parts, message: dict[str, Any], room: int) -> int:
    """Fill the messages inside a message, and return the number of bytes by which they grew."""
    grown = 0
    for field, filler, is_array in parts:
        part = message.get(field)
        if is_array:
            for item in part if type(part) is list else ():
                if type(item) is dict:
                    grown += filler.fill_part(item, room - grown)
        elif type(part) is dict and (filler.parts or len(part) != filler.count):
            grown += filler.fill_part(part, room - grown)
    return grown


class Types:
    """Defaults and fillers of the types of one ROS version."""

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
        self._fillers: dict[str, Filler] = {}

    def filler(self, name: str) -> Filler:
        """Return the filler of a known type."""
        if name not in self._fillers:
            self._fillers[name] = Filler(self, name)
        return self._fillers[name]

    def varying(self, name: str) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the fields of a type whose defaults depend on the time of receipt or on the message's other fields."""

        def now(_message: object) -> dict[str, int]:
            return stamp(self._wall_clock(), self._ros_version)

        def of_other_version(field: str) -> Callable[[dict[str, Any]], int]:
            return lambda message: given if type(given := message.get(field)) is int else 0

        if name in self.times:
            own, other = _TIME[self._ros_version], _TIME[3 - self._ros_version]
            return {field: of_other_version(theirs) for field, theirs in zip(own, other, strict=True)}
        if name == HEADER:
            return {"stamp": now}
        return {
            field: lambda message: self.defaults(HEADER) | {"stamp": now(message)}
            for field, kind in self._field_types(name).items()
            if kind == (HEADER, -1)
        }

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

    def fields(self, name: str) -> FieldTypes:
        """Return the types of a message's fields, and their lengths."""
        if name in self.times:
            return dict.fromkeys(_TIME[self._ros_version], ("uint32", -1))
        return self._field_types(name)

    def has_fields(self, name: str) -> bool:
        """Return whether a type is neither a basic one nor an empty message."""
        return name not in self._scalars and bool(self.fields(name))
