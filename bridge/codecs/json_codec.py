"""JSON on the wire: one object per message, with limits of size and depth, and only finite numbers.

Inbound:

* One WebSocket message holds one object. If a key occurs several times, the last value wins, as in the servers'
  parsers.
* `NaN`, `Infinity` and `-Infinity` are read as None. JSON excludes them, but some servers send them. The reference
  server sends `null` instead, which is read as None too.
* Numbers beyond float64 (`1e999`) are also read as None.
* Messages that are not strict JSON are parsed a second time, by a lenient parser.
* Integers beyond 64 bits become floats.

Outbound: a message with NaN or an infinity is refused, and the error names the field. JSON has no such numbers, and
servers silently drop `null` in a float field. NumPy arrays and scalars are written without intermediate lists. NumPy is
never imported here. Bytes are written as base64, as servers write `uint8[]`.
"""

import base64
import json
import math
import re
from array import array
from collections.abc import Mapping
from itertools import accumulate
from typing import Any, Final

import orjson

from bridge.errors import DecodeError, EncodeError, MessageTooLargeError

MAX_SIZE: Final = 1 << 20
"""Default maximum size in bytes of a message that is sent or received."""
MAX_DEPTH: Final = 64
"""Default maximum nesting of objects and arrays. The deepest standard ROS message has about ten levels."""

_OPTIONS: Final = orjson.OPT_SERIALIZE_NUMPY
_EXCERPT: Final = 60
# Size in bytes up to which counting a character is faster than searching for each occurrence.
_COUNTED: Final = 4096
# Number of occurrences of one character to check before searching for the whole word.
_HOPS: Final = 64
# With fewer bytes than this per permitted level, size and number of `[` can show that a message is not too deep.
_SMALL: Final = 6
# The first byte of `null`; testing for a number is ten times as fast as for a byte string.
_N: Final = ord("n")
# For `is_deeper`: the bytes to remove, braces translated to square brackets, and these to steps of one level up or down
# (signed bytes).
_NO_BRACKETS: Final = bytes(byte for byte in range(256) if byte not in b"[]{}")
_BRACKETS: Final = bytes.maketrans(b"{}", b"[]")
_STEPS: Final = bytes.maketrans(b"[]", b"\x01\xff")

# What precedes a message in JSON and in CBOR.
_KEY: Final = b'"msg":'
_CBOR_KEY: Final = b"cmsg"
_JSON_TOPIC: Final = re.compile(rb'"topic":\s*"([^"]+)"')
# The key `topic` and the header of the text after it: its length is in the low bits, or in a byte of its
# own.
_CBOR_TOPIC: Final = re.compile(rb"etopic(?:x(.)|[\x61-\x77])", re.DOTALL)
_CBOR_LENGTH: Final = 0x1F
# Maximum length of an envelope in bytes.
LONGEST: Final = 512
BRACE: Final = ord("}")
"""The last byte of an operation."""


def excerpt(data: bytes | str) -> str:
    """Return the beginning of received data, short enough for a log line."""
    shown = repr(data[:_EXCERPT])
    return shown[: 2 * _EXCERPT] + "..." if len(data) > _EXCERPT or len(shown) > 2 * _EXCERPT else shown


def text_of(value: Any) -> str:
    """Return a server's explanation as text. Some servers send an object, which becomes JSON."""
    if isinstance(value, str):
        return value
    return "" if value is None else orjson.dumps(value).decode()


def decode(data: bytes, *, max_size: int = MAX_SIZE, max_depth: int = MAX_DEPTH) -> dict[str, Any]:
    """Decode a WebSocket message that contains a JSON object.

    Args:
        data: The whole message.
        max_size: Maximum number of bytes.
        max_depth: Maximum nesting depth of objects and arrays. The outermost object has depth 1.

    Returns:
        The object. All its numbers are finite.

    Raises:
        DecodeError: The data is too large, too deep, or not a JSON object.
    """
    if len(data) > max_size:
        raise DecodeError(f"a message of {len(data)} bytes arrived, expected at most {max_size}")
    try:
        message = orjson.loads(data)
    except orjson.JSONDecodeError as error:
        message = _decode_leniently(data, error)
    if type(message) is not dict:
        raise DecodeError(f"a message that is not a JSON object arrived: {excerpt(data)}")
    if is_deeper(data, max_depth):
        raise DecodeError(f"a message nested deeper than {max_depth} levels arrived: {excerpt(data)}")
    return message


def is_deeper(data: bytes, limit: int) -> bool:
    """Return whether valid JSON has more than `limit` levels of nesting. The JSON is not parsed."""
    if len(data) <= 2 * limit:
        return False
    if len(data) < _SMALL * limit:
        # A level of an array takes two bytes, and one of an object five (`{"":}`), except the innermost one (`{}`).
        arrays = data.count(b"[")
        if arrays + (len(data) - 2 * arrays + 3) // 5 <= limit:
            return False
    if not _has_more_brackets(data, limit):
        return False
    if b"\\" in data:
        data = data.replace(b"\\\\", b"").replace(b'\\"', b"")
    outside_strings = b"".join(data.split(b'"')[::2])
    brackets = outside_strings.translate(_BRACKETS, _NO_BRACKETS)
    while len(brackets) > 2 * limit > 0:
        # Removing the innermost pairs is ten times as fast as counting levels, if it removes most of them.
        outer, limit = brackets.replace(b"[]", b""), limit - 1
        if 2 * len(outer) > len(brackets):
            return max(accumulate(array("b", outer.translate(_STEPS))), default=0) > limit
        brackets = outer
    return max(accumulate(array("b", brackets.translate(_STEPS))), default=0) > limit


def _has_more_brackets(data: bytes, limit: int) -> bool:
    """Return whether JSON has more than `limit` opening brackets.

    JSON with at most `limit` opening brackets is nested at most `limit` levels deep.
    """
    if len(data) <= _COUNTED:
        return data.count(b"{") + data.count(b"[") > limit
    # Searching for the next bracket skips long arrays of numbers forty times faster than counting.
    for bracket in b"{", b"[":
        at = data.find(bracket)
        while at >= 0:
            limit -= 1
            if limit < 0:
                return True
            at = data.find(bracket, at + 1)
    return False


def _decode_leniently(data: bytes, error: orjson.JSONDecodeError) -> Any:
    """Read JSON with non-finite numbers, which become None; raise an error for everything else."""
    try:
        text = data.decode()
        if "infinity when parsed" not in error.msg and "NaN" not in text and "Infinity" not in text:
            raise ValueError  # noqa: TRY301 - the same error as for the other cases
        message = json.loads(
            text, parse_constant=lambda _: None, parse_float=_finite_or_none, parse_int=_int_of_64_bits
        )
        orjson.dumps(message)  # refuses unpaired surrogates and extreme depth, like strict reading
    except (ValueError, TypeError, RecursionError):  # ValueError: also bad UTF-8, an integer of 5000 digits
        raise DecodeError(f"a message that is not JSON arrived ({error.msg}): {excerpt(data)}") from None
    return message


def _int_of_64_bits(text: str) -> int | float | None:
    value = int(text)
    return value if -(1 << 63) <= value < 1 << 64 else _finite_or_none(text)


def _finite_or_none(text: str) -> float | None:
    value = float(text)
    return value if math.isfinite(value) else None


def encode(message: Mapping[str, Any], *, max_size: int = MAX_SIZE, max_depth: int = MAX_DEPTH) -> bytes:
    """Write one message as JSON without white space. Values may be NumPy arrays and scalars.

    Raises:
        EncodeError: The message is nested too deep, or contains a type that JSON does not have. Other causes are
            integers beyond 64 bits, keys that are not strings, NaN and infinity.
        MessageTooLargeError: The JSON has more than `max_size` bytes.
    """
    try:
        try:
            data = orjson.dumps(message, _to_json_type, _OPTIONS)
        except TypeError:
            data = orjson.dumps(_in_native_byte_order(message), _to_json_type, _OPTIONS)
    except TypeError as error:  # of orjson; the error of the default function is its cause
        raise EncodeError(f"the message cannot be written as JSON: {error.__cause__ or error}") from None
    except RecursionError:
        raise EncodeError(f"the message is nested deeper than {max_depth} levels") from None
    if len(data) > max_size:
        raise MessageTooLargeError(f"the message has {len(data)} bytes as JSON, expected at most {max_size}")
    # The first condition is the first one of `_has_null`, and the other is that of `is_deeper`, without their calls.
    if _N in data and _has_null(data):
        place = find_nonfinite(message)
        if place is not None:
            raise EncodeError(
                f"{place} is NaN or infinite, which JSON cannot represent and rosbridge servers silently drop: "
                "omit it, or send None if the receiver accepts null"
            )
    if len(data) > 2 * max_depth and is_deeper(data, max_depth):
        raise EncodeError(f"the message is nested deeper than {max_depth} levels")
    return data


def _has_null(data: bytes) -> bool:
    """Return whether `null` occurs in JSON, even inside a string."""
    at = data.find(b"n")  # searching for one byte is several times faster than for four
    if at < 0:
        return False
    if len(data) > _COUNTED:
        # Long arrays of numbers do not contain an n, so searching for n skips them.
        for _ in range(_HOPS):
            at = data.find(b"n", at)
            if at < 0 or data.startswith(b"null", at):
                return at >= 0
            at += 1
    return data.find(b"null", at) >= 0


def _to_json_type(value: object) -> Any:
    """Convert types that orjson does not support: non-contiguous arrays, bytes (`uint8[]`), other mappings."""
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, bytes | bytearray):
        return base64.b64encode(value).decode()
    dtype = getattr(value, "dtype", None)
    if dtype is not None:
        numbers: Any = value
        return numbers.copy() if numbers.ndim and dtype.kind in "buif" else numbers.tolist()
    raise EncodeError(f"{type(value).__name__} is not a JSON type")


def _in_native_byte_order(value: Any) -> Any:
    """Return the message with arrays in native byte order, because orjson refuses others."""
    if isinstance(value, Mapping):
        return {key: _in_native_byte_order(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_in_native_byte_order(part) for part in value]
    dtype = getattr(value, "dtype", None)
    return value if dtype is None or dtype.isnative else value.astype(dtype.newbyteorder("="))


def find_nonfinite(message: Any) -> str | None:
    """Return the path of the first NaN or infinity in a message, such as `scan.ranges[3]`, or None."""
    inner: list[tuple[str, Any]] = [("", message)]
    while inner:
        place, value = inner.pop()
        if isinstance(value, float):
            if not math.isfinite(value):
                return place or "the value"
        elif isinstance(value, Mapping):
            inner.extend(
                (f"{place}.{key}" if place else str(key), value[key]) for key in reversed(list(value))
            )
        elif isinstance(value, list | tuple):
            inner.extend((f"{place}[{index}]", value[index]) for index in reversed(range(len(value))))
        elif getattr(value, "dtype", None) is not None and not _all_finite(value):
            inner.append((place, value.tolist()))
    return None


def _all_finite(value: Any) -> bool:
    """Return whether a NumPy array or scalar certainly contains neither NaN nor infinity."""
    if value.dtype.kind in "bui":
        return True
    if value.dtype.kind != "f":
        return False  # its elements are checked one by one
    import numpy as np  # already imported, because the value is from NumPy

    return bool(np.isfinite(value).all())


# The envelope of a publish operation: the bytes before its message, which a publisher repeats for each message of a
# topic: `{"op":"publish","topic":"/t","msg":`. Once an envelope is proven, any data that starts with it, continues with
# one JSON object and ends with a brace is a publish operation on that topic, and only the message itself is parsed.


def envelope_of(data: bytes) -> bytes:
    """Return the bytes of an operation up to and including the first key `msg`.

    In a publish operation, these bytes are usually the envelope, the part before the ROS message. `topic_of` checks
    this. If the first `LONGEST` bytes do not contain the key, the result is empty.
    """
    key = _KEY if data[:1] < b"\x80" else _CBOR_KEY
    at = data.find(key, 0, LONGEST)
    return data[: at + len(key)] if at > 0 else b""


def topic_of(envelope: bytes) -> str | None:
    """Return the topic of an envelope, or None if the bytes are not an envelope.

    An envelope is the JSON before the message in a publish operation: `{"op":"publish","topic":"/t","msg":`. Bytes
    with a further key, or without `op` or `topic`, are not an envelope.
    """
    try:
        operation: Any = orjson.loads(envelope + b"{}}")
    except orjson.JSONDecodeError:
        return None
    if type(operation) is not dict or len(operation) != 3 or operation.get("op") != "publish":
        return None
    topic = operation.get("topic")
    return topic if type(topic) is str and operation.get("msg") == {} else None


def topic_in(beginning: bytes) -> str | None:
    """Return the topic of a publish operation from the operation's first bytes, which are JSON or CBOR.

    Return None if the first bytes do not contain the topic.
    """
    match = _JSON_TOPIC.search(beginning.split(b'"msg"', 1)[0])
    if match is not None:
        return match[1].replace(b"\\/", b"/").decode(errors="replace")
    match = _CBOR_TOPIC.search(beginning.split(b"cmsg", 1)[0])
    if match is None:
        return None
    length = match[1][0] if match[1] else match[0][-1] & _CBOR_LENGTH
    return beginning[match.end() : match.end() + length].decode(errors="replace")
