"""The start and the end of every command. During the imports, Ctrl-C exits with code 130 and no traceback."""

# nothing that takes long to import, because Ctrl-C still shows a traceback meanwhile
import atexit
import gc
import os
import signal
import sys
from functools import partial

# the module of each command (a colon precedes a command of a group), and its line in `rosbayes --help`
COMMANDS = {
    "demo": ("casestudies.demo", "Run a case study, without a robot."),
    "toolchain": ("toolchain.commands.main", "From a model to a deployment."),
    "new": ("toolchain.commands.main:new", "Create a model from a template."),
    "build": ("toolchain.commands.main:build", "Build a deployment from a model or a network."),
    "regenerate": ("toolchain.commands.main:regenerate", "Write one part of a deployment again."),
    "check": ("toolchain.commands.main:check", "Report mistakes in a model or a deployment."),
    "inspect": ("toolchain.commands.main:inspect", "Explain a deployment."),
    "advise": ("toolchain.commands.main:advise", "Compare the machines for a model, and recommend one."),
    "explore": ("toolchain.commands.main:explore", "Sweep over machines for a model."),
    "infer": ("toolchain.commands.main:infer", "Compute the posterior of every row of a recording."),
    "fit": ("toolchain.commands.main:fit", "Learn the tables of a model from recordings."),
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
    "disparity-cameras": ("casestudies.disparity.cameras", "Publish stereo pairs of a simulated scene."),
    "disparity-matcher": ("casestudies.disparity.matcher", "Turn stereo pairs into disparity images."),
}


def __getattr__(name: str) -> object:
    """Return the entry-point function of a command: `pcie_app` for `pcie-app`."""
    module, _ = COMMANDS.get(name.replace("_", "-"), ("rosbayes.__main__" if name == "rosbayes" else "", ""))
    if not module:
        raise AttributeError(name)
    return partial(_start, module)


def _start(module: str) -> None:
    # until the command line has its own handlers (`terminal.signals`), when most modules are imported
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    from importlib import import_module

    gc.disable()  # imports leave no garbage, and searching it takes a tenth of their time
    app = import_module(module).app
    gc.enable()
    gc.freeze()
    code: object = None
    try:
        app()
    except SystemExit as end:
        code = end.code
    # at once, because unloading modules in the regular way takes up to half a second
    atexit._run_exitfuncs()  # noqa: SLF001 - os._exit does not
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else int(code is not None))
