"""docs/reference/commands.md: the settings as their class declares them, and a row for every script."""

import importlib
import os
import re
from pathlib import Path

import pytest
from typer.main import get_command

from services.settings import ENV_PREFIX, Settings
from terminal.flags import default_of, field_flag

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/reference/commands.md").read_text()
ROWS = re.findall(r"^\| `(?:\. )?(scripts/[\w-]+(?: [a-z]+)?)", PAGE, re.MULTILINE)
COMMANDS = ("master", "subscriber", "publisher", "pcie_app", "board", "loader", "hub", "listen", "status")
OTHERS = {"hub": {"ros_version", "message_bytes"}, "board": {"boards"}}
"""Flags of a command that are not settings, but have the name of one."""


def flags_of(name):
    command = get_command(importlib.import_module(f"services.commands.{name}").app)
    return {flag.name for flag in command.params} - OTHERS.get(name, set())


def row(name):
    """The row of a setting, as the page has to contain it."""
    commands = [each.replace("_", "-") for each in COMMANDS if name in flags_of(each)]
    flags = field_flag(Settings, name).names or ("--" + name.replace("_", "-"),)
    cells = (
        f"`{ENV_PREFIX}{name.upper()}`",
        ", ".join(f"`{flag}`" for flag in flags) if commands else "",
        default_of(Settings, name),
        Settings.model_fields[name].description,
        ", ".join(commands),
    )
    return " | ".join(("", *cells, "")).strip().replace("|  ", "| ")


@pytest.mark.parametrize("name", Settings.model_fields)
def test_a_setting_has_the_row_of_its_declaration(name):
    assert row(name) in PAGE.splitlines()


def scripts():
    """The scripts of this folder, each with its names if it runs one of several modules."""
    for path in sorted((ROOT / "scripts").iterdir()):
        if path.is_file() and os.access(path, os.X_OK):
            found = re.search(r"^ +(\w+(?: \| \w+)+)\) exec python", path.read_text(), re.MULTILINE)
            names = [f" {name}" for name in found[1].split(" | ")] if found else [""]
            yield from (f"scripts/{path.name}{name}" for name in names)


def test_every_script_has_a_row():
    # the image's entry point is described on the page about containers
    described = {row if row in set(scripts()) else row.split()[0] for row in ROWS}
    assert set(scripts()) - {"scripts/with-kernels"} <= described
