"""Codes from the numbers in a message: likelihoods (`sensor_mode = threshold`) and written priors."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from machines.encode import encode_probability
from toolchain.deployment.sections import Scale
from toolchain.errors import ReadingError


def written_codes(likelihoods: NDArray[np.float64], *, prob_bits: int, scale: Scale) -> NDArray[np.uint16]:
    """Return the codes of the likelihoods of a frame, one per line (`sensor_mode = threshold`).

    Args:
        likelihoods: float64[..., lines] of one sensor: P(its reading | S = line).
        prob_bits: Bits of a code (W), 1 to 16.
        scale: `column`: each row is divided by its maximum, because only ratios matter; `none`: values up to
            1 are encoded unchanged.

    Returns:
        uint16 codes of the same shape.

    Raises:
        ReadingError: A likelihood is not a probability, or a whole row is 0.
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
    """Return the codes of a written prior, uint16[lines]; only the ratios of its numbers matter.

    Args:
        prior: One number per line of the machine, such as a posterior of an earlier frame. With replicas,
            this prior is for all of them, and `replicas` times as many numbers are one prior for each.
        lines: Lines of the machine, over all boards.
        prob_bits: Bits of a code (W), 1 to 16.
        replicas: Machines on a board. With several, uint16[replicas, lines] is returned.

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
