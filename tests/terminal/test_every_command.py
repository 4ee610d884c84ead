"""Every command reads its flags with `terminal.command_line`, which test_usage.py tests."""

import importlib
import re
from pathlib import Path

import pytest
from typer.main import get_command

from terminal.command_line import CommandLine

ROOT = Path(__file__).parents[2]
SOURCES = [
    path
    for package in ("rosbayes", "services", "casestudies", "toolchain", "posteriors", "bridge", "pcie_shim")
    for path in sorted((ROOT / package).rglob("*.py"))
]
COMMANDS = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in SOURCES
    if re.search(r"^app\b.* = ", path.read_text(), re.MULTILINE)
}


def flags_of(command):
    yield from command.params
    for each in getattr(command, "commands", {}).values():
        yield from flags_of(each)


def test_the_commands_are_found():
    assert len(COMMANDS) == 18
    assert not [path for path in SOURCES if re.search(r"\btyper\.(Typer|run)\b", path.read_text())]


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_a_command_is_a_command_line_whose_timeouts_are_positive(name):
    app = importlib.import_module(name).app
    assert type(app) is CommandLine
    for flag in flags_of(get_command(app)):
        if flag.name.endswith("_timeout"):
            assert flag.type_descriptor.parameter_info.min > 0
