"""CBOR on the wire: one map per message, typed arrays without intermediate lists, limits of size and depth.

rosbridge servers send CBOR (RFC 8949) to subscribers that ask for `compression: cbor`: arrays of numbers as
typed arrays (RFC 8746, little endian), `uint8[]` as a byte string. Clients send JSON.

Inbound, only the part of CBOR that ROS messages need is accepted: maps with text keys, arrays, text, byte strings,
numbers, booleans, null, and typed arrays. Every other tag (shared references, bignums, regular expressions, dates)
is refused before it is decoded. NaN and infinities are numbers here, as in ROS.

NumPy is imported when the first array is requested.
"""

import struct
from array import array
from collections.abc import Callable, Mapping
from functools import lru_cache
from io import BytesIO
from sys import byteorder
from typing import Any, Final, Literal

import cbor2

from bridge.codecs.json_codec import MAX_DEPTH, MAX_SIZE, excerpt
from bridge.errors import DecodeError, EncodeError

Arrays = Literal["list", "numpy"]
"""Form of a decoded typed array: a list of numbers (bytes for `uint8[]`), or a read-only NumPy array."""

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
"""Element types by tag, in the notation of NumPy and in that of the modules `array` and `struct`."""
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
        max_size: Maximum of bytes.
        max_depth: Maximum nesting of maps, arrays and tags, including the outermost (an empty one inside
            the last does not count).
        arrays: Form of typed arrays and byte strings: `list` makes lists of numbers, and bytes of `uint8[]`;
            `numpy` makes read-only one-dimensional arrays that share the message's memory.

    Returns:
        The map. Its numbers may be NaN or infinite.

    Raises:
        DecodeError: The data is too large, too deep, not a CBOR map, or contains values that ROS messages
            cannot contain.
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


def encode(
    message: Mapping[str, Any],
    *,
    max_size: int = MAX_SIZE,
    max_depth: int = MAX_DEPTH,
    pack_floats: bool = False,
) -> bytes:
    """Write one message.

    Args:
        message: The object. NumPy arrays (of any shape, flattened in C order) become typed arrays, and byte
            strings remain byte strings; for typed arrays from other values, use `typed_array`.
        max_size: Maximum of bytes.
        max_depth: Maximum nesting of maps and arrays.
        pack_floats: Whether lists of numbers with at least one float become typed arrays of float64, with NaN
            for None (null in JSON). This is for a server that has a message's JSON, but no definition of its type.
            Lists of only integers remain lists, because their width is unknown.

    Raises:
        EncodeError: A type is not supported, a key is not a string, or the message is too deep or too large.
    """
    try:
        data = cbor2.dumps(_prepare(message, max_depth, pack_floats))
    except (cbor2.CBORError, ValueError, OverflowError, RecursionError) as error:
        raise EncodeError(f"the message cannot be written as CBOR: {error.__cause__ or error}") from None
    if len(data) > max_size:
        raise EncodeError(f"the message has {len(data)} bytes as CBOR, expected at most {max_size}")
    return data


def typed_array(values: Any, elements: str) -> cbor2.CBORTag:
    """Return a typed array, for use as a value in a message for `encode`.

    Args:
        values: Any iterable of numbers.
        elements: Their type: `u1 u2 u4 u8 i1 i2 i4 i8 f4 f8`.

    Raises:
        EncodeError: A value does not have this type, or the type is unknown.
    """
    tag = _TAGS.get(elements)
    if tag is None:
        raise EncodeError(
            f"{elements!r} is not an element type of typed arrays, expected one of {' '.join(_TAGS)}"
        )
    try:
        numbers = values if type(values) is list else tuple(values)
        packed = struct.pack(f"<{len(numbers)}{TYPED_ARRAYS[tag][1]}", *numbers)
    except (TypeError, OverflowError, struct.error) as error:
        raise EncodeError(f"the values do not fit a typed array of {elements}: {error}") from None
    return cbor2.CBORTag(tag, packed)


def _prepare(value: Any, levels: int, pack_floats: bool) -> Any:
    """Return the value with only CBOR types, nested at most `levels` deep."""
    kind = type(value)
    if kind in _LEAVES or kind is bytes or kind is cbor2.CBORTag:
        return value
    if not isinstance(value, Mapping | list | tuple):
        return _from_numpy(value)
    # Checked here, because the library has no such limit when it encodes.
    if levels < 1:
        raise EncodeError("the message is nested too deeply")
    if isinstance(value, Mapping):
        if set(map(type, value)) - {str}:
            raise EncodeError("the message has a key that is not a string")
        return {key: _prepare(part, levels - 1, pack_floats) for key, part in value.items()}
    kinds = set(map(type, value))
    if pack_floats and float in kinds and kinds <= _NUMBERS:
        return _packed_floats(value, kinds)
    return value if kinds <= _LEAVES else [_prepare(part, levels - 1, pack_floats) for part in value]


def _packed_floats(values: list[Any] | tuple[Any, ...], kinds: set[type]) -> Any:
    if type(None) in kinds:
        values = [float("nan") if value is None else value for value in values]
    try:
        return typed_array(values, "f8")
    except EncodeError:  # an integer beyond float64
        return values


def _from_numpy(value: Any) -> Any:
    """Return the CBOR form of a NumPy array or scalar."""
    if isinstance(value, str | int | float) and not hasattr(value, "dtype"):
        return value  # of a subclass, for example an enumeration
    dtype = getattr(value, "dtype", None)
    if dtype is None or dtype.kind not in "buifU":
        raise EncodeError(f"{type(value).__name__} is not a type of messages")
    # Scalars, booleans and text have no typed arrays.
    if value.ndim == 0 or dtype.str[1:] not in _TAGS:
        return value.tolist()
    if dtype.byteorder == ">" or byteorder == "big":
        value = value.astype(dtype.newbyteorder("<"))
    return cbor2.CBORTag(_TAGS[dtype.str[1:]], value.tobytes())


# Conversion of whole messages between lists of numbers and NumPy arrays, for when the encoding differs from the
# requested form: CBOR was requested but JSON arrives, or two subscriptions of a client request different forms.


def with_arrays(value: Any) -> Any:
    """Replace every list of numbers in a message that arrived as JSON, in place.

    Floats become float64, with NaN for null; integers become int64, or uint64 if int64 is too small; bytes
    become uint8. All other lists, including numbers mixed with booleans, remain lists.
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
    """Replace every NumPy array in a message, in place: uint8 becomes bytes, all others lists of numbers."""
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
