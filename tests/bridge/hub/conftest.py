import pytest

from bridge.hub import server
from tests.bridge.hub.broker_harness import Harness


@pytest.fixture
def quick_sweeps(monkeypatch):
    """Silent and stuck clients are looked for often, so that limits of tenths of a second can be tested."""
    monkeypatch.setattr(server, "_SWEEP", 0.02)
    monkeypatch.setattr(server, "_CLOSE_TIMEOUT", 0.3)


@pytest.fixture
def hub():
    return Harness()


@pytest.fixture
def publisher(hub):
    """A client that advertises /t as a/B."""
    peer = hub.connect()
    peer.advertise("/t")
    return peer


@pytest.fixture
def subscriber(hub, publisher):
    """A client that is subscribed to /t, after the publisher came."""
    peer = hub.connect()
    peer.subscribe("/t")
    return peer
