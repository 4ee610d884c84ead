"""The pages name what exists, and everything that a user can set: paths, commands, flags, keys, limits, errors."""

import dataclasses
import importlib
import inspect
import os
import re
import shlex
import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel
from typer.main import get_command

from bridge.hub.limits import HubLimits
from machines.parameters import BM1Parameters
from pcie_shim import errors, framing
from rosbayes.__main__ import app
from services.settings import ENV_PREFIX, Settings
from terminal.flags import default_of, field_flag
from tests.bridge.hub.broker_harness import Harness
from toolchain.checks.findings import Check
from toolchain.deployment import DeploymentFile

ROOT = Path(__file__).parents[2]
PAGES = {path.relative_to(ROOT).as_posix(): path.read_text() for path in (ROOT / "docs").rglob("*.md")}
PAGES["README.md"] = (ROOT / "README.md").read_text()
ROOMS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["root_packages"]


# Paths, rooms and scripts


def test_paths_functions_and_rooms_of_the_house_exist():
    page = PAGES["docs/explanation/house.md"]
    paths = set(re.findall(r"`(\w+/[\w./]*)`", page))
    assert len(paths) > 40
    assert not [path for path in paths if not (ROOT / path).exists()]
    ways = page.split("## A reading's path", 1)[1]
    rows = re.findall(r"^\| [^|]+ \| `[^|]+\| (`[^|]+) \|$", ways, re.MULTILINE)
    names = {name.rsplit(".", 1)[-1] for row in rows for name in re.findall(r"`([\w.]+)`", row)}
    assert len(names) > 20
    sources = "\n".join(path.read_text() for room in ROOMS for path in (ROOT / room).rglob("*.py"))
    assert not [name for name in names if not re.search(rf"\b(def|class) {name}\b", sources)]


def test_every_script_has_a_row():
    page = PAGES["docs/reference/commands.md"]
    scripts = {
        path.name for path in (ROOT / "scripts").iterdir() if path.is_file() and os.access(path, os.X_OK)
    }
    # the image's entry point is described on the page about containers
    assert not [name for name in scripts - {"with-kernels"} if f"\n| `scripts/{name}" not in page]


# Printed commands


def printed(text):
    """The commands that are printed on a page, without the blocks of other languages."""
    joined = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL).replace("\\\n", " ")
    return re.findall(r"^    (\S.*)$", joined, re.MULTILINE)


def test_the_commands_of_readme_exist_with_their_flags():
    group, checked = get_command(app), 0
    for line in printed(PAGES["README.md"]):
        first, *words = shlex.split(line, comments=True)
        if first.startswith("scripts/"):
            assert (ROOT / first).is_file()
        if (name := first.rpartition("/")[2]) not in group.commands:
            continue
        command = group.resolve_command(None, [name])[1]
        if words and words[0] in getattr(command, "commands", {}):
            command = command.commands[words[0]]
        flags = {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
        assert {word for word in words if word.startswith("-")} <= flags, line
        checked += 1
    assert checked >= 5


def test_units_and_settings_of_the_pages_about_operation_are_known():
    text = "".join(PAGES[f"docs/how-to/{name}.md"] for name in ("containers", "hosts", "operating"))
    units = re.findall(r"`/etc/systemd/system/[\w@.-]+`:\n\n```ini\n(.*?)```", text, re.DOTALL)
    assert len(units) == 3
    commands = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for unit in units:
        assert re.search(r"^ExecStart=/opt/rosbayes/.venv/bin/([\w-]+)", unit, re.MULTILINE)[1] in commands
        assert "SuccessExitStatus=143" in unit
    assert set(re.findall(r"\bBM_[A-Z_]+", text)) <= {
        ENV_PREFIX + name.upper() for name in Settings.model_fields
    }


# What a user can set or meet


def documented(page, heading):
    """The names in the first column of the tables of a section."""
    section = re.split(r"\n##+ ", PAGES[f"docs/{page}.md"].split(f"\n## {heading}", 1)[1], maxsplit=1)[0]
    rows = re.findall(r"^\| (`.+?) \|", section, re.MULTILINE)
    return [key for row in rows for key in re.findall(r"`([^`]+)`", row)]


def options_of(*path):
    command = get_command(app).resolve_command(None, ["toolchain"])[1]
    for name in path:
        command = command.commands[name]
    names = {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
    return {name for name in names if name.startswith("-")} - {"--help", "-h"}


def sections():
    """The keys of each section of deployment.toml."""
    plain = []
    for name, field in DeploymentFile.model_fields.items():
        inner = [field.annotation, *getattr(field.annotation, "__args__", ())]
        models = [each for each in inner if isinstance(each, type) and issubclass(each, BaseModel)]
        key = str(field.validation_alias or name)
        if models:
            single = inner[0] is models[0] or type(None) in inner
            yield f"`[{key}]`" if single else f"`[[{key}]]`", list(models[0].model_fields)
        else:
            plain.append(key)
    yield "Top level", plain


def test_every_key_of_the_deployment_is_described():
    for heading, keys in sections():
        assert sorted(documented("reference/deployment", heading)) == sorted(keys)


def test_every_option_of_the_toolchain_is_described():
    for command, page, heading in (
        ("build", "reference/toolchain", "Options"),
        ("fit", "how-to/models", "6. Learning the tables"),
    ):
        assert {key.split(" ")[0] for key in documented(page, heading)} == options_of(command)
    section = PAGES["docs/reference/toolchain.md"].split("\n## One part again", 1)[1].split("\n## ", 1)[0]
    question = {"--set", "--searched", "--known", "--given", "--prior-select", "--on-missing"}
    options = set().union(*(options_of("regenerate", part) for part in ("memories", "project", "deployment")))
    assert not {name for name in options - question if name not in section}


def test_every_check_and_parameter_is_described():
    assert set(documented("reference/toolchain", "Checks before anything runs")) == set(Check) - {Check.RNG}
    for field in dataclasses.fields(BM1Parameters):
        assert f"| `{field.name}` |" in PAGES["docs/reference/machines.md"]


def test_every_limit_and_service_of_the_hub_is_described():
    services = Harness().connect().rosapi("node_details", node="/rosapi")["services"]
    assert services
    limits = [field.name for field in dataclasses.fields(HubLimits)]
    for name in (*limits, *(service.removeprefix("/rosapi/") for service in services)):
        assert f"`{name}`" in PAGES["docs/how-to/hub.md"]


def test_every_error_and_operation_of_a_board_is_described():
    page = PAGES["docs/reference/boards.md"]
    for name, error in inspect.getmembers(errors, inspect.isclass):
        if issubclass(error, errors.BoardError | errors.ImageError) and error is not errors.BoardError:
            assert f"| `{name}` | {error.exit_code} |" in page
    for name in ("GREET", "READ", "WRITE", "IRQ", "ERROR", "PROGRAM"):
        assert f"| {getattr(framing, name)} {name} |" in page


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
    assert row(name) in PAGES["docs/reference/commands.md"].splitlines()
