"""The `toolchain regenerate` commands (thesis 3.4): one part of a deployment is written again."""

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

app = CommandLine(no_args_is_help=True)

Directory: TypeAlias = Annotated[
    Path, typer.Argument(help="Folder of the deployment, which `toolchain build` wrote.", metavar="DIR")
]


@app.callback()
def regenerate() -> None:
    """Redo one part of a deployment, leave the rest as it is, and say what changed."""


def memories(
    directory: Directory,
    flags: ModelFlags,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Take the tables from the model as it is now; without it, from the boards' images.",
            metavar="MODEL",
        ),
    ] = None,
) -> None:
    """Write the parameters and memory files again; with --model also the boards' images, for a model with new numbers.

    For example `toolchain regenerate memories build/boat --model casestudies/boat`. Everything in deployment.toml that
    does not concern the tables, such as topics and endpoints, stays as it is.
    """
    from toolchain.building.build import build_date
    from toolchain.building.regenerate import regenerate_memories
    from toolchain.commands.request import model_file, read_model
    from toolchain.errors import BuildError

    if model is not None:
        read = read_model(model, flags)
        before = _lines(directory)
        changes = regenerate_memories(directory, read, build_date=build_date(model_file(model)))
        _print_changes(changes, before, _lines(directory))
    elif flags.settings or flags.question:
        raise BuildError(
            f"{'--set' if flags.settings else flags.question[0]} belongs to a model: add --model"
        )
    else:
        _print_changes(regenerate_memories(directory))


def project(directory: Directory) -> None:
    """Write the Quartus project again.

    For example `toolchain regenerate project build/boat`.
    """
    from toolchain.building.regenerate import regenerate_project

    changes = regenerate_project(directory)
    _print_changes(changes)
    if not changes:
        typer.echo("rng = ideal exists only emulated, so there is no project", err=True)


def deployment(
    directory: Directory,
    uri: Annotated[
        str | None, typer.Option(help="rosbridge server with the readings.", metavar="ws://HOST:PORT")
    ] = None,
    topic: Annotated[str | None, typer.Option(help="Topic with the readings.", metavar="TOPIC")] = None,
    message_type: Annotated[
        str | None, typer.Option("--type", help="That topic's type.", metavar="PACKAGE/NAME")
    ] = None,
    output: Annotated[str | None, typer.Option(help="Topic for the posteriors.", metavar="TOPIC")] = None,
    order: Annotated[
        str | None,
        typer.Option(
            help="The sensors in the order in which columns 1 to N are to read them.", metavar="A,B,C"
        ),
    ] = None,
    path: Annotated[
        list[str] | None,
        typer.Option(help="Where in the message a variable is; repeat for more.", metavar="NAME=PATH"),
    ] = None,
    target_count: TargetCount = None,
    max_cycles: Annotated[int | None, typer.Option(help="Cycles after which a machine stops anyway.")] = None,
    stop: Annotated[
        Stop | None,
        typer.Option(help="slices: all boards soon after the first overflow; own: each at its own."),
    ] = None,
    queue: Annotated[
        Queue | None, typer.Option(help="Frames that come too fast: the newest counts, or all in order.")
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="Seconds within which readings from several topics belong together.")
    ] = None,
) -> None:
    """Write deployment.toml with other topics, or variables in another order; edits by hand are kept.

    For example `toolchain regenerate deployment build/boat --order D2,D1,D3,B1,B2,B3` where the first two readings were
    mixed up. No image, memory or board is touched. Flags that are left out change nothing.
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
    _print_changes(changes, before, _lines(directory))


def _lines(directory: Path) -> list[str]:
    """Return the lines of `deployment.toml`; none where it is missing, which is refused elsewhere."""
    file = directory / FILE_NAME
    return file.read_text(encoding="utf-8", errors="replace").splitlines() if file.is_file() else []


def _print_changes(changes: "Changes", before: Sequence[str] = (), after: Sequence[str] = ()) -> None:
    for name, change in changes:
        typer.echo(f"{change:9}  {name}")
        if name == FILE_NAME:
            for line in difflib.unified_diff(before, after, lineterm="", n=0):
                if not line.startswith(("---", "+++", "@@")):
                    typer.echo(f"           {line}")


add_commands(app, memories, project, deployment)
