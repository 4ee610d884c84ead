"""Absent fields of a message, filled with default values, so that every subscriber receives all fields.

The reference server builds a ROS message from the JSON, and forwards the ROS message (`_to_object_inst` in
rosbridge_library/internal/message_conversion.py). The hub fills fields as the reference server does. An absent
field has the default value of the ROS message. The absent stamp of a `std_msgs/Header` is the time of receipt. If the
whole header is absent, its stamp is the time of receipt too, as the specification says (ROSBRIDGE_PROTOCOL.md, 3.3.3).
Unlike the reference server, the hub does not check present values.

    {"op":"publish","topic":"/t","msg":{"data":[1.5]}}                                     as received
    {"op":"publish","topic":"/t","msg":{"data":[1.5],"layout":{"dim":[],"data_offset":0}}} as forwarded

Most messages lack only outermost fields. The hub then replaces the last two braces of the publisher's JSON with the
*tail*, the JSON of the absent fields. If a nested message lacks fields, the hub encodes the whole message again.
"""

from collections.abc import Callable
from typing import Any, Final

import orjson

from bridge.hub.limits import RefusedOperationError

# Number of combinations of absent fields that are remembered for one type.
_KNOWN: Final = 32

_Parts = tuple[tuple[str, "Filler", bool], ...]
"""The fields of a message that are messages or arrays of messages: name, filler, and whether it is an array."""

_Absent = tuple[dict[str, Any], bytes, _Parts]
"""Of a message: absent fields with their defaults (read-only), the JSON of the defaults, and the parts present."""


class Filler:
    """The fields of one message type, and the defaults for absent fields."""

    def __init__(
        self,
        defaults: dict[str, Any],
        varying: dict[str, Callable[[dict[str, Any]], Any]],
        parts: _Parts,
        *,
        is_time: bool,
    ) -> None:
        """Prepare a type.

        Args:
            defaults: The default of each field. The defaults must not be changed.
            varying: Functions that compute the defaults that are not constant, by field. A stamp or a header gets the
                time of receipt. In a time, an absent `secs` gets the value of `sec` in the same message. The other
                fields in which ROS 1 and ROS 2 differ are filled in the same way.
            parts: The fields that contain a message or an array of messages, each with its filler.
            is_time: Whether the type is a time or a duration.
        """
        self._defaults = defaults
        self._varying = varying
        self.parts = parts
        # What a message lacks, by its present fields. A publisher repeats the same few combinations, so most messages
        # are filled without checking single fields.
        self._known: dict[tuple[str, ...], _Absent] = {}
        # A message with as many fields as its type is complete. If it has unknown fields in place of absent ones,
        # the reference server refuses it; here its subscribers see what is wrong. Only the fields of a time may
        # replace each other, so its number of fields says nothing.
        self.count = -1 if is_time else len(defaults)

    def named(self, values: list[Any]) -> dict[str, Any]:
        """Return the message whose fields have these values, in the order of the fields.

        A caller may pass the arguments of a service as a list of values instead of an object.
        """
        return dict(zip(self._defaults, values, strict=False))

    def fill(self, message: dict[str, Any], room: int, *, keep: bool = True) -> bytes | None:
        """Fill the absent fields of a message. Values of a wrong type stay as they are.

        Args:
            message: The message.
            room: Number of bytes by which the nested messages may grow.
            keep: If true, the absent fields are also added to `message`. If false, they are only returned, which saves
                about a tenth of the time for a small message.

        Returns:
            The absent fields as JSON, followed by two closing braces. The caller replaces the last two braces of the
            received operation by these bytes. The message must be the last value of the operation.
            The bytes are empty if no field was absent.
            The result is None if a nested message has grown. The absent fields are then in `message`, even if `keep` is
            false, and the caller must encode the operation again.

        Raises:
            RefusedOperationError: The nested messages would grow by more than `room`.
        """
        if len(message) == self.count:
            return None if self.parts and _fill_parts(self.parts, message, room) else b""
        absent, tail, parts = self._known.get(tuple(message)) or self._look_up(message)
        if parts and _fill_parts(parts, message, room):
            message.update(absent)
            return None
        if keep:
            message.update(absent)
        return tail

    def fill_part(self, message: dict[str, Any], room: int) -> int:
        """Fill a nested message, and return the number of bytes by which it has grown.

        Raises a RefusedOperationError if it would grow by more than `room` bytes.
        """
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
        """Return the absent fields of a message, and cache the result for messages with identical field names."""
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
