"""Numbers and texts behind flags: of every command, each flag refuses what it can't use, and the value is seen."""

import importlib
import sys

import pytest
from typer.main import get_command

from terminal.command_line import CommandLine

MODULES = (
    *(f"services.commands.{name}" for name in ("master", "board", "loader")),
    *(f"services.pipeline.{name}" for name in ("subscriber", "publisher", "pcie_app")),
    *(f"services.commands.{name}" for name in ("hub", "discover", "listen", "status")),
    *(f"casestudies.boat.{name}" for name in ("simulator", "normaliser", "viewer")),
    *("casestudies.mrclam.convert", "casestudies.mrclam.player", "toolchain.commands.main"),
)


def flags_of(command, path=()):
    """Every flag that takes a value: the words before it, itself, and its type."""
    for parameter in command.params:
        if parameter.param_type_name == "option" and not parameter.is_flag:
            yield path, max(parameter.opts, key=len), parameter.type_descriptor
    for name, each in getattr(command, "commands", {}).items():
        yield from flags_of(each, (*path, name))


def every_flag():
    for module in MODULES:
        app = importlib.import_module(module).app
        assert isinstance(app, CommandLine)
        for path, flag, kind in flags_of(get_command(app)):
            yield pytest.param(app, path, flag, kind, id=" ".join((module.split(".")[-1], *path, flag)))


def refused(capsys, monkeypatch, app, path, flag, value):
    """The one sentence about a value."""
    monkeypatch.setattr(sys, "argv", ["/usr/bin/it"])
    monkeypatch.setattr(sys.modules["__main__"], "__package__", None)
    with pytest.raises(SystemExit) as ended:
        app([*path, f"{flag}={value}"])
    out, err = capsys.readouterr()
    assert (ended.value.code, out) == (2, "")
    assert err.count("\n") == 1
    assert err.endswith(f"; {' '.join(('it', *path))} --help says more\n")
    return err.removeprefix("error: ").removesuffix("\n")


FLAGS = list(every_flag())
TIMEOUTS = [
    each
    for each in FLAGS
    if each.values[3].annotation is float
    and each.values[2].endswith("timeout")
    and each.values[2] != "--seen-timeout"
]
COMMANDS = {(id(each.values[0]), each.values[1]): each for each in FLAGS}


@pytest.mark.parametrize(("app", "path", "flag", "kind"), FLAGS)
def test_what_no_flag_can_use(capsys, monkeypatch, app, path, flag, kind):
    said = refused(capsys, monkeypatch, app, path, flag, " ")
    assert said.startswith(f"{flag} ' ': expected ")
    if kind.annotation not in {int, float}:
        return
    word = "a whole number" if kind.annotation is int else "a number"
    for value, seen in (
        ("nan", "nan"),
        ("inf", "inf"),
        ("-1e400", "-1e400"),
        ("\x1b[2J\n1", r"'\x1b[2J\n1'"),
    ):
        said = refused(capsys, monkeypatch, app, path, flag, value)
        assert said.startswith(f"{flag} {seen}: expected {word}")


@pytest.mark.parametrize(("app", "path", "flag", "kind"), TIMEOUTS)
def test_a_time_out_says_its_limits(capsys, monkeypatch, app, path, flag, kind):
    for value in ("-1", "0"):
        said = refused(capsys, monkeypatch, app, path, flag, value)
        assert said.startswith(f"{flag} {value}: expected a number from 0.")


@pytest.mark.parametrize(("app", "path", "flag", "kind"), COMMANDS.values())
def test_a_flag_without_its_value_names_its_own_subcommand(capsys, monkeypatch, app, path, flag, kind):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/it"])
    monkeypatch.setattr(sys.modules["__main__"], "__package__", None)
    with pytest.raises(SystemExit):
        app([*path, flag])
    command = " ".join(("it", *path))
    assert capsys.readouterr().err == f"error: {flag} needs a value; {command} --help says more\n"
