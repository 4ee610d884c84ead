"""Result topics: what is read from them, and which result belongs to which frame and truth.

The wire, as the publisher sends it:   frame 1, result 1, frame 2, result 2, ...
The three topics are handed over one by one, so any order across topics must give the same pairs.
"""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from casestudies.errors import BadResultError
from casestudies.results import (
    FrameReport,
    Instance,
    Pairing,
    Posterior,
    Truth,
    read_frame_report,
    read_posterior,
    read_truth,
)


def status(name, message="", hardware="", **values):
    return {
        "level": 0,
        "name": name,
        "message": message,
        "hardware_id": hardware,
        "values": [{"key": key, "value": str(value)} for key, value in values.items()],
    }


def frame_message(*, stamp=None, **values):
    return {
        "header": {"stamp": stamp or {"sec": 12, "nanosec": 34}, "frame_id": "bm"},
        "status": [
            status("rosbayes: frame", "overflow", "boat", **values),
            status("rosbayes: board 0", "overflow", "board0", cycles=812, counts_total=900, reason=1),
            status("rosbayes: board 1", "impossible", "board1", cycles=0, counts_total=0, reason=4),
        ],
    }


def posterior_message(data, *sizes):
    dims = [{"label": label, "size": size, "stride": 1} for label, size in zip("yx", sizes, strict=False)]
    return {"layout": {"dim": dims, "data_offset": 0}, "data": data}


class TestReading:
    def test_a_frame_report(self):
        report = read_frame_report(
            frame_message(
                number=7,
                cycles=812,
                counts_total=900,
                published="true",
                received_ns=1_700_000_000_000_000_001,
                sent_ns=1_700_000_000_002_000_001,
                rosbridge_in_us="12.5",
                local_hops_us="3",
                something_new="x",
            ),
            99,
        )
        assert report.stamp_ns == 12_000_000_034
        assert (report.number, report.cycles, report.counts_total) == (7, 812, 900)
        assert report.published
        assert report.received_ns == 1_700_000_000_000_000_001
        assert report.sent_ns == 1_700_000_000_002_000_001
        assert report.stages.rosbridge_in == 12.5
        assert report.stages.local_hops == 3
        assert report.stages.reads is None
        assert report.outcome == "overflow"
        assert [(b.name, b.stopped, b.cycles) for b in report.boards] == [
            ("board0", "overflow", 812),
            ("board1", "impossible", 0),
        ]

    def test_stamps_of_both_ros(self):
        assert read_frame_report(frame_message(stamp={"secs": 1, "nsecs": 2}), 0).stamp_ns == 1_000_000_002

    def test_keys_may_be_absent(self):
        report = read_frame_report(frame_message(), 0)
        assert report.published
        assert report.number is None

    def test_a_frame_without_a_posterior(self):
        assert not read_frame_report(frame_message(published="false"), 0).published

    @pytest.mark.parametrize(
        "message",
        [
            {},
            {"header": {}, "status": [status("x")]},
            {"header": {"stamp": {"sec": 1, "nanosec": 1}}, "status": []},
            frame_message(cycles="many"),
            frame_message(reads_us="nan"),
        ],
    )
    def test_what_is_no_report(self, message):
        with pytest.raises(BadResultError, match="/bm/frame is not the diagnostic_msgs/DiagnosticArray"):
            read_frame_report(message, 0)

    def test_a_posterior(self):
        posterior = read_posterior(posterior_message([0.5, 0.25, 0.25, 0, 0, 0], 2, 3), 5)
        assert posterior.values == (0.5, 0.25, 0.25, 0, 0, 0)
        assert posterior.sizes == (2, 3)
        assert posterior.labels == ("y", "x")
        assert posterior.heard_ns == 5

    def test_a_posterior_without_a_layout(self):
        assert read_posterior({"data": [1.0]}, 0).sizes == (1,)

    def test_a_posterior_behind_an_offset(self):
        message = posterior_message([9.0, 0.5, 0.5], 1, 2)
        message["layout"]["data_offset"] = 1
        assert read_posterior(message, 0).values == (0.5, 0.5)

    @pytest.mark.parametrize("data", [None, [None], ["x"], [float("nan")], [-0.5]])
    def test_what_is_no_posterior(self, data):
        with pytest.raises(BadResultError, match="/BMresults is not the std_msgs/Float64MultiArray"):
            read_posterior({"data": data}, 0)

    @pytest.mark.parametrize(("data", "sizes"), [([1.0] * 5, (2, 3)), ([], ())])
    def test_a_layout_of_something_else(self, data, sizes):
        with pytest.raises(BadResultError, match="its layout says"):
            read_posterior(posterior_message(data, *sizes), 0)

    def test_a_truth(self):
        message = {
            "header": {"stamp": {"sec": 1, "nanosec": 5}},
            "pose": {"position": {"x": 1, "y": -2.5, "z": 0}, "orientation": {}},
        }
        assert read_truth(message, "/t") == Truth(stamp_ns=1_000_000_005, x=1, y=-2.5)
        with pytest.raises(BadResultError, match="/t is not"):
            read_truth({"pose": {}}, "/t")


def report(number, heard, *, published=True, stamp=None):
    return FrameReport(
        stamp_ns=number * 100 if stamp is None else stamp,
        heard_ns=heard,
        outcome="",
        number=number,
        published=published,
    )


def result(value, heard):
    return Posterior(values=(float(value),), labels=("x",), sizes=(1,), heard_ns=heard)


def truth(number, stamp=None):
    return Truth(stamp_ns=number * 100 if stamp is None else stamp, x=float(number), y=0.0)


def told(instances):
    """(frame number, result's value, truth's x) of each."""
    return [
        (
            i.report.number if i.report else None,
            i.posterior.values[0] if i.posterior else None,
            i.truth.x if i.truth else None,
        )
        for i in instances
    ]


class TestPairing:
    def test_a_result_goes_to_the_frame_before_it(self):
        pairing = Pairing()
        assert pairing.add_truth(truth(1)) == []
        assert pairing.add_report(report(1, 10)) == []
        assert told(pairing.add_posterior(result(1, 11))) == [(1, 1, 1)]

    @given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.sets(st.integers(1, 12)))
    def test_the_order_across_topics_does_not_matter(self, seed, frames, without):
        """Whatever interleaving of the three topics: the pairs are the same, and none is said twice."""
        reports = [report(n, 10 * n, published=n not in without) for n in range(1, frames + 1)]
        results = [result(n, 10 * n + 1) for n in range(1, frames + 1) if n not in without]
        truths = [truth(n) for n in range(1, frames + 1)]
        pairing = Pairing()
        left = [(pairing.add_report, reports), (pairing.add_posterior, results)]
        heard = []
        for one in truths:  # the simulator's topic is always ahead: it makes the readings
            heard += pairing.add_truth(one)
        rng = random.Random(seed)
        while left := [(add, queue) for add, queue in left if queue]:
            add, queue = rng.choice(left)
            heard += add(queue.pop(0))
        heard += pairing.flush()
        expected = [(n, None if n in without else n, n) for n in range(1, frames + 1)]
        assert told(heard) == expected
        assert pairing.announced_only == 0

    def test_a_late_truth_is_waited_for(self):
        pairing = Pairing()
        pairing.add_truth(truth(1))
        pairing.add_report(report(2, 10))
        assert pairing.add_posterior(result(2, 11)) == []
        assert told(pairing.add_truth(truth(2))) == [(2, 2, 2)]

    def test_a_newer_truth_ends_the_waiting(self):
        pairing = Pairing()
        pairing.add_truth(truth(1))
        pairing.add_report(report(2, 10))
        pairing.add_posterior(result(2, 11))
        assert told(pairing.add_truth(truth(3))) == [(2, 2, None)]

    def test_the_next_frame_ends_the_waiting(self):
        pairing = Pairing()
        pairing.add_truth(truth(1))
        pairing.add_report(report(2, 10))
        pairing.add_posterior(result(2, 11))
        pairing.add_report(report(3, 20))
        assert told(pairing.add_posterior(result(3, 21))) == [(2, 2, None)]
        assert told(pairing.flush()) == [(3, 3, None)]
        assert pairing.flush() == []

    def test_without_truths_nothing_is_waited_for(self):
        pairing = Pairing()
        pairing.add_report(report(1, 10))
        assert told(pairing.add_posterior(result(1, 11))) == [(1, 1, None)]

    def test_an_older_truth_serves_within_the_tolerance(self):
        pairing = Pairing(truth_tolerance_ns=50)
        pairing.add_truth(truth(1, stamp=960))
        pairing.add_report(report(1, 10, stamp=1000))
        pairing.add_posterior(result(1, 11))
        (instance,) = pairing.add_truth(truth(2, stamp=1030))
        assert told([instance]) == [(1, 1, 1)]
        assert instance.truth_age_ns == 40

    def test_a_truth_older_than_the_tolerance_does_not_serve(self):
        pairing = Pairing(truth_tolerance_ns=39)
        pairing.add_truth(truth(1, stamp=960))
        pairing.add_report(report(1, 10, stamp=1000))
        pairing.add_posterior(result(1, 11))
        assert told(pairing.add_truth(truth(2, stamp=1030))) == [(1, 1, None)]

    def test_a_result_whose_report_was_lost(self):
        pairing = Pairing()
        pairing.add_posterior(result(1, 11))
        pairing.add_report(report(2, 20))
        assert told(pairing.add_posterior(result(2, 21))) == [(2, 2, None)]

    def test_a_report_whose_result_was_lost(self):
        pairing = Pairing()
        pairing.add_report(report(1, 10))
        pairing.add_report(report(2, 20))
        assert told(pairing.add_posterior(result(2, 21))) == [(2, 2, None)]
        assert pairing.announced_only == 1

    def test_a_server_that_swaps_a_report_and_its_result(self):
        pairing = Pairing(disorder_ns=5)
        heard = pairing.add_posterior(result(1, 10)) + pairing.add_report(report(1, 14))
        heard += pairing.add_report(report(2, 20)) + pairing.add_posterior(result(2, 21))
        heard += pairing.add_posterior(result(3, 30)) + pairing.add_report(report(3, 33))
        assert told(heard) == [(1, 1, None), (2, 2, None), (3, 3, None)]
        pairing.add_report(report(4, 40))  # its result is lost
        pairing.add_report(report(5, 50))
        assert told(pairing.add_posterior(result(5, 55))) == [(5, 5, None)]
        assert pairing.announced_only == 1

    def test_results_without_any_report_come_out_at_the_end(self):
        pairing = Pairing()
        pairing.add_posterior(result(1, 11))
        assert told(pairing.flush()) == [(None, 1, None)]

    def test_memory_is_bounded(self):
        pairing = Pairing()
        for number in range(10_000):
            pairing.add_truth(truth(number))
        assert len(pairing._truths) <= 4096


class TestTimes:
    def test_measured_from_sending_and_from_the_reading(self):
        instance = Instance(
            report=FrameReport(stamp_ns=0, heard_ns=0, outcome="", received_ns=1_000, sent_ns=5_000),
            posterior=result(1, 9_000),
        )
        assert instance.rosbridge_out_us == 4.0
        assert instance.latency_us == 8.0

    @pytest.mark.parametrize("received", [None, 10_000])
    def test_not_known_or_clocks_that_disagree(self, received):
        posterior = result(1, 9_000)
        frame = FrameReport(stamp_ns=0, heard_ns=0, outcome="", received_ns=received)
        assert Instance(report=frame, posterior=posterior).latency_us is None
        assert Instance(report=frame, posterior=None).latency_us is None
        assert Instance(report=None, posterior=posterior).latency_us is None
