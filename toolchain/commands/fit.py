"""The `toolchain fit` command, which learns tables from recordings with ground truth."""

from pathlib import Path
from typing import Annotated

import typer

from toolchain.commands.flags import ReadingColumns, Settings
from toolchain.learning import FitMethod, FitOptions, FitPrior


def fit(
    case: Annotated[
        Path, typer.Argument(help="Folder with model.py, whose variables are fitted.", metavar="MODEL")
    ],
    recordings: Annotated[
        list[Path], typer.Argument(help="CSV, MCAP or bag with readings and the truth.", metavar="RECORDING")
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="Output file: .toml for normals, .npz for counts.", metavar="FILE"
        ),
    ],
    truth: Annotated[
        list[str],
        typer.Option(
            help="Column of the true value of a searched dimension; one per dimension.",
            metavar="LABEL=COLUMN",
        ),
    ],
    readings: ReadingColumns = None,
    settings: Settings = None,
    method: Annotated[
        FitMethod, typer.Option(help="normals: sigma and the share of outliers; counts: whole tables.")
    ] = FitMethod.NORMALS,
    pool: Annotated[
        list[str] | None,
        typer.Option(
            help="normals: variables that share sigma and bias, such as 'range_*'.", metavar="PATTERN"
        ),
    ] = None,
    bias: Annotated[bool, typer.Option("--bias", help="normals: also fit a constant error.")] = False,
    floor: Annotated[
        float,
        typer.Option(
            help="normals: minimum probability of an outlier, relative to the peak; codes must represent it."
        ),
    ] = 0.005,
    pseudo_count: Annotated[
        float, typer.Option(help="counts: weight of the Dirichlet prior of a cell, in readings.")
    ] = 1.0,
    prior: Annotated[
        FitPrior, typer.Option(help="counts: shape of the prior: the table of the model, or uniform.")
    ] = FitPrior.MODEL,
    learn_prior: Annotated[
        bool, typer.Option("--learn-prior", help="counts: also count how often each cell is the true one.")
    ] = False,
    check: Annotated[
        list[Path] | None,
        typer.Option(
            help="A recording for comparing model and fit, not used for learning.", metavar="RECORDING"
        ),
    ] = None,
    tolerance: Annotated[
        float, typer.Option(help="bags: maximum time between a reading and its truth.", metavar="SECONDS")
    ] = 0.1,
) -> None:
    """Learn the tables of a model, and its prior, from recordings with ground truth, and report the data behind each.

    For example `toolchain fit casestudies/mrclam DATA/ds1_robot3.csv -o fit.toml --set landmarks=DATA/landmarks.csv
    --truth y=ref_y_m --truth x=ref_x_m --reading 'range_*=range_*_m' --reading 'bearing_*=bearing_*_rad'
    --pool 'range_*' --pool 'bearing_*' --check DATA/ds1_robot5.csv`
    """
    from toolchain.learning.fit_report import run_fit

    options = FitOptions(
        truth=tuple(truth),
        readings=tuple(readings or ()),
        method=method,
        pool=tuple(pool or ()),
        bias=bias,
        floor=floor,
        pseudo_count=pseudo_count,
        prior=prior,
        learn_prior=learn_prior,
        tolerance_s=tolerance,
    )
    typer.echo(run_fit(case, recordings, output, settings or [], options, check or []), nl=False)
