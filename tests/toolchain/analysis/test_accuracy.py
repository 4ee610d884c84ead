"""Accuracy: figures that can be computed by hand, and intervals with the stated coverage."""

import numpy as np
import pytest

from machines.bm1 import BM1Machine
from machines.parameters import BM1Parameters
from tests.toolchain.corridor import corridor, machine_of
from toolchain.analysis.accuracy import _difference, _line_probabilities, bootstrap, measure, share_of_frames
from toolchain.analysis.emulation import EmulatedBoards
from toolchain.analysis.readings import MISSING, Readings, sample_readings
from toolchain.building.machine import split
from toolchain.deployment import Stop
from toolchain.errors import ModelError
from toolchain.models.model import Known, Model, dimension, exact_posterior


def boards_of(machine, count=1, *, target=255, limit=2**15, stop=Stop.SLICES):
    return EmulatedBoards(split(machine, count), target_count=target, max_cycles=limit, stop=stop)


def test_a_difference_by_hand():
    ours, theirs = np.array([0.5, 0.5, 0.0]), np.array([0.25, 0.5, 0.25])
    variation, divergence, same = _difference(ours, theirs)
    assert variation == pytest.approx(0.25)
    assert divergence == pytest.approx(0.5)  # 0.5 log2 2
    assert same  # of two equally probable lines one is theirs
    assert not _difference(np.array([0.6, 0.4, 0.0]), theirs)[2]


def test_how_often_codes_let_lines_count():
    machine = BM1Machine(
        BM1Parameters(lines=3, sensor_bits=(1,)),
        np.array([[255, 128, 64]], dtype=np.uint16),
        (np.array([[255, 128, 0], [255, 255, 255]], dtype=np.uint16),),
    )
    chances = _line_probabilities(machine, (0,), 0)
    assert chances / chances.sum() == pytest.approx([0.8, 0.2, 0])
    zero = BM1Machine(machine.parameters, np.zeros((1, 3), dtype=np.uint16), machine.tables)
    assert not _line_probabilities(zero, (0,), 0).any()


def test_a_machine_beside_its_model():
    model = corridor(24, sigma=1.5)
    readings = sample_readings(model, 40, seed=1)
    coarse, fine = (
        measure(boards_of(machine_of(model, prob_bits=bits), 2), readings, model, banks=2) for bits in (3, 10)
    )
    for accuracy in (coarse, fine):
        assert accuracy.machine is not None
        assert accuracy.quantising is not None
        assert accuracy.sampling is not None
        low, value, high = (
            getattr(accuracy.machine.total_variation, name) for name in ("low", "value", "high")
        )
        assert low < value < high
        # The distance of the machine is at most the sum of both losses.
        assert value <= accuracy.quantising.total_variation.value + accuracy.sampling.total_variation.value
    assert coarse.quantising.total_variation.value > 10 * fine.quantising.total_variation.value
    assert fine.machine.total_variation.value == pytest.approx(fine.sampling.total_variation.value, rel=0.1)
    assert 0 < fine.machine.total_variation.value < 0.1
    assert fine.overflow == 1
    assert fine.cycles.median.value % 256 == 0 or fine.cycles.median.value < 512


def test_z_scores_are_near_1_with_fresh_bits_and_larger_without():
    model = corridor(40, sigma=2.0)
    readings = sample_readings(model, 100, seed=1)
    fresh, stale = (
        measure(boards_of(machine_of(model, steps_per_clock=steps, rng_banks=256)), readings, None, banks=1)
        for steps in (8, 1)
    )
    assert fresh.z.rms.value == pytest.approx(1, abs=0.12)
    assert fresh.z.rms.low < 1 < fresh.z.rms.high
    assert stale.z.rms.low > 1.1
    assert fresh.z.draws == 100
    few = measure(boards_of(machine_of(model, rng_banks=4)), readings, None, banks=1)
    assert few.z.draws == 4
    assert fresh.machine is None
    assert fresh.quantising is None


def test_the_same_frames_give_the_same_figures_and_every_frame_is_reported():
    model = corridor()
    readings = sample_readings(model, 10, seed=1)
    told = []
    accuracy = measure(boards_of(machine_of(model)), readings, model, advance=lambda: told.append(1))
    assert accuracy == measure(boards_of(machine_of(model)), readings, model)
    assert len(told) == 10


def test_frames_without_a_posterior_are_counted():
    table = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]])
    model = Model(
        name="torn",
        searched=(dimension("s", size=3),),
        known=(Known(name="A", table=table), Known(name="B", table=table)),
        prior=np.array([0.4999, 0.4999, 0.0002]),
    )
    # A = 0 and B = 1 is possible on the last line alone, whose prior is code 0.
    readings = Readings("by hand", np.array([[0, 0], [0, 1]]), np.array([-1, -1]))
    accuracy = measure(boards_of(machine_of(model)), readings, model, banks=3)
    assert accuracy.impossible == 0.5
    assert accuracy.without == 0.5
    assert accuracy.machine.total_variation.value < 0.05


def test_a_selected_prior_and_missing_readings():
    model = corridor(16, sigma=1.5, select=True, missing=True)
    readings = sample_readings(model, 30, seed=1)
    readings.addresses[::3, 0] = MISSING
    readings.prior_addresses[::5] = MISSING
    accuracy = measure(
        boards_of(machine_of(model, prob_bits=12, counter_bits=12), 2, target=2000), readings, model
    )
    assert accuracy.frames == 30
    assert accuracy.quantising.total_variation.value < 0.003
    assert accuracy.machine.total_variation.value < 0.03


def test_readings_that_the_model_finds_impossible():
    table = np.array([[1.0, 1.0], [0.0, 0.0]])
    model = Model(name="sure", searched=(dimension("s", size=2),), known=(Known(name="A", table=table),))
    readings = Readings("by hand", np.array([[1]]), np.array([-1]))
    with pytest.raises(ModelError, match="by hand"):
        measure(boards_of(machine_of(model)), readings, model)
    assert exact_posterior(model, [0]) == pytest.approx([0.5, 0.5])


def test_intervals():
    values = np.random.default_rng(1).normal(10, 2, (400, 1))
    interval = bootstrap(values, np.mean)
    assert interval.low < interval.value < interval.high
    assert interval.high - interval.low == pytest.approx(2 * 1.96 * 2 / 20, rel=0.25)
    all_agree = share_of_frames(1.0, 20)
    assert all_agree.high == 1
    assert all_agree.low == pytest.approx(0.839, abs=0.001)  # Wilson's, from a table
