"""The `toolchain regenerate` commands, which write one part of a deployment again (thesis 3.4)."""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from terminal.command_line import CommandLine
from toolchain.commands.flags import ModelFlags, TargetCount, add_commands
from toolchain.deployment import FILE_NAME, Queue, Stop

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
    from toolchain.commands.request import model_file, read_model
    from toolchain.errors import BuildError

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


def deployment(
    directory: Directory,
    uri: Annotated[
        str | None,
        typer.Option(help="rosbridge server of the readings.", metavar="ws://HOST:PORT|robot:NAME"),
    ] = None,
    topic: Annotated[str | None, typer.Option(help="Topic of the readings.", metavar="TOPIC")] = None,
    message_type: Annotated[
        str | None, typer.Option("--type", help="That topic's type.", metavar="PACKAGE/NAME")
    ] = None,
    output: Annotated[str | None, typer.Option(help="Topic of the posteriors.", metavar="TOPIC")] = None,
    order: Annotated[
        str | None, typer.Option(help="The sensors in the order of columns 1 to N.", metavar="A,B,C")
    ] = None,
    path: Annotated[
        list[str] | None,
        typer.Option(help="Path of a variable in the message; repeatable.", metavar="NAME=PATH"),
    ] = None,
    target_count: TargetCount = None,
    max_cycles: Annotated[int | None, typer.Option(help="Maximum number of cycles.")] = None,
    stop: Annotated[
        Stop | None,
        typer.Option(
            help="slices: all boards shortly after the first overflow; own: each at its own overflow."
        ),
    ] = None,
    queue: Annotated[
        Queue | None, typer.Option(help="If readings arrive too fast: keep only the latest, or all in order.")
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="Seconds within which readings from several topics belong together.")
    ] = None,
    verbose: Verbose = False,
) -> None:
    """Write deployment.toml with other topics, or variables in another order; manual edits are kept.

    For example `toolchain regenerate deployment build/boat --order D2,D1,D3,B1,B2,B3` if the first two
    readings were swapped. Images, memories and boards are not touched. Omitted flags do not change anything.
    """
    from toolchain.building.regenerate import DeploymentEdits, regenerate_deployment
    from toolchain.flag_values import key_values, names_in

    edits = DeploymentEdits(
        uri=uri,
        topic=topic,
        type=message_type,
        output=output,
        order=None if order is None else tuple(names_in("--order", order)),
        paths=tuple(key_values(path or (), "--path", "range=data[0]").items()),
        target_count=target_count,
        max_cycles=max_cycles,
        stop=stop,
        queue=queue,
        tolerance_s=tolerance,
    )
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
