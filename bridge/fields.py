"""Lookup of variables in ROS messages, by bare name or by path.

These are the rules for the variables in `deployment.toml`: a name with `.` or `[` is a path
(`pose.position.x`, `ranges[3]`). A bare name is searched in the whole message, depth first, except inside
arrays. A message may have only one field with the name. The path to the field in the first message is used for
all later messages.

An index selects an element of an array in every form: a list, a NumPy array, bytes, and the base64 text of
`uint8[]` in JSON.
"""

import base64
import re
from collections.abc import Sequence
from typing import Any, Final

from bridge.errors import FieldAmbiguousError, FieldMissingError, PathError

Place = tuple[str | int, ...]
"""Place of a field in a message: the keys of objects and the indices of arrays on the way to it, outermost first."""

MAX_LISTED: Final = 24
"""Maximum number of fields listed in an error."""
MAX_SHOWN: Final = 80
"""Maximum number of characters of each field's path in an error."""

_STEP = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)|\[([0-9]{1,9})\]")


class Field:
    """Place of one variable in the messages of one topic.

    Attributes:
        name: The configured bare name or path.
        place: Place of the variable. For a bare name, it is None until a message contains the name.
    """

    __slots__ = ("_is_path", "name", "place")

    def __init__(self, name: str) -> None:
        """Read a bare name or a path.

        Raises:
            PathError: The text is neither a bare name nor a path.
        """
        self.name = name
        self._is_path = "." in name or "[" in name
        self.place: Place | None = parse_path(name) if self._is_path else None
        if not self._is_path and _STEP.fullmatch(name) is None:
            raise PathError(
                f"{name[:MAX_SHOWN]!r} is not a field name: letters, digits and _ (example: D1), or a path "
                "(examples: pose.position.x, ranges[3])"
            )

    def value(self, message: dict[str, Any]) -> tuple[bool, Any]:
        """Look up the variable in a message.

        Returns:
            True if the message has the variable, and its unchanged value. The value of a missing variable is None.

        Raises:
            FieldAmbiguousError: The place of a bare name is not known from an earlier message, and several fields of
                this message have the name.
        """
        # A bare name is searched until it is found, and then has the same place in all messages.
        place = self.place
        if place is None:
            places = find_places(message, self.name)
            if not places:
                return False, None
            if len(places) > 1:
                shown = ", ".join(map(_show, places[:MAX_LISTED]))
                raise FieldAmbiguousError(
                    f"the message has {len(places)} fields named {self.name!r} ({shown}): "
                    "give the path of one of them"
                )
            self.place = place = places[0]
        # Every step may fail, because a field may be null in this message, or an array shorter.
        value: Any = message
        for step in place:
            if isinstance(step, str):
                if not isinstance(value, dict) or step not in value:
                    return False, None
                value = value[step]
            else:
                length = _length(value)
                if length is None or step >= length:
                    return False, None
                value = _element(value, step)
        return True, value

    def missing(self, message: dict[str, Any]) -> FieldMissingError:
        """Return the error for a message that lacks the variable. The error says what the message has instead."""
        return FieldMissingError(f"the message has no field {self.name!r}{self._reason(message)}")

    def _reason(self, message: dict[str, Any]) -> str:
        """Return why a message does not have the variable, as a clause after its name."""
        if self.place is None:
            return f"; it has {_list_fields(message)}"
        value: Any = message
        for depth, step in enumerate(self.place):
            before = _show(self.place[:depth])
            where = f" in {before!r}" if before else ""
            if isinstance(step, int):
                length = _length(value)
                if length is None:
                    return f": {before!r} is {_kind(value)}, not an array"
                if step >= length:
                    return f": {before!r} has {length} elements, so there is no index {step}"
                value = _element(value, step)
            elif not isinstance(value, dict):
                return f": {before!r} is {_kind(value)}, not an object"
            elif step not in value:
                return f": it has no {step!r}{where}; it has {_list_fields(value)}"
            else:
                value = value[step]
        return ""


def all_missing(fields: Sequence[Field], message: dict[str, Any]) -> FieldMissingError:
    """Return the error for a message that has none of `fields`.

    The error names at most `MAX_LISTED` of `fields`, and lists the fields that the message has.
    """
    first, *others = fields
    if not others:
        return first.missing(message)
    # The message is listed once for all of them, because the list may be long.
    names = [repr(field.name) for field in fields[:MAX_LISTED]]
    more = f" and {len(fields) - MAX_LISTED} more" if len(fields) > MAX_LISTED else ""
    return FieldMissingError(
        f"the message has no fields {', '.join(names)}{more}; it has {_list_fields(message)}"
    )


def parse_path(path: str) -> Place:
    """Parse a path: names joined by dots, and array indices (from 0) in brackets.

    Raises:
        PathError: The path is empty or malformed. If it is malformed, the error names the position.
    """
    steps: list[str | int] = []
    at = 0
    while at < len(path):
        start = at
        if steps and path[at] == ".":
            at += 1
        step = _STEP.match(path, at)
        # A dot stands before every name but the first, and before nothing else.
        if step is None or (step[1] is not None) != (at > start or not steps):
            raise PathError(
                f"the path {path[:MAX_SHOWN]!r} is malformed at character {at + 1}: expected names joined by dots, with "
                "indices in brackets (examples: pose.position.x, ranges[3])"
            )
        steps.append(step[1] if step[1] is not None else int(step[2]))
        at = step.end()
    if not steps:
        raise PathError("the path of a variable is empty (examples: D1, pose.position.x, ranges[3])")
    return tuple(steps)


def format_place(place: Place) -> str:
    """Return a place as a path, such as `pose.position.x` or `ranges[3]`."""
    text = ""
    for step in place:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text


def find_places(message: dict[str, Any], name: str) -> list[Place]:
    """Return the places of all fields with a name, depth first in the order of the message. Arrays are not searched."""
    # A stack instead of recursion, because messages may be deeply nested; reversed, so that places are in the order of
    # the message.
    places: list[Place] = []
    inner: list[tuple[Place, dict[str, Any]]] = [((), message)]
    while inner:
        place, value = inner.pop()
        if place and place[-1] == name:
            places.append(place)
        inner.extend(
            ((*place, key), part if isinstance(part, dict) else {})
            for key, part in reversed(value.items())
            if key == name or isinstance(part, dict)
        )
    return places


def _list_fields(message: dict[str, Any]) -> str:
    """Return the paths of all fields as text, arrays with their lengths."""
    listed: list[str] = []
    inner: list[tuple[Place, Any]] = [((key,), value) for key, value in reversed(message.items())]
    while inner:
        place, value = inner.pop()
        if len(listed) == MAX_LISTED:
            return ", ".join(listed) + " and more"
        if isinstance(value, dict) and value:
            inner.extend(((*place, key), part) for key, part in reversed(value.items()))
        elif isinstance(value, list | bytes) or hasattr(value, "dtype"):
            listed.append(f"{_show(place)} ({_kind(value)})")
        else:
            listed.append(_show(place))
    return ", ".join(listed) or "no fields at all"


def _show(place: Place) -> str:
    """Return the path of a place for an error, shortened and printable."""
    text = format_place(place)
    if len(text) > MAX_SHOWN:
        text = text[: MAX_SHOWN - 3] + "..."
    return text if text.isprintable() else repr(text)


def _length(value: Any) -> int | None:
    """Return the length of an array in any form; None if the value is not an array."""
    if isinstance(value, str):
        # Four characters are three bytes, minus one for each =.
        return None if len(value) % 4 or not value else len(value) // 4 * 3 - value[-2:].count("=")
    if isinstance(value, list | bytes) or getattr(value, "ndim", 0) == 1:
        return len(value)
    return None


def _element(value: Any, index: int) -> Any:
    """Return one element of an array in any form; None if base64 text is malformed at this index."""
    # Decodes only the four characters with this byte, and not the whole image.
    if isinstance(value, str):
        four = value[index // 3 * 4 : index // 3 * 4 + 4]
        try:
            return base64.b64decode(four, validate=True)[index % 3]
        except (ValueError, IndexError):
            return None
    # A Python number, as from JSON, because NumPy's scalars behave differently.
    element = value[index]
    return element.item() if hasattr(element, "dtype") else element


def _kind(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list | bytes) or hasattr(value, "dtype"):
        return f"an array of {len(value)}"
    if isinstance(value, bool):
        return "a boolean"
    return "a string" if isinstance(value, str) else "a number"
