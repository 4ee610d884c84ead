"""Arrays in messages as a reader wants them: lists become NumPy arrays, NumPy arrays lists.

For topics whose server or whose neighbour wants it otherwise: one that was asked for CBOR and sends JSON, or two
topics of one client of which one wants arrays and the other lists.
"""

from typing import Any, Final

_REALS: Final = frozenset({int, float, type(None)})


def with_arrays(value: Any) -> Any:
    """Replace every list of numbers in a message that came as JSON.

    Floats become float64, with NaN for a null among them; integers become int64 (uint64 where that is too small), and
    bytes uint8. What is a list of something else, or mixed with booleans, stays a list.

    Args:
        value: a message; it is changed where it stands.

    Returns:
        The message.
    """
    import numpy as np

    def replaced(part: Any) -> Any:
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

    return _walk(value, list, replaced)


def with_lists(value: Any) -> Any:
    """Replace every NumPy array in a message: uint8 becomes bytes, all others lists of numbers.

    Args:
        value: a message; it is changed where it stands.

    Returns:
        The message.
    """
    import numpy as np

    def replaced(part: Any) -> Any:
        return part.tobytes() if part.dtype == np.uint8 else part.tolist()

    return _walk(value, np.ndarray, replaced)


def _walk(message: Any, kind: type, replaced: Any) -> Any:
    inner = [message]
    while inner:
        container = inner.pop()
        for key, part in list(container.items() if type(container) is dict else enumerate(container)):
            if type(part) is kind and (other := replaced(part)) is not None:
                container[key] = other
            elif type(part) is dict or (type(part) is list and part):
                inner.append(part)
    return message
