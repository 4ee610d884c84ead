"""The umbrella command: its subcommands, what it imports for them, its completion and its version."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from typer.main import get_command

from rosbayes import start
from rosbayes.__main__ import app
from rosbayes.start import COMMANDS
from tests.command_runner import invoke
from tests.patience import PATIENCE
from toolchain.commands import main

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SCRIPTS = {name: module for name, (module, _) in COMMANDS.items() if ":" not in module}
HEAVY = {"numba", "numpy", "pydantic", "websockets"}


def run_apart(code, **environment):
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | environment,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert not done.stderr
    return done.stdout


def test_its_subcommands_are_the_other_commands():
    group = get_command(app)
    parts = set(get_command(main.app).commands)
    assert set(group.commands) == set(SCRIPTS) | parts
    for name in parts:
        assert group.resolve_command(None, [name])[1].name == name
    for name, place in SCRIPTS.items():
        loaded = group.resolve_command(None, [name])[1]
        assert loaded.callback.__module__ in {place, f"{place.rpartition('.')[0]}.main"}


def test_every_command_has_an_entry_point():
    scripts = PROJECT["scripts"]
    # `demo` alone would be a name for anything
    assert set(scripts) | {"demo"} == {"rosbayes", *SCRIPTS}
    for name, place in scripts.items():
        assert place == f"rosbayes.start:{name.replace('-', '_')}"
        assert callable(getattr(start, place.partition(":")[2]))
    assert not hasattr(start, "bord")


@pytest.mark.thorough
@pytest.mark.parametrize("command", ["hub", "rosbayes", "board"])
def test_ctrl_c_during_the_imports_ends_a_command_silently(command):
    code = f"""
import signal, sys
class Interrupting:
    def find_spec(self, name, *_):
        if name == "typer":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
from rosbayes.start import {command}
{command}()
"""
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, timeout=PATIENCE, check=False
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, b"", b"")


@pytest.mark.parametrize(
    ("arguments", "not_imported"),
    [([], HEAVY), (["hub"], {"numba", "numpy"}), (["toolchain", "build"], {"numba", "numpy"})],
)
@pytest.mark.thorough
def test_help_imports_only_the_named_subcommand(arguments, not_imported):
    code = f"""
import contextlib, io, sys
from rosbayes.__main__ import app
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
    app({[*arguments, "--help"]})
print(*sys.modules)
"""
    loaded = set(run_apart(code).split())
    assert not loaded & not_imported
    assert ("services.commands.hub" in loaded) is (arguments == ["hub"])


def test_a_subcommand_has_the_flags_and_exit_codes_of_the_command():
    ended = invoke(app, ["board", "--boards", "0"])
    assert ended.exit_code == 2
    assert " board --help" in ended.stderr
    assert invoke(app, ["bord"]).exit_code == 2


@pytest.mark.thorough
def test_one_completion_serves_all_subcommands():
    shown = run_apart(
        "import sys; sys.argv = ['rosbayes']; from rosbayes.__main__ import app; app()",
        _ROSBAYES_COMPLETE="complete_bash",
        COMP_WORDS="rosbayes toolchain reg",
        COMP_CWORD="2",
    )
    assert shown.split() == ["regenerate"]
    hub = get_command(app).resolve_command(None, ["hub"])[1]
    assert not [each for each in hub.params if "completion" in each.name]


def test_its_version_is_the_packages():
    assert invoke(app, ["--version"]).stdout.split() == ["rosbayes", PROJECT["version"]]
