"""The `toolchain new` command, which creates a runnable model from a template."""

import re
import shlex
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Final

import typer

from toolchain.errors import BuildError

_FILES: Final = ("model.py", "robot.py")


def new(
    name: Annotated[Path, typer.Argument(help="Folder to create; its last part is the name of the model.")],
) -> None:
    """Create a model from a runnable template: a robot in a corridor.

    For example `toolchain new mymodel`; it prints the next steps.
    """
    model = name.name
    if not re.fullmatch(r"[A-Za-z]\w{0,60}", model, re.ASCII):
        raise BuildError(
            f"{model or str(name)!r} is not a model's name: expected a letter, then letters, digits and _"
        )
    for file in _FILES:
        if (name / file).exists():
            raise BuildError(f"{name / file} already exists; choose another name")
    if not name.parent.is_dir():
        raise BuildError(
            f"{name.parent} is not a folder, so {model} cannot be created in it; create it first, or correct the path"
        )
    try:
        name.mkdir(exist_ok=True)
        for file in _FILES:
            text = files("toolchain.commands").joinpath("template", file + ".txt").read_text(encoding="utf-8")
            (name / file).write_text(text.replace("NAME", model), encoding="utf-8")
    except OSError as reason:
        raise BuildError(f"{name} cannot be written: {reason.strerror or reason}") from None
    typer.echo(_next_steps(name), nl=False)


def _next_steps(folder: Path) -> str:
    where, built = shlex.quote(str(folder)), f"build/{folder.name}"
    return f"""Made {folder / "model.py"} and {folder / "robot.py"}. To build it:

    toolchain build {where} -o {built} --uri ws://127.0.0.1:9090 --topic /{folder.name}/readings --type std_msgs/Float64MultiArray

To run it, start a rosbridge server in a second terminal, and the simulated robot in a third:

    hub
    python {shlex.quote(str(folder / "robot.py"))}

and in the first one:

    master --once -d {built}

Then change model.py, build it again, and point --uri at the robot.
"""
