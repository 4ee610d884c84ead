"""The pinned logic of two small boards and its estimate: a change of look-up tables fails here."""

import shutil

import pytest

from hdl.test.netlist import synthesised
from hdl.test.project import HDL, BM1Parameters, RngKind, SensorMode, image_of_parameters, run_tool
from toolchain.analysis.logic import WORST_ERROR, logic_of

pytestmark = pytest.mark.thorough
needs_ghdl = pytest.mark.skipif(
    shutil.which("ghdl") is None, reason="ghdl is not installed (Debian: apt-get install ghdl)"
)

PLAIN = BM1Parameters(lines=4, sensor_bits=(3, 2))
REPLICAS = BM1Parameters(
    lines=2,
    sensor_bits=(4,),
    prob_bits=4,
    counter_bits=6,
    rng=RngKind.LFSR16,
    sensor_mode=SensorMode.THRESHOLD,
    replicas=2,
    rng_banks=2,
)


@needs_ghdl
@pytest.mark.parametrize(
    ("parameters", "aluts", "registers"),
    [(PLAIN, 2142, 1234), (REPLICAS, 2180, 1388)],
    ids=["plain", "replicas"],
)
def test_the_logic_of_a_small_board_is_unchanged(tmp_path, parameters, aluts, registers):
    found = synthesised(image_of_parameters(parameters), tmp_path)
    assert (found.aluts, found.registers) == (aluts, registers)
    estimate = logic_of(parameters)
    assert estimate.registers == registers
    assert estimate.aluts == pytest.approx(found.aluts, rel=WORST_ERROR)
    assert estimate.alms == pytest.approx(found.alms, rel=WORST_ERROR)


@needs_ghdl
def test_the_table_for_quartus_is_vhdl(tmp_path):
    sources = [HDL / "bm1_table.vhd", HDL / "synthesis/bm1_table_block.vhd"]
    run_tool(["ghdl", "-a", "--std=08", *map(str, sources)], tmp_path)
