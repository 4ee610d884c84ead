"""The VHDL in short: sessions of two machines, units, a proof, datasheets and logic; scripts/verify hdl has all."""

import json
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from hdl.test.datasheets import PAGES, THEORY, main
from hdl.test.datasheets import units as documented_units
from hdl.test.netlist import BLACK_BOX, run_yosys, synthesised
from hdl.test.project import (
    HDL,
    SOURCES,
    BM1Parameters,
    RngKind,
    SensorMode,
    image_of,
    image_of_parameters,
    run_tool,
    verilog,
    write_hardware_files,
)
from hdl.test.verification import Check, formal, units
from machines.parameters import PriorMode
from tests.patience import FACTOR, PROCESS_PATIENCE
from toolchain.analysis.logic import WORST_ERROR, logic_of, random_memories_of, tables_of, word_memories_of
from toolchain.outputs.mif import LENGTH

needs_ghdl = pytest.mark.skipif(
    shutil.which("ghdl") is None, reason="ghdl is not installed (Debian: apt-get install ghdl)"
)

SESSIONS = (15, 25)
"""A threshold machine with several banks; replicas with an address for each cell."""


@needs_ghdl
@pytest.mark.parametrize(
    "check",
    [
        pytest.param(Check("session", str(seed)), marks=kind)
        for seed, kind in zip(SESSIONS, (pytest.mark.process, pytest.mark.thorough), strict=True)
    ],
    ids=lambda check: check.name,
)
def test_the_hardware_answers_as_the_emulated_board(check):
    assert check.failure(frames=3) is None


@pytest.mark.thorough
@pytest.mark.timeout(1200 * FACTOR)
@needs_ghdl
@pytest.mark.parametrize(
    "check", [*units(), *(each for each in formal() if each.what == "guard")], ids=lambda check: check.name
)
def test_units_keep_their_promises(check):
    assert check.failure() is None


def test_every_unit_is_a_source_and_explains_its_theory_generics_and_ports():
    assert {path.name for path in HDL.glob("*.vhd")} == set(SOURCES)
    for unit in documented_units():
        text = (PAGES / f"{unit.name}.md").read_text()
        assert len(text.partition(THEORY)[2].split()) > 20
        unexplained = [name for name, *_, comment in (*unit.generics, *unit.ports) if not comment]
        assert not [name for name in unexplained if not name.startswith("axi_")], unit.name


def test_the_datasheets_are_up_to_date(capsys):
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


REPLICAS = {"sensor_mode": SensorMode.THRESHOLD, "replicas": 2, "rng": RngKind.LFSR16, "rng_banks": 2}


@pytest.mark.thorough
@needs_ghdl
@pytest.mark.parametrize(
    ("parameters", "aluts", "registers"),
    [
        # the map and its hash are in the logic, so that another map has another number of ALUTs
        (BM1Parameters(lines=4, sensor_bits=(3, 2)), 2143, 1234),
        (BM1Parameters(lines=4, sensor_bits=(4,), prob_bits=4, counter_bits=6, **REPLICAS), 2351, 1450),
    ],
    ids=["plain", "replicas"],
)
def test_the_logic_of_a_small_board_is_unchanged(tmp_path, parameters, aluts, registers):
    found = synthesised(image_of_parameters(parameters), tmp_path)
    assert (found.aluts, found.registers) == (aluts, registers)
    estimate = logic_of(parameters)
    assert estimate.registers == registers
    assert estimate.aluts == pytest.approx(found.aluts, rel=WORST_ERROR)
    assert estimate.alms == pytest.approx(found.alms, rel=WORST_ERROR)


@pytest.mark.thorough
@needs_ghdl
@pytest.mark.parametrize(
    "others",
    [
        {"prior_bits": 3},
        {"sensor_mode": SensorMode.CELL, "replicas": 2, "prior_bits": 1},
        {"prior_mode": PriorMode.WRITTEN, "replicas": 2},
        {"rng": RngKind.TABLE, "shared": False, "steps_per_clock": 1},
    ],
    ids=["prior select", "replicas of cells", "written priors", "a table for each cell"],
)
def test_the_hardware_has_the_memories_of_the_estimate(tmp_path, others):
    parameters = BM1Parameters(lines=5, sensor_bits=(4, 2), **others)
    image = image_of(image_of_parameters(parameters).machine, more_inputs=9)
    write_hardware_files(image, tmp_path)
    (tmp_path / "bm1.v").write_text(verilog(tmp_path, table=BLACK_BOX))
    passes = "hierarchy -top bm1; proc; flatten; opt_clean; memory -nomap; write_json flat.json"
    run_yosys(f"read_verilog bm1.v; {passes}", tmp_path)
    cells = json.loads((tmp_path / "flat.json").read_text())["modules"]["bm1"]["cells"].values()
    sizes = {"bm1_table": ("DEPTH", "DATA_BITS"), "$mem_v2": ("SIZE", "WIDTH")}
    found = Counter(
        tuple(int(cell["parameters"][name], 2) for name in sizes[cell["type"]])
        for cell in cells
        if cell["type"] in sizes
    )
    del found[1, 5 * 8]  # the only row of a prior is a constant
    estimated = tables_of(parameters) + random_memories_of(parameters, LENGTH)
    estimated += word_memories_of(parameters, image.interface_sensors)
    assert found == sum((Counter({(each.words, each.width): each.count}) for each in estimated), Counter())


@pytest.mark.thorough
@needs_ghdl
def test_the_table_for_quartus_is_vhdl(tmp_path):
    sources = [HDL / "bm1_table.vhd", HDL / "synthesis/bm1_table_block.vhd"]
    run_tool(["ghdl", "-a", "--std=08", *map(str, sources)], tmp_path)
