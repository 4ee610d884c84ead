"""What `toolchain new` does: a model of one's own, from a template that runs."""

from __future__ import annotations

import re
import shlex
from importlib.resources import files
from typing import TYPE_CHECKING, Final

from toolchain.errors import BuildError

if TYPE_CHECKING:
    from pathlib import Path

_FILES: Final = ("model.py", "robot.py")


def new_model(folder: Path) -> str:
    """Write the template into a folder, and return what to do next.

    Args:
        folder: It is made; its last part names the model, its topic and nothing else.

    Raises:
        BuildError: A name that no topic can have, files that are there already, or a folder that can't be written.
    """
    name = folder.name
    if not re.fullmatch(r"[A-Za-z]\w{0,60}", name, re.ASCII):
        message = f"{name or str(folder)!r} names no model: expected a letter, then letters, digits and _"
        raise BuildError(message)
    for file in _FILES:
        if (folder / file).exists():
            message = f"{folder / file} is there already; choose another name"
            raise BuildError(message)
    if not folder.parent.is_dir():
        message = (
            f"{folder.parent} is no folder, so {name} can't be made in it: make it first, or correct the path"
        )
        raise BuildError(message)
    try:
        folder.mkdir(exist_ok=True)
        for file in _FILES:
            text = files("toolchain.commands").joinpath("template", file + ".txt").read_text(encoding="utf-8")
            (folder / file).write_text(text.replace("NAME", name), encoding="utf-8")
    except OSError as reason:
        message = f"{folder} can't be written: {reason.strerror or reason}"
        raise BuildError(message) from None
    return _next_steps(folder)


def _next_steps(folder: Path) -> str:
    where, built = shlex.quote(str(folder)), f"build/{folder.name}"
    return f"""Made {folder / "model.py"} and {folder / "robot.py"}. To build it:

    toolchain build {where} -o {built} --uri ws://127.0.0.1:9090 --topic /{folder.name}/readings --type std_msgs/Float64MultiArray

To run it, in a second and a third terminal a rosbridge server and what stands for the robot:

    hub
    python {shlex.quote(str(folder / "robot.py"))}

and in the first one:

    master --once -d {built}

Then change model.py, build it again, and point --uri at the robot.
"""
