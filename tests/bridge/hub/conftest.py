import asyncio
from collections.abc import Callable

import pytest
import uvloop

from bridge.hub import server


def pytest_asyncio_loop_factories() -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    """The hub's sockets are tested on both event loops: their transports differ."""
    return {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}


@pytest.fixture
def quick_sweeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Silent and stuck clients are looked for often, so that limits of tenths of a second can be tested."""
    monkeypatch.setattr(server, "_SWEEP", 0.02)
    monkeypatch.setattr(server, "_CLOSE_TIMEOUT", 0.3)
