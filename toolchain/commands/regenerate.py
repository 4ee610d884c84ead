"""The `toolchain regenerate` commands, which write one part of a deployment again (thesis 3.4)."""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from terminal.command_line import CommandLine
from toolchain.building.options import DeploymentEdits
from toolchain.commands.request import ModelFlags, model_file, read_model
from toolchain.deployment import FILE_NAME
from toolchain.errors import BuildError
from toolchain.flags import add_commands

if TYPE_CHECKING:
    from toolchain.building.regenerate import Changes

app = CommandLine()

Directory: TypeAlias = Annotated[
    Path, typer.Argument(help="Folder of the deployment, written by `toolchain build`.", metavar="DIR")
]
Verbose: TypeAlias = Annotated[bool, typer.Option("--verbose", "-v", help="List unchanged files too.")]


@app.callback()
def regenerate() -> None:
    """Write one part of a deployment again without changing the rest, and report the changes."""


def memories(
    directory: Directory,
    flags: ModelFlags,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Use the tables of the current model; without it, those of the images.", metavar="MODEL"
        ),
    ] = None,
    verbose: Verbose = False,
) -> None:
    """Write the parameters and memory files again; with --model also the images, with new numbers.

    For example `toolchain regenerate memories build/boat --model casestudies/boat`. Everything else in
    deployment.toml, such as topics and endpoints, does not change.
    """
    from toolchain.building.build import build_date
    from toolchain.building.regenerate import regenerate_memories

    if model is not None:
        read = read_model(model, flags)
        before = _lines(directory)
        changes = regenerate_memories(directory, read, build_date=build_date(model_file(model)))
        _print_changes(changes, before, _lines(directory), verbose=verbose)
    elif flags.settings or flags.question:
        raise BuildError(f"{'--set' if flags.settings else flags.question[0]} is for a model: add --model")
    else:
        _print_changes(regenerate_memories(directory), verbose=verbose)


def project(directory: Directory, verbose: Verbose = False) -> None:
    """Write the Quartus project again.

    For example `toolchain regenerate project build/boat`.
    """
    from toolchain.building.regenerate import regenerate_project

    changes = regenerate_project(directory)
    _print_changes(changes, verbose=verbose)
    if not changes:
        typer.echo("rng = ideal exists only in emulation, so there is no project", err=True)


def deployment(directory: Directory, edits: DeploymentEdits, verbose: Verbose = False) -> None:
    """Write deployment.toml with other topics, or variables in another order; manual edits are kept.

    For example `toolchain regenerate deployment build/boat --order D2,D1,D3,B1,B2,B3` if the first two
    readings were swapped. Images, memories and boards are not touched. Omitted flags do not change anything.
    """
    from toolchain.building.regenerate import regenerate_deployment

    before = _lines(directory)
    changes = regenerate_deployment(directory, edits)
    _print_changes(changes, before, _lines(directory), verbose=verbose)


def _lines(directory: Path) -> list[str]:
    """Return the lines of `deployment.toml`; none if it is missing, which is an error elsewhere."""
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
        files = "1 file" if len(unchanged) == 1 else f"{len(unchanged)} files"
        typer.echo(f"unchanged  {files} (--verbose lists them)")


add_commands(app, memories, project, deployment)
