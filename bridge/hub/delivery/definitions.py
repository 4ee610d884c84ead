"""Message definitions, from ``rosbags`` where that is installed: what the fields of a type are.

The hub passes JSON on without them. They are wanted by who asks for a typed form: CBOR with typed arrays, the
serialised message (cbor-raw), and rosapi's descriptions of types. ``rosbags`` is imported when the first of
these is asked for, never before; without it CBOR packs floats alone, and the others are refused with a sentence.
"""

from base64 import b64decode
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Literal

from bridge.errors import BridgeError
from bridge.hub.operations import RefusedError
from bridge.names import ros1_type, ros2_type

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

RosVersion = Literal[1, 2]

#: rosbags' names of numbers: the elements of a typed array, and an example for descriptions.
_NUMBERS: Final = {
    "int8": "i1",
    "uint8": "u1",
    "octet": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
_DEFAULTS: Final[dict[str, Any]] = {"bool": False, "string": "", "wstring": ""} | {
    name: 0.0 if elements[0] == "f" else 0 for name, elements in _NUMBERS.items()
}
_BYTES: Final = frozenset({"uint8", "octet"})
_TIMES: Final = {"builtin_interfaces/msg/Time": "time", "builtin_interfaces/msg/Duration": "duration"}
#: What the fields of a time are called in ROS 1, by rosbags' names, which are ROS 2's.
_ROS1_TIME: Final = {"sec": "secs", "nanosec": "nsecs"}
#: Types that keep what was made of them: clients can name no more than there are.
_MISSING: Final = (
    "the hub has no message definitions here: install rosbags (pip install rosbags) and start it again"
)

_Convert = Callable[[Any], Any]


class Definitions:
    """What is known of message types, for one ROS version."""

    def __init__(self, ros_version: RosVersion = 1) -> None:
        """Know nothing until something is asked for."""
        self.ros_version: RosVersion = ros_version
        self._loaded: Typestore | None = None
        self._missing = False
        self._typed: dict[str, _Convert] = {}

    def name(self, type_name: str) -> str:
        """A message type's name as this ROS version writes it."""
        return ros2_type(type_name) if self.ros_version == 2 else ros1_type(type_name)

    def typed(self, type_name: str, message: dict[str, Any]) -> dict[str, Any] | None:
        """A message with its arrays of numbers as typed arrays, for CBOR.

        Returns:
            The message; None where its type is not known, or it does not fit its type.
        """
        convert = self._typed.get(type_name)
        if convert is None:
            try:
                store, known = self._known(type_name)
            except RefusedError:
                return None
            convert = self._typed[type_name] = _message_to_typed(store, known, {})
        try:
            converted: dict[str, Any] = convert(message)
        except (BridgeError, TypeError, ValueError, AttributeError, OverflowError):
            return None
        return converted

    def serialise(self, type_name: str, message: dict[str, Any]) -> bytes:
        """A message as ROS's own transport would carry it: ROS 1's wire format, or CDR with its header in ROS 2.

        Raises:
            RefusedError: the type is not known, or the message does not fit it.
        """
        store, known = self._known(type_name)
        try:
            made = self._made(store, known, message, "")
            data = (
                store.serialize_cdr(made, known)
                if self.ros_version == 2
                else store.serialize_ros1(made, known)
            )
        except (
            Exception
        ) as error:  # rosbags, NumPy and struct each say in their own way that a value does not fit
            raise RefusedError(f"a message does not fit its type {self.name(type_name)}: {error}") from None
        return bytes(data)

    def full_text(self, type_name: str) -> str:
        """A type's definition and those of all it is made of, as bag files have it.

        Raises:
            RefusedError: the type is not known.
        """
        store, known = self._known(type_name)
        definition, _digest = store.generate_msgdef(known, ros_version=self.ros_version)
        return definition

    def details(self, type_name: str) -> list[dict[str, Any]]:
        """A type's fields and those of all it is made of, as ``rosapi_msgs/TypeDef``.

        Raises:
            RefusedError: the type is not known.
        """
        store, known = self._known(type_name)
        found: dict[str, dict[str, Any]] = {}
        waiting = [known]
        while waiting:
            name = waiting.pop(0)
            if name in found:
                continue
            constants, fields = store.fielddefs[name]
            described = found[name] = {
                "type": self._shown(name),
                "fieldnames": [self._field(name, field) for field, _ in fields],
                "fieldtypes": [],
                "fieldarraylen": [],
                "examples": [],
                "constnames": [constant for constant, _, _ in constants],
                "constvalues": [str(value) for _, _, value in constants],
            }
            for _field, (kind, content) in fields:
                element, length = _element(kind, content)
                nested = element in store.fielddefs
                described["fieldtypes"].append(self._shown(element) if nested else element)
                described["fieldarraylen"].append(length)
                example = "[]" if length >= 0 else "{}" if nested else str(_DEFAULTS.get(element, ""))
                described["examples"].append(example)
                if nested:
                    waiting.append(element)
        return list(found.values())

    def _shown(self, name: str) -> str:
        if self.ros_version == 1:
            return _TIMES.get(name) or ros1_type(name)
        return name

    def _field(self, type_name: str, field: str) -> str:
        return _ROS1_TIME[field] if self.ros_version == 1 and type_name in _TIMES else field

    def _known(self, type_name: str) -> "tuple[Typestore, str]":
        store = self._store()
        known = ros2_type(type_name)
        if known not in store.fielddefs:
            raise RefusedError(f"the hub does not know the fields of {type_name}")
        return store, known

    def _store(self) -> "Typestore":
        if self._loaded is None:
            if self._missing:
                raise RefusedError(_MISSING)
            try:
                from rosbags.typesys import Stores, get_typestore
            except ImportError:
                self._missing = True
                raise RefusedError(_MISSING) from None
            self._loaded = get_typestore(Stores.ROS2_JAZZY if self.ros_version == 2 else Stores.ROS1_NOETIC)
        return self._loaded

    def _made(self, store: "Typestore", name: str, message: Any, place: str) -> Any:
        """A message of rosbags' from JSON; what is left out has its default."""
        if not isinstance(message, dict):
            raise TypeError(f"{place or 'the message'} is no object")
        _constants, fields = store.fielddefs[name]
        given = dict(message)
        values = {}
        for field, (kind, content) in fields:
            value = given.pop(field, None)
            other = _ROS1_TIME.get(field) if name in _TIMES else None
            if other is not None and (alias := given.pop(other, None)) is not None:
                value = alias
            values[field] = self._value(store, kind, content, value, f"{place}{field}")
        if given:
            raise ValueError(f"it has a field {place}{next(iter(given))}, which the type has not")
        return store.types[name](**values)

    def _value(self, store: "Typestore", kind: Any, content: Any, value: Any, place: str) -> Any:
        element, length = _element(kind, content)
        if length < 0:
            if element in store.fielddefs:
                return self._made(store, element, {} if value is None else value, f"{place}.")
            default = _DEFAULTS[element]
            if value is None:
                return default
            if isinstance(default, str) != isinstance(value, str):
                raise ValueError(f"{place} is no {element}")
            return float(value) if isinstance(default, float) else type(default)(value)
        items = [] if value is None else value
        if element in _NUMBERS:
            return _numbers(items, element, length, place)
        if not isinstance(items, list):
            raise TypeError(f"{place} is no array")
        if length and value is None:
            items = [None] * length
        if length and len(items) != length:
            raise ValueError(f"{place} has {len(items)} elements, not {length}")
        inner_kind, inner_content = content[0]
        return [
            self._value(store, inner_kind, inner_content, item, f"{place}[{index}]")
            for index, item in enumerate(items)
        ]


def _element(kind: Any, content: Any) -> tuple[str, int]:
    """The type of a field or of its elements, and its length: -1 for none, 0 for any."""
    name = kind.name
    if name == "BASE":
        return str(content[0]), -1
    if name == "NAME":
        return str(content), -1
    inner, length = content
    element, _ = _element(*inner)
    return element, length if name == "ARRAY" else 0


def _numbers(items: Any, element: str, length: int, place: str) -> Any:
    """An array of numbers for rosbags: a NumPy array of their type."""
    import numpy as np

    elements = _NUMBERS[element]
    if isinstance(items, str) and element in _BYTES:
        array = np.frombuffer(b64decode(items, validate=True), np.uint8)
    elif isinstance(items, list):
        if elements[0] == "f":
            items = [float("nan") if item is None else item for item in items]
        elif any(type(item) is not int for item in items):
            raise ValueError(f"{place} has elements that are no integers")
        array = np.array(items, np.dtype(elements))
    else:
        raise ValueError(f"{place} is no array of {element}")
    if array.ndim != 1:
        raise ValueError(f"{place} is no array of {element}")
    if length and not items:
        array = np.zeros(length, array.dtype)
    if length and len(array) != length:
        raise ValueError(f"{place} has {len(array)} elements, not {length}")
    return array


def _message_to_typed(store: "Typestore", name: str, made: dict[str, _Convert]) -> _Convert:
    """What makes typed arrays of a message's arrays of numbers; types without any pass as they are."""
    converts: dict[str, _Convert] = {}

    def convert(message: dict[str, Any]) -> dict[str, Any]:
        return {
            field: converts[field](value) if field in converts else value for field, value in message.items()
        }

    made[name] = convert
    for field, (kind, content) in store.fielddefs[name][1]:
        element, length = _element(kind, content)
        if element in _NUMBERS:
            if length >= 0:
                converts[field] = _bytes if element in _BYTES else _typed_array(_NUMBERS[element])
        elif element in store.fielddefs:
            inner = made.get(element) or _message_to_typed(store, element, made)
            converts[field] = inner if length < 0 else _each(inner)
    return convert


def _each(convert: _Convert) -> _Convert:
    def each(values: list[Any]) -> list[Any]:
        return [convert(value) for value in values]

    return each


def _bytes(value: Any) -> bytes:
    return b64decode(value, validate=True) if isinstance(value, str) else bytes(value)


def _typed_array(elements: str) -> _Convert:
    from bridge.codecs.cbor_codec import typed_array

    nothing = float("nan") if elements[0] == "f" else 0

    def convert(values: list[Any]) -> Any:
        try:
            return typed_array(values, elements)
        except BridgeError:
            return typed_array([nothing if value is None else value for value in values], elements)

    return convert
