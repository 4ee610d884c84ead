"""The conversion of a reading to an address of its column, in plain Python.

`address = floor((value - offset) / step + 0.5)`, modulo `period` if the variable has one. The range check comes last.
"""

import math

from toolchain.deployment import Variable
from toolchain.errors import NotANumberError, ReadingMissingError, ValueOutOfRangeError

_SHOWN = 60


def to_address(variable: Variable, value: object) -> int | None:
    """Return the address of a reading in its column, from 0 to `variable.values - 1`, or None for a missing reading.

    `None`, NaN and an empty array are missing readings. JSON null and an absent field are `None`. Booleans are 0 and 1.
    A string is never a number, but may be the name of a state.

    Raises:
        ReadingMissingError: The reading is missing and `on_missing` is `error`.
        NotANumberError: The reading is an object, a non-empty array, or a string that names no state.
        ValueOutOfRangeError: The reading is out of range and `on_range` is `error`. If the variable is periodic and
            `on_range` is `clamp`, an infinite reading also raises this error.
    """
    if value is None:
        return _missing(variable, "is absent or null (NaN is null in JSON)")
    if isinstance(value, str) and value in variable.states:
        return variable.states.index(value)
    if not isinstance(value, int | float):  # bool is an int: False is 0, True is 1
        if isinstance(value, list | tuple) and not value:
            return _missing(variable, "is an empty array")
        names = f", nor one of its states: {_states(variable)}" if variable.states else ""
        raise NotANumberError(
            f"variable {variable.name}: {_shown(value)} is {_kind(value)}, not a number{names}"
        )
    if value != value:  # noqa: PLR0124 - NaN; math.isnan fails on integers beyond a double
        return _missing(variable, "is NaN")

    try:
        position = math.floor((value - variable.offset) / variable.step + 0.5)
    except OverflowError:  # infinite, or an integer that exceeds a double
        upwards = (value > 0) == (variable.step > 0)
        return _unserved(variable, value, None if variable.period else upwards)
    if variable.period is not None:
        position %= variable.period
    if 0 <= position < variable.values:
        return position
    return _unserved(variable, value, position >= variable.values)


def _missing(variable: Variable, what: str) -> int | None:
    if variable.on_missing == "error":
        raise ReadingMissingError(
            f"variable {variable.name} {what}, and this deployment needs it (on_missing = error)"
        )
    return None


def _unserved(variable: Variable, value: float, beyond_top: bool | None) -> int | None:
    """Return the address for a value out of range as `on_range` requires, or None if the reading counts as missing.

    `beyond_top` is True if the value lies beyond the variable's last value, and False if it lies before the first
    value. It is None for an infinite value of a periodic variable, because neither end is nearer.

    Raises:
        ValueOutOfRangeError: The value has no address.
        ReadingMissingError: The reading counts as missing, but `on_missing` is `error`.
    """
    if variable.on_range == "missing":
        return _missing(variable, f"is {_shown(value)}, out of range")
    if variable.on_range == "clamp" and beyond_top is not None:
        return variable.values - 1 if beyond_top else 0
    last = variable.offset + (variable.values - 1) * variable.step
    low, high = sorted((variable.offset, last))
    around = f", around a period of {variable.period} steps" if variable.period else ""
    raise ValueOutOfRangeError(
        f"variable {variable.name}: {_shown(value)} is out of range, expected {low:g} to {high:g} "
        f"in steps of {abs(variable.step):g}{around}{f' ({_states(variable)})' if variable.states else ''}"
    )


def _states(variable: Variable) -> str:
    return _shortened(", ".join(variable.states))


def _shown(value: object) -> str:
    try:
        text = repr(value)
    except ValueError:  # an integer with more digits than Python prints
        return "an integer of thousands of digits"
    return _shortened(text)


def _shortened(text: str) -> str:
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."


def _kind(value: object) -> str:
    match value:
        case str():
            return "a string"
        case list() | tuple():
            return f"an array of {len(value)}"
        case dict():
            return "an object"
        case _:
            return f"of type {type(value).__name__}"
