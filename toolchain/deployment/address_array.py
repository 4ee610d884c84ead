"""Conversion of arrays of readings to addresses: one per line, one per replica, or both (thesis 4.4).

Each number is converted as in `toolchain.deployment.address`. Rows are in order (replica after replica, line
after line), and a reading of a sensor is missing on all lines of a machine or on none.
"""

import base64
import binascii
import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from machines.parameters import SensorMode
from toolchain.deployment import Deployment, Scale, Variable
from toolchain.deployment.address import to_address
from toolchain.deployment.written_codes import written_codes
from toolchain.errors import NotANumberError, ReadingError, ReadingMissingError

MISSING: Final = -1
"""The address of a missing reading, in all lines of its machine."""


def to_addresses(deployment: Deployment, variable: Variable, value: object) -> list[int] | None:
    """Return the addresses (`threshold`: codes) of one variable's readings in a frame.

    Args:
        deployment: The source of the shape, `deployment.reading_shape(variable)`.
        variable: As for `toolchain.deployment.address.to_address`.
        value: The value of the field: a flat array, or one with the shape; bytes (`uint8[]`) as bytes or as
            base64. With `None` or an empty array, all readings are missing; null and NaN are single missing
            readings.

    Returns:
        One address per element of the shape, row by row; `MISSING` in all lines of a missing reading. `None`
        if every reading is missing.

    Raises:
        ReadingError: The array has another length, or contains an unusable reading, which the sentence names.
    """
    machine = deployment.machine
    shape = deployment.reading_shape(variable)
    numbers = _numbers(variable, value, shape)
    if numbers is None:
        to_address(
            variable, None if value is None else []
        )  # raises an error if the reading must not be missing
        return None
    if machine.sensor_mode is SensorMode.THRESHOLD and variable.kind == "sensor":
        addresses = _codes(variable, numbers, machine.prob_bits, machine.scale)
    else:
        addresses = _addresses(variable, numbers)
    if variable.kind == "sensor" and machine.sensor_mode is not SensorMode.COLUMN:
        _check_missing(variable, addresses)
    if (addresses == MISSING).all():
        return None
    flat: list[int] = addresses.ravel().tolist()
    return flat


def _numbers(variable: Variable, value: object, shape: tuple[int, ...]) -> NDArray[np.float64] | None:
    """Return the array as float64 with this shape and NaN for null, or None if it is empty or absent."""
    if value is None:
        return None
    given: Any = value
    if isinstance(value, str):
        try:
            given = base64.b64decode(value, validate=True)
        except (ValueError, binascii.Error):
            given = value
    if isinstance(given, bytes | bytearray | memoryview):
        given = np.frombuffer(given, np.uint8)
    if isinstance(given, tuple):
        given = list(given)
    if isinstance(given, list) and variable.states:
        given = [variable.states.index(each) if each in variable.states else each for each in given]
        given = [variable.offset + each * variable.step if type(each) is int else each for each in given]
    if isinstance(given, list) and not given:
        return None
    if not isinstance(given, list | np.ndarray) or (isinstance(given, list) and _holds_text(given)):
        what = "an array with strings" if isinstance(given, list) else f"of type {type(value).__name__}"
        raise NotANumberError(
            f"variable {variable.name} is {what}, expected an array of {_length(shape)} numbers"
        )
    try:
        numbers = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise NotANumberError(
            f"variable {variable.name} is not an array of {_length(shape)} numbers"
        ) from None
    if numbers.size == 0:
        return None
    if numbers.shape != shape and numbers.shape != (math.prod(shape),):
        found = " x ".join(map(str, numbers.shape)) or "one"
        raise ReadingError(f"variable {variable.name} has {found} values, expected {_length(shape)}")
    return numbers.reshape(shape)


def _length(shape: tuple[int, ...]) -> str:
    return f"{math.prod(shape)}" + (f" ({shape[0]} replicas of {shape[1]} lines)" if len(shape) == 2 else "")


def _holds_text(values: list[Any]) -> bool:
    """Return whether there are strings, which NumPy would read as numbers."""
    return any(
        isinstance(each, str) or (isinstance(each, list) and any(isinstance(inner, str) for inner in each))
        for each in values
    )


def _addresses(variable: Variable, numbers: NDArray[np.float64]) -> NDArray[np.int64]:
    with np.errstate(invalid="ignore", over="ignore"):
        places = np.floor((numbers - variable.offset) / variable.step + 0.5)
        if variable.period is not None:
            places = np.mod(places, variable.period)
        served = (places >= 0) & (places < variable.values)
    addresses = np.where(served, places, MISSING).astype(np.int64)
    for at in np.argwhere(~served):
        # the rest are few, and are converted or refused one by one
        place = tuple(at.tolist())
        number = float(numbers[place])
        try:
            address = to_address(variable, None if math.isnan(number) else number)
        except ReadingError as error:
            raise type(error)(f"{error} (value {', '.join(map(str, place))} of the array)") from None
        addresses[place] = MISSING if address is None else address
    return addresses


def _codes(
    variable: Variable, numbers: NDArray[np.float64], prob_bits: int, scale: Scale
) -> NDArray[np.int64]:
    rows = numbers.reshape(-1, numbers.shape[-1])
    absent = np.isnan(rows)
    if absent.any():
        to_address(variable, None)
    codes = np.full(rows.shape, MISSING, dtype=np.int64)
    there = ~absent.all(axis=1)
    try:
        if there.any():
            given = np.where(absent[there], 0.0, rows[there])
            codes[there] = written_codes(given, prob_bits=prob_bits, scale=scale)
    except ReadingError as error:
        raise ReadingError(f"variable {variable.name}: {error}") from None
    codes[absent] = MISSING
    return codes.reshape(numbers.shape)


def _check_missing(variable: Variable, addresses: NDArray[np.int64]) -> None:
    """Raise an error for a reading that is missing only on some lines, which would favour these lines."""
    missing = addresses == MISSING
    partly = missing.any(axis=-1) & ~missing.all(axis=-1)
    if partly.any():
        where = f" of replica {int(np.flatnonzero(partly)[0])}" if addresses.ndim == 2 else ""
        raise ReadingMissingError(
            f"variable {variable.name} is missing on some lines{where} and not on others; a reading is missing on all "
            "lines or on none"
        )
