"""The `toolchain regenerate` commands (thesis 3.4): flags, and what became of each file."""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from terminal.command_line import CommandLine
from terminal.refusals import one_sentence
from toolchain.commands import flags
from toolchain.deployment import FILE_NAME, Queue, Stop
from toolchain.options import OnMissing

if TYPE_CHECKING:
    from toolchain.regenerate import Changes

app = CommandLine(no_args_is_help=True)

Directory: TypeAlias = Annotated[
    Path, typer.Argument(help="Folder of the deployment, which `toolchain build` wrote.", metavar="DIR")
]


@app.callback()
def regenerate() -> None:
    """Redo one part of a deployment, leave the rest as it is, and say what changed."""


@app.command()
def memories(
    directory: Directory,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Take the tables from the model as it is now; without it, from the boards' images.",
            metavar="MODEL",
        ),
    ] = None,
    settings: flags.Settings = None,
    searched: flags.Searched = "",
    known: flags.KnownNames = "",
    given: flags.Given = None,
    prior_select: flags.PriorSelectName = "",
    on_missing: flags.OnMissingFlag = OnMissing.ERROR,
) -> None:
    """The parameters and memory files; with --model also the boards' images, for a model with new numbers.

    For example `toolchain regenerate memories build/boat --model casestudies/boat`. Topics, endpoints and everything
    else in deployment.toml that says nothing of the tables stays as it is.
    """
    with one_sentence():
        from toolchain.build import build_date
        from toolchain.commands.named_model import NetworkQuestion, Unread, model_file, read_model
        from toolchain.errors import BuildError
        from toolchain.regenerate import regenerate_memories

        question = NetworkQuestion.of_flags(searched, known, given, prior_select, on_missing)
        if model is None:
            if settings or question.flags:
                message = f"{'--set' if settings else question.flags[0]} belongs to a model: add --model"
                raise BuildError(message)
            changes = regenerate_memories(directory)
            _tell(changes)
        else:
            read = read_model(model, question, Unread(settings=tuple(settings or ())))
            before = _lines(directory)
            changes = regenerate_memories(directory, read, build_date=build_date(model_file(model)))
            _tell(changes, before, _lines(directory))


@app.command()
def project(directory: Directory) -> None:
    """The Quartus project.

    For example `toolchain regenerate project build/boat`.
    """
    with one_sentence():
        from toolchain.regenerate import regenerate_project

        changes = regenerate_project(directory)
    _tell(changes)
    if not changes:
        typer.echo("rng = ideal exists emulated only, so there is no project", err=True)


@app.command()
def deployment(
    directory: Directory,
    uri: Annotated[str | None, typer.Option(help="rosbridge server with the readings.")] = None,
    topic: Annotated[str | None, typer.Option(help="Topic with the readings.")] = None,
    message_type: Annotated[str | None, typer.Option("--type", help="That topic's type.")] = None,
    output: Annotated[str | None, typer.Option(help="Topic for the posteriors.")] = None,
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
    target_count: flags.TargetCount = None,
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
    """deployment.toml: with other topics, or variables in another order; edits by hand are kept too.

    For example `toolchain regenerate deployment build/boat --order D2,D1,D3,B1,B2,B3` where the first two readings were
    mixed up. No image, memory or board is touched. What is left out stays as it is.
    """
    with one_sentence():
        from toolchain.flag_values import key_values, names_in
        from toolchain.regenerate import DeploymentEdits, regenerate_deployment

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
    _tell(changes, before, _lines(directory))


def _lines(directory: Path) -> list[str]:
    """Return `deployment.toml` as it stands; nothing where it isn't there, which is refused elsewhere."""
    file = directory / FILE_NAME
    return file.read_text(encoding="utf-8", errors="replace").splitlines() if file.is_file() else []


def _tell(changes: "Changes", before: Sequence[str] = (), after: Sequence[str] = ()) -> None:
    """Say what became of each file, and which lines of `deployment.toml` did."""
    for name, change in changes:
        typer.echo(f"{change:9}  {name}")
        if name == FILE_NAME:
            for line in difflib.unified_diff(before, after, lineterm="", n=0):
                if not line.startswith(("---", "+++", "@@")):
                    typer.echo(f"           {line}")
