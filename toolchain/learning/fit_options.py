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
    """What a fit is told beside the model and the recordings.

    Attributes:
        truth: `LABEL=COLUMN` of each searched dimension.
        readings: `NAME=COLUMN` of known variables; one `*` in both stands for the same text.
        method: What is learnt.
        pool: Patterns of variables that share sigma and bias; each keeps its own outliers' share.
        bias: Whether a constant error is fitted.
        floor: What an outlier gets at least, relative to the peak.
        pseudo_count: Readings that the Dirichlet prior of a cell is worth.
        prior: What that prior looks like.
        tolerance_s: Seconds between a reading in a bag and the truth that belongs to it.
    """

    truth: tuple[str, ...]
    readings: tuple[str, ...] = ()
    method: FitMethod = FitMethod.NORMALS
    pool: tuple[str, ...] = ()
    bias: bool = False
    floor: float = 0.005
    pseudo_count: float = 1.0
    prior: FitPrior = FitPrior.MODEL
    tolerance_s: float = 0.1
