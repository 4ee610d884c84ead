"""`/BMresults`: messages, and the posteriors that are read from them."""

import base64
import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from posteriors import BadResultError, FrameReport, LabelError, Posterior, StageTimes
from posteriors.posterior import read_posterior, read_samples
from tests.posteriors.messages import JSON, posterior_message, posterior_of


class TestReading:
    @pytest.mark.parametrize(
        ("message", "sizes", "probabilities"),
        [
            (posterior_message([0.5, 0.25, 0.25, 0, 0, 0], 2, 3), (2, 3), (0.5, 0.25, 0.25, 0, 0, 0)),
            (posterior_message([9.0, 0.5, 0.5], 1, 2, offset=1), (1, 2), (0.5, 0.5)),
            ({"data": [0.25, 0.75]}, (2,), (0.25, 0.75)),
        ],
    )
    def test_a_posterior_with_and_without_a_layout(self, message, sizes, probabilities):
        labels = ("y", "x") if "layout" in message else ("cell",)
        expected = Posterior(probabilities=probabilities, labels=labels, sizes=sizes, heard_ns=5)
        assert read_posterior(message, 5) == expected

    def test_values_of_any_size_have_a_mean(self):
        assert read_posterior({"data": [0, 0, 0, 4e307, 4e307]}, 0).mean() == {"cell": 3.5}

    @pytest.mark.parametrize(
        "message",
        [
            *({"data": data} for data in (None, [None], ["x"], [float("nan")], [-0.5])),
            *({"data": data} for data in ([], [0.0, 0.0], [1e308, 1e308])),
            posterior_message([1.0] * 5, 2, 3),
            {"layout": {"dim": [{"label": "x", "size": 1}] * 2}, "data": [1.0]},
            {"layout": {"dim": [{"label": str(at), "size": 1} for at in range(33)]}, "data": [1.0]},
        ],
    )
    def test_a_message_that_is_not_a_posterior_is_refused(self, message):
        with pytest.raises(BadResultError, match="/elsewhere"):
            read_posterior(message, 0, "/elsewhere")


def made(values, labels):
    return posterior_of(np.asarray(values) / np.sum(values), *labels)


def received(heard_ns, **report):
    return posterior_of([1], "x", heard_ns=heard_ns, report=FrameReport(stamp_ns=5, outcome="", **report))


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
        with pytest.raises(LabelError, match="'room'"):
            posterior.marginal("rom")
        with pytest.raises(LabelError, match="room, hour"):
            posterior.at(x=1)
        with pytest.raises(LabelError):
            posterior.marginal("room", "room")

    def test_a_cell_outside_of_the_grid(self):
        posterior = made([[1, 3]], ("y", "x"))
        assert posterior.at(y=0, x=1) == 0.75
        for cell in ({"y": 0, "x": 2}, {"y": 0, "x": -1}, {"y": 0}):
            with pytest.raises(LabelError):
                posterior.at(cell)

    def test_values_need_the_deployment(self):
        posterior = made([[1, 3]], ("y", "x"))
        for values in (posterior.best_value, posterior.mean_value):
            with pytest.raises(LabelError, match="with_units"):
                values()

    def test_entropy_and_total_variation(self):
        even, sure = made([1, 1, 1, 1], ("x",)), made([0, 1, 0, 0], ("x",))
        assert (even.entropy, sure.entropy) == (2.0, 0.0)
        assert (even.total_variation(even), even.total_variation(sure)) == (0.0, 0.75)
        with pytest.raises(LabelError):
            even.total_variation(made([1, 1, 1, 1], ("y",)))

    def test_its_report_tells_its_frame_and_its_times_where_clocks_agree(self):
        bare = made([1, 1], ("x",))
        assert (bare.number, bare.stamp_ns, bare.cycles) == (None, None, None)
        assert (bare.latency_us, bare.rosbridge_out_us, bare.stages) == (None, None, StageTimes())
        posterior = received(9_000, number=3, cycles=7, received_ns=1_000, sent_ns=5_000)
        assert (posterior.latency_us, posterior.rosbridge_out_us) == (8.0, 4.0)
        assert (posterior.number, posterior.stamp_ns, posterior.cycles) == (3, 5, 7)
        assert received(9_000, received_ns=10_000).latency_us is None


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
def test_hostile_posteriors_are_read_or_refused_in_one_sentence(message):
    try:
        posterior = read_posterior(message, 0)
    except BadResultError as error:
        assert len(str(error)) < 1000
        return
    assert posterior.at(posterior.best()) == posterior.probability
    assert list(posterior.mean()) == list(posterior.labels)
    assert posterior.values.shape == posterior.sizes


def test_one_replica_by_itself():
    both = Posterior(
        probabilities=(0.25, 0.75, 0.0, 0.0, 1.0, 0.0), labels=("replica", "s"), sizes=(3, 2), heard_ns=5
    )
    assert both.replicas == 3
    first = both.replica(0)
    assert (first.probabilities, first.labels, first.sizes) == ((0.25, 0.75), ("s",), (2,))
    assert first.best() == {"s": 1}
    assert both.replica(2).best() == {"s": 0}
    assert first.replica(0) is first
    for at in (1, 3, -1):
        with pytest.raises(LabelError):
            both.replica(at)


LAYOUT = {"dim": [{"size": 2}, {"size": 8}]}


@pytest.mark.parametrize("form", [list, bytes, lambda octets: base64.b64encode(octets).decode()])
def test_samples_arrive_in_each_form_of_bytes(form):
    message = {"layout": LAYOUT, "data": form(struct.pack("<4I", 1, 2, 3, 0xABC))}
    assert read_samples(message).tolist() == [[1, 2], [3, 0xABC]]


@pytest.mark.parametrize(
    "message",
    [
        {},
        {"layout": LAYOUT, "data": [1]},
        {"layout": LAYOUT, "data": 10**12},
        {"layout": {"dim": []}, "data": [0] * 8},
        {"layout": {"dim": [{"size": 2}, {"size": math.inf}]}, "data": [0] * 8},
    ],
)
def test_messages_that_are_no_samples(message):
    with pytest.raises(BadResultError, match="/bm/samples"):
        read_samples(message)


def test_the_values_in_a_state_follow_each_other_from_its_low_bit():
    sizes = (2, 5, 1, 2**20, 2**12, 3)
    values = [1, 4, 0, 2**20 - 2, 2**12 - 1, 3]  # the last one is an unused code
    state = 1 | 4 << 1 | (2**20 - 2) << 4 | (2**12 - 1) << 24 | 3 << 36
    message = {"layout": LAYOUT, "data": state.to_bytes(8, "little") + bytes(8)}
    assert read_samples(message, sizes).tolist() == [values, [0] * 6]
    with pytest.raises(BadResultError, match="this machine"):
        read_samples(message, (*sizes, 2**30))
