"""The `toolchain` command (thesis 3.4): its subcommands, and its end on a signal."""

import signal
from types import FrameType

import typer

from terminal.command_line import CommandLine
from toolchain.commands import regenerate

# NumPy and what needs it are imported inside these functions, so that --help answers at once.
from toolchain.commands.build import build
from toolchain.commands.check import check
from toolchain.commands.explore import explore
from toolchain.commands.fit import fit
from toolchain.commands.inspect import inspect
from toolchain.commands.new import new
from toolchain.commands.registration import add_commands

app = CommandLine(no_args_is_help=True)
app.add_typer(regenerate.app, name="regenerate")
add_commands(app, build, check, inspect, explore, fit, new)


@app.callback()
def toolchain() -> None:
    """From a model, in Python or in a network's file, to everything a Bayesian machine needs."""


def main() -> None:
    """Run the `toolchain` command; SIGINT ends it with 130 and SIGTERM with 143."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _end)
    app()


def _end(number: int, _frame: FrameType | None) -> None:
    typer.echo(f"error: ended by {signal.Signals(number).name}; what was asked for is not complete", err=True)
    raise SystemExit(128 + number)
