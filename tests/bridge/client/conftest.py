"""A fake server, and a client that is connected to it; a test gives their options as indirect parameters."""

from collections.abc import AsyncIterator

import pytest

from bridge.client import Ros, connect, rosapi, session
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Accept an answer of rosapi however late a busy machine gives it."""
    for module in (rosapi, session):
        monkeypatch.setattr(module, "_ROSAPI_TIMEOUT", PATIENCE / 2)


@pytest.fixture
async def fake(request: pytest.FixtureRequest) -> AsyncIterator[FakeRosbridge]:
    async with FakeRosbridge(**getattr(request, "param", {})) as fake:
        yield fake


@pytest.fixture
async def ros(request: pytest.FixtureRequest, fake: FakeRosbridge) -> AsyncIterator[Ros]:
    async with connect(fake.uri, **getattr(request, "param", {})) as ros:
        yield ros
