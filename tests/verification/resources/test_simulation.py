"""The Verilog text in a simulator: counts, cycles, reasons and states are the reference's, to the bit.

small machine --> verilog.py --> Icarus Verilog --> outcomes == outcomes <-- machines.reference <-- small machine
"""

import pytest

from tests.verification.resources.cases import SIMULATED, machine_of
from tests.verification.resources.simulation import frames_of, reference, simulated


@pytest.mark.verification
@pytest.mark.parametrize("case", [pytest.param(each, id=each.name) for each in SIMULATED])
def test_the_text_computes_what_the_reference_does(case, tmp_path, record_property):
    ours, played = reference(machine_of(case), frames_of(case))
    record_property("ends", ", ".join(f"{each.reason.name.lower()} {each.cycles}" for each in ours))
    assert simulated(case, played, tmp_path) == ours
