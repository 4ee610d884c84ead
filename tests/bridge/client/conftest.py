"""A fake server, a client that is connected to it, and a hub; a test gives their options as indirect parameters."""

import pytest

from bridge.client import connect, session, type_checks
from tests.bridge.hub.sockets import running_hub
from tests.fake_rosbridge import FakeRosbridge
from tests.patience import PATIENCE


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """Accept an answer of rosapi however late a busy machine gives it."""
    for module in (type_checks, session):
        monkeypatch.setattr(module, "_ROSAPI_TIMEOUT", PATIENCE / 2)


@pytest.fixture
async def fake(request):
    async with FakeRosbridge(**getattr(request, "param", {})) as fake:
        yield fake


@pytest.fixture
async def hub(request):
    """The URI of a hub; of ROS 2, unless a test gives other options."""
    async with running_hub(**{"ros_version": 2} | getattr(request, "param", {})) as port:
        yield f"ws://127.0.0.1:{port}"


@pytest.fixture
async def ros(request, fake):
    async with connect(fake.uri, **getattr(request, "param", {})) as ros:
        yield ros
