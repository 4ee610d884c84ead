"""Quantising: scaling of probabilities, their conversion to codes of W bits, and the loss of the conversion.

A row of a column's table has the likelihoods of one value of the variable. A factor common to all lines does not change
the posterior. By default, each row is therefore divided by its maximum over all lines of all boards. Without this
division, a machine would rarely count. An outlier floor is a small probability that a model gives to every value. If
the code of the floor is not 0, a single outlier does not exclude the true line.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from machines.encode import decode_code, encode_probability
from machines.parameters import PROB_BITS_MAX, SensorMode
from toolchain.deployment import Scale
from toolchain.deployment.filter import prediction_codes
from toolchain.models.conditional import middle_bin
from toolchain.models.model import Known, Model

_HALVINGS: Final = 12
"""Number of bisection steps in the search for an outlier floor below 1; enough for the two reported digits."""

_ROUNDING: Final = 1e-12
"""Divergences in bits below this are only rounding errors of float64."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnLoss:
    """The quantisation loss of one column."""

    name: str
    """The known variable's name, or `prior`."""
    bits: int
    """Number of address bits."""
    values: int
    """Number of values of the variable.

    For `prior`, number of values of the variable that selects the prior, or 1 if no variable selects the prior.
    """
    mass: float
    """Sum of P(S, K) over the cells with code 0: the probability that a reading selects code 0 on the true line."""
    kl_bits: float
    """KL(Q(S | k) || P(S | k)) in bits, averaged over the readings k of this column.

    P is the exact posterior for the reading k of this column alone. Q is the posterior for the same reading, from the
    column's codes. A reading with code 0 on every line has no Q, and is left out. With `sensor_mode = cell`, all lines
    are assumed to have the same reading k. KL(P || Q) would be infinite if a line with a small probability gets the
    code 0.
    """
    dead_values: int
    """Number of values that have a probability above 0, but code 0 on every line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VanishedFloor:
    """An outlier floor so low that its code is 0. `what` and `advice` are clauses of a message to the user."""

    name: str
    what: str
    advice: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Quantised:
    """The codes of a model for all lines, before the lines are divided among boards."""

    prior: NDArray[np.uint16]
    """uint16[rows, lines]: one row or, if a variable selects the prior, one row for each address of the variable.

    In the second case, the last address stands for a missing reading. Its row is the prior of the model. Rows of
    addresses that stand for no value contain 0.
    """
    tables: tuple[NDArray[np.uint16], ...]
    """uint16[2**bits, lines] per known variable. Rows of addresses that stand for no value contain 0. The last row is
    for missing readings, and contains all-ones codes. With `SensorMode.THRESHOLD`, there are no tables.
    """
    losses: tuple[ColumnLoss, ...]
    """The loss of the prior, and then the loss of each table in `tables`."""
    floors: tuple[VanishedFloor, ...]
    """The outlier floors (`floor` of a distribution) that are so low that they become code 0."""
    warnings: tuple[str, ...]
    """Warnings for the user, one sentence each."""


def quantise(
    model: Model,
    *,
    prob_bits: int = 8,
    scale: Scale = Scale.ADDRESS,
    sensor_mode: SensorMode = SensorMode.COLUMN,
) -> Quantised:
    """Convert the probabilities of a model to codes of `prob_bits` bits (1 to 16), and compute the quantisation loss.

    Before the conversion, each row of a table (`Scale.ADDRESS`), the whole table (`COLUMN`) or nothing (`NONE`) is
    divided by its maximum. If each cell has its own reading, `scale` must not be `ADDRESS`.
    """
    prior = model.prior_distribution
    prior_codes, prior_loss = _quantised_prior(model, prob_bits, scale)
    losses = [prior_loss]
    warnings: list[str] = []
    floors: list[VanishedFloor] = []
    tables = []
    for known in model.known if sensor_mode is not SensorMode.THRESHOLD else ():
        ratios = scaled(known.table, scale)
        served = encode_probability(ratios, prob_bits)
        table = np.zeros((1 << known.bits, model.lines), dtype=np.uint16)
        table[: known.values] = served
        table[-1] = (1 << prob_bits) - 1
        tables.append(table)
        loss = _loss(known.name, known.bits, prior * known.table, prior * decode_code(served, prob_bits))
        losses.append(loss)
        vanished = (served == 0) & (ratios > 0)
        if known.floor and vanished.any():
            floors.append(floor := _vanished_floor(known, ratios, vanished, prob_bits, scale))
            warnings.append(f"Variable {known.name}: {floor.what}; {floor.advice}.")
        if loss.dead_values:
            warnings.append(
                f"Variable {known.name}: {loss.dead_values} of its {known.values} values are possible but have "
                "code 0 on every line, so such a reading "
                + (
                    "gives no posterior; use --scale address or more --prob-bits."
                    if sensor_mode is SensorMode.COLUMN
                    else "makes its line impossible; use more --prob-bits."
                )
            )
    return Quantised(
        prior=prior_codes,
        tables=tuple(tables),
        losses=tuple(losses),
        floors=tuple(floors),
        warnings=tuple(warnings),
    )


def _quantised_prior(model: Model, prob_bits: int, scale: Scale) -> tuple[NDArray[np.uint16], ColumnLoss]:
    plain = model.prior_distribution[np.newaxis]
    select = model.prior_select
    if select is None:
        is_filter = model.transition is not None
        codes = (
            prediction_codes(plain, prob_bits)
            if is_filter
            else encode_probability(scaled(plain, scale), prob_bits)
        )
        return codes, _loss("prior", 0, plain, decode_code(codes, prob_bits))
    served = encode_probability(scaled(np.vstack([select.table, plain]), scale), prob_bits)
    codes = np.zeros((1 << select.bits, model.lines), dtype=np.uint16)
    codes[: select.values] = served[:-1]
    codes[-1] = served[-1]
    # the frequency of each row is unknown here, so all have the same weight
    loss = _loss("prior", select.bits, select.table / select.values, decode_code(served[:-1], prob_bits))
    return codes, loss


def scaled(table: NDArray[np.float64], scale: Scale) -> NDArray[np.float64]:
    """Return a table, float64[values, lines], divided by maxima according to `scale`.

    `ADDRESS` divides each row by the maximum of the row. `COLUMN` divides the whole table by the table's maximum.
    `NONE` divides nothing. A row of zeros remains zero.
    """
    if scale is Scale.NONE:
        return table
    largest = table.max(axis=1, keepdims=True) if scale is Scale.ADDRESS else np.asarray(table.max())
    ratios: NDArray[np.float64] = table / np.where(largest > 0, largest, 1.0)
    return ratios


def _loss(name: str, bits: int, exact: NDArray[np.float64], quantised: NDArray[np.float64]) -> ColumnLoss:
    """Compare `exact`, P(S, K), with `quantised`, the table of the codes. Both are float64[values, lines].

    Rows of `quantised` may have any scale.
    """
    weight = exact.sum(axis=1)
    remaining = quantised.sum(axis=1)
    alive = (remaining > 0) & (weight > 0)
    p = exact[alive] / weight[alive, np.newaxis]
    q = quantised[alive] / remaining[alive, np.newaxis]
    # q is 0 wherever p is; there, and where a code became 0, q log q/p is 0.
    ratio = np.divide(q, p, out=np.ones_like(q), where=q > 0)
    divergence = (q * np.log2(ratio)).sum(axis=1)
    return ColumnLoss(
        name=name,
        bits=bits,
        values=len(exact),
        mass=float(exact[quantised == 0].sum()),
        kl_bits=kl_bits if (kl_bits := float(weight[alive] @ divergence)) > _ROUNDING else 0.0,
        dead_values=int(np.count_nonzero((weight > 0) & (remaining == 0))),
    )


def _vanished_floor(
    known: Known, ratios: NDArray[np.float64], vanished: NDArray[np.bool_], prob_bits: int, scale: Scale
) -> VanishedFloor:
    """Describe an outlier floor that becomes code 0, and advise a higher floor or wider codes."""
    least = float(ratios[vanished].min())
    needed = math.ceil(-math.log2(least) - 1)
    ways = [f"a floor of about {enough:.2g}"] if (enough := _enough_floor(known, prob_bits, scale)) else []
    ways += [f"--prob-bits {needed}"] if needed <= PROB_BITS_MAX else []
    return VanishedFloor(
        name=known.name,
        what=(
            f"its outlier floor of {known.floor:g} vanishes at {np.count_nonzero(vanished.any(axis=1))} of its "
            f"{known.values} values (below 2^-{prob_bits + 1 if prob_bits > 1 else 1} of the largest probability there), so that one outlier "
            "makes the true line impossible"
        ),
        advice=f"use {' or '.join(ways) or 'no narrower distribution than the codes hold'}",
    )


def _enough_floor(known: Known, prob_bits: int, scale: Scale) -> float:
    """Return the lowest floor with which no code is 0, rounded up to two digits; 0 if even a floor of 1 is too low.

    The floor is found by bisection, because a higher one also raises the maxima by which probabilities are divided.
    """
    peak = known.table.max(axis=0)
    if known.normal is not None:
        peak = middle_bin(np.broadcast_to(abs(known.step) / np.asarray(known.normal.sigma), peak.shape))
    # the table without a floor, up to a factor per line
    bare = np.maximum(known.table * (1 + known.values * known.floor * peak) - known.floor * peak, 0)

    def holds(floor: float) -> bool:
        table = bare + floor * peak
        return bool(encode_probability(scaled(table / table.sum(axis=0), scale), prob_bits).all())

    low, high = math.log(known.floor), math.log(1.0)
    if not holds(1.0):
        return 0.0
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if holds(math.exp(middle)) else (middle, high)
    digit = 10.0 ** (math.floor(high / math.log(10)) - 1)
    return math.ceil(math.exp(high) / digit) * digit
