import pytest

from tests.integration.conftest import build_boat
from toolchain.deployment import load_deployment


@pytest.fixture(scope="session")
def boat(tmp_path_factory):
    """The boat's deployment on 8 x 8 cells and four boards."""
    return load_deployment(build_boat(tmp_path_factory.mktemp("boat") / "deployment"))


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


@pytest.fixture
def link():
    return RecordingLink()
