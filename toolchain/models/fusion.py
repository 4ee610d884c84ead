"""Exact naive Bayesian fusion in float64 (equation 2.2), the reference for the posterior of a machine."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from toolchain.errors import ModelError
from toolchain.models.model import Model


def exact_posterior(
    model: Model, addresses: Sequence[int | NDArray[np.int64] | None], *, prior_address: int | None = None
) -> NDArray[np.float64]:
    """Return P(S | readings) of the unquantised model.

    Args:
        model: The model.
        addresses: One per known variable, in the order of the columns; None for a missing reading. If lines
            have their own readings (`sensor_mode = cell`), int64[lines] per variable.
        prior_address: The row of the selected prior; None for the prior without a selection.

    Returns:
        float64[lines], summing to 1.

    Raises:
        ModelError: The number of addresses is wrong, an address is not supported, or the readings are
            impossible on every line.
    """
    if len(addresses) != len(model.known):
        raise ModelError(
            f"{len(addresses)} readings for the {len(model.known)} known variables of {model.name!r}"
        )
    factors = []
    for known, address in zip(model.known, addresses, strict=True):
        if address is None:
            continue
        if isinstance(address, np.ndarray):
            factors.append(known.table[address, np.arange(model.lines)])
            continue
        if not 0 <= address < known.values:
            raise ModelError(f"variable {known.name}: address {address} is not one of its {known.values}")
        factors.append(known.table[address])
    if prior_address is None:
        return fuse(model.prior_distribution, factors)
    rows = None if model.prior_select is None else model.prior_select.table
    if rows is None or not 0 <= prior_address < len(rows):
        raise ModelError(f"model {model.name!r} has no prior of address {prior_address}")
    return fuse(rows[prior_address], factors)


def fuse(prior: NDArray[np.float64], likelihoods: Iterable[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the normalised product of a prior and likelihoods, float64[lines] each, up to factors.

    The product is a sum of logarithms, so that many small likelihoods don't underflow; a ModelError if it is
    0.
    """
    with np.errstate(divide="ignore"):  # log 0 = -inf is an impossible line
        logarithm = np.log(prior)
        for likelihood in likelihoods:
            logarithm = logarithm + np.log(likelihood)
    largest = logarithm.max()
    if largest == -np.inf:
        raise ModelError("these readings are impossible on every line: there is no posterior")
    weights = np.exp(logarithm - largest)
    posterior: NDArray[np.float64] = weights / weights.sum()
    return posterior
