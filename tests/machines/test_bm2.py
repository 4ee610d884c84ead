"""The reference BM2 on the thesis's sprinkler, and its starts, stops and refusals."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from machines.bm2 import BM2Machine, BM2Parameters, BM2Start, BM2StopReason, start_state
from machines.bm2_reference import ReferenceBM2
from machines.parameters import Sequencer
from tests.machines.bm2_of_the_page import PageBM2
from tests.machines.random_networks import play, runs

RAIN, SPRINKLER, GRASS = range(3)
WET = 1 << GRASS


def sprinkler(**changes):
    """Rain, sprinkler and wet grass (thesis 2.1.3.1): P(rain | wet) = 0.3577."""
    parameters = BM2Parameters(
        **{
            "cardinalities": (2, 2, 2),
            "factors": ((RAIN,), (RAIN, SPRINKLER), (RAIN, SPRINKLER, GRASS)),
            "searched": (RAIN,),
            "known": (GRASS,),
            **changes,
        }
    )
    wet = np.array([[0, 0.9], [0.8, 0.99]])
    return BM2Machine.from_factors(
        parameters, [[0.8, 0.2], [[0.6, 0.4], [0.99, 0.01]], np.stack([1 - wet, wet], axis=-1)]
    )


def start_of(machine, **changes):
    """A start with wet grass."""
    return BM2Start(
        **{
            "state": start_state(machine, {GRASS: 1}),
            "known": WET,
            "samples": 2000,
            "burn_in": 500,
            "ops_timeout": 2**20,
            "max_cycles": 2**40,
            **changes,
        }
    )


@pytest.mark.parametrize("order", Sequencer)
def test_the_sprinkler(order):
    kernel = ReferenceBM2(sprinkler())
    reason = kernel.start(start_of(kernel.machine, sequencer=order))
    assert reason is kernel.reason is BM2StopReason.SAMPLES
    assert 6.5 < kernel.cycles / 2500 < 7.6
    rain = kernel.results[:2]
    assert rain.sum() == kernel.samples == 2000
    assert rain[1] / 2000 == pytest.approx(0.3577, abs=0.12)


@pytest.mark.parametrize(
    ("examples", "cycles"), [(60, 60), pytest.param(300, 400, marks=pytest.mark.thorough)]
)
def test_equals_the_page(examples, cycles):
    search = given(runs(cycles=cycles))(equals_the_page)
    settings(max_examples=examples, suppress_health_check=list(HealthCheck), deadline=None)(search)()


def equals_the_page(run):
    page = PageBM2(run.machine.parameters, run.factors, run.machine.rng_table)
    due = play(page, run.courses, lambda page, reason: page.shown(reason))
    for shown, expected in zip(play(ReferenceBM2(run.machine), run.courses), due, strict=True):
        assert shown == expected
