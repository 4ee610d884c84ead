"""The VHDL in short: sessions of two machines, the units' benches and a proof; scripts/verify hdl has all of them."""

import shutil

import pytest

from hdl.test.mutants import MUTANTS
from hdl.test.project import HDL, SOURCES
from hdl.test.verification import Check, formal, units
from tests.patience import FACTOR

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


@pytest.mark.thorough
@needs_ghdl
def test_a_broken_machine_is_found(tmp_path):
    shutil.copytree(HDL, tmp_path / "hdl")
    counter = tmp_path / "hdl" / "bm1_counter.vhd"
    text = counter.read_text()
    assert text.count("count <= count + 1;") == 1
    counter.write_text(text.replace("count <= count + 1;", "count <= count + 2;"))
    why = Check("proof", "core of one machine").failure(tmp_path / "hdl")
    assert why == "a property does not hold"


def test_every_unit_is_in_the_list_of_sources():
    found = {path.name for path in HDL.glob("*.vhd")}
    assert found == set(SOURCES)


def test_every_mutant_changes_its_file_in_one_place():
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) >= 12
    for mutant in MUTANTS:
        assert (HDL / mutant.file).read_text().count(mutant.right) == 1, mutant.name
        assert mutant.right != mutant.wrong
