"""Frames with their truth, matched by stamps, from a list and from a server."""

import asyncio

import pytest

from bridge.client import connect
from casestudies.topics import Listener, Truth, listen, read_truth
from posteriors.errors import BadResultError, NoResultError
from posteriors.frame_report import FrameReport
from posteriors.posterior import Posterior
from tests.casestudies.pretend_stack import certain, frame_message
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE
from tests.posteriors.messages import posterior_message


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


class Heard:
    """Frames in place of those of a server."""

    def __init__(self, *frames):
        self.frames = list(frames)

    async def next_frame(self, _limit_s):
        return self.frames.pop(0)


async def test_a_late_truth_is_waited_for_until_a_newer_one_comes(monkeypatch):
    monkeypatch.setattr("casestudies.topics._PATIENCE_S", PATIENCE)
    listener = Listener(Heard(frame(2), frame(3)), 0)
    listener.add_truth(truth(1))
    heard = []
    for newer in (2, 4):
        waiting = asyncio.create_task(listener.next(PATIENCE))
        done, _ = await asyncio.wait({waiting}, timeout=0.01)
        assert not done
        listener.add_truth(truth(newer))
        heard.append(await waiting)
    assert told(heard) == [(2, 2), (3, None)]


async def test_frames_do_not_wait_for_truths_that_have_stopped(monkeypatch):
    monkeypatch.setattr("casestudies.topics._PATIENCE_S", 0.01)
    listener = Listener(Heard(frame(1), frame(2), frame(3), frame(4)), 0)
    heard = [await listener.next(PATIENCE)]  # there was none at all
    listener.add_truth(truth(1))
    heard.append(await listener.next(PATIENCE))
    monkeypatch.setattr("casestudies.topics._PATIENCE_S", 2 * PATIENCE)
    async with asyncio.timeout(PATIENCE):
        heard.append(await listener.next(PATIENCE))
    listener.add_truth(truth(4))
    heard.append(await listener.next(PATIENCE))
    assert told(heard) == [(1, None), (2, None), (3, None), (4, 4)]


@pytest.mark.parametrize(("tolerance_ns", "served"), [(50, True), (39, False)])
async def test_an_older_truth_serves_within_the_tolerance(tolerance_ns, served):
    listener = Listener(Heard(frame(1, stamp=1000)), tolerance_ns)
    listener.add_truth(truth(1, stamp=960))
    listener.add_truth(truth(2, stamp=1030))
    instance = await listener.next(PATIENCE)
    assert told([instance]) == [(1, 1 if served else None)]
    assert instance.truth_age_ns == (40 if served else 0)


def test_memory_is_bounded():
    listener = Listener(Heard(), 0)
    for number in range(100_010):
        listener.add_truth(truth(number))
    assert len(listener.route) == 100_000


TRUTH = "/true"


def pose(seconds):
    return {"header": {"stamp": {"sec": seconds, "nanosec": 0}}, "pose": {"position": {"x": seconds, "y": 0}}}


async def say_frame(fake, number, *, published=True):
    await fake.publish("/bm/frame", frame_message({"sec": number, "nanosec": 0}, number, published=published))
    if published:
        await fake.publish("/BMresults", posterior_message(certain(number), 32, 32))


@pytest.fixture
async def heard():
    async with FakeRosbridge() as fake, connect(fake.uri) as ros, listen(ros, truth_topic=TRUTH) as listener:
        await fake.wait_for_op("subscribe", topic=TRUTH)
        yield fake, listener


async def test_frames_come_with_their_posterior_and_truth(heard):
    fake, listener = heard
    for number in (1, 2, 3):
        await fake.publish(TRUTH, pose(number))
        await say_frame(fake, number, published=number != 2)
    instances = [await listener.next(PATIENCE) for _ in range(3)]
    assert [i.report.number for i in instances] == [1, 2, 3]
    assert [i.truth.x for i in instances] == [1, 2, 3]
    assert [i.posterior is None for i in instances] == [False, True, False]
    assert [i.posterior.probabilities.index(1.0) for i in instances[::2]] == [1, 3]
    assert [truth.x for truth in listener.route] == [1, 2, 3]


async def test_a_truth_that_never_comes_is_not_waited_for_to_the_limit(heard):
    fake, listener = heard
    await fake.publish(TRUTH, pose(1))
    await say_frame(fake, 2)
    async with asyncio.timeout(PATIENCE):
        instance = await listener.next(1000)
    assert instance.truth is None
    assert instance.posterior is not None


async def test_a_result_without_a_report_is_handed_out_too(heard):
    fake, listener = heard
    await fake.publish(TRUTH, pose(1))
    await fake.publish("/BMresults", posterior_message(certain(7), 32, 32))
    async with asyncio.timeout(PATIENCE):
        instance = await listener.next(1000)
    assert (instance.report, instance.truth) == (None, None)
    assert instance.posterior.probabilities.index(1.0) == 7


async def test_silence_is_named(heard):
    fake, listener = heard
    with pytest.raises(NoResultError, match=fake.uri):
        await listener.next(0.1)
    await say_frame(fake, 1)
    assert (await listener.next(PATIENCE)).report.number == 1


@pytest.mark.parametrize("topic", ["/bm/frame", "/BMresults", TRUTH])
async def test_nonsense_is_named(heard, topic):
    fake, listener = heard
    await fake.publish(topic, {"data": "nonsense"})
    with pytest.raises(BadResultError, match=topic):
        await listener.next(PATIENCE)
