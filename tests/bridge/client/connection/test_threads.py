"""The client of another thread's event loop cannot be called."""

import asyncio

import pytest

from bridge.errors import WrongThreadError
from tests.patience import PATIENCE


@pytest.mark.parametrize(
    "name",
    [
        "publish_nowait",
        "publish",
        "subscribe",
        "advertise",
        "call",
        "next",
        "close",
        "close client",
        "together",
    ],
)
async def test_a_call_from_another_thread_is_refused(fake, ros, name):
    publication = await ros.advertise("/a", "p/T")
    subscription = ros.subscribe("/b", "p/T")
    calls = {
        "publish_nowait": lambda: publication.publish_nowait({}),
        "publish": lambda: asyncio.run(publication.publish({})),
        "subscribe": lambda: ros.subscribe("/c", "p/T"),
        "advertise": lambda: asyncio.run(ros.advertise("/c", "p/T")),
        "call": lambda: asyncio.run(ros.call("/rosapi/topics")),
        "next": lambda: asyncio.run(subscription.next(1)),
        "close": lambda: asyncio.run(publication.close()),
        "close client": lambda: asyncio.run(ros.close()),
        "together": ros.together,
    }
    with pytest.raises(WrongThreadError):
        await asyncio.to_thread(calls[name])
    # and nothing has changed
    await publication.publish({"n": 1})
    await fake.wait_for_op("publish", topic="/a")
    await fake.wait_for_op("subscribe", topic="/b")
    await fake.publish("/b", {"n": 2})
    assert (await subscription.next(PATIENCE)).msg == {"n": 2}
