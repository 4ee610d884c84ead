"""The command `pcie-app`."""

from typing import Annotated

import typer

from services.boards.deployed import DeployedBoards
from services.commands import flags as options
from services.pipeline.pcie_app import ROLE, PcieApp
from services.pipes.lines import require_pipe
from services.pipes.pcie_app import compute_lines
from services.settings import Settings
from services.sockets.serving import board_endpoints, deployment_for, listening
from terminal.command_line import CommandLine
from terminal.signals import run_async

app = CommandLine(
    help="Drive the boards of a mini-cluster.\n\n"
    "Alone, it reads the output of `subscriber --deployment` from standard input and prints counts:\n\n"
    "`echo '{\"addresses\": [71, 50, 50, 45, 18, 72]}' | pcie-app -d build/boat --boards unix:/tmp/b/board0.sock,...`\n\n"
    "With `--listen ENDPOINT` it serves a master."
)


@app.command(help=app.info.help)
@options.with_settings(
    *("deployment", "boards", "stop", "peer_timeout", "board_timeout", "key_file"),
    *("metrics", "log_level", "log_format"),
)
def pcie_app(
    settings: Settings,
    listen: options.Listen = None,
    reprogram: Annotated[
        bool,
        typer.Option(
            "--reprogram/--no-reprogram",
            help="Program boards that hold another image, instead of refusing them.",
        ),
    ] = False,
    insecure: options.Insecure = False,
) -> int:
    """Drive the boards of a mini-cluster."""
    loaded = deployment_for(settings, images=True)
    deployed = DeployedBoards(settings, loaded, board_endpoints(settings, loaded), reprogram=reprogram)
    # the status is served from a thread, because the main one blocks while boards compute
    if listen is not None:
        link = listening(listen, ROLE, settings, loaded, insecure=insecure)
        return run_async(PcieApp(settings, deployed, link).run())
    require_pipe(ROLE, "readings")
    return compute_lines(deployed, loaded.machine.rng_banks)
