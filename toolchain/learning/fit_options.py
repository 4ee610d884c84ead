"""The options of `toolchain fit`: the method and its assumptions."""

from dataclasses import dataclass
from enum import StrEnum


class FitMethod(StrEnum):
    """A method of learning."""

    NORMALS = "normals"
    """Sigma, outliers' share and bias of variables that are normal around a known mean."""
    COUNTS = "counts"
    """Whole tables, by counting."""


class FitPrior(StrEnum):
    """The form of a counted table before any reading."""

    MODEL = "model"
    """The model's own table."""
    UNIFORM = "uniform"
    """Every value as probable as any other."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """The options of a fit, beside the model and the recordings."""

    truth: tuple[str, ...]
    """`LABEL=COLUMN` of each searched dimension."""
    readings: tuple[str, ...] = ()
    """`NAME=COLUMN` of known variables; one `*` in both matches the same text."""
    method: FitMethod = FitMethod.NORMALS
    """The method of learning."""
    pool: tuple[str, ...] = ()
    """Patterns of variables that share sigma and bias; each keeps its own outliers' share."""
    bias: bool = False
    """True to fit a constant error."""
    floor: float = 0.005
    """The least probability of an outlier, relative to the peak."""
    pseudo_count: float = 1.0
    """Readings that the Dirichlet prior of a cell is worth."""
    prior: FitPrior = FitPrior.MODEL
    """The form of that prior."""
    tolerance_s: float = 0.1
    """Seconds between a reading in a bag and the truth that belongs to it."""
