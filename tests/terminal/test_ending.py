"""The end of a command: signals, full disks, too few files."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from services.errors import SettingsError
from terminal.command_line import CommandLine
from terminal.ending import outcome
from terminal.errors import ExitCode, StoppedError
from tests.command_runner import invoke
from tests.patience import PROCESS_PATIENCE

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
    assert end_of(PLACES[place]) == (ExitCode.TERMINATED, ["asked to end (SIGTERM)"])


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
            raise StoppedError(ExitCode.TERMINATED, "asked to end (SIGTERM)")

    def command():
        type("Made", (), {"name": Named()})

    monkeypatch.setattr("terminal.ending.ignore_signals", lambda: None)
    assert outcome(command) == ExitCode.TERMINATED
    assert capsys.readouterr().err == "asked to end (SIGTERM)\n"


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
    assert (ended.exit_code, ended.output) == (ExitCode.TERMINATED, "asked to end (SIGTERM)\n")


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
