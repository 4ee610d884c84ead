"""Frames: which messages make one, from one topic and from several."""

import math
import struct
from contextlib import nullcontext

import pytest

from bridge.stamps import stamp
from services.errors import VariableError
from services.pipeline.frames import UNPAIRED_WARNING, FrameAssembler, StampGap
from toolchain.deployment import BM1Section, BoardSection, Deployment, Dimension, Source, Variable
from toolchain.deployment.sections import WrittenPrior

HASH = "0" * 64


def deployment(*variables, sources=1, tolerance_s=0.05):
    return Deployment(
        name="test",
        source=[Source(uri="ws://robot:9090", topic=f"/t{at}", type="a/B") for at in range(sources)],
        variable=list(variables),
        searched=[Dimension(label="x", size=4)],
        machine=BM1Section(lines=4),
        board=[BoardSection(image="boards/board0.bm", image_hash=HASH, line_offset=0, lines=4)],
        tolerance_s=tolerance_s,
    )


def variable(name, **settings):
    return Variable(name=name, bits=7, values=101, **settings)


def two_topics(*, tolerance_s=0.05, **second):
    variables = variable("D1"), variable("D2", source=1, **second)
    return FrameAssembler(deployment(*variables, sources=2, tolerance_s=tolerance_s))


def stamped(ms, **values):
    return {"header": {"stamp": stamp(100 * 10**9 + int(ms * 1e6), 2)}, **values}


def test_one_topic_every_message_is_a_frame_with_its_stamp():
    frames = FrameAssembler(deployment(variable("D1"), variable("D2")))
    (reading,) = frames.take(0, stamped(5, D2=7, deep={"D1": 3}), 11, 12)
    assert (reading.addresses, reading.values) == ([3, 7], [3, 7])
    assert reading.stamp_ns == 100_005_000_000
    assert (reading.received_ns, reading.received_tick) == (11, 12)
    (reading,) = frames.take(0, {"D2": 1, "deep": {"D1": 1}}, 77, 0)
    assert reading.stamp_ns == 77  # without a stamp, the receipt


def test_all_missing_variables_are_named():
    frames = FrameAssembler(
        deployment(*map(variable, ("D1", "D2", "D3")), variable("D4", on_missing="missing"))
    )
    with pytest.raises(VariableError) as caught:
        frames.take(0, {"D2": 1}, 0, 0)
    assert ["D1" in str(caught.value), "'D3'" in str(caught.value)] == [True, True]
    assert "'D4'" not in str(caught.value)
    # a null is missing too, and so is a prior that the deployment needs
    prior = WrittenPrior(source=0, path="belief", on_missing="error")
    needs_prior = deployment(variable("D1"), variable("D2")).model_copy(update={"prior": prior})
    for message, names in (
        ({"D2": None}, ("D1", "D2", "belief")),
        ({"D1": 1}, ("D2", "belief")),
        ({"D1": None, "D2": 1, "belief": [1.0] * 4}, ("D1",)),
        ({"D1": 1, "D2": 1}, ("belief",)),
        ({"D1": 1, "D2": 1, "belief": None}, ("belief",)),
    ):
        with pytest.raises(VariableError) as caught:
            FrameAssembler(needs_prior).take(0, message, 0, 0)
        said = str(caught.value).partition("; it has")[0]
        assert [name for name in ("D1", "D2", "belief") if name in said] == list(names)


@pytest.mark.parametrize("message", [{}, {"D1": None}, {"D1": float("nan")}, {"D1": []}])
def test_missing_is_an_error_or_a_missing_address(message):
    with pytest.raises(VariableError, match=r"/t0: .*D1"):
        FrameAssembler(deployment(variable("D1"))).take(0, message, 0, 0)
    optional = FrameAssembler(deployment(variable("D1", on_missing="missing")))
    (reading,) = optional.take(0, message, 0, 0)
    assert (reading.addresses, reading.values) == ([None], [None])


@pytest.mark.parametrize(
    ("value", "address", "kept"),
    [
        *((True, 1, 1.0), (2.25, 2, 2.25), (10**400, 100, math.inf), (-(10**400), 0, -math.inf)),
        ("hall", 1, "hall"),
    ],
)
def test_values_are_kept_as_received(value, address, kept):
    states = ("room", "hall", *map(str, range(99))) if value == "hall" else ()
    frames = FrameAssembler(deployment(variable("D1", on_range="clamp", states=states)))
    (reading,) = frames.take(0, {"D1": value}, 0, 0)
    assert (reading.addresses, reading.values) == ([address], [kept])


@pytest.mark.parametrize("value", ["12", 500, {"a": 1}, [1]])
def test_unusable_values_are_refused(value):
    with pytest.raises(VariableError):
        FrameAssembler(deployment(variable("D1", on_missing="missing"))).take(0, {"D1": value}, 0, 0)


def test_two_topics_are_paired_by_stamp():
    frames = two_topics()
    assert frames.take(0, stamped(0, D1=1), 1, 1) == []
    assert frames.take(0, stamped(100, D1=2), 2, 2) == []
    (reading,) = frames.take(1, stamped(100, D2=9), 3, 3)
    assert (reading.addresses, reading.values, reading.ticks) == ([2, 9], [2, 9], [2, 3])
    assert reading.stamp_ns == 100_100_000_000
    assert frames.unpaired == 1  # the first one's time is over
    assert frames.take(1, stamped(101, D2=9), 4, 4) == []  # the second one is used


def test_a_reading_without_a_topic_that_was_due_says_so():
    frames = two_topics(on_missing="missing")
    assert (frames.needs(0), frames.needs(1)) == (True, False)
    assert frames.take(0, stamped(0, D1=1), 1, 10) == []
    assert frames.deadline == 10 + 50_000_000
    (reading,) = frames.due(frames.deadline)
    assert reading.addresses == [1, None]
    assert dict(frames.absent) == {"/t1": 1}


@pytest.mark.parametrize("needed", [True, False])
def test_a_prior_may_have_a_topic_of_its_own(needed):
    prior = WrittenPrior(source=1, path="belief", on_missing="error" if needed else "model")
    frames = FrameAssembler(deployment(variable("D1"), sources=2).model_copy(update={"prior": prior}))
    assert (frames.needs(0), frames.needs(1)) == (True, needed)
    assert frames.take(0, stamped(0, D1=1), 1, 1) == []
    (reading,) = frames.take(1, stamped(0, belief=[1, 2, 2, 0]), 2, 2)
    assert reading.addresses == [1]
    assert reading.prior_codes == struct.pack("<4H", 128, 255, 255, 0)
    for without in ({}, {"belief": None}):
        with pytest.raises(VariableError) if needed else nullcontext():
            frames.take(1, stamped(100, **without), 3, 3)


def far_apart(ms, count=UNPAIRED_WARNING, **second):
    frames = two_topics()
    for at in range(count):
        frames.take(0, stamped(10 * at, D1=1), 1, 1)
        frames.take(1, stamped(10 * at - ms, D2=1) | second, 10**12, 1)
    return frames


def test_stamps_that_never_meet_are_reported():
    assert far_apart(2000, UNPAIRED_WARNING - 1).stamp_gap() is None
    frames = far_apart(2000)
    assert frames.stamp_gap() == StampGap("/t1", "/t0", 2.0, 0.05, ())
    assert far_apart(-2000).stamp_gap() == StampGap("/t0", "/t1", 2.0, 0.05, ())
    assert far_apart(0, header={}).stamp_gap().without_header == ("/t1",)
    assert frames.take(1, stamped(10 * UNPAIRED_WARNING - 10, D2=1), 1, 1) != []
    assert frames.stamp_gap() is None
