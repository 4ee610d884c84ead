"""A fake server, and a client that is connected to it; a test gives their options as indirect parameters."""

from collections.abc import AsyncIterator

import pytest

from bridge.client import Ros, connect
from tests.fake_rosbridge import FakeRosbridge


@pytest.fixture
async def fake(request: pytest.FixtureRequest) -> AsyncIterator[FakeRosbridge]:
    async with FakeRosbridge(**getattr(request, "param", {})) as fake:
        yield fake


@pytest.fixture
async def ros(request: pytest.FixtureRequest, fake: FakeRosbridge) -> AsyncIterator[Ros]:
    async with connect(fake.uri, **getattr(request, "param", {})) as ros:
        yield ros
