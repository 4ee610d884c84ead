"""The command `rosbayes`, which runs the other commands. It imports only the module of the given subcommand."""

from importlib.metadata import version
from typing import Annotated

import typer

from rosbayes.start import COMMANDS
from terminal.command_line import CommandLine

app = CommandLine(name="rosbayes")
for _name, (_module, _purpose) in COMMANDS.items():
    app.add_later(_name, _module, purpose=_purpose)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"rosbayes {version('rosbayes')}")
        raise typer.Exit


@app.callback()
def rosbayes(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """Bayesian machines for any ROS robot.

    Start with `rosbayes demo`. All other subcommands have a second name: `rosbayes hub` is also `hub`, and
    `rosbayes build` is also `toolchain build`.
    """


if __name__ == "__main__":
    app()
