import pytest

from services.sockets.records import Notice


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

    keep = send

    def notice(self, level, sentence):
        self.send(Notice(level, sentence))


@pytest.fixture
def link():
    return RecordingLink()
