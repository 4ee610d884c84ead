"""Absent fields of a message, filled with their defaults, so that every subscriber sees the whole message.

The reference server builds a ROS message from the JSON and forwards that (`_to_object_inst` in
rosbridge_library/internal/message_conversion.py): an absent field has the message's default, and the stamp of a
`std_msgs/Header` without one is the time of receipt. So is that of an absent header, as the specification says
(ROSBRIDGE_PROTOCOL.md, 3.3.3). Unlike the reference server, the hub does not check present values.

Each message is filled by a function that is compiled for its type. A message that only lacks outermost fields, as most
do, keeps its own JSON, and the JSON of these fields is appended.
"""

import itertools
from base64 import b64encode
from collections.abc import Callable, Container, Mapping
from typing import Any, Final, Literal, NoReturn

import orjson

from bridge.hub.errors import RefusedError
from bridge.stamps import stamp

RosVersion = Literal[1, 2]
FieldTypes = Mapping[str, tuple[str, int]]
"""The types of a message's fields or of their elements, and their lengths: -1 for a scalar, 0 for any."""
Fill = Callable[[dict[str, Any], int], bytes | None]
"""Fills the absent fields of a message in place; a value of another type than its field's stays.

Args:
    message: The message.
    room: Bytes by which its parts may grow.

Returns:
    What to put in place of the last two braces of an operation that ends with the message, both as JSON. It is empty
    if nothing was absent, and None if the message must be written again.

Raises:
    RefusedError: They would grow by more.
"""

HEADER: Final = "std_msgs/msg/Header"
_TIME: Final = {1: ("secs", "nsecs"), 2: ("sec", "nanosec")}
_TIME_SIZE: Final = len('"nanosec":0000000000,')
_CLOSING: Final = b"}}"
_TAILS: Final = 32
"""Maximum number of tails that are kept for one type."""
_ONE: Final = {("geometry_msgs/msg/Quaternion", "w"): 1.0}
"""The only field of the common ROS 2 messages whose default is not zero."""


class Filler:
    """The fields of one message type, and their defaults."""

    def __init__(self, types: "Types", name: str) -> None:
        """Prepare the defaults of a known type."""
        # The stamp of a header and the fields of a time have no constant defaults, so they are filled as in a part.
        is_like_part = name == HEADER or name in types.times or not types.fields(name)
        self._defaults = {} if is_like_part else types.defaults(name)
        self._headers: frozenset[str] = frozenset() if is_like_part else types.headers(name)
        self._tails = {0: b""}
        """By the number of the absent fields (see `_compiled_fill`)."""
        self.fill: Fill = _compiled_fill(types, name, self._tails, self._tail, like_part=is_like_part)

    def named(self, values: list[Any]) -> dict[str, Any]:
        """Return the message with these values in the order of the fields, as arguments of services may be given."""
        return dict(zip(self._defaults, values, strict=False))

    def _tail(self, absent: int, message: dict[str, Any]) -> bytes:
        """Return the JSON of the fields that were absent, and keep it if it has no time of receipt."""
        fields = {field: message[field] for bit, field in enumerate(self._defaults) if absent >> bit & 1}
        was_empty = absent >> len(self._defaults)
        tail = b"" if was_empty else b","
        tail += orjson.dumps(fields)[1:-1] + _CLOSING
        if self._headers.isdisjoint(fields):
            if len(self._tails) == _TAILS:
                del self._tails[
                    next(reversed(self._tails))
                ]  # one of a rare message rather than of the first ones
            self._tails[absent] = tail
        return tail


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

    def fields(self, name: str) -> FieldTypes:
        """Return the types of a message's fields, and their lengths."""
        if name in self.times:
            return dict.fromkeys(_TIME[self._ros_version], ("uint32", -1))
        return self._field_types(name)

    def has_fields(self, name: str) -> bool:
        """Return whether a type is neither a basic one nor an empty message."""
        return name not in self._scalars and bool(self.fields(name))

    def other_field(self, name: str, field: str) -> str | None:
        """Return the field of the other ROS version for a field of a time, and None for other types."""
        if name not in self.times:
            return None
        return dict(zip(_TIME[self._ros_version], _TIME[3 - self._ros_version], strict=True))[field]


def _compiled_fill(
    types: Types,
    name: str,
    tails: Mapping[int, bytes],
    new_tail: Callable[[int, dict[str, Any]], bytes],
    *,
    like_part: bool,
) -> Fill:
    """Return the function that fills messages of a type.

    It runs for every message, most of which have complete parts, and takes a fifth of the time of a loop over the
    fields.

    Args:
        types: All types.
        name: The type.
        tails: What to put in place of the last two braces of an operation, by the number of the absent fields: a bit
            each, and one more if the message is empty. Their size is limited by the type.
        new_tail: Returns the same for a message that was filled.
        like_part: Whether the message is filled like a part, so that it must be written again.
    """
    lines = ["def fill(m0, room):", " left = room"]
    if not like_part:
        lines.append(f" absent = 0 if m0 else {1 << len(types.fields(name))}")
    numbers = itertools.count(1)
    namespace: dict[str, Any] = {
        "new_stamp": types.new_stamp,
        "new_header": types.new_header,
        "tails": tails,
        "new_tail": new_tail,
        "refuse": _refuse,
    }

    def add_fields(part: str, message: str, indent: str) -> None:
        """Add the lines that fill a dictionary."""
        defaults = types.defaults(part)
        for bit, (field, (element, length)) in enumerate(types.fields(part).items()):
            default = f"d{next(numbers)}"
            namespace[default] = defaults[field]
            size = len(orjson.dumps({field: defaults[field]})) - 1
            other = types.other_field(part, field)
            if other is not None:
                size, default = _TIME_SIZE, f"t if type(t := {message}.get({other!r})) is int else 0"
            elif part == HEADER and field == "stamp":
                default = "new_stamp()"
            elif element == HEADER and length < 0:
                default = "new_header()"
            count = f"left -= {size}" if like_part or message != "m0" else f"absent |= {1 << bit}"
            lines.append(f"{indent}if {field!r} not in {message}:")
            lines.append(f"{indent} {message}[{field!r}] = {default}; {count}")
            if types.has_fields(element):
                lines.append(f"{indent}else:")
                add_value(element, length, f"{message}[{field!r}]", indent + " ")

    def add_value(element: str, length: int, value: str, indent: str) -> None:
        """Add the lines that fill a value, if it is a dictionary, or a list of them if that is its type."""
        inner = f"m{next(numbers)}"
        lines.append(f"{indent}{inner} = {value}")
        if length >= 0:
            lines.append(f"{indent}for {inner} in {inner} if type({inner}) is list else ():")
            indent += " "
            lines.append(f"{indent}if left < 0: refuse()")
        lines.append(f"{indent}if type({inner}) is dict:")
        add_fields(element, inner, indent + " ")

    add_fields(name, "m0", " ")
    if like_part:
        lines.append(" tail = b''")
    else:
        lines += [" try: tail = tails[absent]", " except KeyError: tail = new_tail(absent, m0)"]
    lines += [" if left == room: return tail", " if left < 0: refuse()"]
    exec("\n".join(lines), namespace)  # noqa: S102 - the names of fields are those of installed definitions
    fill: Fill = namespace["fill"]
    return fill


def _refuse() -> NoReturn:
    raise RefusedError("a message is too large with the default values of its absent fields")
