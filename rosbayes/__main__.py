"""The command `rosbayes`: `rosbayes hub` is `hub`. A subcommand's module is imported only when it is named."""

from importlib.metadata import version
from typing import Annotated, Final

import typer

from terminal.command_line import CommandLine

# each command line, and what it does in the list of `rosbayes --help`
_COMMANDS: Final = {
    "toolchain": ("toolchain.commands.main", "From a model to a deployment."),
    "query": ("toolchain.commands.main:query", "Print a posterior of a network, exact and of a machine."),
    "show": ("toolchain.commands.main:show", "List the variables of a network."),
    "master": ("services.commands.master", "Move readings to the boards and posteriors back."),
    "listen": ("services.commands.listen", "Print, draw or save the posteriors of a running stack."),
    "dashboard": ("services.commands.dashboard", "Show posteriors in a browser."),
    "status": ("services.commands.status", "Show the whole stack in one screen."),
    "hub": ("services.commands.hub", "Serve rosbridge without ROS."),
    "discover": ("services.commands.discover", "List the rosbridge servers on this network."),
    "subscriber": ("services.commands.subscriber", "Take variables out of a ROS topic."),
    "publisher": ("services.commands.publisher", "Publish posteriors over rosbridge."),
    "pcie-app": ("services.commands.pcie_app", "Drive the boards of a mini-cluster."),
    "board": ("services.commands.board", "Emulate boards of the mini-cluster."),
    "loader": ("services.commands.loader", "Program a board with an image."),
    "boat-simulator": ("casestudies.boat.simulator", "Publish the readings of a simulated boat."),
    "boat-normaliser": ("casestudies.boat.normaliser", "Turn raw readings into whole numbers in range."),
    "boat-viewer": ("casestudies.boat.viewer", "Show posteriors beside the boat's true position."),
    "sprinkler-garden": (
        "casestudies.sprinkler.garden",
        "Publish whether a simulated garden's grass is wet.",
    ),
    "sprinkler-viewer": ("casestudies.sprinkler.viewer", "Show how the estimate of rain converges."),
}

app = CommandLine(name="rosbayes")
for _name, (_module, _purpose) in _COMMANDS.items():
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

    Each subcommand is also a command of its own: `rosbayes hub` and `hub` are the same, and so are `rosbayes query` and
    `toolchain query`.
    """


if __name__ == "__main__":
    app()
