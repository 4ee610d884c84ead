"""Message definitions (the fields of each type) from `rosbags`, if it is installed.

The hub forwards JSON without them. They are needed for CBOR with typed arrays, for serialised messages
(cbor-raw) and for rosapi's descriptions of types. `rosbags` is imported by the first operation that needs it;
without it CBOR packs only floats, and the other two are refused.

Every conversion checks the type, range and number of values before it allocates memory for them.
"""

import contextlib
import time
from base64 import b64decode
from collections.abc import Callable
from functools import cache
from math import inf, nan
from typing import TYPE_CHECKING, Any, Final, Literal

from bridge.errors import BridgeError
from bridge.hub.delivery.filling import FieldTypes, Filler, Types
from bridge.hub.delivery.interfaces import PARTS, message_texts, part_name
from bridge.hub.errors import DefinitionsPendingError, RefusedError
from bridge.names import ros1_type, ros2_type

if TYPE_CHECKING:
    from rosbags.typesys import Stores
    from rosbags.typesys.store import Typestore

RosVersion = Literal[1, 2]

_NUMBERS: Final = {
    "int8": "i1",
    "uint8": "u1",
    "octet": "u1",
    "byte": "u1",
    "char": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
"""Element types of arrays by rosbags' names of numbers."""
_FLOAT32: Final = 3.4028234663852886e38
_RANGES: Final = {"f4": (-_FLOAT32, _FLOAT32), "f8": (-inf, inf)} | {
    f"{sign}{size}": (-(1 << 8 * size - 1), (1 << 8 * size - 1) - 1)
    if sign == "i"
    else (0, (1 << 8 * size) - 1)
    for sign in "iu"
    for size in (1, 2, 4, 8)
}
_DEFAULTS: Final[dict[str, Any]] = {"bool": False, "string": "", "wstring": ""} | {
    name: 0.0 if elements[0] == "f" else 0 for name, elements in _NUMBERS.items()
}
_BYTES: Final = frozenset({"uint8", "octet", "char"})
_TIMES: Final = {"builtin_interfaces/msg/Time": "time", "builtin_interfaces/msg/Duration": "duration"}
_ROS1_TIME: Final = {"sec": "secs", "nanosec": "nsecs"}
"""Fields of a time in ROS 1, by their names in rosbags, which are ROS 2's."""
_BYTES_A_VALUE: Final = 16
"""Bytes of the size limit per value of a serialised message; `{}` in an array can stand for dozens of values.
"""
_DUMMY: Final = "structure_needs_at_least_one_member"
_MISSING: Final = (
    "the hub has no message definitions: install rosbags (pip install rosbags) and start the hub again"
)

_Convert = Callable[[Any], Any]


class Definitions:
    """The known message types of one ROS version."""

    def __init__(self, ros_version: RosVersion = 1, wall_clock: Callable[[], int] = time.time_ns) -> None:
        """Start without definitions; `wall_clock` returns nanoseconds since 1970, for absent stamps."""
        self.ros_version: RosVersion = ros_version
        self.load_in_background: Callable[[], None] | None = None
        """Starts a thread for `load`; without it, loading blocks the operation that needs definitions."""
        self.pending = False
        """True while an operation waits for `load`."""
        self._store: Typestore | None = None
        self._missing = False
        self._typed: dict[str, _Convert] = {}
        self._types = Types(self._field_types, _DEFAULTS, _TIMES, ros_version, wall_clock)
        self._texts: dict[str, str] = {}

    def load(self) -> None:
        """Import rosbags and its types, which takes tenths of a second."""
        try:
            from rosbags.typesys import Stores
        except ImportError:
            self._missing = True
        else:
            self._store = _store(Stores.ROS2_JAZZY if self.ros_version == 2 else Stores.ROS1_NOETIC)
        self.pending = False

    def preload(self) -> None:
        """Load the definitions in the background, before an operation needs them."""
        with contextlib.suppress(DefinitionsPendingError):
            self.require()

    def require(self) -> None:
        """Load the definitions for an operation that needs them.

        Raises:
            DefinitionsPendingError: They are being loaded in the background; repeat the operation afterwards.
        """
        if self._store is not None or self._missing:
            return
        if self.load_in_background is None:
            self.load()
        else:
            if not self.pending:
                self.pending = True
                self.load_in_background()
            raise DefinitionsPendingError

    def name(self, type_name: str) -> str:
        """Return a message type's name as this ROS version writes it."""
        return ros2_type(type_name) if self.ros_version == 2 else ros1_type(type_name)

    def filler(self, type_name: str) -> Filler | None:
        """Return the filler of the absent fields of a message type, or None if the type is unknown.

        Raises:
            DefinitionsPendingError: The definitions are being loaded.
        """
        self.require()
        try:
            _store, known = self._known(type_name)
        except BridgeError:
            return None
        return self._types.filler(known)

    def fillers(self, type_name: str, kind: Literal["srv", "action"]) -> dict[str, Filler]:
        """Return the fillers of the parts of a service or an action, such as `Request`, without unknown parts.

        Raises:
            DefinitionsPendingError: The definitions are being loaded.
        """
        fillers = {part: self.filler(part_name(type_name, part, self.ros_version)) for part in PARTS[kind]}
        return {part: filler for part, filler in fillers.items() if filler is not None}

    def _field_types(self, name: str) -> FieldTypes:
        store, known = self._known(name)
        fields = _fields(store, known)
        return {self._field(name, field): _element(kind, content) for field, (kind, content) in fields}

    def typed(self, type_name: str, message: dict[str, Any]) -> dict[str, Any] | None:
        """Convert a message's arrays of numbers to typed arrays, for CBOR.

        Returns:
            The message, or None if its type is unknown or does not fit it.
        """
        try:
            convert = self._typed.get(type_name)
            if convert is None:
                store, known = self._known(type_name)
                convert = self._typed[type_name] = _typed_converter(store, known, {})
            converted: dict[str, Any] = convert(message)
        except (BridgeError, TypeError, ValueError, AttributeError):
            return None
        return converted

    def serialise(self, type_name: str, message: dict[str, Any], max_size: int) -> bytes:
        """Serialise a message as ROS 1's transport would, or as CDR with its header, or raise a RefusedError."""
        store, known = self._known(type_name)
        try:
            built = _Builder(store, max_size // _BYTES_A_VALUE).message(known, message, "")
            serialise = store.serialize_cdr if self.ros_version == 2 else store.serialize_ros1
            return bytes(serialise(built, known))
        except Exception as error:  # rosbags, NumPy and struct raise their own errors for unsuitable values
            raise RefusedError(f"a message does not fit its type {self.name(type_name)}: {error}") from None

    def full_text(self, type_name: str) -> str:
        """Return the definitions of a type and of its parts, as in bag files, or raise a RefusedError."""
        text = self._texts.get(type_name)
        if text is None:
            store, known = self._known(type_name)
            text, _digest = store.generate_msgdef(known, ros_version=self.ros_version)
            self._texts[type_name] = text
        return text

    def details(self, type_name: str) -> list[dict[str, Any]]:
        """Return the fields of a type and of its parts, as `rosapi_msgs/TypeDef`, or raise a RefusedError."""
        store, known = self._known(type_name)
        found: dict[str, dict[str, Any]] = {}
        waiting = [known]
        while waiting:
            name = waiting.pop(0)
            if name in found:
                continue
            constants, fields = store.fielddefs[name][0], _fields(store, name)
            elements = [_element(kind, content) for _, (kind, content) in fields]
            nested = [element in store.fielddefs for element, _ in elements]
            found[name] = {
                "type": self._shown(name),
                "fieldnames": [self._field(name, field) for field, _ in fields],
                "fieldtypes": [
                    self._shown(element) if inner else element
                    for (element, _), inner in zip(elements, nested, strict=True)
                ],
                "fieldarraylen": [length for _, length in elements],
                "examples": [
                    "[]" if length >= 0 else "{}" if inner else str(_DEFAULTS.get(element, ""))
                    for (element, length), inner in zip(elements, nested, strict=True)
                ],
                "constnames": [constant for constant, _, _ in constants],
                "constvalues": [str(value) for _, _, value in constants],
            }
            waiting += [element for (element, _), inner in zip(elements, nested, strict=True) if inner]
        return list(found.values())

    def _shown(self, name: str) -> str:
        if self.ros_version == 1:
            return _TIMES.get(name) or ros1_type(name)
        part = name.rpartition("_")[2]  # names of messages have no underscore
        kind = next(
            (kind for kind, parts in PARTS.items() if part in parts and "_" in name.rpartition("/")[2]), "msg"
        )
        return name.replace("/msg/", f"/{kind}/")

    def _field(self, type_name: str, field: str) -> str:
        return _ROS1_TIME[field] if self.ros_version == 1 and type_name in _TIMES else field

    def _known(self, type_name: str) -> "tuple[Typestore, str]":
        self.require()
        if self._store is None:
            raise RefusedError(_MISSING)
        known = ros2_type(type_name)
        if not _define(self._store, known, self.ros_version):
            raise RefusedError(f"the hub does not know the fields of {type_name}")
        return self._store, known


@cache
def _store(name: "Stores") -> "Typestore":
    """Return the types of a ROS version, one store for all hubs of a process."""
    from rosbags.typesys import get_typestore

    return get_typestore(name)


def _define(store: "Typestore", name: str, ros_version: RosVersion) -> bool:
    """Return whether a type is known, after adding its definition and those of its parts if rosbags lacks them."""
    if name in store.fielddefs:
        return True
    text = message_texts(ros_version).get(name)
    if text is None:
        return False
    from rosbags.typesys import get_types_from_msg

    types = get_types_from_msg(text, name)
    for field in types[name][1]:
        element, _length = _element(*field[1])
        if element not in _DEFAULTS:
            _define(store, element, ros_version)
    if ros_version == 1:
        types = {name: (types[name][0], [entry for entry in types[name][1] if entry[0] != _DUMMY])}
    store.register(types)
    return True


class _Builder:
    """Builder of rosbags' objects from JSON; fields that are left out get their default."""

    def __init__(self, store: "Typestore", max_values: int) -> None:
        self._store = store
        self._max_values = max_values
        self._values = 0

    def message(self, name: str, message: Any, place: str) -> Any:
        """Build a message of a known type."""
        if not isinstance(message, dict):
            raise TypeError(f"{place or 'the message'} is not an object")
        _constants, fields = self._store.fielddefs[name]
        self._count(len(fields))
        given = dict(message)
        values = {}
        for field, (kind, content) in fields:
            value = given.pop(field, None)
            other = _ROS1_TIME.get(field) if name in _TIMES else None
            if other is not None and (alias := given.pop(other, None)) is not None:
                value = alias
            values[field] = self._value(kind, content, value, f"{place}{field}")
        if given:
            raise ValueError(f"the type has no field {place}{next(iter(given))}")
        return self._store.types[name](**values)

    def _value(self, kind: Any, content: Any, value: Any, place: str) -> Any:
        element, length = _element(kind, content)
        if length < 0:
            if element in self._store.fielddefs:
                return self.message(element, {} if value is None else value, f"{place}.")
            return _scalar(value, element, place)
        if value is None:
            value = [_DEFAULTS.get(element)] * length
        if element in _NUMBERS:
            import numpy as np

            numbers = _numbers(value, element, length, place)
            if isinstance(numbers, bytes):
                return np.frombuffer(numbers, np.uint8)
            return np.array(numbers, _NUMBERS[element])
        if not isinstance(value, list) or (length and len(value) != length):
            raise ValueError(f"{place} is not an array of {length or 'any number of'} elements")
        self._count(len(value))
        inner_kind, inner_content = content[0]
        return [
            self._value(inner_kind, inner_content, item, f"{place}[{index}]")
            for index, item in enumerate(value)
        ]

    def _count(self, values: int) -> None:
        """Count values, and refuse a message with too many before they are built."""
        self._values += max(values, 1)
        if self._values > self._max_values:
            raise ValueError(f"it has more than {self._max_values} values")


def _fields(store: "Typestore", name: str) -> list[Any]:
    """Return the fields of a type, without the one that ROS 2 adds to an empty message."""
    return [entry for entry in store.fielddefs[name][1] if entry[0] != _DUMMY]


def _element(kind: Any, content: Any) -> tuple[str, int]:
    """Return the type of a field or of its elements, and its length: -1 for a scalar, 0 for any."""
    name = kind.name
    if name == "BASE":
        return str(content[0]), -1
    if name == "NAME":
        return str(content), -1
    inner, length = content
    element, _ = _element(*inner)
    return element, length if name == "ARRAY" else 0


def _scalar(value: Any, element: str, place: str) -> Any:
    default = _DEFAULTS[element]
    if value is None:
        return default
    if element in _NUMBERS:
        return type(default)(_numbers([value], element, 1, place)[0])
    if element == "bool" and value in (0, 1):
        return bool(value)
    if not isinstance(default, str) or not isinstance(value, str):
        raise TypeError(f"{place} is not a {element}")
    return value


def _numbers(values: Any, element: str, length: int, place: str) -> list[Any] | bytes:
    """Return an array's numbers, checked: their types, their range, and their number unless `length` is 0."""
    if isinstance(values, str) and element in _BYTES:
        values = b64decode(values, validate=True)
    if not isinstance(values, list | bytes) or (length and len(values) != length):
        raise ValueError(f"{place} is not an array of {length or 'any number of'} {element}")
    if isinstance(values, bytes):
        return values
    elements = _NUMBERS[element]
    kinds = set(map(type, values))
    present: list[Any] = values
    if elements[0] == "f" and type(None) in kinds:
        present = [value for value in values if value is not None]
        kinds.discard(type(None))
    low, high = _RANGES[elements]
    if not kinds <= ({int, float} if elements[0] == "f" else {int}) or (
        present and high != inf and not (low <= min(present) and max(present) <= high)
    ):
        raise ValueError(f"{place} has values that are not {element}")
    checked: list[Any] = (
        values if present is values else [nan if value is None else value for value in values]
    )
    return checked


def _typed_converter(store: "Typestore", name: str, known: dict[str, _Convert]) -> _Convert:
    """Return the function that converts a message's arrays of numbers and leaves other fields unchanged."""
    converts: dict[str, _Convert] = {}

    def convert(message: dict[str, Any]) -> dict[str, Any]:
        return {
            field: converts[field](value) if field in converts else value for field, value in message.items()
        }

    known[name] = convert
    for field, (kind, content) in store.fielddefs[name][1]:
        element, length = _element(kind, content)
        if element in _NUMBERS:
            if length >= 0:
                converts[field] = _array_converter(field, element, length)
        elif element in store.fielddefs:
            inner = known.get(element) or _typed_converter(store, element, known)
            converts[field] = inner if length < 0 else _each(inner)
    return convert


def _each(convert: _Convert) -> _Convert:
    def each(values: Any) -> list[Any]:
        if not isinstance(values, list):
            raise TypeError
        return [convert(value) for value in values]

    return each


def _array_converter(field: str, element: str, length: int) -> _Convert:
    from bridge.codecs.cbor_codec import typed_array

    def convert(values: Any) -> Any:
        numbers = _numbers(values, element, length, field)
        return bytes(numbers) if element in _BYTES else typed_array(numbers, _NUMBERS[element])

    return convert
