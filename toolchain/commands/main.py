"""The `toolchain` command (thesis 3.4) and its subcommands."""

from terminal.command_line import CommandLine
from toolchain.commands import regenerate

# NumPy and modules that need it are imported inside these functions, so that --help is fast.
from toolchain.commands.build import build
from toolchain.commands.check import check
from toolchain.commands.explore import explore
from toolchain.commands.fit import fit
from toolchain.commands.flags import add_commands
from toolchain.commands.inspect import inspect
from toolchain.commands.new import new

app = CommandLine()
app.add_typer(regenerate.app, name="regenerate")
add_commands(app, build, check, inspect, explore, fit, new)


@app.callback()
def toolchain() -> None:
    """Build, check and inspect deployments of Bayesian machines, from models in Python or network files."""
