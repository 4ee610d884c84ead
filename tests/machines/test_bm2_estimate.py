"""Estimates from samples, against chains of known correlation and formulas written out."""

import math

import numpy as np
import pytest

from machines.bm2 import BM2Machine, BM2Parameters, BM2Start, BM2StopReason, start_state, unpack
from machines.bm2_estimate import (
    BATCHES_MIN,
    BoardSamples,
    batch_effective_samples,
    effective_samples,
    estimate,
    searched_counts,
    searched_values,
    split_r_hat,
)
from machines.bm2_reference import ReferenceBM2
from machines.parameters import Sequencer

SAMPLES, CYCLES, TIMEOUT = (BM2StopReason.SAMPLES, BM2StopReason.MAX_CYCLES, BM2StopReason.OPS_TIMEOUT)


def sticky(stay, samples, seed=1):
    """A chain of two equally likely values whose correlation at distance t is (2 * stay - 1)**t."""
    flips = np.random.default_rng(seed).random(samples) >= stay
    return np.cumsum(flips) % 2


def cumulative(values, batches, size=2):
    return np.cumsum([np.bincount(part, minlength=size) for part in np.array_split(values, batches)], axis=0)


def ended(reason, *counts):
    """The chain of a board that ended with these counts."""
    return BoardSamples(reason, np.array([counts]))


@pytest.mark.parametrize("stay", [0.5, 0.7, 0.9, 0.97])
def test_effective_samples_of_known_correlation(stay):
    samples, correlation = 200_000, 2 * stay - 1
    due = samples * (1 - correlation) / (1 + correlation)
    values = sticky(stay, samples)
    by_sequence = effective_samples(values, 2)
    assert by_sequence[0] == pytest.approx(by_sequence[1])
    assert by_sequence[0] == pytest.approx(due, rel=0.1)
    # means of batches scatter more: sqrt(2 / (batches - 1))
    assert batch_effective_samples(cumulative(values, 400))[0] == pytest.approx(due, rel=0.3)


def test_no_more_effective_samples_than_samples():
    values = np.arange(1000) % 2
    assert effective_samples(values, 2).tolist() == [1000, 1000]
    assert batch_effective_samples(cumulative(values, 20)).tolist() == [1000, 1000]


def test_values_that_never_change_count_in_full():
    values = np.zeros(500, dtype=np.int64)
    assert effective_samples(values, 3).tolist() == [500] * 3
    assert batch_effective_samples(cumulative(values, 25, 3)).tolist() == [500] * 3


def test_batch_means_are_the_formula():
    """Batches of two sizes: the variance of the mean is that of the weighted batch means."""
    random = np.random.default_rng(3)
    sizes = np.tile([100, 60], 10)
    ones = random.binomial(sizes, random.uniform(0.1, 0.5, 20))
    mean, total = ones.sum() / sizes.sum(), sizes.sum()
    variance = 20 / 19 * sum((n / total * (x / n - mean)) ** 2 for x, n in zip(ones, sizes, strict=True))
    counts = np.cumsum(np.stack([sizes - ones, ones], axis=1), axis=0)
    due = min(mean * (1 - mean) / variance, total)
    assert due < total
    assert batch_effective_samples(counts) == pytest.approx([due, due])


def test_too_few_batches_tell_nothing():
    values = sticky(0.8, 5000)
    few = cumulative(values, BATCHES_MIN - 1)
    assert np.isnan(batch_effective_samples(few)).all()
    # batches without a sample are none
    assert np.isnan(batch_effective_samples(np.concatenate([few, few[-1:], few[-1:]]))).all()
    assert not np.isnan(batch_effective_samples(cumulative(values, BATCHES_MIN))).any()


def test_r_hat_is_the_formula():
    halves = [sticky(0.7, 300, seed) for seed in range(6)]
    n = 300
    means = [half.mean() for half in halves]
    grand = sum(means) / 6
    between = n / 5 * sum((mean - grand) ** 2 for mean in means)
    within = (
        sum(sum((x - mean) ** 2 for x in half) / (n - 1) for half, mean in zip(halves, means, strict=True))
        / 6
    )
    due = math.sqrt(((n - 1) / n * within + between / n) / within)
    counts = np.stack([np.bincount(half, minlength=2) for half in halves])
    assert split_r_hat(counts) == pytest.approx([due, due])


def test_r_hat_of_chains_that_stand_still():
    assert split_r_hat(np.array([[10, 0], [10, 0]])).tolist() == [1, 1]
    assert split_r_hat(np.array([[10, 0], [0, 10]])).tolist() == [math.inf, math.inf]


def test_r_hat_sees_boards_that_disagree():
    chains = [BoardSamples(SAMPLES, cumulative(sticky(0.5, 2000, seed), 20)) for seed in range(2)]
    assert estimate(chains).r_hat == pytest.approx(1, abs=0.01)
    apart = [*chains, BoardSamples(SAMPLES, cumulative(np.ones(2000, dtype=np.int64), 20))]
    assert estimate(apart).r_hat > 1.1
    assert math.isnan(estimate(chains[:1]).r_hat)


@pytest.mark.parametrize("samples", [1, 2])
def test_halves_of_one_sample_have_no_r_hat(samples):
    half = np.array([samples - 1, 1])
    result = estimate([BoardSamples(SAMPLES, np.stack([half, 2 * half]))] * 2)
    assert math.isnan(result.r_hat) is (samples == 1)


def test_a_board_that_drifts_disagrees_with_itself():
    """Both boards have the same mean, but their halves differ: only split chains show it."""
    drifting = np.repeat([0, 1], 1000)
    drifting[::10] ^= 1
    chains = [
        BoardSamples(SAMPLES, cumulative(drifting, 20)),
        BoardSamples(SAMPLES, cumulative(drifting, 20), drifting),
    ]
    assert estimate(chains).r_hat > 1.3


def test_boards_that_drew_all_samples_are_added():
    result = estimate([ended(SAMPLES, 30, 10), ended(SAMPLES, 50, 10)])
    assert result.posterior.tolist() == [0.8, 0.2]
    assert result.left_out == ()


def test_a_board_that_timed_out_is_left_out():
    result = estimate([ended(SAMPLES, 30, 10), ended(TIMEOUT, 0, 99)])
    assert result.posterior.tolist() == [0.75, 0.25]
    assert result.left_out == (1,)
    alone = estimate([ended(TIMEOUT, 1, 1)])
    assert (alone.posterior, alone.left_out) == (None, (0,))


def test_boards_have_equal_weights_if_one_ran_out_of_cycles():
    result = estimate(
        [ended(SAMPLES, 30, 10), ended(CYCLES, 0, 1), ended(CYCLES, 0, 0), ended(TIMEOUT, 5, 0)]
    )
    assert result.posterior.tolist() == [0.375, 0.625]
    assert result.left_out == (2, 3)


def test_nothing_to_estimate():
    nothing = np.zeros((1, 2), dtype=np.uint32)
    none = estimate([BoardSamples(BM2StopReason.IMPOSSIBLE, nothing)] * 2)
    assert none.posterior is None
    assert none.left_out == (0, 1)
    # one sample each: no error, no R-hat, but a posterior
    one = estimate([BoardSamples(SAMPLES, np.array([[1, 0]]))] * 2)
    assert one.posterior.tolist() == [1, 0]
    assert math.isnan(one.effective_samples)
    assert math.isnan(one.r_hat)


@pytest.mark.parametrize("streamed", [False, True])
def test_the_error_is_that_of_the_posterior(streamed):
    """Over many frames, the posterior scatters as much as the stated error says."""
    errors, stated = [], []
    for frame in range(40):
        values = [sticky(0.9, 4000, 100 * frame + board) for board in range(2)]
        chains = [BoardSamples(SAMPLES, cumulative(own, 20), own if streamed else None) for own in values]
        result = estimate(chains)
        assert result.effective_samples == pytest.approx(2 * 4000 * 0.2 / 1.8, rel=0.8)
        errors.append(result.posterior[1] - 0.5)
        stated.append(result.error[1])
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.mean(stated), rel=0.35)


def test_a_value_that_was_never_seen_has_an_error():
    result = estimate([BoardSamples(SAMPLES, cumulative(sticky(0.5, 1000), 20, 3))])
    assert result.posterior[2] == 0
    assert 0 < result.error[2] < 0.01


@pytest.mark.parametrize("streamed", [False, True])
def test_chains_that_never_change(streamed):
    """Such a chain may be stuck: it tells nothing of its error, but two of them that disagree do."""
    zeros, ones = (
        BoardSamples(SAMPLES, cumulative(values, 20), values if streamed else None)
        for values in (np.zeros(1000, dtype=np.int64), np.ones(1000, dtype=np.int64))
    )
    for same in ([zeros], [zeros, zeros]):
        result = estimate(same)
        assert result.posterior.tolist() == [1, 0]
        assert math.isnan(result.effective_samples)
        assert np.isnan(result.error).all()
    apart = estimate([zeros, ones])
    assert (apart.r_hat, apart.error.tolist()) == (math.inf, [0.5, 0.5])
    assert math.isnan(apart.effective_samples)


def test_boards_that_disagree_have_the_error_between_them():
    """Each chain mixes well, but around another mean."""
    random = np.random.default_rng(1)
    values = [(random.random(4000) < chance).astype(np.int64) for chance in (0.2, 0.8)]
    result = estimate([BoardSamples(SAMPLES, cumulative(own, 20)) for own in values])
    due = np.std([own.mean() for own in values], ddof=1) / math.sqrt(2)
    assert result.r_hat > 1.1
    assert result.effective_samples > 4000
    assert result.error == pytest.approx([due, due])


@pytest.mark.parametrize(("share", "disagrees"), [(0.31, False), (0.3, True)])
def test_boards_disagree_from_an_r_hat_of_1_1_on(share, disagrees):
    """Until then, their error is that of as many independent samples."""
    random = np.random.default_rng(1)
    chains = [
        BoardSamples(SAMPLES, cumulative((random.random(4000) < chance).astype(np.int64), 20))
        for chance in (share, 1 - share)
    ]
    result = estimate(chains)
    assert (result.r_hat > 1.1) is disagrees
    assert result.r_hat == pytest.approx(1.1, abs=0.01)
    own = math.sqrt(0.25 / result.effective_samples)
    assert bool(result.error[0] > 1.5 * own) is disagrees


@pytest.mark.parametrize("joint", [True, False])
def test_counts_and_stream_name_the_same_values(joint):
    """A searched joint of three variables, in another order than the state's, whose codes cross a word."""
    random = np.random.default_rng(5)
    cardinalities = (3, 9, 8, 8, 8, 8, 8, 8, 8, 8, 5, 3)  # variable 10 has the bits 30 to 32
    searched = (10, 0, 11) if joint else (10,)
    parameters = BM2Parameters(
        cardinalities=cardinalities,
        factors=tuple((at,) for at in range(12)),
        searched=searched,
        sample_every="move",
        stream=1500,
        prob_bits=4,  # unused codes come often
    )
    machine = BM2Machine.from_factors(parameters, [random.uniform(1, 2, size) for size in cardinalities])
    kernel = ReferenceBM2(machine)
    kernel.start(
        BM2Start(
            state=start_state(machine, {}),
            known=0,
            samples=1500,
            burn_in=0,
            ops_timeout=100,
            max_cycles=2**40,
            sequencer=Sequencer.RANDOM,
        )
    )
    values = searched_values(parameters, kernel.stream)
    for row, value in zip(kernel.stream, values, strict=True):
        codes = unpack(parameters, int(row[0]) | int(row[1]) << 32)
        due = 0
        for variable in searched:
            due = due * cardinalities[variable] + codes[variable]
        used = all(code < cardinality for code, cardinality in zip(codes, cardinalities, strict=True))
        assert value == (due if used else -1)
    size = math.prod(cardinalities[variable] for variable in searched)
    counts = searched_counts(parameters, kernel.results)
    assert counts.tolist() == np.bincount(values[values >= 0], minlength=size).tolist()
    assert searched_counts(parameters, np.stack([kernel.results] * 2)).tolist() == [counts.tolist()] * 2
    assert counts.sum() == kernel.samples - kernel.unused < kernel.samples


def test_counts_of_a_variable_whose_joint_does_not_fit():
    parameters = BM2Parameters(cardinalities=(3, 2000), factors=((0,), (1,)), searched=(1,))
    assert parameters.joint_words == 0
    assert searched_counts(parameters, np.arange(4 + 2048)).tolist() == list(range(4, 2004))
