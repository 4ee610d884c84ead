"""Conditional distributions P(K | S) of a reading K: normals or, for bearings, wrapped normals.

The address of a reading is the index of its bin. A bin extends half a step to each side of its centre. A bin's
probability is the integral of the normal over the bin, not the density at the centre. So coarse bins are exact too.
The lines of a table are the values of the searched variables S.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from toolchain.errors import ModelError
from toolchain.models.model import Normal, check_table

# Copies of a wrapped normal that are further away than this many sigma add less than 1e-32.
_FARTHEST_COPY: Final = 12.0
# A wrapped normal whose sigma is two turns is uniform to 1e-34, and so is any wider one.
_UNIFORM: Final = 2.0


def normal_table(name: str, shape: Normal, *, values: int, offset: float, step: float) -> NDArray[np.float64]:
    """Return P(K | S) for normals over `values` bins, float64[values, lines]. The outermost bins include the tails."""
    mean, sigma = _checked(name, shape, values, step)
    inner = offset + (np.arange(1, values) - 0.5) * step
    edges = np.concatenate(([-np.inf], inner, [np.inf]))[:, np.newaxis]
    z = (edges - mean) / sigma
    tails = _upper_tail(np.abs(z))
    table = _mass(z[:-1], z[1:], tails[:-1], tails[1:])
    return _with_outliers(table, shape, step / sigma)


def wrapped_normal_table(
    name: str, shape: Normal, *, values: int, offset: float, step: float
) -> NDArray[np.float64]:
    """Return P(K | S) for wrapped normals, float64[values, lines]. Together, all bins cover one turn."""
    mean, sigma = _checked(name, shape, values, step)
    turn = values * step
    sigma = np.minimum(sigma, _UNIFORM * turn)
    lower = offset + (np.arange(values) - 0.5)[:, np.newaxis] * step - mean
    lower = (lower + turn / 2) % turn - turn / 2
    upper = np.roll(lower, -1, axis=0)
    over = upper <= lower  # the bin opposite the mean, where the circle is cut
    table = np.zeros_like(lower)
    # The cut bin extends a step beyond half a turn.
    copies = math.ceil((_FARTHEST_COPY * float(np.max(sigma)) + step) / turn - 0.5)
    for copy in range(-max(copies, 0), max(copies, 0) + 1):
        z_lower = (lower + copy * turn) / sigma
        z_upper = (np.where(over, upper + turn, upper) + copy * turn) / sigma
        tails_lower = _upper_tail(np.abs(z_lower))
        tails_upper = np.roll(tails_lower, -1, axis=0)
        tails_upper[over] = _upper_tail(np.abs(z_upper[over]))
        table += _mass(z_lower, z_upper, tails_lower, tails_upper)
    return _with_outliers(table, shape, step / sigma)


def _checked(
    name: str, shape: Normal, values: int, step: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    mean = np.asarray(shape.mean, dtype=np.float64)
    if mean.ndim != 1 or not np.all(np.isfinite(mean)):
        raise ModelError(f"variable {name!r}: its mean must be one finite number for every line")
    spread = np.asarray(shape.sigma, dtype=np.float64)
    if spread.shape not in {(), mean.shape}:
        raise ModelError(
            f"variable {name!r}: sigma has shape {spread.shape}, expected one number or {mean.shape}"
        )
    if not (np.all(spread > 0) and np.all(np.isfinite(spread))):
        raise ModelError(f"variable {name!r}: sigma must be positive on every line")
    if values < 1 or not step > 0 or not math.isfinite(step):
        raise ModelError(f"variable {name!r}: {values} bins of width {step:g}; both must be positive")
    if not 0 <= shape.floor < math.inf:
        raise ModelError(
            f"variable {name!r}: a floor of {shape.floor:g}, expected a share of the peak from 0"
        )
    if not 0 <= shape.outliers <= 1:
        raise ModelError(
            f"variable {name!r}: {shape.outliers:g} of its readings are outliers, expected 0 to 1"
        )
    check_table(f"P({name} | S)", values, len(mean))
    return mean, np.broadcast_to(spread, mean.shape)


def _upper_tail(z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return 1 - Phi(z) for z >= 0, accurate far into the tail (NumPy has no erfc)."""
    scaled = (z / math.sqrt(2)).ravel().tolist()
    return np.fromiter(map(math.erfc, scaled), np.float64, len(scaled)).reshape(z.shape) / 2


def _mass(
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    tails_lower: NDArray[np.float64],
    tails_upper: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return Phi(upper) - Phi(lower) without cancellation, from 1 - Phi at |lower| and at |upper|."""
    same_side = np.abs(tails_lower - tails_upper)
    return np.where((lower < 0) & (upper > 0), 1 - tails_lower - tails_upper, same_side)


def middle_bin(bin_in_sigmas: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability of the bin whose centre is the mean of a normal distribution.

    `bin_in_sigmas` is the width of the bin divided by sigma.
    """
    return 1 - 2 * _upper_tail(bin_in_sigmas / 2)


def _with_outliers(
    table: NDArray[np.float64], shape: Normal, bin_in_sigmas: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Spread the share of outliers over all bins, add the floor of `shape` to each bin, and normalise every line.

    The floor is relative to the probability of a bin with the mean at its centre.
    """
    if shape.outliers:
        table = (1 - shape.outliers) * table + shape.outliers / len(table)
    if shape.floor:
        table = table + shape.floor * middle_bin(bin_in_sigmas)
    normalised: NDArray[np.float64] = table / table.sum(axis=0)
    return normalised
