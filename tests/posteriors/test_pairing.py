"""Pairing of posteriors with reports.

The wire, as the publisher sends it:   frame 1, result 1, frame 2, result 2, ...
The two topics are handed over one by one, so any order across topics must give the same pairs.
"""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from posteriors import FrameReport, Posterior
from posteriors.pairing import WAITING, Pairing


def report(number, heard, *, published=True, stamp=None):
    return FrameReport(
        stamp_ns=number * 100 if stamp is None else stamp,
        heard_ns=heard,
        outcome="",
        number=number,
        published=published,
    )


def result(value, heard):
    return Posterior(probabilities=(float(value),), labels=("x",), sizes=(1,), heard_ns=heard)


def pairs(frames):
    """(frame number, result's value) of each."""
    return [(each.number, each.probabilities[0] if isinstance(each, Posterior) else None) for each in frames]


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.sets(st.integers(1, 12)))
def test_the_order_across_topics_does_not_matter(seed, frames, without):
    """Any interleaving of the two topics gives the same pairs, each once."""
    reports = [report(n, 10 * n, published=n not in without) for n in range(1, frames + 1)]
    results = [result(n, 10 * n + 1) for n in range(1, frames + 1) if n not in without]
    pairing = Pairing()
    left = [(pairing.add_report, reports), (pairing.add_posterior, results)]
    heard = []
    rng = random.Random(seed)
    while left := [(add, queue) for add, queue in left if queue]:
        add, queue = rng.choice(left)
        heard += add(queue.pop(0))
    heard += pairing.flush()
    assert pairs(heard) == [(n, None if n in without else n) for n in range(1, frames + 1)]
    assert pairing.announced_only == 0


def test_a_result_whose_report_was_lost():
    pairing = Pairing()
    pairing.add_posterior(result(1, 11))
    assert pairing.waits
    assert pairs(pairing.add_report(report(2, 20))) == [(None, 1)]
    assert not pairing.waits
    assert pairs(pairing.add_posterior(result(2, 21))) == [(2, 2)]


def test_a_report_whose_result_was_lost():
    pairing = Pairing()
    pairing.add_report(report(1, 10))
    pairing.add_report(report(2, 20))
    assert pairs(pairing.add_posterior(result(2, 21))) == [(2, 2)]
    assert pairing.announced_only == 1


def test_a_server_that_swaps_a_report_and_its_result():
    pairing = Pairing(disorder_ns=5)
    heard = pairing.add_posterior(result(1, 10)) + pairing.add_report(report(1, 14))
    heard += pairing.add_report(report(2, 20)) + pairing.add_posterior(result(2, 21))
    heard += pairing.add_posterior(result(3, 30)) + pairing.add_report(report(3, 33))
    assert pairs(heard) == [(1, 1), (2, 2), (3, 3)]
    pairing.add_report(report(4, 40))  # its result is lost
    pairing.add_report(report(5, 50))
    assert pairs(pairing.add_posterior(result(5, 55))) == [(5, 5)]
    assert pairing.announced_only == 1


@pytest.mark.parametrize(("heard", "number"), [(12, 1), (15, 1), (16, 2)])
def test_a_result_is_of_the_first_report_until_the_disorder_is_over(heard, number):
    pairing = Pairing(disorder_ns=5)
    pairing.add_report(report(1, 10))
    pairing.add_report(report(2, 14))
    assert pairs(pairing.add_posterior(result(7, heard))) == [(number, 7)]


def test_memory_is_bounded_where_only_one_topic_speaks():
    reports, results = Pairing(), Pairing()
    came = 0
    for number in range(4 * WAITING):
        reports.add_report(report(number, number))
        came += len(results.add_posterior(result(number + 1, number)))
    assert len(reports._reports) == len(results._posteriors) == WAITING
    assert came == reports.announced_only == 3 * WAITING
