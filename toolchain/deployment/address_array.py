"""Conversion of arrays of readings to addresses or codes (thesis 4.4).

An array has a reading for each line, for each replica, or for each line of each replica. All lines of the first
replica come first. Each number is converted as in `toolchain.deployment.address`. A reading of a sensor is missing
either on all lines of a machine or on none. Likelihoods (`sensor_mode = threshold`) and written priors become codes.
"""

import base64
import binascii
import math
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from machines.encode import encode_probability
from machines.parameters import SensorMode
from toolchain.deployment import Deployment, Scale, Variable
from toolchain.deployment.address import to_address
from toolchain.errors import NotANumberError, ReadingError, ReadingMissingError


def written_codes(likelihoods: NDArray[np.float64], *, prob_bits: int, scale: Scale) -> NDArray[np.uint16]:
    """Return the codes of one sensor's likelihoods in a frame, one per line (`sensor_mode = threshold`).

    The likelihoods are float64[..., lines]: P(the sensor's reading | S = line). The codes have the shape of the
    likelihoods. With the scale `none`, likelihoods are encoded unchanged. With any other scale, each row is divided by
    its maximum, because only ratios matter.

    Raises:
        ReadingError: A likelihood is negative or not finite. With the scale `none`, a likelihood is above 1. With any
            other scale, a whole row is 0.
    """
    if not np.isfinite(likelihoods).all():
        raise ReadingError("a likelihood is not finite")
    if (least := float(likelihoods.min())) < 0:
        raise ReadingError(f"{least:g} is not a probability")
    largest = likelihoods.max(axis=-1, keepdims=True)
    if scale is Scale.NONE:
        if float(largest.max()) > 1:
            raise ReadingError(
                f"{float(largest.max()):g} is not a probability, expected 0 to 1 (scale = none)"
            )
        return encode_probability(likelihoods, prob_bits)
    if not (largest > 0).all():
        raise ReadingError("it is 0 on all lines, so none is possible")
    return encode_probability(likelihoods / largest, prob_bits)


def written_prior(prior: ArrayLike, *, lines: int, prob_bits: int, replicas: int = 1) -> NDArray[np.uint16]:
    """Return the codes of a written prior: uint16[lines], or uint16[replicas, lines] for several replicas.

    The prior may be the posterior of an earlier frame. Only the ratios of its numbers matter. `lines` is the number of
    lines of all boards together. If `prior` has `lines` numbers, all replicas share the prior. If `prior` has
    `replicas` * `lines` numbers, each replica has its own prior.

    Raises:
        ReadingError: The number of values is wrong, a value is not a probability, or all values are 0.
    """
    try:
        numbers = np.asarray(prior, dtype=np.float64)
    except (TypeError, ValueError):
        raise ReadingError("the written prior is not an array of numbers") from None
    if replicas > 1 and numbers.size == replicas * lines:
        numbers = numbers.reshape(replicas, lines)
    elif numbers.shape != (lines,):
        message = (
            f"the written prior has shape {numbers.shape}, expected one number for each of {lines} lines"
        )
        raise ReadingError(message + (f", or for each of {replicas} replicas" if replicas > 1 else ""))
    largest = numbers.max(axis=-1, keepdims=True)
    if not np.all(np.isfinite(numbers)) or np.any(numbers < 0) or not np.all(largest > 0):
        raise ReadingError(
            "the written prior is not a distribution: it contains a negative, infinite or NaN number, or only zeros"
        )
    codes = encode_probability(numbers / largest, prob_bits)
    return codes if replicas == 1 else np.broadcast_to(codes, (replicas, lines)).copy()


MISSING: Final = -1
"""The value that stands for the address of a missing reading."""


def to_addresses(deployment: Deployment, variable: Variable, value: object) -> list[int] | None:
    """Return the addresses of one variable's readings in a frame, or None if all readings are missing.

    There is one address per element of the array, row by row. The address of a missing reading is `MISSING`. If each
    line has its own reading, a sensor's readings must be missing on all lines of a machine, or on none. If the
    machine's `sensor_mode` is `threshold`, a sensor has codes instead of addresses.

    `value` is the value of the field: a flat array, or an array of the shape `deployment.reading_shape(variable)`. An
    array `uint8[]` may be bytes or base64 text. A null or NaN in the array is one missing reading. If `value` is `None`
    or an empty array, all readings are missing.

    Raises:
        ReadingError: The array has a wrong length or contains an unusable reading. The error names the reading.
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
    if variable.kind == "sensor" and machine.reads_lines:
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
    """Return whether nested arrays have strings in them, which NumPy would read as numbers."""
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
    """Raise an error for a reading that is missing on some lines only, because those lines would be favoured."""
    missing = addresses == MISSING
    partly = missing.any(axis=-1) & ~missing.all(axis=-1)
    if partly.any():
        where = f" of replica {int(np.flatnonzero(partly)[0])}" if addresses.ndim == 2 else ""
        raise ReadingMissingError(
            f"variable {variable.name} is missing on some lines{where} and not on others; a reading is missing on all "
            "lines or on none"
        )
