"""The command `listen`."""

import contextlib
from pathlib import Path
from typing import Annotated

import typer

from services.commands import flags as options
from services.errors import SettingsError
from services.output.listener import show_frames
from services.output.posterior_file import open_result_file
from services.output.posterior_output import drawing, print_json, print_line
from services.settings import LONGEST_S, Settings
from terminal.command_line import CommandLine
from terminal.signals import run_async

app = CommandLine(
    help="Print, draw or save the posteriors of a running stack.\n\n"
    "`listen --uri ws://robot:9090 --count 10`\n\n"
    "With `-d build/boat`, cells have values in their units, and the server is that of the deployment. `--plot` draws each "
    "posterior in the terminal; `--save posteriors.jsonl` (or .csv, .npz) saves them."
)


@app.command(help=app.info.help)
@options.with_settings(
    *("uri", "ca", "deployment", "first_data_timeout", "connect_timeout", "ros_version", "log_format")
)
def listen(
    settings: Settings,
    topic: options.ResultsTopic = None,
    count: options.Count = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per line, with the whole posterior.")
    ] = False,
    plot: Annotated[bool, typer.Option("--plot", help="Draw each posterior in the terminal.")] = False,
    save: Annotated[
        Path | None,
        typer.Option(
            help="Save to this file: .jsonl and .csv are appended to, .npz is overwritten.", metavar="FILE"
        ),
    ] = None,
    timeout: Annotated[
        float | None,
        typer.Option(
            min=0.1,
            max=LONGEST_S,
            help="Exit after this many seconds without a result.",
            show_default="it waits",
        ),
    ] = None,
) -> int:
    """Print, draw or save the posteriors of a running stack."""
    if as_json and plot:
        raise SettingsError("--json and --plot both use standard output: give one of them")
    loaded, server, where = options.results_of(settings, topic)
    if server is None:
        raise SettingsError("give --uri ws://HOST:PORT, or --deployment DIR (listen --help shows examples)")
    # opened before the connection: a run that cannot be saved would be lost
    with contextlib.ExitStack() as stack:
        file = open_result_file(save) if save is not None else None
        if file is not None:
            stack.callback(file.close)
        show = stack.enter_context(drawing()) if plot else print_json if as_json else print_line
        return run_async(
            show_frames(
                settings, loaded, uri=server, topic=where, count=count, silence=timeout, show=show, file=file
            )
        )
