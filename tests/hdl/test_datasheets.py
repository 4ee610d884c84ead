"""The datasheets match the VHDL, and the VHDL follows its style."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from hdl.test.datasheets import PAGES, THEORY, main, units
from hdl.test.project import HDL
from tests.patience import PROCESS_PATIENCE


@pytest.mark.parametrize("unit", units(), ids=lambda unit: unit.name)
def test_a_unit_has_its_page(unit):
    text = (PAGES / f"{unit.name}.md").read_text()
    assert len(text.partition(THEORY)[2].split()) > 20
    for name, _, _, comment in unit.generics:
        assert f"| `{name}` |" in text
        assert comment, f"{unit.name}.{name} is not explained"
    for name, direction, _, comment in unit.ports:
        assert f"| `{name}` | {direction} |" in text
        assert comment or name.startswith("axi_"), f"{unit.name}.{name} is not explained"


def test_the_pages_are_up_to_date(capsys):
    assert main(["--check"]) == 0, capsys.readouterr().err


def test_every_page_is_in_the_overview():
    overview = (PAGES / "README.md").read_text()
    assert set(re.findall(r"\]\((\w+)\.md\)", overview)) == {path.stem for path in PAGES.glob("*.md")} - {
        "README"
    }


@pytest.mark.thorough
def test_the_vhdl_keeps_to_its_style():
    files = [*HDL.glob("*.vhd"), *HDL.glob("s*/*.vhd"), *HDL.glob("test/formal/*.vhd")]
    assert len(files) > 20
    done = subprocess.run(
        [Path(sys.executable).with_name("vsg"), "-c", HDL / "vsg.yaml", "-of", "syntastic", "-f", *files],
        check=False,
        capture_output=True,
        text=True,
        timeout=PROCESS_PATIENCE,
    )
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stdout + done.stderr
