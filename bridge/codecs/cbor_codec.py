"""CBOR on the wire: one map in, one out, typed arrays without lists in between, within limits of size and depth.

rosbridge servers send CBOR (RFC 8949) to a subscriber that asks for ``compression: cbor``: numeric arrays as
typed arrays (RFC 8746, little endian), ``uint8[]`` as a byte string. What a client sends is JSON.

Inbound, of all that CBOR can say only what a ROS message needs is taken: maps with text keys, arrays, text, byte
strings, numbers, booleans, null, and the typed arrays. Every other tag (shared references, bignums, regular
expressions, dates) is refused before anything is made of it. NaN and infinities are numbers here, as in ROS.

NumPy is imported when the first array is wanted, never before.
"""

from array import array
from collections.abc import Callable, Mapping
from functools import lru_cache
from io import BytesIO
from sys import byteorder
from typing import Any, Final, Literal

import cbor2

from bridge.codecs.json_codec import MAX_DEPTH, MAX_SIZE, excerpt
from bridge.errors import DecodeError, EncodeError

#: What becomes of a typed array: a list of numbers (bytes for ``uint8[]``), or a read-only NumPy array.
Arrays = Literal["list", "numpy"]

#: By tag: NumPy's name of the elements, and that of the module ``array``.
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
_TAGS: Final = {name[1:]: tag for tag, (name, _code) in TYPED_ARRAYS.items()}
_FLOAT64: Final = 86
_LEAVES: Final = frozenset({str, int, float, bool, type(None)})
_NUMBERS: Final = frozenset({int, float, type(None)})

_Decoder = Callable[[Any, bool], Any]


def decode(
    data: bytes, *, max_size: int = MAX_SIZE, max_depth: int = MAX_DEPTH, arrays: Arrays = "list"
) -> dict[str, Any]:
    """Read one message.

    Args:
        data: a whole WebSocket message.
        max_size: bytes at most.
        max_depth: maps, arrays and tags within each other at most, the outermost included (an empty one
            inside the last does not count).
        arrays: what typed arrays and byte strings become: ``list`` makes lists of numbers, and bytes of
            ``uint8[]``; ``numpy`` makes read-only arrays of one dimension, which share the message's memory.

    Returns:
        The map. Its numbers may be NaN or infinite.

    Raises:
        DecodeError: too large, too deep, no CBOR, CBOR but no map, or something that no ROS message holds.
    """
    if len(data) > max_size:
        raise DecodeError(f"a message of {len(data)} bytes arrived, at most {max_size} are taken")
    source = BytesIO(data)
    try:
        message = cbor2.CBORDecoder(
            source, semantic_decoders=_decoders(arrays), max_depth=max_depth, strict_hashable_types=True
        ).decode()
    except (cbor2.CBORError, ValueError, OverflowError, RecursionError) as error:
        why = error.__cause__ if isinstance(error.__cause__, DecodeError) else error
        raise DecodeError(f"a message that is no usable CBOR arrived ({why}): {excerpt(data)}") from None
    if type(message) is not dict or source.tell() != len(data):
        raise DecodeError(f"a message that is no single CBOR map arrived: {excerpt(data)}")
    _check(message, arrays, data)
    return message


class _Tags(dict[int, _Decoder]):
    """What is made of each tag: typed arrays of those that stand here, nothing of all others."""

    def __missing__(self, tag: int) -> _Decoder:
        """Refuse a tag, also those that the library would make something of."""

        def refuse(_value: object, _immutable: bool) -> Any:
            raise DecodeError(f"tag {tag} is none of a typed array")

        return refuse


@lru_cache(maxsize=2)
def _decoders(arrays: Arrays) -> _Tags:
    make = _numpy_array if arrays == "numpy" else _plain_array
    return _Tags({tag: make(tag) for tag in TYPED_ARRAYS})


def _plain_array(tag: int) -> _Decoder:
    code = TYPED_ARRAYS[tag][1]
    size = array(code).itemsize

    def make(value: object, _immutable: bool) -> "array[Any]":
        if type(value) is not bytes or len(value) % size:
            raise DecodeError(f"a typed array (tag {tag}) has no whole number of {size}-byte elements")
        numbers = array(code, value)  # a list once all is read: no tag around it takes it for its own content
        if byteorder == "big":
            numbers.byteswap()
        return numbers

    return make


def _numpy_array(tag: int) -> _Decoder:
    import numpy as np

    dtype = np.dtype(TYPED_ARRAYS[tag][0])

    def make(value: object, _immutable: bool) -> Any:
        if type(value) is not bytes or len(value) % dtype.itemsize:
            raise DecodeError(
                f"a typed array (tag {tag}) has no whole number of {dtype.itemsize}-byte elements"
            )
        return np.frombuffer(value, dtype)

    return make


def _check(message: dict[str, Any], arrays: Arrays, data: bytes) -> None:
    """Refuse what the library makes of what no message holds; give byte strings the form that is wanted."""
    from_bytes = _decoders("numpy")[64] if arrays == "numpy" else None
    inner: list[Any] = [message]
    while inner:
        container = inner.pop()
        if type(container) is dict:
            if set(map(type, container)) - {str}:
                raise DecodeError(f"a message with a key that is no text arrived: {excerpt(data)}")
            items: Any = container.items()
        elif set(map(type, container)) <= _LEAVES:
            continue
        else:
            items = enumerate(container)
        for key, value in items:
            kind = type(value)
            if kind in _LEAVES:
                continue
            if kind is dict or kind is list:
                inner.append(value)
            elif kind is bytes:
                if from_bytes is not None:
                    container[key] = from_bytes(value, False)
            elif kind is array:
                container[key] = value.tobytes() if value.typecode == "B" else value.tolist()
            elif kind is cbor2.CBORSimpleValue or value is cbor2.undefined:
                raise DecodeError(f"a message with a value that has no meaning arrived: {excerpt(data)}")


def encode(
    message: Mapping[str, Any],
    *,
    max_size: int = MAX_SIZE,
    max_depth: int = MAX_DEPTH,
    pack_floats: bool = False,
) -> bytes:
    """Write one message.

    Args:
        message: what to send. NumPy arrays (C order, any shape, flattened) become typed arrays, byte strings
            stay such; `typed_array` makes typed arrays of anything else.
        max_size: bytes at most.
        max_depth: maps and arrays within each other at most.
        pack_floats: whether lists of numbers with at least one float among them become typed arrays of
            float64, a None (JSON's null) among them NaN. That is what a server does that has the message as
            JSON and no definition of its type: lists of integers alone stay lists, since nobody can tell
            whether they are of 8 or of 64 bits.

    Raises:
        EncodeError: a type that CBOR has not got here, a key that is no string, too deep or too large.
    """
    try:
        data = cbor2.dumps(_prepare(message, max_depth, pack_floats))
    except (cbor2.CBORError, ValueError, OverflowError, RecursionError) as error:
        raise EncodeError(f"the message cannot be written as CBOR: {error.__cause__ or error}") from None
    if len(data) > max_size:
        raise EncodeError(f"the message has {len(data)} bytes as CBOR, at most {max_size} are sent")
    return data


def typed_array(values: Any, elements: str) -> cbor2.CBORTag:
    """A typed array to be a value in a message that `encode` writes.

    Args:
        values: numbers, in anything that can be iterated.
        elements: what each is: ``u1 u2 u4 u8 i1 i2 i4 i8 f4 f8``.

    Raises:
        EncodeError: a value is none of these, or the elements have another name.
    """
    tag = _TAGS.get(elements)
    if tag is None:
        raise EncodeError(f"{elements!r} names no elements of a typed array, these do: {' '.join(_TAGS)}")
    try:
        numbers = array(TYPED_ARRAYS[tag][1], values)
    except (TypeError, OverflowError, ValueError) as error:
        raise EncodeError(f"the values make no typed array of {elements}: {error}") from None
    if byteorder == "big":
        numbers.byteswap()
    return cbor2.CBORTag(tag, numbers.tobytes())


def _prepare(value: Any, levels: int, pack_floats: bool) -> Any:
    """The value with everything in it that is no CBOR yet made so; ``levels`` may still be within each other."""
    kind = type(value)
    if kind in _LEAVES or kind is bytes or kind is cbor2.CBORTag:
        return value
    if isinstance(value, Mapping):
        if levels < 1:
            raise EncodeError("the message is nested too deeply")
        if set(map(type, value)) - {str}:
            raise EncodeError("the message has a key that is no string")
        return {key: _prepare(part, levels - 1, pack_floats) for key, part in value.items()}
    if isinstance(value, list | tuple):
        if levels < 1:
            raise EncodeError("the message is nested too deeply")
        kinds = set(map(type, value))
        if pack_floats and float in kinds and kinds <= _NUMBERS:
            return _packed_floats(value, kinds)
        return value if kinds <= _LEAVES else [_prepare(part, levels - 1, pack_floats) for part in value]
    return _from_numpy(value)


def _packed_floats(values: list[Any] | tuple[Any, ...], kinds: set[type]) -> Any:
    if type(None) in kinds:
        values = [float("nan") if value is None else value for value in values]
    try:
        return typed_array(values, "f8")
    except EncodeError:  # an integer that no float64 holds
        return values


def _from_numpy(value: Any) -> Any:
    """What stands for a NumPy array or scalar."""
    if isinstance(value, str | int | float) and not hasattr(value, "dtype"):
        return value  # of a class that is one of these, an enumeration for example
    dtype = getattr(value, "dtype", None)
    if dtype is None or dtype.kind not in "buifU":
        raise EncodeError(f"{type(value).__name__} is nothing that a message can hold")
    if value.ndim == 0 or dtype.str[1:] not in _TAGS:
        return value.tolist()
    if dtype.byteorder == ">" or byteorder == "big":
        value = value.astype(dtype.newbyteorder("<"))
    return cbor2.CBORTag(_TAGS[dtype.str[1:]], value.tobytes())
