"""CBOR on the wire: one map per message, typed arrays without intermediate lists, limits of size and depth.

rosbridge servers send CBOR (RFC 8949) to subscribers that ask for `compression: cbor`. An array of numbers is a
typed array (RFC 8746, little endian). An array `uint8[]` is a byte string. Clients send JSON.

The decoder accepts only the part of CBOR that ROS messages need: maps with text keys, arrays, typed arrays, text,
byte strings, numbers, booleans and null. The decoder refuses all other tags, such as bignums and dates, before it
decodes their content. NaN and infinities are numbers, as in ROS.

NumPy is imported when the first array is requested.
"""

import struct
from array import array
from collections.abc import Callable, Sequence
from functools import lru_cache
from io import BytesIO
from math import nan
from sys import byteorder
from typing import Any, Final, Literal

import cbor2

from bridge.codecs.json_codec import MAX_DEPTH, MAX_SIZE, excerpt
from bridge.errors import DecodeError, EncodeError

Arrays = Literal["list", "numpy"]
"""Form of decoded typed arrays: lists of numbers, with `bytes` for `uint8[]`, or read-only NumPy arrays."""

TYPED_ARRAYS: Final = {
    64: ("<u1", "B"),
    69: ("<u2", "H"),
    70: ("<u4", "I"),
    71: ("<u8", "Q"),
    72: ("<i1", "b"),
    77: ("<i2", "h"),
    78: ("<i4", "i"),
    79: ("<i8", "q"),
    85: ("<f4", "f"),
    86: ("<f8", "d"),
}
"""Element type of each CBOR tag: its NumPy name, and its code in the modules `array` and `struct`."""
_BYTES_TAG: Final = 64
_TAGS: Final = {name[1:]: tag for tag, (name, _code) in TYPED_ARRAYS.items()}
_TEXT: Final = frozenset({str})
_LEAVES: Final = frozenset({str, int, float, bool, type(None)})
_NUMBERS: Final = frozenset({int, float, type(None)})

_Decoder = Callable[[Any, bool], Any]


def decode(
    data: bytes, *, max_size: int = MAX_SIZE, max_depth: int = MAX_DEPTH, arrays: Arrays = "list"
) -> dict[str, Any]:
    """Read one message.

    Args:
        data: A whole WebSocket message.
        max_size: Maximum number of bytes.
        max_depth: Maximum nesting of maps, arrays and tags. The outermost level counts. An empty map or array at
            the innermost level does not count.
        arrays: Form of typed arrays and byte strings. With `list`, a `uint8[]` becomes `bytes`, and every other array
            a list of numbers. With `numpy`, each becomes a read-only one-dimensional array.

    Returns:
        The map of the message, whose numbers may be NaN or infinite.

    Raises:
        DecodeError: The data is too large, is nested too deeply, or is not a CBOR map. The error is also raised
            if the map contains values that ROS messages cannot contain.
    """
    if len(data) > max_size:
        raise DecodeError(f"a message of {len(data)} bytes arrived, expected at most {max_size}")
    source = BytesIO(data)
    try:
        message = cbor2.CBORDecoder(
            source, semantic_decoders=_decoders(arrays), max_depth=max_depth, strict_hashable_types=True
        ).decode()
    except (cbor2.CBORError, ValueError, OverflowError, RecursionError) as error:
        # The library wraps errors of our tag decoders, whose own sentence says more.
        why = error.__cause__ if isinstance(error.__cause__, DecodeError) else error
        raise DecodeError(f"a message that is not usable CBOR arrived ({why}): {excerpt(data)}") from None
    # Trailing bytes would be a second message, which nobody reads.
    if type(message) is not dict or source.tell() != len(data):
        raise DecodeError(f"a message that is not a single CBOR map arrived: {excerpt(data)}")
    _check(message, arrays, data)
    return message


class _Tags(dict[int, _Decoder]):
    """Decoders of the accepted tags, and refusal of all others."""

    def __missing__(self, tag: int) -> _Decoder:
        """Refuse a tag, even one that the library could decode."""

        def refuse(_value: object, _immutable: bool) -> Any:
            raise DecodeError(f"tag {tag} is not a typed array's")

        return refuse


@lru_cache(maxsize=2)
def _decoders(arrays: Arrays) -> _Tags:
    return _Tags({tag: _decoder(tag, arrays) for tag in TYPED_ARRAYS})


def _decoder(tag: int, arrays: Arrays) -> _Decoder:
    name, code = TYPED_ARRAYS[tag]
    size = array(code).itemsize
    if arrays == "numpy":
        import numpy as np

        dtype = np.dtype(name)

    def make(value: object, _immutable: bool) -> Any:
        # A tag may stand before any value, and a length that is no multiple would be an error of NumPy.
        if type(value) is not bytes or len(value) % size:
            raise DecodeError(f"a typed array (tag {tag}) does not consist of {size}-byte elements")
        if arrays == "numpy":
            return np.frombuffer(value, dtype)
        # Not a list yet: `_check` creates it, so that another tag around this one cannot use it as its content.
        numbers = array(code, value)
        if byteorder == "big":
            numbers.byteswap()
        return numbers

    return make


def _check(message: dict[str, Any], arrays: Arrays, data: bytes) -> None:
    """Refuse values that ROS messages cannot contain, and convert byte strings and arrays to the requested form."""
    from_bytes = _decoders("numpy")[_BYTES_TAG] if arrays == "numpy" else None
    # A stack instead of recursion, and types of whole containers at once: most are long lists of numbers.
    inner: list[Any] = [message]
    while inner:
        container = inner.pop()
        if type(container) is dict:
            if not _TEXT.issuperset(map(type, container)):
                raise DecodeError(f"a message with a key that is not text arrived: {excerpt(data)}")
            items: Any = container.items()
        elif _LEAVES.issuperset(map(type, container)):
            continue
        else:
            items = enumerate(container)
        for key, value in items:
            kind = type(value)
            if kind in _LEAVES:
                continue
            if (kind is dict or kind is list) and value:
                inner.append(value)
            elif kind is bytes:
                if from_bytes is not None:
                    container[key] = from_bytes(value, False)
            elif kind is array:
                container[key] = value.tobytes() if value.typecode == "B" else value.tolist()
            elif kind is cbor2.CBORSimpleValue or value is cbor2.undefined:
                raise DecodeError(f"a message with an unsupported value arrived: {excerpt(data)}")


def encode_json(message: dict[str, Any]) -> bytes:
    """Encode a decoded JSON message of unknown ROS type as CBOR.

    A list of numbers with at least one float becomes a typed array of float64, and None becomes NaN. A list of
    integers remains a list, because the width of the integers is unknown.
    """
    return cbor2.dumps(_packed(message))


def _packed(value: Any) -> Any:
    if type(value) is dict:
        return {key: _packed(part) for key, part in value.items()}
    if type(value) is not list:
        return value
    kinds = set(map(type, value))
    if float in kinds and kinds <= _NUMBERS:
        return typed_array([nan if part is None else part for part in value], "f8")
    return value if kinds <= _LEAVES else [_packed(part) for part in value]


def typed_array(numbers: Sequence[Any], elements: str) -> cbor2.CBORTag:
    """Return numbers as a typed array for a message; `elements` is the NumPy type, for example `u1` or `f8`.

    Raises an EncodeError if a number does not fit the type.
    """
    tag = _TAGS[elements]
    try:
        packed = struct.pack(f"<{len(numbers)}{TYPED_ARRAYS[tag][1]}", *numbers)
    except (OverflowError, struct.error) as error:
        raise EncodeError(f"the values do not fit a typed array of {elements}: {error}") from None
    return cbor2.CBORTag(tag, packed)


# Conversion of whole messages between lists of numbers and NumPy arrays, for when the encoding differs from the
# requested form: CBOR was requested but JSON arrives, or two subscriptions of a client request different forms.


def with_arrays(value: Any) -> Any:
    """In a message that arrived as JSON, replace every list of numbers by an array, in place.

    A list with a float becomes float64, and null becomes NaN. A list of integers becomes int64, or uint64 if int64 is
    too small. All other lists remain lists, for example lists with booleans. A `uint8[]` remains base64 text.
    """
    import numpy as np

    def array_of(part: Any) -> Any:
        kinds = set(map(type, part))
        if not kinds or not kinds <= _NUMBERS:
            return None
        if float in kinds:
            return np.array(
                [np.nan if x is None else x for x in part] if type(None) in kinds else part, np.float64
            )
        if kinds != {int}:
            return None
        try:
            return np.array(part, np.int64)
        except OverflowError:
            return np.array(part, np.uint64) if min(part) >= 0 else None

    return _replace(value, list, array_of)


def with_lists(value: Any) -> Any:
    """In a message, convert NumPy arrays in place. A uint8 array becomes `bytes`, any other array a list of numbers."""
    import numpy as np

    def list_of(part: Any) -> Any:
        return part.tobytes() if part.dtype == np.uint8 else part.tolist()

    return _replace(value, np.ndarray, list_of)


def _replace(message: Any, kind: type, convert: Any) -> Any:
    inner = [message]
    while inner:
        container = inner.pop()
        for key, part in list(container.items() if type(container) is dict else enumerate(container)):
            if type(part) is kind and (converted := convert(part)) is not None:
                container[key] = converted
            elif type(part) is dict or (type(part) is list and part):
                inner.append(part)
    return message
