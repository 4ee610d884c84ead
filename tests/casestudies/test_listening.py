"""Listening to three topics of a fake server: conditions and limits of the wait."""

import asyncio

import pytest

from bridge.client import connect
from casestudies.listening import listen
from posteriors.errors import BadResultError, NoResultError
from tests.casestudies.pretend_stack import certain, frame_message, posterior_message
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE

TRUTH = "/true"


def pose(seconds):
    return {"header": {"stamp": {"sec": seconds, "nanosec": 0}}, "pose": {"position": {"x": seconds, "y": 0}}}


async def say_frame(fake, number, *, published=True):
    await fake.publish("/bm/frame", frame_message({"sec": number, "nanosec": 0}, number, published=published))
    if published:
        await fake.publish("/BMresults", posterior_message(certain(number)))


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


async def test_a_truth_that_is_a_little_late_is_waited_for(heard, monkeypatch):
    monkeypatch.setattr("casestudies.listening._PATIENCE_S", PATIENCE)
    fake, listener = heard
    await fake.publish(TRUTH, pose(1))
    await say_frame(fake, 2)

    async def late():
        await asyncio.sleep(0.2)
        await fake.publish(TRUTH, pose(2))

    arriving = asyncio.create_task(late())
    assert (await listener.next(PATIENCE)).truth.x == 2
    await arriving


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
    await fake.publish("/BMresults", posterior_message(certain(7)))
    async with asyncio.timeout(PATIENCE):
        instance = await listener.next(1000)
    assert instance.report is None
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
