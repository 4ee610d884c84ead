"""The datasheets match the VHDL, and the VHDL follows its style."""

import subprocess
import sys
from pathlib import Path

import pytest

from hdl.test.datasheets import PAGES, THEORY, main, units
from hdl.test.project import HDL
from tests.patience import PROCESS_PATIENCE


def test_every_unit_explains_its_theory_generics_and_ports():
    for unit in units():
        text = (PAGES / f"{unit.name}.md").read_text()
        assert len(text.partition(THEORY)[2].split()) > 20
        unexplained = [name for name, *_, comment in (*unit.generics, *unit.ports) if not comment]
        assert not [name for name in unexplained if not name.startswith("axi_")], unit.name


def test_the_pages_are_up_to_date(capsys):
    assert main(["--check"]) == 0, capsys.readouterr().err


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
