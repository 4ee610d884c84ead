"""How every command of the project reads its command line: what is wrong with it is one sentence, like any other error."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn, cast

import typer
from typer.core import TyperArgument, TyperOption
from typer.main import get_command

from terminal.one_line import one_line, shown

if TYPE_CHECKING:
    from collections.abc import Sequence

UNWRITABLE: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})
"""Numbers of the system's errors that say that what is written finds no place."""
_TYPES: Final = {int: "NUMBER", float: "NUMBER", str: "TEXT"}


class CommandLine(typer.Typer):
    """A command, or several: `-h` and `--help`, plain tracebacks, usage errors as one sentence and exit code 2."""

    def __init__(self, **settings: Any) -> None:
        """Take typer's own settings; those that all commands have in common are set here."""
        super().__init__(
            pretty_exceptions_enable=False,
            rich_markup_mode="markdown",
            context_settings={"help_option_names": ["-h", "--help"]},
            **settings,
        )

    def __call__(self, arguments: Sequence[str] | None = None) -> NoReturn:
        """Run the command with `sys.argv`, or with these arguments, and exit."""
        command = get_command(self)
        name_values(command)
        check_values(command)
        try:
            code = command.main(arguments, standalone_mode=False)
            sys.stdout.flush()  # at its own end Python could only complain
        except typer.TyperException as error:
            if type(error).__name__ != "NoArgsIsHelpError":  # its help is printed already
                print(f"error: {one_line(usage_sentence(error))}", file=sys.stderr, flush=True)
            sys.exit(2)
        except OSError as error:
            if error.errno not in UNWRITABLE or error.filename is not None:
                raise
            drop_output()
            print(f"error: {output_unwritable(error)}", file=sys.stderr, flush=True)
            sys.exit(2)
        sys.exit(code if isinstance(code, int) else 0)


def output_unwritable(error: OSError) -> str:
    """The sentence for standard output that finds no place."""
    return f"the output can't be written: {error.strerror}; free some space, or send it elsewhere"


def drop_output() -> None:
    """Let what still waits for standard output go nowhere, if it can't be written: at its end Python would complain once more."""
    with contextlib.suppress(OSError), Path(os.devnull).open("wb") as null:
        os.dup2(null.fileno(), sys.stdout.fileno())


def name_values(command: Any, parent: typer.Context | None = None) -> None:
    """Say in `--help` what a flag takes: nothing for a switch, `a|b` for a choice, NUMBER, TEXT, PATH or DIR for others.

    Args:
        command: Typer's command or group; its flags are changed.
        parent: Of a subcommand: the context of the command that it belongs to.
    """
    context = typer.Context(command, parent=parent, **command.context_settings)
    for parameter in (*command.params, command.get_help_option(context)):
        if isinstance(parameter, TyperArgument):
            parameter.metavar = parameter.metavar or parameter.name.upper()
            # typer repeats the type beside the name
            parameter.display_type_rich = _nothing  # type: ignore[method-assign]  # of this one argument
        elif parameter.is_flag:
            parameter.metavar = ""
        elif parameter.metavar is None:
            choices, kind = _choices(parameter), parameter.type_descriptor.annotation
            other = parameter.type_descriptor.path_type.upper()
            parameter.metavar = "|".join(choices) if choices else _TYPES.get(kind, other)
    for each in getattr(command, "commands", {}).values():
        name_values(each, context)


class RefusedValueError(typer.BadParameter):
    """A value that is none for any flag: a blank text, or a number that is not finite."""

    def __init__(self, value: str, context: typer.Context, parameter: TyperOption | TyperArgument) -> None:
        """Take the value as it was typed, and where."""
        super().__init__("expected a text that is not blank", context, parameter)
        self.value = value


def check_values(command: Any) -> None:
    """Have every flag refuse a blank value and a number that is not finite, and every mistake name its own subcommand.

    Args:
        command: Typer's command or group; its flags are changed.
    """
    parse = command.parse_args

    def parse_here(context: typer.Context, arguments: list[str]) -> list[str]:
        try:
            rest: list[str] = parse(context, arguments)
        except typer.TyperException as error:
            # typer's parser does not say whose flag it was that has no value
            if getattr(error, "ctx", context) is None:
                cast("Any", error).ctx = context
            raise
        return rest

    command.parse_args = parse_here
    for parameter in command.params:
        _check_value(parameter)
    for each in getattr(command, "commands", {}).values():
        check_values(each)


def _check_value(parameter: TyperOption | TyperArgument) -> None:
    process = parameter.process_value

    def checked(ctx: Any, value: Any) -> Any:
        source = ctx.get_parameter_source(parameter.name)
        typed = value if isinstance(value, list | tuple) else (value,)
        if source is not None and source.name == "COMMANDLINE":
            for each in typed:
                if (
                    isinstance(each, str)
                    and not each.strip()
                    and not _choices(parameter)
                    and not _is_number(parameter)
                ):
                    raise RefusedValueError(each, ctx, parameter)
        found = process(ctx, value)
        if isinstance(found, float) and not math.isfinite(found):
            raise RefusedValueError(str(value), ctx, parameter)
        return found

    parameter.process_value = checked  # type: ignore[method-assign]  # of this one flag


def _is_number(parameter: TyperOption | TyperArgument) -> bool:
    return parameter.type_descriptor.annotation in {int, float}


def _nothing(*_: object, **__: object) -> None:
    """What an argument takes is said by its name."""


def usage_sentence(error: typer.TyperException) -> str:
    """Return what is wrong with a command line: where, what was expected, and where to read on."""
    context = getattr(error, "ctx", None)
    command = Path(sys.argv[0]).name if context is None else context.command_path
    return f"{_without_stop(_what(error, command))}; {command} --help says more"


def _without_stop(sentence: str) -> str:
    """A sentence that goes on: without its full stop, but an ellipsis stays."""
    sentence = sentence.rstrip()
    return sentence if sentence.endswith("...") else sentence.removesuffix(".")


def _what(error: typer.TyperException, command: str) -> str:
    option = getattr(error, "option_name", None)
    parameter = getattr(error, "param", None)
    kind = type(error).__name__
    if kind == "NoSuchOption":
        near = getattr(error, "possibilities", None)
        guess = f" (did you mean {_one_of(near)}?)" if near else ""
        return f"{command} has no {shown(option)}{guess}"
    if kind == "MissingParameter" and parameter is not None:
        return f"{_place(parameter)} is missing: {_meaning(parameter)}"
    if isinstance(error, typer.BadParameter) and parameter is not None:
        return f"{_place(parameter)}{_value(error)}: {_expected(error, parameter)}"
    if isinstance(error, typer.BadParameter):
        return f"{error.param_hint or command}: {error.message}"
    if kind == "BadOptionUsage" and "requires" in error.message:
        return f"{shown(option)} needs a value"
    if kind == "BadOptionUsage":
        return f"{shown(option)} takes no value"
    return f"{command}: {one_line(error.message[:1].lower() + error.message[1:])}"


def _place(parameter: TyperOption | TyperArgument) -> str:
    if isinstance(parameter, TyperOption):
        return max(parameter.opts, key=len)
    return parameter.metavar or parameter.name.upper()


def _meaning(parameter: TyperOption | TyperArgument) -> str:
    choices = _choices(parameter)
    if choices:
        return f"expected {_one_of(choices)}"
    help_text = _without_stop(parameter.help or "it must be given")
    return help_text[:1].lower() + help_text[1:]


def _value(error: typer.BadParameter) -> str:
    """Return the value that was typed, where the check that refused it kept it."""
    if isinstance(error, RefusedValueError):
        return f" {shown(error.value)}"
    details = getattr(error.__cause__, "errors", None)
    if details is None:
        return ""
    value = details()[0].get("input")
    return f" {shown(value)}" if isinstance(value, str | int | float) else ""


def _expected(error: typer.BadParameter, parameter: TyperOption | TyperArgument) -> str:
    choices = _choices(parameter)
    if choices:
        return f"expected {_one_of(choices)}"
    kind = parameter.type_descriptor.annotation
    if not _is_number(parameter):
        return one_line(error.message.removeprefix("Value error, "))
    information = parameter.type_descriptor.parameter_info
    limits = [
        f"{word} {limit:g}"
        for word, limit in (("from", information.min), ("to", information.max))
        if limit is not None
    ]
    return " ".join(["expected a whole number" if kind is int else "expected a number", *limits])


def _choices(parameter: TyperOption | TyperArgument) -> list[str]:
    return [str(getattr(each, "value", each)) for each in parameter.type_descriptor.choices or ()]


def _one_of(choices: Sequence[str]) -> str:
    return choices[0] if len(choices) == 1 else f"{', '.join(choices[:-1])} or {choices[-1]}"
