"""True positions: what is read, and which frame gets which."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from casestudies.listening import Truth, Truths, read_truth
from posteriors.errors import BadResultError
from posteriors.frame_report import FrameReport
from posteriors.posterior import Posterior


def test_a_truth():
    message = {
        "header": {"stamp": {"sec": 1, "nanosec": 5}},
        "pose": {"position": {"x": 1, "y": -2.5, "z": 0}, "orientation": {}},
    }
    assert read_truth(message, "/t") == Truth(stamp_ns=1_000_000_005, x=1, y=-2.5)
    with pytest.raises(BadResultError, match="/t .*header"):
        read_truth({"pose": {}}, "/t")


def frame(number, stamp=None):
    report = FrameReport(
        stamp_ns=number * 100 if stamp is None else stamp, heard_ns=0, outcome="", number=number
    )
    return Posterior(probabilities=(1.0,), labels=("x",), sizes=(1,), heard_ns=0, report=report)


def truth(number, stamp=None):
    return Truth(stamp_ns=number * 100 if stamp is None else stamp, x=float(number), y=0.0)


def told(instances):
    """(frame number, truth's x) of each."""
    return [(i.report.number, i.truth.x if i.truth else None) for i in instances]


@given(st.integers(1, 12), st.sets(st.integers(1, 12)))
def test_frames_without_a_posterior_have_a_truth_too(frames, without):
    truths = Truths()
    heard = []
    for number in range(1, frames + 1):
        heard += truths.add_truth(truth(number))
        one = frame(number)
        heard += truths.add_frame(one.report if number in without else one)
    assert told(heard) == [(n, n) for n in range(1, frames + 1)]
    assert [i.posterior is None for i in heard] == [n in without for n in range(1, frames + 1)]


def test_a_late_truth_is_waited_for_until_a_newer_one_or_the_next_frame_comes():
    truths = Truths()
    truths.add_truth(truth(1))
    assert truths.add_frame(frame(2)) == []
    assert truths.waits
    assert told(truths.add_truth(truth(2))) == [(2, 2)]
    truths.add_frame(frame(3))
    assert told(truths.add_truth(truth(4))) == [(3, None)]
    truths.add_frame(frame(5))
    assert told(truths.add_frame(frame(6))) == [(5, None)]
    assert told(truths.flush()) == [(6, None)]
    assert truths.flush() == []


def test_a_result_without_a_report_has_no_truth():
    truths = Truths()
    truths.add_truth(truth(1))
    (instance,) = truths.add_frame(Posterior(probabilities=(1.0,), labels=("x",), sizes=(1,), heard_ns=100))
    assert instance.truth is None


@pytest.mark.parametrize(("tolerance_ns", "served"), [(50, True), (39, False)])
def test_an_older_truth_serves_within_the_tolerance(tolerance_ns, served):
    truths = Truths(tolerance_ns=tolerance_ns)
    truths.add_truth(truth(1, stamp=960))
    truths.add_frame(frame(1, stamp=1000))
    (instance,) = truths.add_truth(truth(2, stamp=1030))
    assert told([instance]) == [(1, 1 if served else None)]
    assert instance.truth_age_ns == (40 if served else 0)


def test_memory_is_bounded():
    truths = Truths()
    for number in range(10_000):
        truths.add_truth(truth(number))
    assert len(truths._truths) <= 4096
