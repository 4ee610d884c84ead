"""A fake server, and a client that is connected to it; a test gives their options as indirect parameters."""

import pytest

from bridge.client import connect, rosapi, session
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """Accept an answer of rosapi however late a busy machine gives it."""
    for module in (rosapi, session):
        monkeypatch.setattr(module, "_ROSAPI_TIMEOUT", PATIENCE / 2)


@pytest.fixture
async def fake(request):
    async with FakeRosbridge(**getattr(request, "param", {})) as fake:
        yield fake


@pytest.fixture
async def ros(request, fake):
    async with connect(fake.uri, **getattr(request, "param", {})) as ros:
        yield ros
