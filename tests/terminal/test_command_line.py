"""Command lines: a mistake is a sentence and exit code 2, and every end has its code: signals, full disks, bugs."""

import importlib
import os
import re
import signal
import subprocess
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.main import get_command

from services.errors import SettingsError
from terminal.command_line import CommandLine
from terminal.ending import outcome
from terminal.errors import ExitCode, StoppedError
from terminal.signals import run_async
from tests.command_runner import invoke
from tests.patience import PROCESS_PATIENCE

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
    assert len(COMMANDS) > 15
    assert not [path for path, text in SOURCES.items() if re.search(r"\btyper\.(Typer|run)\b", text)]
    for name in COMMANDS:
        app = importlib.import_module(name).app
        assert type(app) is CommandLine
        for flag in flags_of(get_command(app)):
            if flag.name.endswith("_timeout"):
                assert flag.type_descriptor.parameter_info.min > 0


# The end of a command

PROGRAM = """
import os, signal, threading, time
from terminal.command_line import CommandLine
from terminal.output import print_json_line
from terminal.signals import check_signals, run_async
app = CommandLine(help="a command")

async def work():
    return 0

@app.command()
def command():
    {body}

app()
"""


def end_of(body, *arguments, stdout=subprocess.DEVNULL):
    """Run a command with this body; return its exit code and what it wrote to standard error."""
    code = PROGRAM.replace("{body}", body.strip().replace("\n", "\n    "))
    ended = subprocess.run(
        [sys.executable, "-W", "error", "-c", code, *arguments],
        check=False,
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        timeout=PROCESS_PATIENCE,
        # Unbuffered, Python reports a full disk without a flush at the end.
        env={name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"},
    )
    return ended.returncode, ended.stderr.splitlines()


RAISE = "signal.raise_signal(signal.SIGTERM)"
PLACES = {
    "waiting": "threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGTERM)).start()\ntime.sleep(20)",
    "catching Exception": f"try:\n    {RAISE}\nexcept Exception:\n    pass\ntime.sleep(20)",
    # Python drops the exception in these two; the next check finds it
    "in a C callback": f"import ctypes\nctypes.CFUNCTYPE(None)(lambda: {RAISE})()\ncheck_signals()\ntime.sleep(20)",
    "in a finaliser": f"class Held:\n    def __del__(self):\n        {RAISE}\nHeld()\ncheck_signals()\ntime.sleep(20)",
    "after a coroutine": f"run_async(work())\n{RAISE}\ntime.sleep(20)",
    "while forking": f"os.register_at_fork(after_in_parent=lambda: {RAISE})\nos.fork() or os._exit(0)\ncheck_signals()",
}


@pytest.mark.thorough
@pytest.mark.parametrize("place", PLACES)
def test_a_signal_ends_a_command_wherever_it_is(place):
    assert end_of(PLACES[place]) == (ExitCode.TERMINATED, ["terminated (SIGTERM)"])


@pytest.mark.parametrize("ending", ["return", "raise OSError"])
def test_a_signal_that_arrives_when_a_command_has_ended(monkeypatch, ending):
    """It interrupts the call that would have it ignored."""
    calls = []

    def interrupted():
        calls.append(ending)
        if len(calls) == 1:
            raise StoppedError(ExitCode.INTERRUPTED, "interrupted (Ctrl-C)")

    def command():
        if ending != "return":
            raise OSError

    monkeypatch.setattr("terminal.ending.ignore_signals", interrupted)
    assert outcome(command) == ExitCode.INTERRUPTED
    assert len(calls) == 2


def test_a_signal_that_arrives_while_a_class_is_made(monkeypatch, capsys):
    """Python 3.11 wraps it in a RuntimeError."""

    class Named:
        def __set_name__(self, *_):
            raise StoppedError(ExitCode.TERMINATED, "terminated (SIGTERM)")

    def command():
        type("Made", (), {"name": Named()})

    monkeypatch.setattr("terminal.ending.ignore_signals", lambda: None)
    assert outcome(command) == ExitCode.TERMINATED
    assert capsys.readouterr().err == "terminated (SIGTERM)\n"


@pytest.mark.parametrize(
    "replaced", [ImportError("numba._devicearray failed to import"), SettingsError("this needs numba")]
)
def test_a_signal_is_the_reason_of_what_fails_after_it(replaced):
    """The C code of numba prints the exception of a signal that interrupts its import, and raises another one."""
    app = CommandLine(help="a command")

    @app.command()
    def command():
        try:
            signal.raise_signal(signal.SIGTERM)
        except StoppedError:
            sys.excepthook(*sys.exc_info())
        raise replaced

    ended = invoke(app, [])
    assert (ended.exit_code, ended.output) == (ExitCode.TERMINATED, "terminated (SIGTERM)\n")


def test_a_dropped_signal_ends_a_coroutine_before_it_begins():
    app, began = CommandLine(help="a command"), []

    class Held:
        def __del__(self):
            signal.raise_signal(signal.SIGTERM)

    async def work():
        began.append(True)

    @app.command()
    def command():
        Held()  # Python drops what its finaliser raises
        return run_async(work())

    ended = invoke(app, [])
    assert (ended.exit_code, began) == (ExitCode.TERMINATED, [])


@pytest.mark.thorough
def test_a_dropped_signal_counts_at_the_end_of_a_command():
    body = "import ctypes\nctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))()"
    assert end_of(body)[0] == ExitCode.INTERRUPTED


@pytest.mark.thorough
@pytest.mark.parametrize("command", [["print(1)"], ["print_json_line(1)"], ["pass", "--help"]])
def test_a_full_disk_behind_standard_output_is_one_sentence(command):
    with Path("/dev/full").open("w") as full:
        code, lines = end_of(*command, stdout=full)
    assert (code, len(lines)) == (ExitCode.USAGE, 1)


@pytest.mark.thorough
def test_too_few_open_files_are_one_sentence():
    limit = "import resource\nresource.setrlimit(resource.RLIMIT_NOFILE, (3, 3))\n"
    code, lines = end_of(limit + "run_async(work())")
    assert code == ExitCode.USAGE
    assert not any("Traceback" in line for line in lines)


@pytest.mark.thorough
def test_a_file_that_the_system_refuses_is_one_sentence():
    code, lines = end_of("open('/nowhere/at/all')")
    assert (code, len(lines)) == (ExitCode.USAGE, 1)
    assert "/nowhere/at/all" in lines[0]


@pytest.mark.process
def test_a_reader_that_has_enough_is_not_an_error():
    code, lines = end_of("raise BrokenPipeError")
    assert (code, lines) == (ExitCode.DONE, [])


@pytest.mark.process
def test_only_a_bug_shows_a_traceback():
    code, lines = end_of("raise ZeroDivisionError")
    assert code == ExitCode.BUG
    assert any("Traceback" in line for line in lines)
