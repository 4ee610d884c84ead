import asyncio
from contextlib import asynccontextmanager

import pytest

from services.sockets.records import Notice, Ready
from tests.services.conftest import until


@asynccontextmanager
async def running(service, link):
    """A service's task, from the time when it is ready."""
    task = asyncio.create_task(service.run())
    await link.until(lambda: task.done() or link.of(Ready))
    yield task
    task.cancel()
    await asyncio.wait([task])


class RecordingLink:
    """A service's link to a master that takes everything, and keeps what it was sent."""

    has_master = True

    def __init__(self):
        self.backlog = 0
        self.sent = []

    def make(self, take):
        self.take = take
        return self

    async def __aenter__(self):
        return self

    async def __aexit__(self, *_):
        pass

    def send(self, record):
        self.sent.append(record)
        return True

    keep, until = send, staticmethod(until)

    def of(self, kind):
        """The records of a kind that were sent."""
        return [each for each in self.sent if isinstance(each, kind)]

    def notice(self, level, sentence):
        self.send(Notice(level, sentence))


@pytest.fixture
def link():
    return RecordingLink()
