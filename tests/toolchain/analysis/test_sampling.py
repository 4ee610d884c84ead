"""Runs of a BM2 on drawn readings: they follow the model, approach exact inference, and say why boards stopped."""

from collections import Counter

import numpy as np
import pytest

from tests.toolchain.chains import machine_of, network, sprinkler
from toolchain.analysis.chain import ExactChain
from toolchain.analysis.logic import device_named
from toolchain.analysis.sampling import chain_resources, drawn_readings, run_chains
from toolchain.errors import BuildError

DEVICE = device_named("proce-v-d8")


def test_readings_are_drawn_from_their_joint_distribution():
    weights = np.array([[[4.0, 0], [1, 2]], [[0, 3], [5, 1]]])  # A, B, C
    drawn = Counter(drawn_readings(network({"ABC": weights}, known=("C", "B")), 4000, seed=1))
    expected = weights.sum(axis=0).T / weights.sum()
    for (c, b), count in drawn.items():
        assert count / 4000 == pytest.approx(expected[c, b], abs=0.03)
    assert drawn_readings(sprinkler(), 5, seed=3) == drawn_readings(sprinkler(), 5, seed=3)
    with pytest.raises(BuildError, match="--frames is 0"):
        drawn_readings(sprinkler(), 0, seed=1)


def test_runs_approach_exact_inference():
    model = sprinkler()
    machine = machine_of(model)
    found = run_chains([machine], [(0,), (1,)], model, samples=200_000, max_cycles=2**40)
    assert found.frames == 2
    assert found.total_variation.value < 0.02
    cycles = [ExactChain(machine, {2: grass}).cycles for grass in (0, 1)]
    assert found.sweep_cycles == pytest.approx(np.mean(cycles), rel=0.03)
    assert found.effective_samples[1] == pytest.approx(200_000 * 0.0097, rel=0.5)
    assert (found.r_hat, found.reasons) == (0, {"samples": 2})


def test_two_boards_start_apart_and_are_compared():
    model = network({"AB": [[1, 0], [0, 1]], "BC": [[1, 0], [0, 1]]}, searched=("A",))
    machines = [machine_of(model, chain=chain, chains=2, stream=8) for chain in (0, 1)]
    found = run_chains(machines, [()], model, samples=100, max_cycles=2**40)
    assert found.total_variation.value < 0.05  # each is stuck where it started, at 0 and at 1
    assert found.r_hat == 1e9
    assert found.effective_samples[1] <= 200


def test_boards_that_do_not_finish():
    model = sprinkler()
    ended = run_chains([machine_of(model)], [(1,)], model, samples=10**6, max_cycles=20_000)
    assert ended.reasons == {"max_cycles": 1}
    with pytest.raises(BuildError, match="none of the readings gives a posterior"):
        run_chains([machine_of(model, ops_timeout=1)], [(1,)], model, samples=100, max_cycles=2**40)
    impossible = network({"AB": [[1, 0], [1, 0]]}, known=("B",), searched=("A",))
    found = run_chains([machine_of(impossible)], [(0,), (1,)], None, samples=100, max_cycles=2**40)
    assert (found.frames, found.without, found.total_variation) == (2, 0.5, None)
    assert found.reasons == {"samples": 1, "impossible": 1}
    compared = run_chains([machine_of(impossible)], [(0,), (1,)], impossible, samples=100, max_cycles=2**40)
    assert compared.alone.value < 0.2
    assert compared.total_variation.value == (compared.alone.value + 1) / 2


def test_resources():
    model = sprinkler()
    small, literal = (chain_resources(machine_of(model, prob_bits=bits), DEVICE) for bits in (8, 16))
    assert small.fits
    assert small.memories.table_bits == 8 * (1 + 4 + 12)
    assert literal.memories.table_bits == 16 * (1 + 4 + 12)
    assert literal.alms > small.alms
    wide = network({"ABC": np.random.default_rng(1).random((64, 64, 64)), "A": np.arange(1, 65)})
    estimate = chain_resources(machine_of(wide), DEVICE)
    assert estimate.memories.blocks > 18 * 2**17 / 1024
    assert not estimate.fits
    assert "but only 2,053 of 2,567 can be used" in estimate.why_not
