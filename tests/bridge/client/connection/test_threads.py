"""The client of another thread's event loop cannot be called."""

import asyncio

import pytest

from bridge.errors import WrongThreadError
from tests.patience import PATIENCE


async def test_calls_from_another_thread_are_refused_and_change_nothing(fake, ros):
    publication = await ros.advertise("/a", "p/T")
    subscription = ros.subscribe("/b", "p/T")
    calls = (
        lambda: publication.publish_nowait({}),
        lambda: asyncio.run(publication.publish({})),
        lambda: ros.subscribe("/c", "p/T"),
        lambda: asyncio.run(ros.advertise("/c", "p/T")),
        lambda: asyncio.run(ros.call("/rosapi/topics")),
        lambda: asyncio.run(subscription.next(1)),
        lambda: asyncio.run(publication.close()),
        lambda: asyncio.run(ros.close()),
        ros.together,
    )
    for call in calls:
        with pytest.raises(WrongThreadError):
            await asyncio.to_thread(call)
    await publication.publish({"n": 1})
    await fake.wait_for_op("publish", topic="/a")
    await fake.wait_for_op("subscribe", topic="/b")
    await fake.publish("/b", {"n": 2})
    assert (await subscription.next(PATIENCE)).msg == {"n": 2}
