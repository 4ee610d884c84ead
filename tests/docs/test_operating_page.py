"""The pages about operation: alarms are those of the sources, and systemd accepts the units."""

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PROCESS_PATIENCE

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs/how-to"
PAGE = "".join((FOLDER / name).read_text() for name in ("containers.md", "hosts.md", "operating.md"))
PACKAGES = ("services", "terminal", "posteriors", "bridge", "pcie_shim")


def texts(node):
    """The text of a node, if it is one; of an f-string the pieces between its expressions, joined by …."""
    if isinstance(node, ast.JoinedStr):
        yield "".join(part.value if isinstance(part, ast.Constant) else "…" for part in node.values)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield re.sub(r"%[sd]", "…", node.value)


ALARMS = PAGE.split("## Alarms", 1)[1]


def alarms():
    return re.findall(r"^\| `(.+?)` \|", ALARMS, re.MULTILINE)


TEXTS = {
    text
    for package in PACKAGES
    for path in (ROOT / package).rglob("*.py")
    for node in ast.walk(ast.parse(path.read_text()))
    for text in texts(node)
}


def is_printed(alarm):
    """Return whether every part of an alarm between its `…` (one sentence may quote another) is in the sources."""
    pieces = [piece for piece in re.split("…|: ", alarm) if len(re.sub(r"\W", "", piece)) > 2]
    return bool(pieces) and all(any(piece.strip() in text for text in TEXTS) for piece in pieces)


@pytest.mark.parametrize("alarm", alarms())
def test_every_alarm_of_the_page_is_one_of_the_sources(alarm):
    assert is_printed(alarm)


def test_an_alarm_that_nobody_prints_is_found_and_nothing_is_overlooked():
    assert not is_printed("… is quite unhappy with …")
    assert len(alarms()) > 40
    assert len(set(warnings())) > 12
    assert len(units()) == 3


def warnings():
    """The texts of all `x.warning("...")` and `x.notice("warning", "...")` calls, where they are not variables.

    Of the bridge it is the hub's log that the page describes: a service shows only the errors of libraries.
    """
    for folder in ("services", "terminal", "posteriors", "bridge/hub"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                    place = {"warning": 0, "notice": 1}.get(node.func.attr, len(node.args))
                    for argument in node.args[place : place + 1]:
                        yield from texts(argument)


@pytest.mark.parametrize("warning", sorted(set(warnings())))
def test_every_warning_is_on_the_page(warning):
    piece = max(warning.split("…"), key=len)
    assert any(piece.strip() in shown for shown in re.findall("`([^`]+)`", ALARMS))


def units():
    """The unit files of the page: name and text."""
    found = re.findall(r"`/etc/systemd/system/([\w@.-]+)`:\n\n```ini\n(.*?)```", PAGE, re.DOTALL)
    return [pytest.param(name, text, id=name) for name, text in found]


@pytest.mark.parametrize(("name", "text"), units())
def test_a_unit_starts_one_of_our_commands_and_settings_are_known(name, text):
    from services.settings import ENV_PREFIX, Settings

    command = re.search(r"^ExecStart=/opt/rosbayes/.venv/bin/([\w-]+)", text, re.MULTILINE)[1]
    assert (Path(sys.executable).parent / command).exists()
    known = {ENV_PREFIX + name.upper() for name in Settings.model_fields}
    assert set(re.findall(r"\bBM_[A-Z_]+", PAGE)) <= known
    assert "SuccessExitStatus=143" in text


@pytest.mark.thorough
@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed here")
@pytest.mark.parametrize(("name", "text"), units())
def test_systemd_takes_the_unit(name, text, tmp_path):
    unit = tmp_path / name
    # what the unit starts has to be there for the check
    unit.write_text(text.replace("/opt/rosbayes/.venv/bin", str(Path(sys.executable).parent)))
    checked = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)],
        capture_output=True,
        text=True,
        timeout=PROCESS_PATIENCE,
        check=False,
    )
    about_it = [line for line in checked.stderr.splitlines() if name in line or str(tmp_path) in line]
    assert not about_it, checked.stderr
    assert checked.returncode == 0, checked.stderr
