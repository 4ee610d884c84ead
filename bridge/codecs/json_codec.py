"""JSON on the wire: one object in, one out, within limits of size and depth; nothing non-finite leaves.

Inbound:

* One object per WebSocket message. A key that comes twice has its last value, as with the servers' parsers.
* Bare ``NaN``, ``Infinity`` and ``-Infinity``, which some servers leak although JSON has none, and numbers
  beyond float64 (``1e999``) are read as None: to a reader they are what the reference server's ``null`` is.
  Only a message that strict JSON refuses pays for this second look.
* Integers beyond 64 bits become floats.

Outbound: floats that are NaN or infinite either leave as ``null`` (what the reference server does), or are
refused with their place named (what a publisher wants: servers drop ``null`` in a float field silently).
NumPy arrays and scalars are written without lists in between when NumPy is loaded; it is never imported here.
Bytes are written as base64, as servers have ``uint8[]``.
"""

import base64
import json
import math
from collections.abc import Mapping
from typing import Any, Final, Literal

import orjson

from bridge.errors import DecodeError, EncodeError

#: Bytes of one message at most, both ways, unless a caller says otherwise.
MAX_SIZE: Final = 1 << 20
#: Objects and arrays within each other at most, both ways. The deepest standard ROS message has about ten.
MAX_DEPTH: Final = 64

_OPTIONS: Final = orjson.OPT_SERIALIZE_NUMPY
_SHOWN: Final = 60
# Bytes up to which counting brackets is faster than looking for each.
_COUNTED: Final = 4096
# Characters that are looked for one by one before a whole word is searched.
_HOPS: Final = 64


def excerpt(data: bytes | str) -> str:
    """The beginning of what arrived, fit for a line of a log."""
    shown = repr(data[:_SHOWN])
    return shown[: 2 * _SHOWN] + "..." if len(data) > _SHOWN or len(shown) > 2 * _SHOWN else shown


def text_of(value: Any) -> str:
    """What a server says, as text: it is meant to be a string, and some send an object."""
    if isinstance(value, str):
        return value
    if value is None:
        return ""
    try:
        return encode({"": value})[4:-1].decode()
    except EncodeError:
        return repr(value)


def decode(data: bytes | str, *, max_size: int = MAX_SIZE, max_depth: int = MAX_DEPTH) -> dict[str, Any]:
    """Read one message.

    Args:
        data: a whole WebSocket message, text as UTF-8 or already decoded.
        max_size: bytes (characters of a str) at most.
        max_depth: objects and arrays within each other at most, the outermost included.

    Returns:
        The object. Its numbers are finite.

    Raises:
        DecodeError: too large, too deep, no JSON, or JSON but no object.
    """
    if len(data) > max_size:
        raise DecodeError(f"a message of {len(data)} bytes arrived, at most {max_size} are taken")
    try:
        message = orjson.loads(data)
    except orjson.JSONDecodeError as error:
        message = _decode_leniently(data, error)
    if type(message) is not dict:
        raise DecodeError(f"a message that is no JSON object arrived: {excerpt(data)}")
    if could_be_deeper(data, max_depth) and depth(message, max_depth) > max_depth:
        raise DecodeError(f"a message nested deeper than {max_depth} levels arrived: {excerpt(data)}")
    return message


def could_be_deeper(data: bytes | str, limit: int) -> bool:
    """Whether JSON may have more than ``limit`` objects and arrays within each other: only then it needs a walk.

    Each of them opens and closes: what has not so many bytes, or not so many opening brackets, is not so deep.
    """
    if len(data) <= 2 * limit:
        return False
    if isinstance(data, str):
        return data.count("{") + data.count("[") > limit
    if len(data) <= _COUNTED:
        return data.count(b"{") + data.count(b"[") > limit
    # Looking for the next one skips what is between, long arrays of numbers, forty times faster than counting does.
    for bracket in b"{", b"[":
        at = data.find(bracket)
        while at >= 0:
            limit -= 1
            if limit < 0:
                return True
            at = data.find(bracket, at + 1)
    return False


def _decode_leniently(data: bytes | str, error: orjson.JSONDecodeError) -> Any:
    """Read what only breaks JSON by non-finite numbers, as None; refuse everything else."""
    if "infinity when parsed" not in error.msg:
        text = data if isinstance(data, str) else data.decode("utf-8", "replace")
        if "NaN" not in text and "Infinity" not in text:
            raise DecodeError(f"a message that is no JSON arrived ({error.msg}): {excerpt(data)}") from None
    try:
        message = json.loads(
            data,
            parse_constant=lambda _constant: None,
            parse_float=_finite_or_none,
            parse_int=_int_of_64_bits,
        )
        orjson.dumps(
            message
        )  # refuses what strict reading would not have given: half characters, great depth
    except (ValueError, TypeError, RecursionError):  # ValueError: also bad UTF-8, an integer of 5000 digits
        raise DecodeError(f"a message that is no JSON arrived ({error.msg}): {excerpt(data)}") from None
    return message


def _int_of_64_bits(text: str) -> int | float | None:
    value = int(text)
    return value if -(1 << 63) <= value < 1 << 64 else _finite_or_none(text)


def _finite_or_none(text: str) -> float | None:
    value = float(text)
    return value if math.isfinite(value) else None


def depth(value: Any, limit: int) -> int:
    """How many objects and arrays are within each other in ``value``; counting ends at ``limit`` + 1."""
    level, inner = 0, [value]
    while inner := [item for item in inner if isinstance(item, dict | list | tuple)]:
        level += 1
        if level > limit:
            break
        inner = [
            item
            for container in inner
            for item in (container.values() if isinstance(container, dict) else container)
        ]
    return level


def encode(
    message: Mapping[str, Any],
    *,
    nonfinite: Literal["null", "refuse"] = "null",
    max_size: int = MAX_SIZE,
    max_depth: int = MAX_DEPTH,
) -> bytes:
    """Write one message.

    Args:
        message: what to send; values may be NumPy arrays (C-contiguous or not) and NumPy scalars.
        nonfinite: what happens to NaN and infinities.
        max_size: bytes at most.
        max_depth: objects and arrays within each other at most.

    Returns:
        UTF-8 JSON without whitespace.

    Raises:
        EncodeError: a type that JSON has not got, an integer beyond 64 bits, a key that is no string, a NaN
            or infinity with ``nonfinite="refuse"`` (its place is named), too deep or too large.
    """
    try:
        try:
            data = orjson.dumps(message, _not_json, _OPTIONS)
        except TypeError as error:
            if "native-endianness" not in str(error):
                raise
            data = orjson.dumps(_in_own_byte_order(message), _not_json, _OPTIONS)
    except TypeError as error:  # orjson.JSONEncodeError is a TypeError; default's own errors are its cause
        raise EncodeError(f"the message cannot be written as JSON: {error.__cause__ or error}") from None
    except RecursionError:
        raise EncodeError(f"the message is nested deeper than {max_depth} levels") from None
    if len(data) > max_size:
        raise EncodeError(f"the message has {len(data)} bytes as JSON, at most {max_size} are sent")
    if nonfinite == "refuse" and _has_null(data):
        place = find_nonfinite(message)
        if place is not None:
            raise EncodeError(
                f"{place} is NaN or infinite, which JSON has not got and rosbridge servers drop without a "
                "word: leave it out, or send None where the receiver takes null"
            )
    if could_be_deeper(data, max_depth) and depth(orjson.loads(data), max_depth) > max_depth:
        raise EncodeError(f"the message is nested deeper than {max_depth} levels")
    return data


def _has_null(data: bytes) -> bool:
    """Whether ``null`` is in the JSON, be it in a text."""
    at = data.find(b"n")  # one byte is looked for several times as fast as four are
    if at < 0:
        return False
    if len(data) > _COUNTED:
        # Long arrays of numbers have no n: what is between two of them is skipped, not searched.
        for _ in range(_HOPS):
            at = data.find(b"n", at)
            if at < 0 or data.startswith(b"null", at):
                return at >= 0
            at += 1
    return data.find(b"null", at) >= 0


def _not_json(value: object) -> Any:
    """What orjson does not know: arrays that are not contiguous, bytes (``uint8[]``), mappings that are no dicts."""
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, bytes | bytearray):
        return base64.b64encode(value).decode()
    dtype = getattr(value, "dtype", None)
    if dtype is not None:
        array: Any = value
        return array.copy() if array.ndim and dtype.kind in "buif" else array.tolist()
    raise EncodeError(f"{type(value).__name__} is no type of JSON")


def _in_own_byte_order(value: Any) -> Any:
    """The message with arrays of the other byte order, which orjson refuses, in this machine's."""
    if isinstance(value, Mapping):
        return {key: _in_own_byte_order(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_in_own_byte_order(part) for part in value]
    dtype = getattr(value, "dtype", None)
    return value if dtype is None or dtype.isnative else value.astype(dtype.newbyteorder("="))


def find_nonfinite(message: Any) -> str | None:
    """The place of the first NaN or infinity (``scan.ranges[3]``), None if there is none."""
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
    """Whether a NumPy array or scalar has neither NaN nor infinity."""
    if value.dtype.kind in "bui":
        return True
    if value.dtype.kind != "f":
        return False  # looked at one by one
    import numpy as np  # it is loaded: the value is its

    return bool(np.isfinite(value).all())
