"""Conversion of JSON messages by the types of their fields.

A message becomes CBOR with typed arrays, or an object that rosbags can serialise.
Every conversion checks the type, range and number of values before it allocates memory for them.
"""

from base64 import b64decode
from collections.abc import Callable
from functools import lru_cache
from math import inf, nan
from typing import TYPE_CHECKING, Any, Final

import cbor2
import msgspec

from bridge.codecs.cbor_codec import typed_array
from bridge.codecs.message_check import element_of

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Encode = Callable[[Any], bytes]

# Element types of NumPy by the names of numeric types in rosbags.
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
_FLOAT32: Final = 3.4028234663852886e38
_RANGES: Final = {"f4": (-_FLOAT32, _FLOAT32), "f8": (-inf, inf)} | {
    f"{sign}{size}": (-(1 << 8 * size - 1), (1 << 8 * size - 1) - 1)
    if sign == "i"
    else (0, (1 << 8 * size) - 1)
    for sign in "iu"
    for size in (1, 2, 4, 8)
}
DEFAULTS: Final[dict[str, Any]] = {"bool": False, "string": "", "wstring": ""} | {
    name: 0.0 if elements[0] == "f" else 0 for name, elements in _NUMBERS.items()
}
_BYTES: Final = frozenset({"uint8", "octet", "char"})
TIMES: Final = {"builtin_interfaces/msg/Time": "time", "builtin_interfaces/msg/Duration": "duration"}
# Fields of a time in ROS 1, by their names in rosbags, which are ROS 2's.
ROS1_TIME: Final = {"sec": "secs", "nanosec": "nsecs"}
# First bytes of CBOR arrays and maps, to which a size below `_INLINE` is added; for others `_FOUR_BYTES` is added, and
# the size follows in four bytes.
_ARRAY: Final = 0x80
_MAP: Final = 0xA0
_INLINE: Final = 24
_FOUR_BYTES: Final = 26
DUMMY: Final = "structure_needs_at_least_one_member"


class Builder:
    """Builder of rosbags' message objects from JSON. An absent field gets its default."""

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
        # Values that are left at the end have no field.
        given = dict(message)
        values = {}
        for field, (kind, content) in fields:
            value = given.pop(field, None)
            other = ROS1_TIME.get(field) if name in TIMES else None
            if other is not None and (alias := given.pop(other, None)) is not None:
                value = alias
            values[field] = self._value(kind, content, value, f"{place}{field}")
        if given:
            raise ValueError(f"the type has no field {place}{next(iter(given))}")
        return self._store.types[name](**values)

    def _value(self, kind: Any, content: Any, value: Any, place: str) -> Any:
        element, length = element_of(kind, content)
        if length < 0:
            if element in self._store.fielddefs:
                return self.message(element, {} if value is None else value, f"{place}.")
            return _scalar(value, element, place)
        if value is None:
            value = [DEFAULTS.get(element)] * length
        if element in _NUMBERS:
            import numpy as np

            # Bytes from base64 become an array without a list of numbers in between.
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
        """Add to the count of a message's values, and refuse too many before they are built."""
        self._values += max(values, 1)
        if self._values > self._max_values:
            raise ValueError(f"it has more than {self._max_values} values")


def fields_of(store: "Typestore", name: str) -> list[Any]:
    """Return the fields of a type, without the field that ROS 2 adds to a type without fields."""
    return [entry for entry in store.fielddefs[name][1] if entry[0] != DUMMY]


def _scalar(value: Any, element: str, place: str) -> Any:
    default = DEFAULTS[element]
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
    """Check the types, the range and the number of an array's values, and return the values.

    If `length` is 0, the array may have any number of values.
    """
    if element == "float64" and not length:
        try:  # much faster than comparing types, it refuses the same ones
            return msgspec.convert(values, list[float])
        except msgspec.ValidationError:  # for example of null
            pass
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


def cbor_encoder(
    store: "Typestore", name: str, defaults: Callable[[str], dict[str, Any]], known: dict[str, Encode | None]
) -> Encode | None:
    """Return a function that encodes messages of the type `name` as CBOR, with arrays of numbers as typed arrays.

    If neither the type nor a nested type has an array of numbers, return None. `defaults` returns the default values
    of a type's fields. `known` stores the functions of nested message types.
    """
    encoders: dict[str, Encode] = {}

    def encode(message: dict[str, Any]) -> bytes:
        parts = [_head(_MAP, len(message))]
        for field, value in message.items():
            parts += _text(field), encoders.get(field, cbor2.dumps)(value)
        return b"".join(parts)

    has_arrays = False
    for field, (kind, content) in store.fielddefs[name][1]:
        element, length = element_of(kind, content)
        if element in _NUMBERS:
            if length >= 0:
                encoders[field] = _array_encoder(field, element, length)
                has_arrays = True
        elif element in store.fielddefs:
            if element not in known:
                known[element] = cbor_encoder(store, element, defaults, known)
            if (inner := known[element]) is not None:
                encoders[field] = inner if length < 0 else _each(inner)
                has_arrays = True
            elif length < 0:
                encoders[field] = _unless_default(defaults(name).get(field))
    return encode if has_arrays else None


def _each(encode: Encode) -> Encode:
    def each(values: Any) -> bytes:
        if not isinstance(values, list):
            raise TypeError
        return _head(_ARRAY, len(values)) + b"".join(map(encode, values))

    return each


def _unless_default(default: Any) -> Encode:
    """Return an encoder for a field that most messages lack: it encodes the default of the field only once."""
    encoded = cbor2.dumps(default)
    return lambda value: encoded if value is default else cbor2.dumps(value)


def _array_encoder(field: str, element: str, length: int) -> Encode:
    def encode(values: Any) -> bytes:
        numbers = _numbers(values, element, length, field)
        return cbor2.dumps(bytes(numbers) if element in _BYTES else typed_array(numbers, _NUMBERS[element]))

    return encode


@lru_cache(maxsize=1024)
def _text(text: str) -> bytes:
    return cbor2.dumps(text)


def _head(kind: int, size: int) -> bytes:
    """Return the CBOR bytes before the content of a map or an array (RFC 8949, section 3)."""
    if size < _INLINE:
        return bytes((kind | size,))
    return bytes((kind | _FOUR_BYTES,)) + size.to_bytes(4, "big")
