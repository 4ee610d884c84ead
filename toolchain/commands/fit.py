"""The `toolchain fit` command: a model's tables from recordings with ground truth."""

from pathlib import Path
from typing import Annotated

import typer

from toolchain.commands.flags import ReadingColumns, Settings
from toolchain.learning.fit_options import FitMethod, FitOptions, FitPrior


def fit(
    case: Annotated[
        Path, typer.Argument(help="Folder that holds model.py: its variables are fitted.", metavar="MODEL")
    ],
    recordings: Annotated[
        list[Path],
        typer.Argument(help="CSV, MCAP or bag, with readings and the truth.", metavar="RECORDING"),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="The file to write: .toml of normals, .npz of counts.", metavar="FILE"
        ),
    ],
    truth: Annotated[
        list[str],
        typer.Option(
            help="Where a searched dimension's true value is; one for each.", metavar="LABEL=COLUMN"
        ),
    ],
    readings: ReadingColumns = None,
    settings: Settings = None,
    method: Annotated[
        FitMethod, typer.Option(help="normals: sigma and the outliers' share; counts: whole tables.")
    ] = FitMethod.NORMALS,
    pool: Annotated[
        list[str] | None,
        typer.Option(help="normals: variables with one sigma for all, such as 'range_*'.", metavar="PATTERN"),
    ] = None,
    bias: Annotated[bool, typer.Option("--bias", help="normals: fit a constant error too.")] = False,
    floor: Annotated[
        float,
        typer.Option(help="normals: the least an outlier gets, relative to the peak; codes must hold it."),
    ] = 0.005,
    pseudo_count: Annotated[
        float, typer.Option(help="counts: readings that the Dirichlet prior of a cell is worth.")
    ] = 1.0,
    prior: Annotated[
        FitPrior, typer.Option(help="counts: what the prior looks like: the model's own table, or uniform.")
    ] = FitPrior.MODEL,
    check: Annotated[
        list[Path] | None,
        typer.Option(
            help="A recording to compare the model and the fit on; never learnt from.", metavar="RECORDING"
        ),
    ] = None,
    tolerance: Annotated[
        float,
        typer.Option(help="Of bags: between a reading and the truth that belongs to it.", metavar="SECONDS"),
    ] = 0.1,
) -> None:
    """Learn a model's tables from recordings with ground truth, and say how much data each rests on.

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
        tolerance_s=tolerance,
    )
    typer.echo(run_fit(case, recordings, output, settings or [], options, check or []), nl=False)
