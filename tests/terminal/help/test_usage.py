"""Mistakes in a command line: one sentence with the mistake, its place, the expected value, and where to read more."""

import re
import sys
from enum import StrEnum
from typing import Annotated

import pytest
import typer

from terminal.command_line import CommandLine
from tests.command_runner import invoke


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


def make_app():
    app = CommandLine(no_args_is_help=True)

    @app.callback()
    def top():
        """Several commands."""

    @app.command()
    def paint(
        wall: Annotated[str, typer.Argument(help="The wall to paint, its doors, ...")],
        colour: Annotated[Colour, typer.Option("--colour", "-c", help="Its colour.")] = Colour.RED,
        coats: Annotated[int, typer.Option(min=1, max=9)] = 1,
        thickness: Annotated[float, typer.Option(min=0.1)] = 1.0,
        *,
        dry: Annotated[bool, typer.Option("--dry")] = False,
    ):
        print("painted", wall, colour, coats, thickness, dry)
        raise typer.Exit(7)

    return app


def run(*arguments):
    """(exit code, stdout, stderr)"""
    ended = invoke(make_app(), arguments)
    return ended.exit_code, ended.stdout, ended.stderr


@pytest.fixture(autouse=True)
def called_painter(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/painter"])
    # as an installed command, whatever runs the tests
    monkeypatch.setattr(sys.modules["__main__"], "__package__", None)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["paint", "w", "--colour", "green"], "--colour green: expected red or blue; painter paint --help"),
        (["paint", "w", "-c", "green"], "--colour green: expected red or blue;"),
        (["paint", "w", "--coats", "x"], "--coats x: expected a whole number from 1 to 9;"),
        (["paint", "w", "--coats", "10"], "--coats 10: expected a whole number from 1 to 9;"),
        (["paint", "w", "--coats", "1.5"], "--coats 1.5: expected a whole number from 1 to 9;"),
        (["paint", "w", "--thickness", "nan"], "--thickness nan: expected a number from 0.1;"),
        (["paint", "w", "--coats", "\x1b[1m"], r"--coats '\x1b[1m': expected a whole number"),
        (["paint"], "WALL is missing: the wall to paint, its doors, ...;"),
        (["paint", ""], "WALL '': expected a text that is not blank;"),
        (["paint", "w", "--thickness", "inf"], "--thickness inf: expected a number from 0.1;"),
        (["paint", "w", "--thickness", "1e400"], "--thickness 1e400: expected a number from 0.1;"),
        (["paint", "w", "--coats", " "], "--coats ' ': expected a whole number from 1 to 9;"),
        (["paint", "w", "--colou", "red"], "painter paint has no --colou (did you mean --colour?);"),
        (["paint", "w", "--coats"], "--coats needs a value; painter paint --help"),
        (["paint", "w", "--dry=1"], "--dry takes no value;"),
        (["paint", "a", "b"], "painter paint: got unexpected extra argument(s) (b);"),
        (["pant"], "painter: no such command 'pant'. Did you mean 'paint'?; painter --help says more"),
    ],
)
def test_a_mistake_is_one_sentence(arguments, sentence):
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {sentence}")
    assert err.endswith(" --help says more\n")
    assert err.count("\n") == 1


def test_what_is_right_runs_and_its_exit_code_counts():
    assert run("paint", "w", "--coats", "2") == (7, "painted w red 2 1.0 False\n", "")


def test_help_says_what_flags_take():
    code, out, _ = run("paint", "-h")
    assert code == 0
    assert "red|blue" in out
    assert re.search(r"--coats NUMBER +\[default: 1; 1 to 9\]", out)
    assert "WALL" in out


def test_no_command_is_answered_with_help():
    code, out, err = run()
    assert code == 2
    assert "paint" in out
    assert not err
