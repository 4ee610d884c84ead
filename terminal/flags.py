"""Flags made from the fields of a model, so that the meaning, limits and default of a flag are written once.

    class Settings(BaseModel):                            def listen(settings: Settings, plot: ...)
        uri: Annotated[str, Flag(...)] = Field(...)  ──▶      listen --uri URI --plot

Typer reads the flags of a command from the signature of a function. `expanded` replaces a parameter in the signature
by several flags. When the command is called, `expanded` makes the parameter's value from the values of the flags.
"""

import functools
import inspect
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Union, get_args, get_origin

import typer
from pydantic import BaseModel


@dataclass(frozen=True, slots=True)
class Flag:
    """A flag's names (if not `--field-name`), the word for its value, and the text of its default."""

    names: tuple[str, ...] = ()
    metavar: str | None = None
    otherwise: str = ""
    """Text that the help shows as the default. If it is empty, the help shows the field's default."""


@dataclass(frozen=True, slots=True)
class Group:
    """Flags that replace one parameter of a command. `compose` makes the parameter's value from the flags' values."""

    flags: Sequence[inspect.Parameter]
    compose: Callable[..., Any]


def field_flag(model: type[BaseModel], name: str) -> Flag:
    """Return the `Flag` in the annotation of a model's field, or `Flag()` if there is none."""
    found = [each for each in model.model_fields[name].metadata if isinstance(each, Flag)]
    return found[0] if found else Flag()


def default_of(model: type[BaseModel], name: str) -> str:
    """Return the default of a model's field as text, or "" if there is none."""
    default = model.model_fields[name].default
    return field_flag(model, name).otherwise or ("" if default in (None, False, ()) else str(default))


def flags_of(model: type[BaseModel], names: Sequence[str], *, prefix: str) -> list[inspect.Parameter]:
    """Return a command-line flag for each of the model's fields in `names`.

    If the user omits a flag, the flag's value is None. The field then gets the value of the environment variable
    `PREFIX...`, or else its default.
    """
    return [_flag_of(model, name, f"{prefix}{name.upper()}") for name in names]


def _flag_of(model: type[BaseModel], name: str, variable: str) -> inspect.Parameter:
    field, flag = model.model_fields[name], field_flag(model, name)
    kind = field.annotation
    if get_origin(kind) in (Union, types.UnionType):
        (kind,) = (each for each in get_args(kind) if each is not types.NoneType)
    if get_origin(kind) is tuple:  # one text, which the model splits
        kind = str
    default = default_of(model, name)
    option = typer.Option(
        *(flag.names or ("--" + name.replace("_", "-"),)),
        help=field.description,
        metavar=flag.metavar,
        show_default=f"{variable}, or {default}" if default else variable,
        min=_limit(field.metadata, "ge"),
        max=_limit(field.metadata, "le"),
    )
    annotation: Any = Annotated[kind | None, option]  # type: ignore[operator]  # it is a class at run time
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def _limit(constraints: Sequence[Any], name: str) -> Any:
    return next((getattr(each, name) for each in constraints if hasattr(each, name)), None)


def expanded(command: Callable[..., Any], groups: Mapping[str, Group]) -> Callable[..., Any]:
    """Return a command in which each parameter named in `groups` is replaced by its group of flags."""
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        if parameter.name in groups:
            parameters += groups[parameter.name].flags
        else:
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

    @functools.wraps(command)
    def run(**values: Any) -> Any:
        for name, group in groups.items():
            values[name] = group.compose(**{flag.name: values.pop(flag.name) for flag in group.flags})
        return command(**values)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # inspect.signature() reads it
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run
