"""The synthesizable text: its shape here; what it computes is checked by scripts/verify resources, in a simulator."""

import re
import shutil
import subprocess

import pytest

from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset
from tests.toolchain.corridor import corridor, machine_of
from toolchain.analysis.rtl import verilog
from toolchain.errors import BuildError


def test_a_cell_for_every_code_and_a_counter_for_every_line():
    text = verilog(machine_of(corridor(5)), tables=True)
    assert len(re.findall(r"^  bm1_cell #\(8\) c_", text, re.MULTILINE)) == 5 * 3
    assert len(re.findall(r"^  bm1_counter #\(8\) n_", text, re.MULTILINE)) == 5
    assert len(re.findall(r"^  bm1_generator g_", text, re.MULTILINE)) == 3
    assert text.count("module ") == text.count("endmodule") * 1


def test_tables_are_black_boxes_for_a_count():
    machine = machine_of(corridor(3))
    assert verilog(machine, tables=False).count("(* blackbox *)") == 9
    assert "blackbox" not in verilog(machine, tables=True)


@pytest.mark.skipif(shutil.which("iverilog") is None, reason="Icarus Verilog is not installed")
@pytest.mark.parametrize(
    "others",
    [
        {},
        {"shared": False, "rng_banks": 1},
        {"rng": RngKind.LFSR16, "rng_reset": RngReset.FREE, "prob_bits": 4},
        {"prior_mode": PriorMode.WRITTEN},
    ],
)
def test_it_is_verilog(tmp_path, others):
    machine = machine_of(corridor(3), **others)
    path = tmp_path / "bm1.v"
    path.write_text(verilog(machine, tables=True))
    subprocess.run(["iverilog", "-g2005", "-t", "null", str(path)], check=True, timeout=60)


def test_what_has_no_logic():
    machine = machine_of(corridor(3), rng=RngKind.IDEAL)
    with pytest.raises(BuildError, match="rng = ideal has no logic here"):
        verilog(machine, tables=True)
    with pytest.raises(BuildError, match="more than 2048 cells"):
        verilog(machine_of(corridor(900)), tables=False)
    assert BM1Parameters(lines=900, sensor_bits=(5, 2)).columns * 900 > 2048
