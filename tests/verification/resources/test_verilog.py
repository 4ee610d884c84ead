"""The synthesizable text: its shape here; what it computes is checked by scripts/verify resources, in a simulator."""

import re
import shutil
import subprocess
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.bm1 import BM1Machine
from machines.parameters import BM1Parameters, PriorMode, RngKind, RngReset, SensorMode
from pcie_shim.programming_file import interface_words
from tests.toolchain.corridor import corridor, machine_of
from tests.verification.resources.verilog import OUTCOME_WORDS, PRIOR_ADDRESSES, Places, verilog
from toolchain.errors import BuildError


def test_replicas_share_the_generators_alone():
    text = verilog(machine_of(corridor(5), replicas=3), tables=True)
    assert len(re.findall(r"^  bm1_cell #\(8\) c_", text, re.MULTILINE)) == 3 * 5 * 3
    assert len(re.findall(r"^  bm1_counter #\(8\) n_", text, re.MULTILINE)) == 3 * 5
    assert len(re.findall(r"^  bm1_generator g_", text, re.MULTILINE)) == 3
    assert len(re.findall(r"^  bm1_table_\d_\d t_", text, re.MULTILINE)) == 3 * 5 * 3
    assert text.count("bm1_table_1_0 t_") == 3  # of one and the same content
    assert "blackbox" not in text


def test_inputs_for_each_cell():
    text = verilog(machine_of(corridor(5), sensor_mode=SensorMode.CELL), tables=False)
    assert "bm1_table_2_4 t_0_2_4 (clk, address_0_2_4, code_0_2_4);" in text
    one = machine_of(corridor(5))
    given = BM1Machine(
        replace(one.parameters, sensor_mode=SensorMode.THRESHOLD, sensor_bits=(8, 8)), one.prior, ()
    )
    text = verilog(given, tables=False)
    assert "assign code_0_2_4 = address_0_2_4;" in text
    assert text.count("(* blackbox *)") == 5  # the prior's


@given(
    st.integers(1, 300),
    st.integers(0, 4),
    st.integers(1, 40),
    st.sampled_from(SensorMode),
    st.sampled_from(PriorMode),
)
def test_every_register_has_a_place_of_its_own(lines, sensors, replicas, mode, prior):
    bits = (8,) * sensors
    parameters = BM1Parameters(
        lines=lines, sensor_bits=bits, replicas=replicas, sensor_mode=mode, prior_mode=prior
    )
    places = Places(parameters)
    inputs, results = interface_words(parameters)
    written = results if prior is PriorMode.WRITTEN else 0
    halts = -(-replicas // 32) if replicas > 1 else 0
    assert places.inputs == PRIOR_ADDRESSES + replicas
    assert places.end == places.inputs + inputs + written + halts
    assert places.outcomes >= max(results, OUTCOME_WORDS * replicas)
    assert places.outcomes & (places.outcomes - 1) == 0


@pytest.mark.skipif(shutil.which("iverilog") is None, reason="Icarus Verilog is not installed")
@pytest.mark.parametrize(
    "others",
    [
        {},
        {"shared": False, "rng_banks": 1},
        {"rng": RngKind.LFSR16, "rng_reset": RngReset.FREE, "prob_bits": 4},
        {"prior_mode": PriorMode.WRITTEN},
        {"sensor_mode": SensorMode.CELL},
        {"replicas": 3},
        {"replicas": 40, "sensor_mode": SensorMode.CELL, "prior_mode": PriorMode.WRITTEN},
    ],
)
def test_it_is_verilog(tmp_path, others):
    machine = machine_of(corridor(3), **others)
    path = tmp_path / "bm1.v"
    path.write_text(verilog(machine, tables=True))
    subprocess.run(["iverilog", "-g2005", "-t", "null", str(path)], check=True, timeout=240)


def test_what_has_no_logic():
    machine = machine_of(corridor(3), rng=RngKind.IDEAL)
    with pytest.raises(BuildError, match="rng = ideal"):
        verilog(machine, tables=True)
    with pytest.raises(BuildError, match="2048"):
        verilog(machine_of(corridor(900)), tables=False)
    with pytest.raises(BuildError, match="20 times"):
        verilog(machine_of(corridor(50), replicas=20), tables=False)
