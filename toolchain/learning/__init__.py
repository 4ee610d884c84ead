"""Tables learnt from recorded readings with ground truth: the method, and its assumptions."""

from dataclasses import dataclass
from enum import StrEnum


class FitMethod(StrEnum):
    """A method of learning."""

    NORMALS = "normals"
    """Sigma, share of outliers and bias of variables that are normal around a known mean."""
    COUNTS = "counts"
    """Whole tables, by counting."""


class FitPrior(StrEnum):
    """The shape of a counted table before any reading."""

    MODEL = "model"
    """The table of the model."""
    UNIFORM = "uniform"
    """All values equally probable."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """The options of a fit, except the model and the recordings."""

    truth: tuple[str, ...]
    """`LABEL=COLUMN` of each searched dimension."""
    readings: tuple[str, ...] = ()
    """`NAME=COLUMN` of known variables; one `*` in both matches the same text."""
    method: FitMethod = FitMethod.NORMALS
    """The method of learning."""
    pool: tuple[str, ...] = ()
    """Patterns of variables that share sigma and bias; each has its own share of outliers."""
    bias: bool = False
    """True to fit a constant error."""
    floor: float = 0.005
    """The minimum probability of an outlier, relative to the peak."""
    pseudo_count: float = 1.0
    """Weight of the Dirichlet prior of a cell, in readings."""
    prior: FitPrior = FitPrior.MODEL
    """Shape of that prior."""
    learn_prior: bool = False
    """True to count P(S) too."""
    tolerance_s: float = 0.1
    """Maximum time in seconds between a reading in a bag and its truth."""
