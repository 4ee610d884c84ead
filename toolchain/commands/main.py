"""The `toolchain` command (thesis 3.4), and two of its subcommands: `new` and `fit`."""

import re
import shlex
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Final

import typer

from terminal.command_line import CommandLine
from toolchain.bounded_files import file_errors

# NumPy and modules that need it are imported inside the functions of these modules, so that --help is fast.
from toolchain.commands import regenerate
from toolchain.commands.build import build, check
from toolchain.commands.explore import explore, inspect
from toolchain.errors import BuildError
from toolchain.flags import Settings, add_commands
from toolchain.learning import FitOptions

app = CommandLine()
app.add_typer(regenerate.app, name="regenerate")


@app.callback()
def toolchain() -> None:
    """Build, check and inspect deployments of Bayesian machines, from models in Python or network files."""


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
    options: FitOptions,
    settings: Settings = None,
    check: Annotated[
        list[Path] | None,
        typer.Option(
            help="A recording for comparing model and fit, not used for learning.", metavar="RECORDING"
        ),
    ] = None,
) -> None:
    """Learn the tables of a model, and its prior, from recordings with ground truth, and report the data behind each.

    For example `toolchain fit casestudies/mrclam DATA/ds1_robot3.csv -o fit.toml --set landmarks=DATA/landmarks.csv
    --truth y=ref_y_m --truth x=ref_x_m --reading 'range_*=range_*_m' --reading 'bearing_*=bearing_*_rad'
    --pool 'range_*' --pool 'bearing_*' --check DATA/ds1_robot5.csv`
    """
    from toolchain.learning.fit_report import run_fit

    typer.echo(run_fit(case, recordings, output, settings or [], options, check or []), nl=False)


_FILES: Final = ("model.py", "robot.py")


def new(
    name: Annotated[Path, typer.Argument(help="Folder to create; its last part is the name of the model.")],
) -> None:
    """Create a model from a runnable template: a robot in a corridor.

    For example `toolchain new mymodel`; it prints the next steps.
    """
    model = name.name
    if not re.fullmatch(r"[A-Za-z]\w{0,60}", model, re.ASCII):
        raise BuildError(
            f"{model or str(name)!r} is not a model's name: expected a letter, then letters, digits and _"
        )
    for file in _FILES:
        if (name / file).exists():
            raise BuildError(f"{name / file} already exists; choose another name")
    if not name.parent.is_dir():
        raise BuildError(
            f"{name.parent} is not a folder, so {model} cannot be created in it; create it first, or correct the path"
        )
    with file_errors(name, "written", BuildError):
        name.mkdir(exist_ok=True)
        for file in _FILES:
            text = files("toolchain.commands").joinpath("template", file + ".txt").read_text(encoding="utf-8")
            (name / file).write_text(text.replace("NAME", model), encoding="utf-8")
    typer.echo(_next_steps(name), nl=False)


def _next_steps(folder: Path) -> str:
    where, built = shlex.quote(str(folder)), f"build/{folder.name}"
    return f"""Made {folder / "model.py"} and {folder / "robot.py"}. To build it:

    toolchain build {where} -o {built} --uri ws://127.0.0.1:9090 --topic /{folder.name}/readings --type std_msgs/Float64MultiArray

To run it, start a rosbridge server in a second terminal, and the simulated robot in a third:

    hub
    python {shlex.quote(str(folder / "robot.py"))}

and in the first one:

    master --once -d {built}

Then change model.py, build it again, and point --uri at the robot.
"""


add_commands(app, build, check, inspect, explore, fit, new)
