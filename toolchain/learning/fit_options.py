"""How `toolchain fit` learns: the method and what it assumes beside the recordings."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class FitMethod(StrEnum):
    """What is learnt."""

    NORMALS = "normals"
    """Sigma, outliers' share and bias of variables that are normal around a known mean."""
    COUNTS = "counts"
    """Whole tables, by counting."""


class FitPrior(StrEnum):
    """What a counted table looks like before any reading."""

    MODEL = "model"
    """The model's own table."""
    UNIFORM = "uniform"
    """Every value as probable as any other."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """What a fit is told beside the model and the recordings."""

    truth: tuple[str, ...]
    """`LABEL=COLUMN` of each searched dimension."""
    readings: tuple[str, ...] = ()
    """`NAME=COLUMN` of known variables; one `*` in both stands for the same text."""
    method: FitMethod = FitMethod.NORMALS
    """What is learnt."""
    pool: tuple[str, ...] = ()
    """Patterns of variables that share sigma and bias; each keeps its own outliers' share."""
    bias: bool = False
    """Whether a constant error is fitted."""
    floor: float = 0.005
    """What an outlier gets at least, relative to the peak."""
    pseudo_count: float = 1.0
    """Readings that the Dirichlet prior of a cell is worth."""
    prior: FitPrior = FitPrior.MODEL
    """What that prior looks like."""
    tolerance_s: float = 0.1
    """Seconds between a reading in a bag and the truth that belongs to it."""
