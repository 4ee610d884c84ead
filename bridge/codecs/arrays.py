"""Conversion of whole messages between lists of numbers and NumPy arrays.

It is used when the encoding differs from the requested form: CBOR was requested but JSON arrives, or one of
two subscriptions of a client requests arrays and the other one lists.
"""

from typing import Any, Final

_REALS: Final = frozenset({int, float, type(None)})


def with_arrays(value: Any) -> Any:
    """Replace every list of numbers in a message that arrived as JSON, in place.

    Floats become float64, with NaN for null; integers become int64, or uint64 if int64 is too small; bytes
    become uint8. All other lists, including numbers mixed with booleans, remain lists.
    """
    import numpy as np

    def array_of(part: Any) -> Any:
        kinds = set(map(type, part))
        if not kinds or not kinds <= _REALS:
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
