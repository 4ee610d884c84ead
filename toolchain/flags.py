"""Flags of the toolchain: groups made from dataclasses, single flags that commands share, and parsers of values.

@dataclass                                               def explore(sweep: Sweep, model: ...)
class Sweep:                                   ──▶           explore --steps LIST --banks N [MODEL]
    banks: Annotated[int, typer.Option(...)] = 2
"""

import inspect
from collections.abc import Callable, Iterable
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any, Final, TypeAlias, get_type_hints

import typer

from terminal.command_line import CommandLine
from terminal.flags import Group, expanded
from toolchain.deployment import Stop
from toolchain.errors import BuildError

Bits: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        help="Address bits of a variable's column, or of the prior it selects; repeatable.",
        show_default="the model's",
        metavar="NAME=BITS",
    ),
]
MAX_CYCLES: Final = typer.Option(help="Maximum number of cycles.")
MaxCycles: TypeAlias = Annotated[int, MAX_CYCLES]
Partitions: TypeAlias = Annotated[int, typer.Option(help="Number of boards.")]
ReadingColumns: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--reading",
        help="Column of a known variable's readings; * stands for the same text in both; repeatable.",
        show_default="its name",
        metavar="NAME=COLUMN",
    ),
]
BagTolerance: TypeAlias = Annotated[
    float,
    typer.Option(
        "--tolerance",
        min=0,
        help="bags: maximum time between messages that belong together.",
        metavar="SECONDS",
    ),
]
Settings: TypeAlias = Annotated[
    list[str] | None, typer.Option("--set", help="A parameter of the model; repeatable.", metavar="KEY=VALUE")
]
STOP: Final = typer.Option(
    help="slices: all boards shortly after the first overflow; own: each at its own overflow."
)
StopWhen: TypeAlias = Annotated[Stop, STOP]


def add_commands(app: CommandLine, *commands: Callable[..., None]) -> None:
    """Add each function to a command line, as a command with the function's name.

    If a parameter of a function is a dataclass, each field of the dataclass becomes a flag.
    """
    for command in commands:
        parameters = inspect.signature(command, eval_str=True).parameters
        kinds = {name: each.annotation for name, each in parameters.items()}
        groups = {name: _group(kind) for name, kind in kinds.items() if is_dataclass(kind)}
        app.command()(expanded(command, groups))


def _group(kind: Any) -> Group:
    hints = get_type_hints(kind, include_extras=True)
    flags = [
        inspect.Parameter(
            each.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if each.default is MISSING else each.default,
            annotation=hints[each.name],
        )
        for each in fields(kind)
    ]
    return Group(flags, kind)


def key_values(settings: Iterable[str], flag: str = "--set", example: str = "width=64") -> dict[str, str]:
    """Return the values of a repeated flag KEY=VALUE by key. Raises a BuildError for an invalid or duplicate key."""
    found: dict[str, str] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        key = key.strip()
        if not equals or not key:
            raise BuildError(f"{flag} {setting}: expected KEY=VALUE, such as {flag} {example}")
        if key in found:
            raise BuildError(f"{flag} {key} is given twice")
        found[key] = value
    return found


def names_in(flag: str, text: str) -> list[str]:
    """Return the names in `A,B,C`. Raises a BuildError if a name is empty."""
    names = [name.strip() for name in text.split(",")] if text else []
    if not all(names):
        raise BuildError(f"{flag} {text}: expected comma-separated names, such as {flag} A,B")
    return names
