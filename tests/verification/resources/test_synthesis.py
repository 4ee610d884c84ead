"""The resource estimator against a synthesis of machines that it was not calibrated on, tables left out."""

import pytest

from tests.verification.resources.cases import SYNTHESISED
from tests.verification.resources.synthesis import synthesised
from toolchain.analysis.resources.logic import logic_of

TOLERANCE = 0.15
"""How far an estimate may be from the synthesis, of ALUTs and of ALMs; registers are counted, and must be the same."""


@pytest.mark.verification
@pytest.mark.parametrize("case", [pytest.param(each, id=each.name) for each in SYNTHESISED])
def test_the_estimate_is_near_the_synthesis(case, tmp_path, record_property):
    found = synthesised(case, tmp_path)
    estimate = logic_of(case.parameters, whole_words=False)
    for kind, tolerance in (("aluts", TOLERANCE), ("alms", TOLERANCE), ("registers", 0.0)):
        ours, theirs = getattr(estimate, kind), getattr(found, kind)
        record_property(kind, f"{kind} {ours:.0f} / {theirs:.0f} ({ours / theirs - 1:+.0%})")
        assert abs(ours - theirs) <= tolerance * theirs, kind
