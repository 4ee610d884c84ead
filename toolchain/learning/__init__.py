"""Learning tables from recordings with ground truth: the methods, and the flags of a fit."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import typer

from toolchain.flags import BagTolerance, ReadingColumns


class FitMethod(StrEnum):
    """A method of learning."""

    NORMALS = "normals"
    """Learn bias, standard deviation and share of outliers. Readings must be normal around the mean in the model."""
    COUNTS = "counts"
    """Learn whole tables: count how often each value was read while each cell was the true cell."""


class FitPrior(StrEnum):
    """The table with which counting starts. If there are few readings, this table has much influence on the result."""

    MODEL = "model"
    """The model's own table."""
    UNIFORM = "uniform"
    """All values equally probable."""


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """The flags of `toolchain fit` that say how recordings are read, and how tables are learned."""

    truth: Annotated[
        list[str],
        typer.Option(
            help="Column of the true value of a searched dimension; one per dimension.",
            metavar="LABEL=COLUMN",
        ),
    ]
    readings: ReadingColumns = None
    method: Annotated[
        FitMethod, typer.Option(help="normals: sigma and the share of outliers; counts: whole tables.")
    ] = FitMethod.NORMALS
    pool: Annotated[
        list[str] | None,
        typer.Option(
            help="normals: variables that share sigma and bias, such as 'range_*'.", metavar="PATTERN"
        ),
    ] = None
    bias: Annotated[bool, typer.Option("--bias", help="normals: also fit a constant error.")] = False
    floor: Annotated[
        float,
        typer.Option(
            help="normals: minimum probability of an outlier, relative to the peak; codes must represent it."
        ),
    ] = 0.005
    pseudo_count: Annotated[
        float, typer.Option(help="counts: weight of the Dirichlet prior of a cell, in readings.")
    ] = 1.0
    prior: Annotated[
        FitPrior, typer.Option(help="counts: shape of the prior: the table of the model, or uniform.")
    ] = FitPrior.MODEL
    learn_prior: Annotated[
        bool, typer.Option("--learn-prior", help="counts: also count how often each cell is the true one.")
    ] = False
    tolerance_s: BagTolerance = 0.1
