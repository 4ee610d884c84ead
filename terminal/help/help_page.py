"""The page of `--help`: usage, text, and flags in groups, all in one style."""

import inspect
from typing import Any, Final

from typer.core import TyperArgument

from terminal.help.usage import Parameter, metavar

WIDTH: Final = 100
"""Columns of a page at most."""
_COLUMN: Final = 34
"""Columns for a flag and its value; the meaning of a longer one begins on the next line."""
_OTHER: Final = {
    "install_completion": "Install completion for this shell.",
    "show_completion": "Show the completion for this shell.",
    "help": "Show this page.",
}
"""Flags that every command has."""


def write_help(command: Any, context: Any, formatter: Any) -> None:
    """Write the help of a command or a group to a formatter of its library.

    A paragraph that is one command in backticks is not wrapped, so that it can be copied.
    """
    command.format_usage(context, formatter)
    text = "\n\n".join(filter(None, (command.help, command.epilog)))
    for paragraph in inspect.cleandoc(text).split("\n\n"):
        formatter.write_paragraph()
        if paragraph.startswith("`") and paragraph.count("`") == 2 and paragraph.endswith("`"):
            formatter.write(f"    {' '.join(paragraph.strip('`').split())}\n")
        else:
            formatter.write_text(paragraph)
    groups: dict[str, list[tuple[str, str]]] = {}
    for name, each in getattr(command, "commands", {}).items():
        groups.setdefault(each.rich_help_panel or "Commands", []).append(
            (name, each.get_short_help_str(WIDTH))
        )
    shown = [each for each in command.get_params(context) if not each.hidden]
    for parameter in sorted(shown, key=_rank):
        groups.setdefault(_group(parameter), []).append((_flag(parameter), _meaning(parameter, context)))
    for group, rows in groups.items():
        with formatter.section(group):
            formatter.write_dl(rows, col_max=_COLUMN)


def _rank(parameter: Parameter) -> int:
    """Return 0 for arguments, which come first, and 2 for the flags of every command, which come last."""
    return 0 if isinstance(parameter, TyperArgument) else 2 if parameter.name in _OTHER else 1


def _group(parameter: Parameter) -> str:
    return parameter.rich_help_panel or ("Arguments", "Options", "Other")[_rank(parameter)]


def _flag(parameter: Parameter) -> str:
    """Return a flag as it is typed, with the word for its value."""
    if isinstance(parameter, TyperArgument):
        return f"{metavar(parameter)}{'...' if parameter.nargs != 1 else ''}"
    names = ", ".join(sorted(parameter.opts, key=len))
    names += "".join(f" / {each}" for each in parameter.secondary_opts)
    return names if parameter.name in _OTHER else f"{names} {metavar(parameter)}".rstrip()


def _meaning(parameter: Parameter, context: Any) -> str:
    """Return the meaning of a flag, and in brackets its default, the variable that sets it, and its limits."""
    if parameter.name in _OTHER:
        return _OTHER[parameter.name]
    default = _default(parameter, context)
    if variable := parameter.envvar:
        default = f"{variable}, or {default}" if default else str(variable)
    notes = [f"default: {default}"] if default else []
    if parameter.required:
        notes.append("required")
    limits = parameter.type_descriptor.parameter_info
    # those of other numbers only keep typing errors out
    if parameter.type_descriptor.annotation is int and limits.min is not None:
        notes.append(f"{limits.min} or more" if limits.max is None else f"{limits.min} to {limits.max}")
    return " ".join([parameter.help or "", f"[{'; '.join(notes)}]" if notes else ""]).strip()


def _default(parameter: Parameter, context: Any) -> str:
    """Return the default as it would be typed, or nothing if a flag that is not given does nothing."""
    if isinstance(parameter.show_default, str):
        return parameter.show_default
    value = parameter.get_default(context)
    if isinstance(value, bool) and parameter.secondary_opts:
        return (parameter.opts if value else parameter.secondary_opts)[0]
    if value is None or value is False or value == "" or not parameter.show_default:
        return ""
    return f"{value:g}" if isinstance(value, float) else str(getattr(value, "value", value))
