"""The pages of `--help`: groups, and one style for values, defaults, variables and limits."""

import re

import pytest
from typer.main import get_command

from rosbayes.__main__ import app
from services.settings import Settings
from terminal.help.usage import metavar
from tests.command_runner import invoke

SCREENS = 2
LINES = 50


def commands(group, path=()):
    for name in group.commands:
        command = group.resolve_command(None, [name])[1]
        yield (*path, name), command
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))


COMMANDS = dict(commands(get_command(app)))
FLAGS = [
    pytest.param(flag, id=f"{'-'.join(path)}{flag.opts[0]}")
    for path, command in COMMANDS.items()
    for flag in command.params
]


def page(path, monkeypatch, columns=100):
    monkeypatch.setenv("COLUMNS", str(columns))
    ended = invoke(app, [*path, "--help"])
    assert ended.exit_code == 0
    return ended.stdout


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_a_page_fits_two_screens_and_groups_what_is_more_than_one(path, monkeypatch):
    lines = page(path, monkeypatch).splitlines()
    assert len(lines) <= SCREENS * LINES
    groups = [line for line in lines if re.fullmatch(r"\S.*:", line) and not line.endswith("`:")]
    assert "Other:" in groups
    if len(lines) > LINES:
        assert len(groups) >= 5


@pytest.mark.parametrize("flag", FLAGS)
def test_a_default_is_never_prose(flag):
    assert not re.search(r"\(\d+\)|\bdefault", flag.help or "", re.IGNORECASE)
    assert metavar(flag) is not None


def test_an_address_has_one_form_everywhere():
    uris = {metavar(flag.values[0]) for flag in FLAGS if "--uri" in flag.values[0].opts}
    assert uris == {"ws://HOST:PORT|robot:NAME"}


@pytest.mark.parametrize("command", ["master", "subscriber", "publisher", "pcie-app", "listen", "loader"])
def test_a_setting_names_its_variable_and_its_default(command, monkeypatch):
    text = " ".join(page([command], monkeypatch).split())
    flags = {name for each in COMMANDS[command,].params for name in each.opts}
    for name, field in Settings.model_fields.items():
        if f"--{name.replace('_', '-')}" in flags:
            known = f", or {field.default}" if field.default else ""
            assert re.search(rf"\[default: BM_{name.upper()}{known}[],;]", text)


def test_a_page_has_defaults_limits_and_what_is_required(monkeypatch):
    hub = " ".join(page(["hub"], monkeypatch).split())
    assert "[default: 9090; 0 to 65535]" in hub
    build = " ".join(page(["toolchain", "build"], monkeypatch).split())
    assert "--shared / --per-cell" in build
    assert "[default: --shared]" in build
    assert "[required]" in build
    assert "[default: BM_URI, or ws://127.0.0.1:9090]" in " ".join(page(["boat-viewer"], monkeypatch).split())


def test_an_example_is_not_wrapped(monkeypatch):
    example = "    hub --host 0.0.0.0 --tls-cert cert.pem --tls-key key.pem --token-file tokens.txt"
    assert example in page(["hub"], monkeypatch, columns=60).splitlines()
