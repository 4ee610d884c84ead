"""A simulation whose child fails: one error, of the right kind, in limited time, and no child is left.

Simulation --pipe--> a program of this file in place of the simulator
"""

import sys

import psutil
import pytest

from pcie_shim.board import simulation as module
from pcie_shim.board.simulation import Simulation
from pcie_shim.errors import SimulationError

ECHO = "import sys\nfor line in sys.stdin:\n    print({answer!r}, flush=True)\n"


def child(code):
    return [sys.executable, "-c", code]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "answer",
    [
        "", "0", "hello", "0 00000001", "0 00000001 123", "0 00000001 0000000g", "0 00000001 00000000 00000000",
        "0 00000004 " + 8 * "0" + 8 * "1", "é", "0" * 100_000,
    ],
)  # fmt: skip
def test_garbage_is_an_error(tmp_path, answer):
    with Simulation(child(ECHO.format(answer=answer)), tmp_path) as simulation:
        with pytest.raises(SimulationError):
            simulation.read(0, 1)
        assert not psutil.pid_exists(simulation._child.pid)


@pytest.mark.thorough
def test_words_are_little_endian_and_end_with_the_refused_one(tmp_path):
    with Simulation(child(ECHO.format(answer="2 0000000A 01020304A0B0C0D0")), tmp_path) as simulation:
        assert simulation.read(0, 3) == (2, 10, bytes.fromhex("04030201d0c0b0a0"))
        assert not simulation.write(0, 1)
    with Simulation(child(ECHO.format(answer="0 00000003 ")), tmp_path) as simulation:
        assert simulation.write(0, 1)


@pytest.mark.thorough
@pytest.mark.parametrize("code", ["", "import os; os.kill(os.getpid(), 9)", "raise SystemExit('no MIF')"])
def test_a_child_that_ends_is_an_error(tmp_path, code):
    with Simulation(child(code), tmp_path) as simulation:
        with pytest.raises(SimulationError) as raised:
            simulation.read(0, 1)
        assert ("no MIF" in str(raised.value)) == ("no MIF" in code)
        with pytest.raises(SimulationError):
            simulation.write(0, 1)


@pytest.mark.process
def test_a_child_that_hangs_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "ANSWER_S", 0.2)
    with Simulation(child("import time; time.sleep(1000)"), tmp_path) as simulation:
        with pytest.raises(SimulationError):
            simulation.run(10)
        assert not psutil.pid_exists(simulation._child.pid)


@pytest.mark.thorough
def test_a_child_that_ignores_its_end_is_killed(tmp_path):
    with Simulation(child("import time; time.sleep(1000)"), tmp_path) as simulation:
        process = simulation._child.pid
    assert not psutil.pid_exists(process)


@pytest.mark.thorough
def test_a_simulator_that_cannot_be_started(tmp_path):
    with pytest.raises(SimulationError):
        Simulation([str(tmp_path / "nothing")], tmp_path)
