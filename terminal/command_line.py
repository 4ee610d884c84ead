"""The base class of all command lines: start-up, checks of all flags, and exit."""

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any, Final, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from terminal.ending import outcome
from terminal.errors import ExitCode, ReaderGoneError
from terminal.logs import escape_last_resort
from terminal.output import open_standard_streams
from terminal.signals import raise_on_signals

_COMPLETION: Final = frozenset({"install_completion", "show_completion"})


class CommandLine(typer.Typer):
    """A command or a group of commands. It reports a failure as one sentence on standard error and an exit code."""

    def __init__(self, **settings: Any) -> None:
        """Create a `typer.Typer` with `settings`, and with the settings that all commands share."""
        super().__init__(
            cls=_Group,
            pretty_exceptions_enable=False,
            rich_markup_mode=None,
            context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
            **settings,
        )

    def command(
        self, name: str | None = None, *, cls: type[TyperCommand] | None = None, **settings: Any
    ) -> Callable[[Any], Any]:
        """Register a function as a command. If the function returns an integer, the integer is the exit code."""
        return super().command(name, cls=cls or _Command, **settings)

    def add_later(self, name: str, module: str, *, purpose: str) -> None:
        """Add a subcommand whose module is imported only when a user names the subcommand.

        Each module defines its command line as `app`. If `module` is `MODULE`, the subcommand is the whole `app`. If
        `module` is `MODULE:NAME`, the subcommand is only the subcommand NAME of `app`.
        """
        module, _, part = module.partition(":")

        def load() -> Any:
            command: Any = get_command(import_module(module).app)
            if part:
                return command.commands[part]
            # the group has one completion for all
            command.params = [each for each in command.params if each.name not in _COMPLETION]
            return command

        self.command(name, cls=_Later, help=purpose)(load)

    def __call__(self, arguments: Sequence[str] | None = None) -> NoReturn:
        """Run the command with `sys.argv`, or with these arguments, and exit."""
        open_standard_streams()
        escape_last_resort()

        def run() -> object:
            raise_on_signals()
            return get_command(self).main(arguments, standalone_mode=False)

        sys.exit(outcome(run))


class _Command(TyperCommand):
    """A command that refuses blank and non-finite values for all flags."""

    def invoke(self, ctx: Any) -> Any:
        with _noticing_closed_pipe():
            return super().invoke(ctx)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        rest: list[str] = super().parse_args(ctx, list(args))
        # once more, because afterwards Path("") cannot be told from the current folder
        typed, _, _ = self.make_parser(ctx).parse_args(args=list(args))
        parameter: Any
        for parameter in self.params:
            texts = typed.get(parameter.name)
            for each in texts if isinstance(texts, list | tuple) else (texts,):
                if isinstance(each, str) and not each.strip():
                    raise typer.BadParameter(
                        f"expected a text that is not blank, not {each!r}", ctx, parameter
                    )
            found = ctx.params.get(parameter.name)
            if isinstance(found, float) and not math.isfinite(found):
                raise typer.BadParameter(f"expected a finite number, not {texts}", ctx, parameter)
        return rest


class _Later(_Command):
    """A placeholder with the name and purpose of a subcommand. Its callback imports and returns the real command."""


class _Group(TyperGroup):
    """A group of commands."""

    def invoke(self, ctx: Any) -> Any:
        with _noticing_closed_pipe():
            return super().invoke(ctx)

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, command, rest = super().resolve_command(ctx, args)
        if isinstance(command, _Later) and command.callback is not None:
            command = command.callback()
        return name, command, rest

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args and not ctx.resilient_parsing:
            print(ctx.get_help())
            raise typer.Exit(ExitCode.USAGE)
        return super().parse_args(ctx, args)


@contextmanager
def _noticing_closed_pipe() -> Iterator[None]:
    """Within the context, raise a ReaderGoneError if a pipe was closed; typer itself would exit with 1."""
    try:
        yield
    except BrokenPipeError as error:
        raise ReaderGoneError from error
