"""`/bm/frame`: reports that are written and read, and their pairing with posteriors.

The wire, as the publisher sends it:   frame 1, result 1, frame 2, result 2, ...
The two topics are handed over one by one, so any order across topics must give the same pairs.
"""

import json
import random

import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posteriors import BadResultError, BoardReport, FrameReport, Posterior, StageTimes, VariableReading
from posteriors.frame_report import read_frame_report, write_frame_report
from posteriors.pairing import WAITING, Pairing
from tests.posteriors.messages import JSON, report_message, status

REPORT = FrameReport(
    stamp_ns=12_000_000_034,
    heard_ns=99,
    outcome='no "posterior": 100 %',
    deployment="boat %d",
    published=False,
    number=7,
    cycles=812,
    counts_total=900,
    link_bytes=5200,
    link_transfers=8,
    received_ns=1_700_000_000_000_000_001,
    sent_ns=1_700_000_000_002_000_001,
    stages=StageTimes(
        rosbridge_in=12.5,
        local_hops=3.0,
        waited=0.5,
        register_writes=1.0,
        compute=2.0,
        reads=4.0,
        boards_compute=1.5,
        rosbridge_out=7.0,
    ),
    boards=(
        BoardReport(name="board0", stopped="overflow", cycles=812, counts_total=900),
        BoardReport(
            name="board1",
            stopped="slice",
            cycles=9,
            counts_total=2,
            replica_cycles=(9, 0),
            replica_stopped=("max cycles", "impossible"),
        ),
    ),
    details={"samples": "9", 'of "b"': "100 % {x}"},
    missing=("D2", 'B"2'),
    readings={
        "D1": VariableReading(71.25, 71, 3.5),
        'of "a" %d': VariableReading('a "state"; 5', 2, 0.0),
        "far": VariableReading("inf", 100, 1e9),
    },
)


@pytest.mark.parametrize("ros_version", [1, 2])
def test_a_report_that_is_written_is_read_back_whole(ros_version):
    message = json.loads(orjson.dumps(write_frame_report(REPORT, ros_version)))
    assert read_frame_report(message, 99) == REPORT
    assert [status["level"] for status in message["status"]] == [1, 0, 0]
    assert ("sec" in message["header"]["stamp"]) == (ros_version == 2)
    assert [status["name"] for status in message["status"]] == [
        *("rosbayes: frame", "rosbayes: board 0", "rosbayes: board 1")
    ]
    keys = [pair["key"] for pair in message["status"][0]["values"]]
    assert keys == [
        *("number", "published", "cycles", "counts_total", "link_bytes", "link_transfers"),
        *("received_ns", "sent_ns"),
        *("rosbridge_in_us", "local_hops_us", "waited_us", "register_writes_us", "compute_us"),
        *("reads_us", "boards_compute_us", "rosbridge_out_us", "missing", "samples"),
        *('of "b"', "reading.D1", 'reading.of "a" %d', "reading.far"),
    ]


def test_what_is_not_known_is_left_out():
    bare = FrameReport(stamp_ns=5, outcome="done", boards=(BoardReport(name="board0", stopped="slice"),))
    message = json.loads(orjson.dumps(write_frame_report(bare, 2)))
    assert read_frame_report(message, 0) == bare
    assert [[pair["key"] for pair in each["values"]] for each in message["status"]] == [
        ["published", "missing"],
        ["reason"],
    ]


def frame_message(**values):
    return report_message({"sec": 12, "nanosec": 34}, **values)


def test_keys_may_be_absent_or_new():
    report = read_frame_report(frame_message(something_new="x"), 0)
    assert (report.published, report.number, report.stages) == (True, None, StageTimes())


@pytest.mark.parametrize(
    "message",
    [
        {},
        {"header": {}, "status": [status("x")]},
        {"header": {"stamp": {"sec": 1, "nanosec": 1}}, "status": []},
        frame_message(cycles="many"),
        frame_message(reads_us="nan"),
        frame_message(**{"reading.D1": "7"}),
        frame_message(**{"reading.D1": "7;high;3"}),
    ],
)
def test_a_message_that_is_not_a_report_is_refused(message):
    with pytest.raises(BadResultError):
        read_frame_report(message, 0)


@given(
    st.dictionaries(st.sampled_from(["header", "status"]), JSON),
    st.dictionaries(
        st.sampled_from(
            ["number", "published", "cycles", "received_ns", "sent_ns", "compute_us", "missing", "reading.D1"]
        ),
        JSON.map(str),
    ),
)
def test_hostile_reports_are_read_or_refused_in_one_sentence(wild, values):
    for message in (wild, frame_message(**values), frame_message() | wild):
        try:
            report = read_frame_report(message, 0)
        except BadResultError as error:
            assert len(str(error)) < 1000
            continue
        posterior = Posterior(probabilities=(1.0,), labels=("x",), sizes=(1,), heard_ns=5, report=report)
        assert posterior.latency_us is None or posterior.latency_us >= 0


# Pairing


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
    pairing.add_posterior(result(6, 60))  # its report is lost
    assert pairs(pairing.add_report(report(7, 66))) == [(None, 6)]


@pytest.mark.parametrize(("heard", "number"), [(12, 1), (15, 1), (16, 2)])
def test_a_result_is_of_the_first_report_until_the_disorder_is_over(heard, number):
    pairing = Pairing(disorder_ns=5)
    pairing.add_report(report(1, 10))
    pairing.add_report(report(2, 14))
    assert pairs(pairing.add_posterior(result(7, heard))) == [(number, 7)]


@pytest.mark.parametrize(("second", "number"), [(21, 2), (22, 1)])
def test_a_result_is_of_the_second_report_from_the_disorder_before_it_on(second, number):
    pairing = Pairing(disorder_ns=5)
    pairing.add_report(report(1, 10))
    pairing.add_report(report(2, second))
    assert pairs(pairing.add_posterior(result(7, 16))) == [(number, 7)]


def test_memory_is_bounded_where_only_one_topic_speaks():
    reports, results = Pairing(), Pairing()
    came = 0
    for number in range(4 * WAITING):
        reports.add_report(report(number, number))
        came += len(results.add_posterior(result(number + 1, number)))
    assert len(reports._reports) == len(results._posteriors) == WAITING
    assert came == reports.announced_only == 3 * WAITING
