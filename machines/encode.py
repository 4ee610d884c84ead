"""Conversion between probabilities and codes."""

import numpy as np
import numpy.typing as npt

from machines.errors import ParameterError
from machines.parameters import PROB_BITS_MAX


def encode_probability(p: npt.ArrayLike, prob_bits: int) -> npt.NDArray[np.uint16]:
    """Return the code of each probability in `p`, in an array of the shape of `p`.

    A probability is rounded to the nearest probability that a code of W bits represents. Ties are rounded up. For 0 <=
    k <= 2**W - 2, code k represents k / 2**W. The all-ones code represents 1. W is `prob_bits`, from 1 to 16.

    Raises:
        ParameterError: A probability is NaN or not from 0 to 1, or `prob_bits` is out of range.
    """
    _check_bits(prob_bits)
    probabilities = np.asarray(p, dtype=np.float64)
    if not ((probabilities >= 0) & (probabilities <= 1)).all():
        raise ParameterError("A probability to encode is not a number from 0 to 1.")
    ones = (1 << prob_bits) - 1
    scaled = probabilities * (1 << prob_bits)  # exact, because the factor is a power of two
    below = np.floor(scaled)
    # `floor(x + 0.5)` would round the float just below one half up; the remainder is exact.
    nearest = np.minimum(below + (scaled - below >= 0.5), ones - 1)
    # The step from (2**W - 2) / 2**W to 1 is twice as wide: its middle is (2**W - 1) / 2**W.
    return np.where(scaled >= ones, ones, nearest).astype(np.uint16)


def decode_code(codes: npt.ArrayLike, prob_bits: int) -> npt.NDArray[np.float64]:
    """Return the probability of each code: code / 2**prob_bits, or 1 for the code of all ones.

    Raises a ParameterError if a code has more than `prob_bits` bits.
    """
    _check_bits(prob_bits)
    array = np.asarray(codes)
    ones = (1 << prob_bits) - 1
    if array.dtype.kind not in "ui" or not ((array >= 0) & (array <= ones)).all():
        raise ParameterError(f"A code to decode is not an integer from 0 to {ones}.")
    return np.where(array == ones, 1.0, array / (1 << prob_bits))


def _check_bits(prob_bits: int) -> None:
    if not 1 <= prob_bits <= PROB_BITS_MAX:
        raise ParameterError(f"prob_bits is {prob_bits}; it must be from 1 to {PROB_BITS_MAX}.")
