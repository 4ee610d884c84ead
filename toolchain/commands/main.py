"""The `toolchain` command (thesis 3.4), and the smaller subcommands `regenerate`, `fit` and `new`.

So that `--help` is fast, the modules of commands do not import NumPy at the top, neither directly nor through another
module. They import it only inside functions.
"""

import difflib
import re
import shlex
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias

import typer

from terminal.command_line import CommandLine
from toolchain.bounded_files import file_errors
from toolchain.building.options import DeploymentEdits
from toolchain.commands.build import build, check
from toolchain.commands.explore import advise, explore, inspect
from toolchain.commands.infer import infer
from toolchain.commands.query import query, show
from toolchain.commands.request import ModelFlags, model_file, read_source
from toolchain.deployment import FILE_NAME
from toolchain.errors import BuildError, counted
from toolchain.flags import Settings, add_commands
from toolchain.learning import FitOptions

if TYPE_CHECKING:
    from toolchain.building.regenerate import Changes

app = CommandLine()
regeneration = CommandLine()
app.add_typer(regeneration, name="regenerate")


@app.callback()
def toolchain() -> None:
    """Build, check and inspect deployments of Bayesian machines. A model is Python code or a network file."""


Directory: TypeAlias = Annotated[
    Path, typer.Argument(help="Folder of the deployment, written by `toolchain build`.", metavar="DIR")
]
Verbose: TypeAlias = Annotated[bool, typer.Option("--verbose", "-v", help="List unchanged files too.")]


@regeneration.callback()
def regenerate() -> None:
    """Write one part of a deployment again without changing the rest, and report the changes."""


def memories(
    directory: Directory,
    flags: ModelFlags,
    model: Annotated[
        Path | None,
        typer.Option(help="Use the tables of this model; by default, those in the images.", metavar="MODEL"),
    ] = None,
    verbose: Verbose = False,
) -> None:
    """Write the parameters and memory files again. With --model, also write images with the tables of the model.

    For example `toolchain regenerate memories build/boat --model casestudies/boat`. The topics and endpoints in
    deployment.toml do not change.
    """
    from toolchain.building.build import build_date
    from toolchain.building.regenerate import regenerate_memories
    from toolchain.deployment import load_deployment
    from toolchain.outputs.vhdl_parameters import PARAMETERS_FILE

    if model is not None:
        old = load_deployment(directory, images=False)
        flags = flags.over(old.model)
        source = read_source(model, flags)
        before, date = _lines(directory), build_date(model_file(model))
        changes = regenerate_memories(directory, source, flags=flags.section(old.model.bits), build_date=date)
        _print_changes(changes, before, _lines(directory), verbose=verbose)
        # the parameters of the build are not stored, so images may differ from the build's by them or by the model
        new = load_deployment(directory, images=False)
        built = [(one.built_hash, two.image_hash) for one, two in zip(old.boards, new.boards, strict=True)]
        if old.machine.type == "BM1" and any(one not in {None, two} for one, two in built):
            typer.echo(
                f"memories are the model's again, but parameters that were edited stay: to undo those edits, set them back "
                f"in {PARAMETERS_FILE} and run 'toolchain regenerate images {directory}'",
                err=True,
            )
    elif flags.settings or flags.question:
        raise BuildError(f"{'--set' if flags.settings else flags.question[0]} is for a model: add --model")
    else:
        _print_changes(regenerate_memories(directory), verbose=verbose)


def images(directory: Directory, verbose: Verbose = False) -> None:
    """Write the images again from edited memory files and parameters, and report the edits.

    For example, edit build/boat/bm_arch/Memory_MIFs/board0_prior.mif, run `toolchain regenerate images build/boat`,
    and program the boards again.
    """
    from toolchain.building.edited_sources import regenerate_images

    before = _lines(directory)
    edits, changes = regenerate_images(directory)
    for edit in edits:
        typer.echo(f"edited     {edit}")
    _print_changes(changes, before, _lines(directory), verbose=verbose)


def project(directory: Directory, verbose: Verbose = False) -> None:
    """Write the Quartus project again.

    For example `toolchain regenerate project build/boat`.
    """
    from toolchain.building.regenerate import regenerate_project
    from toolchain.deployment import load_deployment
    from toolchain.outputs.output_files import only_emulated

    changes = regenerate_project(directory)
    _print_changes(changes, verbose=verbose)
    if reason := only_emulated(load_deployment(directory, images=False)):
        typer.echo(f"{reason}, so there is no project", err=True)


def deployment(directory: Directory, edits: DeploymentEdits, verbose: Verbose = False) -> None:
    """Change topics, or the order of variables, in deployment.toml. Manual edits of the file are kept.

    For example `toolchain regenerate deployment build/boat --order D2,D1,D3,B1,B2,B3` if the first two
    readings were swapped. The command does not change images and memory files. An omitted flag changes nothing.
    """
    from toolchain.building.regenerate import regenerate_deployment

    before = _lines(directory)
    changes = regenerate_deployment(directory, edits)
    _print_changes(changes, before, _lines(directory), verbose=verbose)


def _lines(directory: Path) -> list[str]:
    """Return the lines of `deployment.toml`, or an empty list if the file is missing.

    A missing file is reported when the deployment is loaded.
    """
    file = directory / FILE_NAME
    return file.read_text(encoding="utf-8", errors="replace").splitlines() if file.is_file() else []


def _print_changes(
    changes: "Changes", before: Sequence[str] = (), after: Sequence[str] = (), *, verbose: bool
) -> None:
    unchanged = [name for name, change in changes if change == "unchanged"]
    for name, change in changes:
        if change == "unchanged" and not verbose:
            continue
        typer.echo(f"{change:9}  {name}")
        if name == FILE_NAME:
            for line in difflib.unified_diff(before, after, lineterm="", n=0):
                if not line.startswith(("---", "+++", "@@")):
                    typer.echo(f"           {line}")
    if unchanged and not verbose:
        typer.echo(f"unchanged  {counted(len(unchanged), 'file')} (--verbose lists them)")


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
    """Learn the tables of a model from recordings with ground truth, and report the data of each table.

    With --learn-prior, the command also learns the prior. For example `toolchain fit casestudies/mrclam
    DATA/ds1_robot3.csv -o fit.toml --set landmarks=DATA/landmarks.csv --truth y=ref_y_m
    --truth x=ref_x_m --reading 'range_*=range_*_m' --reading 'bearing_*=bearing_*_rad' --pool 'range_*'
    --pool 'bearing_*' --check DATA/ds1_robot5.csv`
    """
    from toolchain.learning.fit_report import run_fit

    typer.echo(run_fit(case, recordings, output, settings or [], options, check or []), nl=False)


_FILES: Final = ("model.py", "robot.py")


def new(
    name: Annotated[Path, typer.Argument(help="Folder to create; its last part is the name of the model.")],
) -> None:
    """Create a model from a runnable template: a robot in a corridor.

    For example `toolchain new mymodel`. The command prints the next steps.
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


add_commands(regeneration, memories, images, project, deployment)
add_commands(app, build, check, inspect, advise, explore, infer, query, show, fit, new)
