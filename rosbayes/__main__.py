"""The command `rosbayes`: `rosbayes hub` is `hub`. A subcommand's module is imported only when it is named."""

from importlib.metadata import version
from typing import Annotated, Final

import typer

from terminal.command_line import CommandLine

_RUNNING: Final = "Running a deployment"
_MODELS: Final = "Models"
_SERVERS: Final = "rosbridge servers"
_PROCESSES: Final = "Processes that a master starts"
_BOAT: Final = "The boat case study"

app = CommandLine(name="rosbayes", no_args_is_help=True)
for name, place, panel, purpose in (
    ("toolchain", "toolchain.commands.main", _MODELS, "From a model to a deployment."),
    ("master", "services.commands.master", _RUNNING, "Move readings to the boards and posteriors back."),
    (
        "listen",
        "services.commands.listen",
        _RUNNING,
        "Print, draw or save the posteriors of a running stack.",
    ),
    ("status", "services.commands.status", _RUNNING, "Show the whole stack in one screen."),
    ("hub", "services.commands.hub", _SERVERS, "Serve rosbridge without ROS."),
    ("discover", "services.commands.discover", _SERVERS, "List the rosbridge servers on this network."),
    ("subscriber", "services.commands.subscriber", _PROCESSES, "Take variables out of a ROS topic."),
    ("publisher", "services.commands.publisher", _PROCESSES, "Publish posteriors over rosbridge."),
    ("pcie-app", "services.commands.pcie_app", _PROCESSES, "Drive the boards of a mini-cluster."),
    ("board", "services.commands.board", _PROCESSES, "Emulate boards of the mini-cluster."),
    ("loader", "services.commands.loader", _PROCESSES, "Program a board with an image."),
    ("boat-simulator", "casestudies.boat.simulator", _BOAT, "Publish the readings of a simulated boat."),
    (
        "boat-normaliser",
        "casestudies.boat.normaliser",
        _BOAT,
        "Turn raw readings into whole numbers in range.",
    ),
    ("boat-viewer", "casestudies.boat.viewer", _BOAT, "Show posteriors beside the boat's true position."),
):
    app.add_later(name, place, purpose=purpose, panel=panel)


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

    Each subcommand is also a command of its own: `rosbayes hub` and `hub` are the same.
    """


if __name__ == "__main__":
    app()
