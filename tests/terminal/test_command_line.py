"""Command lines: mistakes end with one sentence and exit code 2, help is typer's, results are exit codes."""

import importlib
import re
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.main import get_command

from terminal.command_line import CommandLine
from tests.command_runner import invoke

ROOT = Path(__file__).parents[2]
PACKAGES = ("rosbayes", "services", "casestudies", "toolchain", "posteriors", "bridge", "pcie_shim")
SOURCES = {path: path.read_text() for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


def run(*arguments):
    """(exit code, stdout, stderr)"""
    app = CommandLine()

    @app.callback()
    def top():
        """Several commands."""

    @app.command()
    def paint(
        wall: Annotated[str, typer.Argument(help="The wall to paint.")],
        colour: Annotated[Colour, typer.Option("--colour", "-c", help="Its colour.")] = Colour.RED,
        coats: Annotated[int, typer.Option(min=1, max=9)] = 1,
        thickness: Annotated[float, typer.Option(min=0.1)] = 1.0,
        place: Annotated[Path, typer.Option()] = Path(),
        *,
        dry: Annotated[bool, typer.Option("--dry")] = False,
    ):
        print("painted", wall, colour, coats, thickness, place, dry)
        raise typer.Exit(7)

    ended = invoke(app, arguments)
    return ended.exit_code, ended.stdout, ended.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["paint", "w", "--colour", "green"],
        ["paint", "w", "--coats", "x\x1b[1m\n"],
        ["paint", "w", "--coats", "10"],
        ["paint", "w", "--thickness", "nan"],
        ["paint", "w", "--thickness", "1e400"],
        ["paint", "w", "--place", " "],
        ["paint", ""],
        ["paint"],
        ["paint", "w", "--colou\x1b", "red"],
        ["paint", "w", "--coats"],
        ["paint", "w", "--dry=1"],
        ["paint", "a", "b\n"],
        ["pant"],
    ],
)
def test_a_mistake_is_one_sentence(monkeypatch, arguments):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/painter"])
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.endswith(" --help says more\n")
    assert err.removesuffix("\n").isprintable()


def test_what_is_right_runs_and_its_exit_code_counts():
    assert run("paint", "w", "--coats", "2") == (7, "painted w red 2 1.0 . False\n", "")


def test_help_names_flags_and_no_command_is_answered_with_it():
    code, out, _ = run("paint", "-h")
    assert code == 0
    assert "--coats" in out
    code, out, err = run()
    assert (code, err) == (2, "")
    assert "paint" in out


COMMANDS = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path, text in SOURCES.items()
    if re.search(r"^app\b.* = ", text, re.MULTILINE)
}


def flags_of(command):
    yield from command.params
    for each in getattr(command, "commands", {}).values():
        yield from flags_of(each)


def test_every_command_is_a_command_line_whose_timeouts_are_positive():
    assert len(COMMANDS) == 18
    assert not [path for path, text in SOURCES.items() if re.search(r"\btyper\.(Typer|run)\b", text)]
    for name in COMMANDS:
        app = importlib.import_module(name).app
        assert type(app) is CommandLine
        for flag in flags_of(get_command(app)):
            if flag.name.endswith("_timeout"):
                assert flag.type_descriptor.parameter_info.min > 0
