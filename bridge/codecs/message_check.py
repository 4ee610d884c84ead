"""Checks of outbound messages against the definition of their type: names of fields, and shapes of arrays.

The checks find programming errors such as a misspelt field or a nested array. The values of scalars are not checked.
"""

import difflib
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from bridge.errors import MessageTypeError, NameFormError
from bridge.names import ros1_type, ros2_type

SCALAR: Final = -1
"""The `length` of a `FieldType` if the field is no array. 0 stands for an array without a fixed length."""
_MAX_TYPES: Final = 1000
_MAX_FIELDS: Final = 1000
_MAX_LENGTH: Final = (1 << 32) - 1
"""Maximum length of an array in ROS."""
_BYTES: Final = frozenset({"uint8", "int8", "octet", "byte", "char"})
_PRIMITIVES: Final = _BYTES | {
    *("bool", "boolean", "int16", "uint16", "int32", "uint32", "int64", "uint64"),
    *("float32", "float64", "float", "double", "string", "wstring"),
}
_TIMES: Final = frozenset({"time", "duration", "builtin_interfaces/Time", "builtin_interfaces/Duration"})


class FieldType(NamedTuple):
    """A field's element type, named as in ROS 1, and its length: `SCALAR`, 0 for any length, or a fixed length."""

    element: str
    length: int

    def __str__(self) -> str:
        brackets = "" if self.length == SCALAR else f"[{self.length or ''}]"
        return self.element + brackets


_TIME_FIELDS: Final = {name: FieldType("int32", SCALAR) for name in ("secs", "nsecs", "sec", "nanosec")}
"""The fields of a time in both ROS versions; servers accept either spelling."""

Definitions = dict[str, dict[str, FieldType]]
"""Maps the name of a message type, in the form of ROS 1, to the names and types of its fields."""


def definitions_from_rosapi(answer: Any) -> Definitions:
    """Return the definitions in an answer of rosapi's service `message_details`. Unreadable types are left out."""
    typedefs = answer.get("typedefs") if isinstance(answer, dict) else None
    found: Definitions = {}
    for each in typedefs[:_MAX_TYPES] if isinstance(typedefs, list) else []:
        match each:
            case {
                "type": str(name),
                "fieldnames": [*names],
                "fieldtypes": [*types],
                "fieldarraylen": [*lengths],
            } if len(names) == len(types) == len(lengths) <= _MAX_FIELDS:
                if all(isinstance(text, str) for text in (*names, *types)) and all(
                    type(length) is int and SCALAR <= length <= _MAX_LENGTH for length in lengths
                ):
                    # ROS 2's rosapi gives the slots of Python's classes: `_x` of the field `x`
                    # (rosapi/objectutils.py, `_handle_array_information`)
                    found[_key(name)] = {
                        field.removeprefix("_"): FieldType(_key(element), length)
                        for field, element, length in zip(names, types, lengths, strict=True)
                    }
    return found


def bundled_definitions(type_name: str, ros_version: int) -> Definitions:
    """Return the definitions of a type, and of all types nested in it, as rosbags contains them.

    The result is empty if rosbags is not installed or does not know the type.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        return {}
    store = get_typestore(Stores.ROS2_JAZZY if ros_version == 2 else Stores.ROS1_NOETIC)
    # The type, and in turn the types of its fields, each once.
    found: Definitions = {}
    waiting = [ros2_type(type_name)]
    while waiting:
        name = waiting.pop()
        if name in store.fielddefs and _key(name) not in found:
            fields = {field: element_of(*kind) for field, kind in store.fielddefs[name][1]}
            found[_key(name)] = {field: FieldType(_key(kind[0]), kind[1]) for field, kind in fields.items()}
            waiting += [element for element, _ in fields.values()]
    return found


def element_of(kind: Any, content: Any) -> tuple[str, int]:
    """Convert rosbags' description of a field to the element type and the length of the field.

    The length is `SCALAR` if the field is no array, and 0 if the field is an array of any length.
    """
    match kind.name:
        case "BASE":
            return str(content[0]), SCALAR
        case "NAME":
            return str(content), SCALAR
        case array:
            inner, length = content
            return element_of(*inner)[0], length if array == "ARRAY" else 0


def _key(type_name: str) -> str:
    try:
        return ros1_type(type_name)
    except NameFormError:
        return type_name  # a primitive


class MessageCheck:
    """The check of messages of one type."""

    def __init__(self, type_name: str, definitions: Definitions) -> None:
        """Prepare the check of the type `type_name`, a key of `definitions` in the ROS 1 form `package/Type`."""
        self._type = type_name
        self._definitions = definitions

    def __call__(self, msg: Mapping[str, Any]) -> None:
        """Check a message.

        Raises:
            MessageTypeError: The message has a field that the type does not have, or an array of another shape.
        """
        self._check(self._type, msg, "")

    def _check(self, type_name: str, msg: Any, place: str) -> None:
        if not isinstance(msg, Mapping):
            raise MessageTypeError(f"{place[:-1] or 'it'} is {_shown(msg)}, expected an object ({type_name})")
        # Unknown parts are left to the server: rosapi does not describe all types of a message.
        fields = _TIME_FIELDS if type_name in _TIMES else self._definitions.get(type_name)
        if fields is None:
            return
        for name, value in msg.items():
            field = fields.get(name)
            if field is None:
                raise _unknown_field(type_name, fields, name, place)
            if value is None:
                continue  # absent, as in ROS
            if field.length != SCALAR:
                self._check_array(type_name, field, value, f"{place}{name}")
            elif self._is_object(field.element):
                self._check(field.element, value, f"{place}{name}.")
            elif field.element in _PRIMITIVES and _is_nested(value):
                raise _misshapen(type_name, f"{place}{name}", field, value)

    def _is_object(self, element: str) -> bool:
        return element in _TIMES or element in self._definitions

    def _check_array(self, type_name: str, field: FieldType, value: Any, place: str) -> None:
        # Bytes and base64 text stand for `uint8[]`; the length of a text is not that of its bytes.
        if isinstance(value, str | bytes | bytearray):
            good = field.element in _BYTES or field.element not in _PRIMITIVES
            length = field.length if isinstance(value, str) else len(value)
        else:
            # Elements are checked only in lists, because NumPy's arrays of one dimension contain no arrays.
            flat = getattr(value, "ndim", 1) == 1 and not isinstance(value, Mapping) and _is_nested(value)
            good = flat and (
                field.element not in _PRIMITIVES
                or hasattr(value, "ndim")
                or not any(_is_nested(item) for item in value)
            )
            length = len(value) if good else 0
        if not good or (field.length and length != field.length):
            raise _misshapen(type_name, place, field, value)
        # Every element, because a program may build each from other data.
        if self._is_object(field.element):
            for index, item in enumerate(value):
                self._check(field.element, item, f"{place}[{index}].")


def check_from_rosapi(answer: Any) -> MessageCheck | None:
    """Return the check of the first type in rosapi's answer, or None if the answer is unreadable.

    The other types in the answer are the types of nested messages.
    """
    definitions = definitions_from_rosapi(answer)
    match answer:
        case {"typedefs": [{"type": str(name)}, *_]} if (key := _key(name)) in definitions:
            return MessageCheck(key, definitions)
    return None


def _is_nested(value: Any) -> bool:
    """Return whether a value is an object or an array."""
    return isinstance(value, list | tuple | Mapping) or bool(getattr(value, "ndim", 0))


def _unknown_field(
    type_name: str, fields: Mapping[str, FieldType], name: Any, place: str
) -> MessageTypeError:
    near = difflib.get_close_matches(str(name), fields, 1, 0.5)
    hint = (
        f"did you mean {place}{near[0]} ({fields[near[0]]})?"
        if near
        else f"expected {', '.join(fields) or 'none'}"
    )
    return MessageTypeError(f"{type_name} has no field {place}{name}; {hint}")


def _misshapen(type_name: str, place: str, field: FieldType, value: Any) -> MessageTypeError:
    return MessageTypeError(f"field {place} of {type_name} is {_shown(value)}, expected {field}")


def _shown(value: Any) -> str:
    """Describe the shape of a value for an error."""
    shape: tuple[int, ...] = getattr(value, "shape", ())
    if shape:
        return f"an array of shape {'x'.join(map(str, shape))}"
    if isinstance(value, Mapping):
        return "an object"
    if isinstance(value, list | tuple):
        return f"an array of {len(value)}{' arrays or objects' if any(map(_is_nested, value)) else ''}"
    return f"{len(value)} bytes" if isinstance(value, bytes | bytearray) else f"a {type(value).__name__}"
