"""Result topics: what is read from them, and which posterior belongs to which frame.

The wire, as the publisher sends it:   frame 1, result 1, frame 2, result 2, ...
The two topics are handed over one by one, so any order across topics must give the same pairs.
"""

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from posteriors.errors import BadResultError, LabelError
from posteriors.frame_report import FrameReport, StageTimes, read_frame_report
from posteriors.pairing import WAITING, Pairing
from posteriors.posterior import Posterior, read_posterior


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
        assert (report.outcome, report.deployment) == ("overflow", "boat")
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
        assert posterior.probabilities == (0.5, 0.25, 0.25, 0, 0, 0)
        assert posterior.sizes == (2, 3)
        assert posterior.labels == ("y", "x")
        assert posterior.heard_ns == 5

    def test_a_posterior_without_a_layout(self):
        posterior = read_posterior({"data": [0.25, 0.75]}, 0)
        assert (posterior.sizes, posterior.labels, posterior.best()) == ((2,), ("cell",), {"cell": 1})

    def test_values_of_any_size_have_a_mean(self):
        assert read_posterior({"data": [0, 0, 0, 4e307, 4e307]}, 0).mean() == {"cell": 3.5}

    def test_a_posterior_behind_an_offset(self):
        message = posterior_message([9.0, 0.5, 0.5], 1, 2)
        message["layout"]["data_offset"] = 1
        assert read_posterior(message, 0).probabilities == (0.5, 0.5)

    @pytest.mark.parametrize("data", [None, [None], ["x"], [float("nan")], [-0.5]])
    def test_what_is_no_posterior(self, data):
        with pytest.raises(BadResultError, match="/BMresults is not the std_msgs/Float64MultiArray"):
            read_posterior({"data": data}, 0)

    @pytest.mark.parametrize(("data", "sizes"), [([1.0] * 5, (2, 3)), ([], ())])
    def test_a_layout_of_something_else(self, data, sizes):
        with pytest.raises(BadResultError, match="its layout says"):
            read_posterior(posterior_message(data, *sizes), 0)

    @pytest.mark.parametrize("data", [[0.0, 0.0], [1e308, 1e308]])
    def test_what_has_no_probability(self, data):
        with pytest.raises(BadResultError, match="/elsewhere has no probability in any of its 2 values"):
            read_posterior({"data": data}, 0, "/elsewhere")

    def test_two_dimensions_of_one_name(self):
        message = posterior_message([0.5, 0.5], 1, 2)
        message["layout"]["dim"][0]["label"] = "x"
        with pytest.raises(BadResultError, match="two dimensions of one name among x, x"):
            read_posterior(message, 0)

    def test_more_dimensions_than_arrays_have(self):
        dims = [{"label": str(at), "size": 1} for at in range(33)]
        with pytest.raises(BadResultError, match="at most 32 items"):
            read_posterior({"layout": {"dim": dims}, "data": [1.0]}, 0)


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


def told(heard):
    """(frame number, result's value) of each."""
    return [(each.number, each.probabilities[0] if isinstance(each, Posterior) else None) for each in heard]


class TestPairing:
    def test_a_result_goes_to_the_frame_before_it(self):
        pairing = Pairing()
        assert pairing.add_report(report(1, 10)) == []
        assert told(pairing.add_posterior(result(1, 11))) == [(1, 1)]

    @given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.sets(st.integers(1, 12)))
    def test_the_order_across_topics_does_not_matter(self, seed, frames, without):
        """Whatever interleaving of the two topics: the pairs are the same, and none is said twice."""
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
        assert told(heard) == [(n, None if n in without else n) for n in range(1, frames + 1)]
        assert pairing.announced_only == 0

    def test_a_result_whose_report_was_lost(self):
        pairing = Pairing()
        pairing.add_posterior(result(1, 11))
        assert pairing.waits
        assert told(pairing.add_report(report(2, 20))) == [(None, 1)]
        assert not pairing.waits
        assert told(pairing.add_posterior(result(2, 21))) == [(2, 2)]

    def test_a_report_whose_result_was_lost(self):
        pairing = Pairing()
        pairing.add_report(report(1, 10))
        pairing.add_report(report(2, 20))
        assert told(pairing.add_posterior(result(2, 21))) == [(2, 2)]
        assert pairing.announced_only == 1

    def test_a_server_that_swaps_a_report_and_its_result(self):
        pairing = Pairing(disorder_ns=5)
        heard = pairing.add_posterior(result(1, 10)) + pairing.add_report(report(1, 14))
        heard += pairing.add_report(report(2, 20)) + pairing.add_posterior(result(2, 21))
        heard += pairing.add_posterior(result(3, 30)) + pairing.add_report(report(3, 33))
        assert told(heard) == [(1, 1), (2, 2), (3, 3)]
        pairing.add_report(report(4, 40))  # its result is lost
        pairing.add_report(report(5, 50))
        assert told(pairing.add_posterior(result(5, 55))) == [(5, 5)]
        assert pairing.announced_only == 1

    def test_results_without_any_report_come_out_at_the_end(self):
        pairing = Pairing()
        pairing.add_posterior(result(1, 11))
        assert told(pairing.flush()) == [(None, 1)]
        assert pairing.flush() == []

    def test_memory_is_bounded_where_only_one_topic_speaks(self):
        reports, results = Pairing(), Pairing()
        came = 0
        for number in range(4 * WAITING):
            reports.add_report(report(number, number))
            came += len(results.add_posterior(result(number + 1, number)))
        assert len(reports._reports) == len(results._posteriors) == WAITING
        assert came == reports.announced_only == 3 * WAITING


def made(values, labels):
    values = np.asarray(values, float)
    return Posterior(
        probabilities=tuple((values / values.sum()).ravel().tolist()),
        labels=labels,
        sizes=values.shape,
        heard_ns=0,
    )


class TestPosterior:
    @given(
        arrays.arrays(
            np.float64, arrays.array_shapes(min_dims=3, max_dims=3, max_side=5), elements=st.floats(0.01, 1)
        )
    )
    def test_its_numbers_are_those_of_numpy(self, values):
        posterior = made(values, ("z", "y", "x"))
        normal = values / values.sum()
        np.testing.assert_array_equal(posterior.values, normal)
        np.testing.assert_allclose(posterior.marginal("y"), normal.sum(axis=(0, 2)))
        np.testing.assert_allclose(posterior.marginal("x", "z"), normal.sum(axis=1).T)
        np.testing.assert_allclose(posterior.marginal(), 1.0)
        best = np.unravel_index(normal.argmax(), normal.shape)
        assert tuple(posterior.best().values()) == best
        assert posterior.probability == posterior.at(posterior.best()) == normal[best]
        means = [
            (normal * np.arange(size).reshape(shape)).sum()
            for size, shape in zip(values.shape, [(-1, 1, 1), (1, -1, 1), (1, 1, -1)], strict=True)
        ]
        assert list(posterior.mean().values()) == pytest.approx(means)

    def test_its_array_is_made_once_and_read_only(self):
        posterior = made([[1, 3]], ("y", "x"))
        assert posterior.values is posterior.values
        with pytest.raises(ValueError, match="read-only"):
            posterior.values[0, 0] = 1

    def test_a_wrong_name_gets_the_nearest_right_one(self):
        posterior = made([[1, 3]], ("room", "hour"))
        with pytest.raises(LabelError, match="no variable 'rom'; did you mean 'room'"):
            posterior.marginal("rom")
        with pytest.raises(LabelError, match="no variable 'x'; there are room, hour"):
            posterior.at(x=1)
        with pytest.raises(LabelError, match="each label once"):
            posterior.marginal("room", "room")

    def test_a_cell_outside_of_the_grid(self):
        posterior = made([[1, 3]], ("y", "x"))
        assert posterior.at(y=0, x=1) == 0.75
        with pytest.raises(LabelError, match="x = 2: x goes from 0 to 1"):
            posterior.at(y=0, x=2)
        with pytest.raises(LabelError, match="x = -1"):
            posterior.at(y=0, x=-1)
        with pytest.raises(LabelError, match="no x: x goes"):
            posterior.at(y=0)

    def test_without_a_report_nothing_is_known_of_its_frame(self):
        posterior = made([1, 1], ("x",))
        assert (posterior.number, posterior.stamp_ns, posterior.cycles) == (None, None, None)
        assert (posterior.latency_us, posterior.rosbridge_out_us) == (None, None)
        assert posterior.stages == StageTimes()

    def test_times_from_the_reading_and_from_the_sending(self):
        frame = FrameReport(
            stamp_ns=5, heard_ns=0, outcome="", number=3, cycles=7, received_ns=1_000, sent_ns=5_000
        )
        pairing = Pairing()
        pairing.add_report(frame)
        (posterior,) = pairing.add_posterior(result(1, 9_000))
        assert (posterior.latency_us, posterior.rosbridge_out_us) == (8.0, 4.0)
        assert (posterior.number, posterior.stamp_ns, posterior.cycles) == (3, 5, 7)

    def test_clocks_that_disagree_give_no_time(self):
        pairing = Pairing()
        pairing.add_report(FrameReport(stamp_ns=0, heard_ns=0, outcome="", received_ns=10_000))
        (posterior,) = pairing.add_posterior(result(1, 9_000))
        assert posterior.latency_us is None


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.integers(10**18, 10**400)
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from(["9" * 5000, "1e999", "nan", "true"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)


class TestHostile:
    """Whatever comes on the topics is read or refused in one sentence; what was read can be used."""

    @given(
        st.dictionaries(st.sampled_from(["layout", "data"]), JSON)
        | st.fixed_dictionaries(
            {
                "data": st.lists(st.floats(0, 1) | JSON, max_size=6),
                "layout": st.fixed_dictionaries(
                    {
                        "dim": st.lists(
                            st.fixed_dictionaries(
                                {"label": st.text(max_size=2), "size": st.integers(0, 3) | JSON}
                            ),
                            max_size=3,
                        ),
                        "data_offset": st.integers(0, 2) | JSON,
                    }
                ),
            }
        )
    )
    def test_posteriors(self, message):
        try:
            posterior = read_posterior(message, 0)
        except BadResultError as error:
            assert len(str(error)) < 1000
            return
        assert posterior.at(posterior.best()) == posterior.probability
        assert list(posterior.mean()) == list(posterior.labels)
        assert posterior.values.shape == posterior.sizes

    @given(
        st.dictionaries(st.sampled_from(["header", "status"]), JSON),
        st.dictionaries(
            st.sampled_from(["number", "published", "cycles", "received_ns", "sent_ns", "compute_us"]),
            JSON.map(str),
        ),
    )
    def test_reports(self, wild, values):
        for message in (wild, frame_message(**values), frame_message() | wild):
            try:
                report = read_frame_report(message, 0)
            except BadResultError as error:
                assert len(str(error)) < 1000
                continue
            pairing = Pairing()
            for heard in [*pairing.add_report(report), *pairing.add_posterior(result(1, 5))]:
                if isinstance(heard, Posterior):
                    assert heard.latency_us is None or heard.latency_us >= 0


def test_one_replica_by_itself():
    both = Posterior(
        probabilities=(0.25, 0.75, 0.0, 0.0, 1.0, 0.0),
        labels=("replica", "s"),
        sizes=(3, 2),
        heard_ns=5,
    )
    assert both.replicas == 3
    first = both.replica(0)
    assert (first.probabilities, first.labels, first.sizes) == ((0.25, 0.75), ("s",), (2,))
    assert first.best() == {"s": 1}
    assert both.replica(2).best() == {"s": 0}
    assert first.replica(0) is first
    with pytest.raises(LabelError, match="replica 1 has no posterior in this frame"):
        both.replica(1)
    with pytest.raises(LabelError, match="there is no replica 3: expected 0 to 2"):
        both.replica(3)
