"""The command `status`."""

from typing import Annotated

import typer

from services.commands import flags as options
from services.errors import SettingsError
from services.output.status_screen import show
from services.settings import Settings
from services.sockets.stack import Found, find_run
from terminal.command_line import CommandLine
from terminal.signals import run_async

app = CommandLine(
    help="Show the whole stack in one screen: processes, boards and images, last frame, rates, losses by reason.\n\n"
    "`status` finds the only run of this user, and lists several, of which `--run NAME` selects one; "
    "`status --directory DIR` selects the processes with that BM_RUN_DIRECTORY.\n\n"
    "Exit codes: 0 everything is ready, 6 something is not, 2 nothing was found."
)


@app.command(help=app.info.help)
@options.with_settings("run_directory")
def status(
    context: typer.Context,
    settings: Settings,
    run: options.Run = None,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Refresh every second until Ctrl-C.")] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object; with --watch, one per line.")
    ] = False,
) -> int:
    """Show the whole stack in one screen."""
    named = None if run is not None else settings.run_directory
    if run is not None and context.params["run_directory"] is not None:
        raise SettingsError("--run and --run-directory both choose a run: omit one of them")
    if named is not None and not named.is_dir():
        raise SettingsError(
            f"{named} is not a folder; name the one with the status sockets (BM_RUN_DIRECTORY of the processes)"
        )

    async def show_run() -> int:
        found = Found(named, []) if named is not None else await find_run(run)
        return await show(found.run, found.others, watch=watch, json=json)

    return run_async(show_run())


if __name__ == "__main__":
    app()
