"""Sentences for usage errors: the place, the expected value, and where to read more."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import typer
from typer.core import TyperArgument, TyperOption

from terminal.one_line import one_line, shown

Parameter = TyperOption | TyperArgument

_TYPES: Final = {int: "NUMBER", float: "NUMBER", str: "TEXT"}


class RefusedValueError(typer.BadParameter):
    """A value that no flag accepts: blank text, or a number that is not finite."""

    def __init__(self, value: str, context: typer.Context, parameter: Parameter) -> None:
        """Store the value as typed, and its place."""
        super().__init__("expected a text that is not blank", context, parameter)
        self.value = value


def choices(parameter: Parameter) -> list[str]:
    """Return the permitted values of a parameter, or an empty list if there is no restriction."""
    return [str(getattr(each, "value", each)) for each in parameter.type_descriptor.choices or ()]


def is_number(parameter: Parameter) -> bool:
    """Return whether the values of a parameter are numbers."""
    return parameter.type_descriptor.annotation in {int, float}


def metavar(parameter: Parameter) -> str | None:
    """Return the word for a parameter's value in `--help`: `a|b` for a choice, NUMBER, TEXT, PATH or DIR for others."""
    if parameter.metavar is not None:
        return parameter.metavar
    if isinstance(parameter, TyperArgument):
        return parameter.name.upper()
    if parameter.is_flag:
        return ""
    of_kind = _TYPES.get(parameter.type_descriptor.annotation, parameter.type_descriptor.path_type.upper())
    return "|".join(choices(parameter)) or of_kind


def usage_sentence(error: typer.TyperException) -> str:
    """Return one sentence for a usage error."""
    context = getattr(error, "ctx", None)
    command = Path(sys.argv[0]).name if context is None else context.command_path
    return one_line(f"{_without_stop(_mistake(error, command))}; {command} --help says more")


def _without_stop(sentence: str) -> str:
    """Return a sentence without its full stop; an ellipsis stays."""
    sentence = sentence.rstrip()
    return sentence if sentence.endswith("...") else sentence.removesuffix(".")


def _mistake(error: typer.TyperException, command: str) -> str:
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
    if kind == "BadOptionUsage":
        needs_value = "requires" in error.message  # the library distinguishes the two cases only by this text
        return f"{shown(option)} {'needs a' if needs_value else 'takes no'} value"
    return f"{command}: {one_line(error.message[:1].lower() + error.message[1:])}"


def _place(parameter: Parameter) -> str:
    if isinstance(parameter, TyperOption):
        return max(parameter.opts, key=len)
    return parameter.metavar or parameter.name.upper()


def _meaning(parameter: Parameter) -> str:
    if named := choices(parameter):
        return f"expected {_one_of(named)}"
    help_text = _without_stop(parameter.help or "it must be given")
    return help_text[:1].lower() + help_text[1:]


def _value(error: typer.BadParameter) -> str:
    """Return the value as typed, if the refusing check stored it."""
    if isinstance(error, RefusedValueError):
        return f" {shown(error.value)}"
    details = getattr(error.__cause__, "errors", None)
    if details is None:
        return ""
    value = details()[0].get("input")
    return f" {shown(value)}" if isinstance(value, str | int | float) else ""


def _expected(error: typer.BadParameter, parameter: Parameter) -> str:
    if named := choices(parameter):
        return f"expected {_one_of(named)}"
    if not is_number(parameter):
        return one_line(error.message.removeprefix("Value error, "))
    whole = parameter.type_descriptor.annotation is int
    information = parameter.type_descriptor.parameter_info
    limits = [
        f"{word} {limit:g}"
        for word, limit in (("from", information.min), ("to", information.max))
        if limit is not None
    ]
    return " ".join(["expected a whole number" if whole else "expected a number", *limits])


def _one_of(named: Sequence[str]) -> str:
    return named[0] if len(named) == 1 else f"{', '.join(named[:-1])} or {named[-1]}"
