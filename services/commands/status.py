"""The command `status`."""

from typing import Annotated

import typer

from services.commands import flags as options
from services.errors import SettingsError
from services.output.status_screen import show
from services.settings import Settings
from terminal.command_line import CommandLine
from terminal.run_directory import default_run_directory
from terminal.signals import run_async

app = CommandLine(
    help="Show the whole stack in one screen: processes, boards and images, last frame, rates, losses by reason.\n\n"
    "Exit codes: 0 everything is ready, 6 something is not, 2 nothing was found."
)


@app.command(help=app.info.help)
@options.with_settings("run_directory")
def status(
    settings: Settings,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Refresh every second until Ctrl-C.")] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object; with --watch, one per line.")
    ] = False,
) -> int:
    """Show the whole stack in one screen."""
    named = settings.run_directory
    if named is not None and not named.is_dir():
        raise SettingsError(
            f"{named} is not a folder; name that of the processes (their --run-directory or BM_RUN_DIRECTORY)"
        )
    # a hub alone is not a stack, unless the user has named its directory
    directory = named or default_run_directory()
    return run_async(show(directory, needs_master=named is None, watch=watch, json=json))


if __name__ == "__main__":
    app()
