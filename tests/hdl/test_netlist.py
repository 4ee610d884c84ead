"""The logic of two small boards, pinned: a change that costs or saves look-up tables shows here."""

import shutil

import numpy as np
import pytest

from hdl.test.netlist import synthesised
from hdl.test.project import BM1Machine, BM1Parameters, RngKind, SensorMode, image_of

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


def image(parameters):
    """Return a board with tables that hold anything: they are left out."""
    random = np.random.default_rng(1)
    prior = random.integers(1, parameters.ones_code, (1, parameters.lines)).astype(np.uint16)
    tables = [
        np.full((1 << bits, parameters.lines), parameters.ones_code, np.uint16)
        for bits in parameters.sensor_bits
    ]
    return image_of(BM1Machine(parameters, prior, tuple(tables) if parameters.has_tables else ()))


@pytest.mark.skipif(
    shutil.which("ghdl") is None, reason="ghdl is not installed (Debian: apt-get install ghdl)"
)
@pytest.mark.parametrize(
    ("parameters", "aluts", "registers"),
    [(PLAIN, 2247, 1234), (REPLICAS, 2072, 1388)],
    ids=["plain", "replicas"],
)
def test_a_small_board_takes_as_much_logic_as_it_did(tmp_path, parameters, aluts, registers):
    found = synthesised(image(parameters), tmp_path)
    assert (found.aluts, found.registers) == (aluts, registers)
